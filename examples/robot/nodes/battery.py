#!/usr/bin/python3
"""The battery: publishes its charge once a second and on /diagnostics."""

import diagnostic_updater
import rospy
from sensor_msgs.msg import BatteryState


def main():
    rospy.init_node("battery")
    states = rospy.Publisher("~state", BatteryState, queue_size=10)
    state = BatteryState(percentage=1.0, voltage=25.2, present=True)
    updater = diagnostic_updater.Updater()
    updater.setHardwareID("battery")

    def charge(status):
        low = state.percentage < rospy.get_param("~warn_below")
        status.summary(status.WARN if low else status.OK, "%d %%" % (100 * state.percentage))
        return status

    updater.add("battery: charge", charge)
    rate = rospy.Rate(1)
    while not rospy.is_shutdown():
        state.header.stamp = rospy.Time.now()
        state.percentage = max(0.1, state.percentage - 0.0001)
        states.publish(state)
        updater.update()
        rate.sleep()


if __name__ == "__main__":
    try:
        main()
    except rospy.ROSInterruptException:
        pass
