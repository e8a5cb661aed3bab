#!/usr/bin/python3
"""Sends the robot from one place in `~places` to the next, forever."""

import itertools

import actionlib
import rospy
from move_base_msgs.msg import MoveBaseAction, MoveBaseGoal
from std_msgs.msg import String


def main():
    rospy.init_node("mission")
    state = rospy.Publisher("~state", String, latch=True, queue_size=1)
    client = actionlib.SimpleActionClient("/move_base", MoveBaseAction)
    client.wait_for_server()
    arrived = 0
    for place in itertools.cycle(rospy.get_param("~places")):
        goal = MoveBaseGoal()
        goal.target_pose.header.frame_id = "map"
        goal.target_pose.header.stamp = rospy.Time.now()
        goal.target_pose.pose.position.x, goal.target_pose.pose.position.y = place["x"], place["y"]
        goal.target_pose.pose.orientation.w = 1
        state.publish("driving to %s" % place["name"])
        ended = client.send_goal_and_wait(goal)
        if rospy.is_shutdown():
            return
        if ended == actionlib.GoalStatus.SUCCEEDED:
            arrived += 1
            rospy.set_param("~arrived", arrived)
            state.publish("at %s" % place["name"])
        else:
            state.publish("did not reach %s" % place["name"])
        rospy.sleep(rospy.get_param("~pause"))


if __name__ == "__main__":
    try:
        main()
    except rospy.ROSInterruptException:
        pass
