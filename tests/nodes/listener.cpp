// Subscribes to `chatter` and prints each message, each change of its links and each publisherUpdate.
// Usage: listener [EVERY]
//
// With EVERY it prints only each EVERYth message of a publisher, the first one, and every gap between two messages.
#include <algorithm>
#include <cstdlib>
#include <map>

#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <ros/topic_manager.h>
#include <ros/xmlrpc_manager.h>
#include <std_msgs/String.h>

#include "lines.h"

static ros::Subscriber subscriber;

// roscpp has no callback for a publisherUpdate. So the node's server passes the call to this function, which passes it
// on to roscpp's own function (that one is private: hence -fno-access-control).
static void on_update(XmlRpc::XmlRpcValue& params, XmlRpc::XmlRpcValue& result)
{
  std::string line = "update " + std::string(params[1]);
  for (int i = 0; i < params[2].size(); ++i)
    line += " " + std::string(params[2][i]);
  say(line);
  ros::TopicManager::instance()->pubUpdateCallback(params, result);
}

struct Last
{
  unsigned long number;
  ros::WallTime at;
  double longest;
};

static unsigned long every = 0;
static std::map<std::string, Last> lasts;

// Prints only some of the messages, and every gap, when there are too many to print.
static void summarise(const std::string& name, unsigned long number)
{
  const ros::WallTime now = ros::WallTime::now();
  const bool first = lasts.count(name) == 0;
  if (first)
    lasts[name] = { number - 1, now, 0.0 };
  Last& last = lasts[name];
  last.longest = std::max(last.longest, (now - last.at).toSec());
  if (number != last.number + 1)
    say("gap " + name + " " + std::to_string(last.number) + " " + std::to_string(number));
  if (first || number % every == 0)
  {
    say("got " + name + " " + std::to_string(number));
    say("pause " + name + " " + std::to_string(last.longest * 1e3));
    last.longest = 0.0;
  }
  last.number = number;
  last.at = now;
}

static void on_message(const std_msgs::StringConstPtr& message)
{
  const std::string& text = message->data;
  const size_t space = text.find(' ');
  if (every == 0)
    say("got " + text);
  else
    summarise(text.substr(0, space), std::strtoul(text.c_str() + space, nullptr, 10));
}

int main(int argc, char** argv)
{
  ros::init(argc, argv, "listener");
  if (argc > 1)
    every = std::strtoul(argv[1], nullptr, 10);
  ros::NodeHandle node;
  ros::XMLRPCManager::instance()->unbind("publisherUpdate");
  ros::XMLRPCManager::instance()->bind("publisherUpdate", on_update);
  subscriber = node.subscribe("chatter", 0, on_message, ros::TransportHints().tcpNoDelay());
  say("ready " + ros::this_node::getName());
  uint32_t links = 0;
  while (ros::ok())
  {
    ros::getGlobalCallbackQueue()->callAvailable(ros::WallDuration(0.01));
    const uint32_t now = subscriber.getNumPublishers();
    if (now != links)
      say("links " + std::to_string(links = now));
  }
}
