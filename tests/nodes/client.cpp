// Calls the service `who` again and again, with a new lookup each time. Usage: client [HZ]
#include <cstdlib>
#include <ros/ros.h>
#include <roscpp/GetLoggers.h>

#include "lines.h"

int main(int argc, char** argv)
{
  ros::init(argc, argv, "client");
  const double hz = argc > 1 ? std::atof(argv[1]) : 5.0;
  ros::NodeHandle node;
  ros::service::waitForService("who");
  say("ready " + ros::this_node::getName());
  ros::Rate rate(hz);
  while (ros::ok())
  {
    // Not ros::service::call: one such call in some 40,000 fails even with a bare rosmaster, because the server closes
    // the connection before roscpp has read the reply (ros_comm issue 1976). A persistent connection stays open.
    ros::ServiceClient client = node.serviceClient<roscpp::GetLoggers>("who", true);
    roscpp::GetLoggers call;
    if (client.call(call) && !call.response.loggers.empty())
      say("reply " + call.response.loggers[0].name);
    else if (ros::ok())
      say("failed the call of the service");
    rate.sleep();
  }
}
