#!/usr/bin/python3
"""A node with any number of publishers, subscribers, services and parameter subscriptions.
Usage: multi.py [pub:TOPIC|sub:TOPIC|srv:SERVICE|param:KEY]...

Each publisher sends ten messages a second. The node prints no `got` lines, because there could be too many.
"""

import rospy
from roscpp.srv import GetLoggers, GetLoggersResponse
from std_msgs.msg import String

from lines import say, ticks


def main():
    rospy.init_node("multi")
    publishers = []
    for argument in rospy.myargv()[1:]:
        kind, _, name = argument.partition(":")
        if kind == "pub":
            publishers.append(rospy.Publisher(name, String, queue_size=10))
        elif kind == "sub":
            rospy.Subscriber(name, String, lambda _message: None)
        elif kind == "srv":
            rospy.Service(name, GetLoggers, lambda _request: GetLoggersResponse([]))
        elif kind == "param":
            rospy.get_param_cached(name, None)
        else:
            raise SystemExit("`%s` is none of pub:, sub:, srv:, param:" % argument)
    say("ready", rospy.get_name())
    for number, _ in enumerate(ticks(10), 1):
        for publisher in publishers:
            publisher.publish("%s %d" % (rospy.get_name(), number))


if __name__ == "__main__":
    main()
