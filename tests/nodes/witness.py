#!/usr/bin/python3
"""Watches the example robot (examples/robot): streams, transforms, diagnostics, and whether drives succeed.

    witness.py                 every second says the lines below, and each gap as it comes (lines.py)
    witness.py bag FILE        says what a bag holds, and ends

    heard JSON                 the number of messages by topic so far
    transforms SECONDS         how old the oldest of the transforms from the map is
    diagnostics NAMES          what the aggregator has put together, without what is stale
    drive TEXT                 what the mission says
    bagged TOPIC FIRST LAST COUNT      the times of the first and the last message
"""

import json
import sys

import rospy
import tf2_ros
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image, JointState, LaserScan
from std_msgs.msg import String

from lines import say, ticks

NUMBERED = {
    "/lidar/front/scan": LaserScan,
    "/lidar/rear/scan": LaserScan,
    "/scan": LaserScan,
    "/base/odom": Odometry,
    "/arm/joint_states": JointState,
    "/camera/front/image_raw": Image,
    "/camera/front/image_grey": Image,
    "/camera/rear/image_raw": Image,
}
FRAMES = ["lidar_front", "lidar_rear", "camera_front", "camera_rear", "left_wheel_link", "gripper"]


class Numbers:
    """Of a topic whose messages are numbered."""

    def __init__(self, topic):
        self.topic, self.last, self.count = topic, None, 0

    def came(self, message):
        number = message.header.seq
        if self.last is not None and number != self.last + 1:
            say("gap", self.topic, self.last, number)
        self.last, self.count = number, self.count + 1


def watch():
    rospy.init_node("witness")
    heard = []
    for topic, kind in NUMBERED.items():
        numbers = Numbers(topic)
        heard.append(numbers)
        rospy.Subscriber(topic, kind, numbers.came, queue_size=None)

    def diagnosed(array):
        fresh = [status.name for status in array.status if status.level != DiagnosticStatus.STALE]
        say("diagnostics", *(name for name in fresh if name.count("/") == 1))

    rospy.Subscriber("/diagnostics_agg", DiagnosticArray, diagnosed)
    rospy.Subscriber("/mission/state", String, lambda state: say("drive", state.data))
    buffer = tf2_ros.Buffer()
    tf2_ros.TransformListener(buffer)
    say("ready", rospy.get_name())
    for _ in ticks(2):
        say("heard", json.dumps({numbers.topic: numbers.count for numbers in heard}))
        try:
            stamps = [buffer.lookup_transform("map", frame, rospy.Time(0)).header.stamp for frame in FRAMES]
            say("transforms", (rospy.Time.now() - min(stamps)).to_sec())
        except tf2_ros.TransformException as error:
            rospy.loginfo("%s", error)


def read(bag):
    import rosbag

    topics = {}
    for topic, message, time in rosbag.Bag(bag).read_messages():
        numbers, times = topics.setdefault(topic, (Numbers(topic), []))
        times.append(time.to_sec())
        if topic in NUMBERED:
            numbers.came(message)
    for topic, (_, times) in topics.items():
        say("bagged", topic, times[0], times[-1], len(times))


if __name__ == "__main__":
    if sys.argv[1:2] == ["bag"]:
        read(sys.argv[2])
    else:
        watch()
