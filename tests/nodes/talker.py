#!/usr/bin/python3
"""Publishes `std_msgs/String` "NAME N" on `chatter`, numbered from 1. Usage: talker.py [HZ [quiet]]

A quiet talker does not print what it has sent. No message is dropped when a listener is slow.
"""

import rospy
from std_msgs.msg import String

from lines import say, ticks


class Links(rospy.SubscribeListener):
    """Prints how many subscribers are connected whenever that changes."""

    def __init__(self):
        rospy.SubscribeListener.__init__(self)
        self.publisher = None

    def peer_subscribe(self, _topic, _publish, _peer_publish):
        say("links", self.publisher.get_num_connections() if self.publisher else 0)

    def peer_unsubscribe(self, _topic, peers):
        say("links", peers)


def main():
    arguments = rospy.myargv()
    hz = float(arguments[1]) if len(arguments) > 1 else 50.0
    quiet = "quiet" in arguments
    rospy.init_node("talker")
    links = Links()
    publisher = rospy.Publisher("chatter", String, subscriber_listener=links, queue_size=0)
    links.publisher = publisher
    say("ready", rospy.get_name())
    for number, _ in enumerate(ticks(hz), 1):
        publisher.publish("%s %d" % (rospy.get_name(), number))
        if not quiet:
            say("sent", number)


if __name__ == "__main__":
    main()
