#!/usr/bin/python3
"""The arm: swings its joints, and folds them on request."""

import math

import rospy
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, SetBoolResponse


def main():
    rospy.init_node("arm")
    names = rospy.get_param("~joints")
    amplitude = rospy.get_param("~amplitude", 0.5)
    folded = [False]

    def fold(request):
        folded[0] = request.data
        return SetBoolResponse(True, "folded" if request.data else "unfolded")

    rospy.Service("fold", SetBool, fold)
    states = rospy.Publisher("joint_states", JointState, queue_size=100)
    rate = rospy.Rate(20)
    while not rospy.is_shutdown():
        now = rospy.Time.now()
        angle = 0 if folded[0] else amplitude * math.sin(now.to_sec())
        state = JointState(name=names, position=[angle * (1 + i) / 2 for i in range(len(names))])
        state.header.stamp = now
        states.publish(state)
        rate.sleep()


if __name__ == "__main__":
    try:
        main()
    except rospy.ROSInterruptException:
        pass
