// The pipeline of the front camera, in one process without copying images: `Grey` converts images to grey, and
// `Preview` lets only some of them pass (nodelet_topic_tools).

#include <boost/make_shared.hpp>
#include <nodelet/nodelet.h>
#include <nodelet_topic_tools/nodelet_throttle.h>
#include <pluginlib/class_list_macros.hpp>
#include <ros/ros.h>
#include <sensor_msgs/Image.h>

namespace robot {

class Grey : public nodelet::Nodelet {
  void onInit() override {
    ros::NodeHandle &node = getNodeHandle();
    publisher_ = node.advertise<sensor_msgs::Image>("image_grey", 100);
    subscriber_ = node.subscribe("image_raw", 100, &Grey::image, this);
  }

  void image(const sensor_msgs::ImageConstPtr &colour) {
    auto grey = boost::make_shared<sensor_msgs::Image>();
    grey->header = colour->header;
    grey->height = colour->height;
    grey->width = colour->width;
    grey->step = colour->width;
    grey->encoding = "mono8";
    grey->data.reserve(colour->data.size() / 3);
    for (size_t at = 0; at + 2 < colour->data.size(); at += 3)
      grey->data.push_back((colour->data[at] + colour->data[at + 1] + colour->data[at + 2]) / 3);
    publisher_.publish(grey);
  }

  ros::Publisher publisher_;
  ros::Subscriber subscriber_;
};

typedef nodelet_topic_tools::NodeletThrottle<sensor_msgs::Image> Preview;

} // namespace robot

PLUGINLIB_EXPORT_CLASS(robot::Grey, nodelet::Nodelet)
PLUGINLIB_EXPORT_CLASS(robot::Preview, nodelet::Nodelet)
