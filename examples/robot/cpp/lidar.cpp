// A laser scanner: publishes a numbered `sensor_msgs/LaserScan` of a room, `~rate` times a second.

#include <cmath>
#include <ros/ros.h>
#include <sensor_msgs/LaserScan.h>

int main(int argc, char **argv) {
  ros::init(argc, argv, "lidar");
  ros::NodeHandle node, own("~");
  sensor_msgs::LaserScan scan;
  own.param<std::string>("frame", scan.header.frame_id, "laser");
  scan.angle_min = -M_PI / 2;
  scan.angle_max = M_PI / 2;
  scan.angle_increment = M_PI / 180;
  scan.range_min = 0.05f;
  scan.range_max = own.param("range", 12.0);
  ros::Publisher publisher = node.advertise<sensor_msgs::LaserScan>("scan", 100);
  ros::Rate rate(own.param("rate", 20));
  while (ros::ok()) {
    scan.header.stamp = ros::Time::now();
    scan.ranges.clear();
    for (int degree = -90; degree <= 90; ++degree)
      scan.ranges.push_back(3 + std::cos(degree * M_PI / 180 * 4 + ros::Time::now().toSec()));
    publisher.publish(scan);
    ros::spinOnce();
    rate.sleep();
  }
}
