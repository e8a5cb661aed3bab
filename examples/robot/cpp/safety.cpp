// Passes commands on to the base unless a scanner sees something closer than `~distance`. Publishes whether the robot is
// stopped on `stopped`, latched.

#include <algorithm>
#include <geometry_msgs/Twist.h>
#include <ros/ros.h>
#include <sensor_msgs/LaserScan.h>
#include <std_msgs/Bool.h>

struct Safety {
  ros::NodeHandle node, own{"~"};
  double distance = own.param("distance", 0.4);
  std_msgs::Bool near;
  ros::Publisher safe = node.advertise<geometry_msgs::Twist>("cmd_vel_out", 1);
  ros::Publisher stopped = node.advertise<std_msgs::Bool>("stopped", 1, true);
  ros::Subscriber commands = node.subscribe("cmd_vel_in", 1, &Safety::command, this);
  ros::Subscriber front = node.subscribe("/lidar/front/scan", 1, &Safety::scan, this);
  ros::Subscriber rear = node.subscribe("/lidar/rear/scan", 1, &Safety::scan, this);

  Safety() { stopped.publish(near); }

  void command(const geometry_msgs::TwistConstPtr &wanted) {
    safe.publish(near.data ? geometry_msgs::Twist() : *wanted);
  }

  void scan(const sensor_msgs::LaserScanConstPtr &scan) {
    const bool now = *std::min_element(scan->ranges.begin(), scan->ranges.end()) < distance;
    if (now != bool(near.data)) {
      near.data = now;
      stopped.publish(near);
    }
  }
};

int main(int argc, char **argv) {
  ros::init(argc, argv, "safety");
  Safety safety;
  ros::spin();
}
