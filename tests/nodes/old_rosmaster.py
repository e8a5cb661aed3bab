#!/usr/bin/python3
"""A real rosmaster that refuses and notifies like 1.14.3. Like waiting_rosmaster.py, it starts only when
there is no file `away` in `ROS_HOME`."""

import os
import time

import rosmaster
import rosmaster.paramserver
from rosmaster.master_api import ROSMasterHandler

compute = rosmaster.paramserver.compute_param_updates
rosmaster.paramserver.compute_param_updates = lambda subscribers, key, value, _ignored=None: compute(
    subscribers, key, value
)
look_up = ROSMasterHandler.lookupService


def look_up_as_before(self, *arguments):
    code, message, value = look_up(self, *arguments)
    return code, message, value or 0


ROSMasterHandler.lookupService = look_up_as_before

away = os.path.join(os.environ["ROS_HOME"], "away")
while os.path.exists(away):
    time.sleep(0.02)
rosmaster.rosmaster_main()
