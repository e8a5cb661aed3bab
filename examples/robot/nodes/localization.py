#!/usr/bin/python3
"""Publishes where the robot is on the map, from scans, odometry and transforms."""

import rospy
import tf2_ros
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Empty, EmptyResponse


def main():
    rospy.init_node("localization")
    broadcaster = tf2_ros.TransformBroadcaster()
    buffer = tf2_ros.Buffer()
    tf2_ros.TransformListener(buffer)
    poses = rospy.Publisher("pose", PoseWithCovarianceStamped, queue_size=10)
    rospy.Subscriber("/map", OccupancyGrid, lambda _map: rospy.loginfo("there is a map"))
    rospy.Service("global_localization", Empty, lambda _request: EmptyResponse())

    def odometry(message):
        moved = TransformStamped()
        moved.header.stamp = message.header.stamp
        moved.header.frame_id, moved.child_frame_id = "map", "odom"
        moved.transform.rotation.w = 1
        broadcaster.sendTransform(moved)
        pose = PoseWithCovarianceStamped(header=moved.header)
        pose.pose.pose = message.pose.pose
        poses.publish(pose)

    def scan(message):
        if not buffer.can_transform("base_link", message.header.frame_id, rospy.Time(0)):
            rospy.logwarn_throttle(10, "no transform from %s yet", message.header.frame_id)

    rospy.Subscriber("odom", Odometry, odometry)
    rospy.Subscriber("scan", LaserScan, scan)
    rospy.spin()


if __name__ == "__main__":
    main()
