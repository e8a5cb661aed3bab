#!/usr/bin/python3
"""Watches the example robot (examples/robot): streams, transforms, diagnostics, and whether drives succeed.

    witness.py                 prints the lines below every second, and each gap when it occurs (lines.py)
    witness.py bag FILE        prints the contents of a bag, and ends

    heard JSON                 number of messages received so far, by topic
    transforms SECONDS         age of the oldest transform from the map
    diagnostics NAMES          the groups of the aggregator that are not stale
    drive TEXT                 the state that the mission publishes
    bagged TOPIC FIRST LAST COUNT      times of the first and the last message, and their number
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
    """Counts the messages of a topic that are numbered."""

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
