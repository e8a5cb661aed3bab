#!/usr/bin/python3
"""A real rosmaster that speaks HTTP/1.0, as on a kernel before 4.16. Like waiting_rosmaster.py, it starts only when
there is no file `away` in `ROS_HOME`."""

import os
import platform
import time

platform.release = lambda: "4.9.0"

import rosmaster

away = os.path.join(os.environ["ROS_HOME"], "away")
while os.path.exists(away):
    time.sleep(0.02)
rosmaster.rosmaster_main()
