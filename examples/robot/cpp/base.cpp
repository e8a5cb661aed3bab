// The driver of a base with two wheels: subscribes to `cmd_vel`, publishes `odom`, the joints of the wheels and the
// transform to the base, and reports its state on /diagnostics.

#include <cmath>
#include <diagnostic_msgs/DiagnosticArray.h>
#include <geometry_msgs/Twist.h>
#include <nav_msgs/Odometry.h>
#include <ros/ros.h>
#include <sensor_msgs/JointState.h>
#include <std_srvs/Trigger.h>
#include <tf2_msgs/TFMessage.h>

struct Base {
  ros::NodeHandle node, own{"~"};
  geometry_msgs::Twist speed;
  double x = 0, y = 0, heading = 0, left = 0, right = 0;
  double radius = own.param("wheel_radius", 0.1), track = own.param("track", 0.5);
  ros::Publisher odometry = node.advertise<nav_msgs::Odometry>("odom", 100);
  ros::Publisher joints = node.advertise<sensor_msgs::JointState>("wheels", 10);
  ros::Publisher transforms = node.advertise<tf2_msgs::TFMessage>("/tf", 10);
  ros::Publisher diagnostics = node.advertise<diagnostic_msgs::DiagnosticArray>("/diagnostics", 1);
  ros::Subscriber commands = node.subscribe("cmd_vel", 1, &Base::command, this);
  ros::ServiceServer stop = node.advertiseService("stop", &Base::stopped, this);
  ros::Timer drive = node.createTimer(ros::Duration(0.05), &Base::step, this);
  ros::Timer look = node.createTimer(ros::Duration(1), &Base::diagnose, this);

  void command(const geometry_msgs::TwistConstPtr &wanted) { speed = *wanted; }

  bool stopped(std_srvs::Trigger::Request &, std_srvs::Trigger::Response &response) {
    speed = geometry_msgs::Twist();
    response.success = true;
    return true;
  }

  void step(const ros::TimerEvent &) {
    const double seconds = 0.05, forward = speed.linear.x * seconds, turn = speed.angular.z * seconds;
    heading += turn;
    x += forward * std::cos(heading);
    y += forward * std::sin(heading);
    left += (forward - turn * track / 2) / radius;
    right += (forward + turn * track / 2) / radius;

    nav_msgs::Odometry odom;
    odom.header.stamp = ros::Time::now();
    odom.header.frame_id = "odom";
    odom.child_frame_id = "base_footprint";
    odom.pose.pose.position.x = x;
    odom.pose.pose.position.y = y;
    odom.pose.pose.orientation.z = std::sin(heading / 2);
    odom.pose.pose.orientation.w = std::cos(heading / 2);
    odom.twist.twist = speed;
    odometry.publish(odom);

    tf2_msgs::TFMessage moved;
    moved.transforms.resize(1);
    moved.transforms[0].header = odom.header;
    moved.transforms[0].child_frame_id = odom.child_frame_id;
    moved.transforms[0].transform.translation.x = x;
    moved.transforms[0].transform.translation.y = y;
    moved.transforms[0].transform.rotation = odom.pose.pose.orientation;
    transforms.publish(moved);

    sensor_msgs::JointState wheels;
    wheels.header.stamp = odom.header.stamp;
    wheels.name = {"left_wheel", "right_wheel"};
    wheels.position = {left, right};
    joints.publish(wheels);
  }

  void diagnose(const ros::TimerEvent &) {
    diagnostic_msgs::DiagnosticArray array;
    array.header.stamp = ros::Time::now();
    array.status.resize(1);
    array.status[0].name = "base: motors";
    array.status[0].hardware_id = own.param<std::string>("port", "");
    array.status[0].message = "running";
    diagnostics.publish(array);
  }
};

int main(int argc, char **argv) {
  ros::init(argc, argv, "base");
  Base base;
  ros::spin();
}
