// Reads a parameter again and again, with a default value that it should never get. It starts before it registers.
// Usage: reader KEY [HZ]
#include <cstdlib>
#include <thread>

#include <ros/ros.h>

#include "lines.h"

static void read_all_the_time(const std::string& key, double hz)
{
  for (unsigned long count = 1;; ++count)
  {
    int value = -1;
    ros::param::param(key, value, -1);
    if (value == -1)
      say("failed it got its default");
    if (count % 10 == 0)
      say("reads " + std::to_string(count));
    ros::WallDuration(1 / hz).sleep();
  }
}

int main(int argc, char** argv)
{
  ros::init(argc, argv, "reader");
  const double hz = argc > 2 ? std::atof(argv[2]) : 50.0;
  std::thread(read_all_the_time, std::string(argv[1]), hz).detach();
  ros::NodeHandle node;
  say("ready " + ros::this_node::getName());
  ros::spin();
  std::_Exit(0);
}
