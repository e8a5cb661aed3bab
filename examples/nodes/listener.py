#!/usr/bin/python3
"""Prints each message on `count` as a line "TIME NUMBER", with TIME in seconds since 1970."""

import time

import rospy
from std_msgs.msg import UInt64

rospy.init_node("listener")
rospy.Subscriber("count", UInt64, lambda message: print("%.6f %d" % (time.time(), message.data), flush=True))
rospy.spin()
