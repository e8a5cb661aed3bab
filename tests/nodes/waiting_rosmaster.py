#!/usr/bin/python3
"""A real rosmaster that starts only when there is no file `away` in `ROS_HOME`."""

import os
import time

import rosmaster

away = os.path.join(os.environ["ROS_HOME"], "away")
while os.path.exists(away):
    time.sleep(0.02)
rosmaster.rosmaster_main()
