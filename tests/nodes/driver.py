#!/usr/bin/python3
"""A typical robot driver. It publishes at 50 Hz, reads a parameter and logs at 10 Hz, and runs `diagnostic_updater`,
which reads its period at 4 Hz. Five times a second it prints the time of its longest pass since the last such line, in
milliseconds. With `writes` it also sets a parameter in each pass, and advertises and unregisters a topic once a second.

As on most robots, neither `~diagnostic_period` nor `/rosout_disable_topics_generation` is set, so rospy's
`get_param_cached` calls `subscribeParam` each time.
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
