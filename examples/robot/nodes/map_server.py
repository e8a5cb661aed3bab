#!/usr/bin/python3
"""Publishes the map, latched, and offers it as a service."""

import rospy
from nav_msgs.msg import MapMetaData, OccupancyGrid
from nav_msgs.srv import GetMap, GetMapResponse


def main():
    rospy.init_node("map_server")
    size = rospy.get_param("~size", 40)
    grid = OccupancyGrid()
    grid.header.frame_id = "map"
    grid.header.stamp = rospy.Time.now()
    grid.info = MapMetaData(resolution=0.1, width=size, height=size)
    walls = (0, size - 1)
    grid.data = [100 if x in walls or y in walls else 0 for y in range(size) for x in range(size)]
    latched = rospy.Publisher("map", OccupancyGrid, latch=True, queue_size=1)
    latched.publish(grid)
    rospy.Service("static_map", GetMap, lambda _request: GetMapResponse(grid))
    rospy.spin()


if __name__ == "__main__":
    main()
