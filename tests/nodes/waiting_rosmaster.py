#!/usr/bin/python3
"""A real rosmaster that begins only when the file `away` in `ROS_HOME` is not there (any more)."""

import os
import time

import rosmaster

away = os.path.join(os.environ["ROS_HOME"], "away")
while os.path.exists(away):
    time.sleep(0.02)
rosmaster.rosmaster_main()
