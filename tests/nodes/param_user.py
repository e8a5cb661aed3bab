#!/usr/bin/python3
"""Prints the value of `get_param_cached` for a parameter whenever it changes. Usage: param_user.py KEY

After the first read, only a paramUpdate of the master changes the cache. rospy before 1.14.4 has no cache and asks.
"""

import json

import rospy

from lines import say, ticks


look = getattr(rospy, "get_param_cached", rospy.get_param)


def main():
    key = rospy.myargv()[1]
    rospy.init_node("param_user")
    look(key, None)
    say("ready", rospy.get_name())
    seen = object()
    for _ in ticks(50):
        try:
            value = look(key, None)
            if value != seen:
                say("value", json.dumps(value))
                seen = value
        except Exception as error:  # a failed read must be reported to the test, not end the node
            say("failed", type(error).__name__, error)
            rospy.sleep(0.1)


if __name__ == "__main__":
    main()
