#!/usr/bin/python3
"""Publishes 1, 2, 3, … on `count`, 50 times a second."""

import rospy
from std_msgs.msg import UInt64

rospy.init_node("talker")
publisher = rospy.Publisher("count", UInt64, queue_size=100)
rate = rospy.Rate(50)
number = 0
while not rospy.is_shutdown():
    number += 1
    publisher.publish(number)
    try:
        rate.sleep()
    except rospy.ROSInterruptException:
        break
