// On SIGUSR1 it publishes, subscribes, offers a service, sets a parameter and reads `/gain`, which is 7, into its
// cache, all at the same time, and prints when each is done. roscpp itself repeats calls that fail.
#include <atomic>
#include <csignal>
#include <functional>
#include <thread>

#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <roscpp/GetLoggers.h>
#include <std_msgs/String.h>

#include "lines.h"

static std::atomic<bool> wanted(false);

static void on_signal(int)
{
  wanted = true;
}

static void on_message(const std_msgs::StringConstPtr&)
{
}

static bool answer(roscpp::GetLoggers::Request&, roscpp::GetLoggers::Response&)
{
  return true;
}

static void step(const std::string& name, std::function<bool()> work)
{
  std::thread([=] { say((work() ? "done " : "failed ") + name); }).detach();
}

int main(int argc, char** argv)
{
  ros::init(argc, argv, "late");
  ros::NodeHandle node("~");
  ros::Publisher publisher;
  ros::Subscriber subscriber;
  ros::ServiceServer server;
  std::signal(SIGUSR1, on_signal);
  say("ready " + ros::this_node::getName());
  while (ros::ok())
  {
    if (wanted.exchange(false))
    {
      step("publish", [&] { return bool(publisher = node.advertise<std_msgs::String>("published", 1)); });
      step("subscribe", [&] { return bool(subscriber = node.subscribe("subscribed", 1, on_message)); });
      step("offer", [&] { return bool(server = node.advertiseService("offered", answer)); });
      step("read", [&] { int gain = -1; return node.getParamCached("/gain", gain) && gain == 7; });
      step("set", [&] { node.setParam("late", 1); return true; });
    }
    ros::getGlobalCallbackQueue()->callAvailable(ros::WallDuration(0.05));
  }
  std::_Exit(0);
}
