#!/usr/bin/python3
"""Calls the service `who` again and again, with a new lookup each time. Usage: client.py [HZ]"""

import rospy
from roscpp.srv import GetLoggers

from lines import say, ticks


def main():
    arguments = rospy.myargv()
    hz = float(arguments[1]) if len(arguments) > 1 else 5.0
    rospy.init_node("client")
    rospy.wait_for_service("who")
    say("ready", rospy.get_name())
    ask = rospy.ServiceProxy("who", GetLoggers)
    for _ in ticks(hz):
        try:
            say("reply", ask().loggers[0].name)
        except rospy.ServiceException as error:
            say("failed", error)
        except rospy.ROSInterruptException:
            break


if __name__ == "__main__":
    main()
