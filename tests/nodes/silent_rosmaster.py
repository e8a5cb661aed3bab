#!/usr/bin/python3
"""A real rosmaster whose notifying threads never wake up: it changes its state and tells no node."""

import rosmaster
from rosmaster.threadpool import ThreadPoolThread

ThreadPoolThread.threadSleepTime = 86400
rosmaster.rosmaster_main()
