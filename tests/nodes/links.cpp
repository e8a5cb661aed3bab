// One of many nodes that start at the same moment and register as fast as they can.
// Usage: links GO NAME pub:TOPIC|sub:TOPIC...
//
// It prints `loaded`, begins when the FIFO GO is opened for writing, and prints `ready NAME URI BEGIN END` when it has
// registered, with times of the computer's monotonic clock.
#include <ctime>
#include <fcntl.h>
#include <unistd.h>
#include <vector>

#include <ros/ros.h>
#include <ros/xmlrpc_manager.h>
#include <std_msgs/String.h>

#include "lines.h"

static double now()
{
  timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return time.tv_sec + time.tv_nsec * 1e-9;
}

static void on_message(const std_msgs::StringConstPtr&)
{
}

int main(int argc, char** argv)
{
  ros::init(argc, argv, argv[2], ros::init_options::NoSigintHandler);
  say("loaded");
  close(open(argv[1], O_RDONLY));
  const double begin = now();
  ros::NodeHandle node;
  std::vector<ros::Publisher> publishers;
  std::vector<ros::Subscriber> subscribers;
  for (int i = 3; i < argc; ++i)
  {
    const std::string end = argv[i];
    if (end.substr(0, 4) == "pub:")
      publishers.push_back(node.advertise<std_msgs::String>(end.substr(4), 1));
    else
      subscribers.push_back(node.subscribe(end.substr(4), 1, on_message));
  }
  say("ready " + ros::this_node::getName() + " " + ros::XMLRPCManager::instance()->getServerURI() + " " +
      std::to_string(begin) + " " + std::to_string(now()));
  ros::spin();
}
