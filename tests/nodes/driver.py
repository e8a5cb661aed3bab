#!/usr/bin/python3
"""A driver as robots have them: at 50 Hz it publishes, at 10 Hz it reads a parameter and logs, and it runs
`diagnostic_updater`, which asks for its period at 4 Hz. It says each fifth of a second how long its longest pass took
in milliseconds since it last said so. With `writes` it also sets a parameter each time, and advertises a topic and takes
it back once a second.

Neither `~diagnostic_period` nor `/rosout_disable_topics_generation` is set, as on most robots: rospy's
`get_param_cached` then calls `subscribeParam` each time.
"""

import sys
import time

import diagnostic_updater
import rospy
from std_msgs.msg import String

from lines import say, ticks

HZ = 50


def main():
    rospy.init_node("driver")
    publisher = rospy.Publisher("~odometry", String, queue_size=10)
    updater = diagnostic_updater.Updater()
    updater.setHardwareID("none")
    updater.add("state", lambda status: status.summary(0, "OK") or status)
    say("ready", rospy.get_name())
    longest = 0.0
    for number, _ in enumerate(ticks(HZ), 1):
        begin = time.monotonic()
        publisher.publish("%s %d" % (rospy.get_name(), number))
        if number % (HZ // 10) == 0:
            rospy.get_param("/gain", 0)
            rospy.loginfo("pass %d", number)
            if "writes" in sys.argv:
                rospy.set_param("~pass", number)
        if number % HZ == 0 and "writes" in sys.argv:
            rospy.Publisher("~now_and_then", String, queue_size=1).unregister()
        updater.update()
        longest = max(longest, time.monotonic() - begin)
        if number % (HZ // 5) == 0:
            say("pass", "%.1f" % (longest * 1e3))
            longest = 0.0


if __name__ == "__main__":
    main()
