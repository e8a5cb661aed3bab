#!/usr/bin/python3
"""Offers the service `who`, which answers with the name of this node.

Its type is roscpp/GetLoggers, which every ROS installation provides for both rospy and roscpp.
"""

import rospy
from roscpp.msg import Logger
from roscpp.srv import GetLoggers, GetLoggersResponse

from lines import say

calls = 0


def answer(_request):
    """Answers with the name of this node, and counts the call."""
    global calls
    calls += 1
    say("called", calls)
    return GetLoggersResponse([Logger(rospy.get_name(), "INFO")])


def main():
    rospy.init_node("server")
    rospy.Service("who", GetLoggers, answer)
    say("ready", rospy.get_name())
    rospy.spin()


if __name__ == "__main__":
    main()
