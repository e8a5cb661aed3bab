// Subscribes to `chatter` and says each message, each change of its links and each publisherUpdate.
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <ros/topic_manager.h>
#include <ros/xmlrpc_manager.h>
#include <std_msgs/String.h>

#include "lines.h"

static ros::Subscriber subscriber;

// roscpp tells nobody of a publisherUpdate. The node's server is asked to hand the call to this
// function, which passes it on to where it went before (private: hence -fno-access-control).
static void on_update(XmlRpc::XmlRpcValue& params, XmlRpc::XmlRpcValue& result)
{
  std::string line = "update " + std::string(params[1]);
  for (int i = 0; i < params[2].size(); ++i)
    line += " " + std::string(params[2][i]);
  say(line);
  ros::TopicManager::instance()->pubUpdateCallback(params, result);
}

static void on_message(const std_msgs::StringConstPtr& message)
{
  say("got " + message->data);
}

int main(int argc, char** argv)
{
  ros::init(argc, argv, "listener");
  ros::NodeHandle node;
  ros::XMLRPCManager::instance()->unbind("publisherUpdate");
  ros::XMLRPCManager::instance()->bind("publisherUpdate", on_update);
  subscriber = node.subscribe("chatter", 1000, on_message);
  say("ready " + ros::this_node::getName());
  uint32_t links = 0;
  while (ros::ok())
  {
    ros::getGlobalCallbackQueue()->callAvailable(ros::WallDuration(0.002));
    const uint32_t now = subscriber.getNumPublishers();
    if (now != links)
      say("links " + std::to_string(links = now));
  }
}
