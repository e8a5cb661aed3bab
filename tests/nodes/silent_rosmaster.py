#!/usr/bin/python3
"""A real rosmaster whose notifier threads never wake: it changes its state, and tells no node of it."""

import rosmaster
from rosmaster.threadpool import ThreadPoolThread

ThreadPoolThread.threadSleepTime = 86400
rosmaster.rosmaster_main()
