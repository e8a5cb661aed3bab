#!/usr/bin/python3
"""Reads a parameter again and again, with a default value that it should never get. Usage: reader.py KEY [HZ]

It starts reading before it registers as a node, because a held registration blocks all other calls of a rospy process.
"""

import rospy

from lines import say, ticks

DEFAULT = -1


def read(key, count):
    """Reads once and prints how often it has."""
    try:
        value = rospy.get_param(key, DEFAULT)
        if value == DEFAULT or rospy.has_param("/not/there"):
            say("failed", "it got its default")
    except Exception as error:  # an error that would end a node must be reported to the test
        say("failed", type(error).__name__, error)
    if count % 10 == 0:
        say("reads", count)


def main():
    arguments = rospy.myargv()
    key = arguments[1]
    hz = float(arguments[2]) if len(arguments) > 2 else 50.0
    for count in range(1, 21):
        read(key, count)
    rospy.init_node("reader")
    say("ready", rospy.get_name())
    for count, _ in enumerate(ticks(hz), count + 1):
        read(key, count)


if __name__ == "__main__":
    main()
