// Publishes std_msgs/String "NAME N" on `chatter`, numbered from 1. Usage: talker [HZ [quiet [logged]]]
//
// `logged`: the node has already logged something. A roscpp node that is told to shut down logs that. If this is the
// first line that it logs, it calls subscribeParam, and so takes its name back from the node that displaced it.
//
// A quiet talker does not print what it has sent. No message is dropped when a listener is slow.
#include <cstdlib>
#include <ros/ros.h>
#include <std_msgs/String.h>

#include "lines.h"

static ros::Publisher publisher;

static void on_link(const ros::SingleSubscriberPublisher&)
{
  say("links " + std::to_string(publisher.getNumSubscribers()));
}

int main(int argc, char** argv)
{
  ros::init(argc, argv, "talker");
  const double hz = argc > 1 ? std::atof(argv[1]) : 50.0;
  const bool quiet = argc > 2 && std::string(argv[2]) == "quiet";
  ros::NodeHandle node;
  bool off = false;
  if (argc > 3 && std::string(argv[3]) == "logged")
    ros::param::getCached("/rosout_disable_topics_generation", off);
  publisher = node.advertise<std_msgs::String>("chatter", 0, on_link, on_link);
  say("ready " + ros::this_node::getName());
  ros::Rate rate(hz);
  for (unsigned long number = 1; ros::ok(); ++number)
  {
    std_msgs::String message;
    message.data = ros::this_node::getName() + " " + std::to_string(number);
    publisher.publish(message);
    if (!quiet)
      say("sent " + std::to_string(number));
    ros::spinOnce();
    rate.sleep();
  }
}
