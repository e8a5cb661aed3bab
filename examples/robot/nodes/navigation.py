#!/usr/bin/python3
"""Drives to a goal: an action server for `move_base`. A drive takes `~seconds`."""

import actionlib
import rospy
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from move_base_msgs.msg import MoveBaseAction, MoveBaseFeedback, MoveBaseResult
from nav_msgs.msg import Path
from std_srvs.srv import Empty, EmptyResponse


def main():
    rospy.init_node("navigation")
    commands = rospy.Publisher("cmd_vel", Twist, queue_size=1)
    plans = rospy.Publisher("~plan", Path, latch=True, queue_size=1)
    here = PoseWithCovarianceStamped()

    def pose(message):
        here.header, here.pose = message.header, message.pose

    rospy.Subscriber("pose", PoseWithCovarianceStamped, pose)
    rospy.Service("~clear_costmaps", Empty, lambda _request: EmptyResponse())

    def drive(goal):
        plans.publish(Path(header=goal.target_pose.header, poses=[goal.target_pose]))
        speed = Twist()
        speed.linear.x = rospy.get_param("~max_speed")
        speed.angular.z = 0.3
        end = rospy.Time.now() + rospy.Duration(rospy.get_param("~seconds"))
        while rospy.Time.now() < end and not rospy.is_shutdown():
            if server.is_preempt_requested():
                server.set_preempted()
                return
            commands.publish(speed)
            feedback = MoveBaseFeedback()
            feedback.base_position.header, feedback.base_position.pose = here.header, here.pose.pose
            server.publish_feedback(feedback)
            rospy.sleep(0.1)
        commands.publish(Twist())
        server.set_succeeded(MoveBaseResult())

    server = actionlib.SimpleActionServer("move_base", MoveBaseAction, drive, auto_start=False)
    server.start()
    rospy.spin()


if __name__ == "__main__":
    try:
        main()
    except rospy.ROSInterruptException:
        pass
