// Offers the service `who`, which answers with the name of this node.
#include <ros/ros.h>
#include <roscpp/GetLoggers.h>

#include "lines.h"

static bool answer(roscpp::GetLoggers::Request&, roscpp::GetLoggers::Response& response)
{
  static unsigned long calls = 0;
  say("called " + std::to_string(++calls));
  roscpp::Logger logger;
  logger.name = ros::this_node::getName();
  logger.level = "INFO";
  response.loggers.push_back(logger);
  return true;
}

int main(int argc, char** argv)
{
  ros::init(argc, argv, "server");
  ros::NodeHandle node;
  ros::ServiceServer server = node.advertiseService("who", answer);
  say("ready " + ros::this_node::getName());
  ros::spin();
}
