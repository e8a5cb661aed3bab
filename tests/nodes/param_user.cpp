// Prints the value of `getCached` for a parameter whenever it changes. Usage: param_user KEY
//
// After the first read, only a paramUpdate of the master changes the cache.
#include <ros/ros.h>

#include "lines.h"

int main(int argc, char** argv)
{
  ros::init(argc, argv, "param_user");
  ros::NodeHandle node;
  const std::string key = argv[1];
  std::string seen = "nothing yet";
  int number = 0;
  ros::param::getCached(key, number);
  say("ready " + ros::this_node::getName());
  ros::Rate rate(50);
  while (ros::ok())
  {
    const std::string now = ros::param::getCached(key, number) ? std::to_string(number) : "null";
    if (now != seen)
      say("value " + (seen = now));
    rate.sleep();
  }
}
