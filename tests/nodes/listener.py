#!/usr/bin/python3
"""Subscribes to `chatter` and prints each message, each change of its links and each publisherUpdate.
Usage: listener.py [EVERY]

With EVERY it prints only each EVERYth message of a publisher, the first one, and every gap between two messages.

rospy has no callback for the links of a subscriber, so this wraps the places where rospy makes and ends them.
"""

import threading

import rospy
import rospy.impl.masterslave
import rospy.impl.tcpros_base
import rospy.topics
from std_msgs.msg import String

from lines import now, say


class Summary:
    """Prints only some of the messages, and every gap, when there are too many to print."""

    def __init__(self, every):
        self.every = every
        self.last = {}

    def on_message(self, message):
        name, _, number = message.data.partition(" ")
        number, moment = int(number), now()
        before, at, longest = self.last.get(name, (number - 1, moment, 0.0))
        longest = max(longest, moment - at)
        if number != before + 1:
            say("gap", name, before, number)
        if number % self.every == 0 or name not in self.last:
            say("got", name, number)
            say("pause", name, "%.3f" % (longest * 1e3))
            longest = 0.0
        self.last[name] = (number, moment, longest)


def watch_updates():
    """Prints every publisherUpdate. Must be called before the node's server starts."""
    original = rospy.impl.masterslave.ROSHandler.publisherUpdate

    def publisher_update(self, caller_id, topic, publishers):
        say("update", topic, *publishers)
        return original(self, caller_id, topic, publishers)

    rospy.impl.masterslave.ROSHandler.publisherUpdate = publisher_update


def watch_reconnects():
    """Counts a broken link as lost, although rospy repairs it under the same connection object."""
    original = rospy.impl.tcpros_base.TCPROSTransport._reconnect

    def reconnect(self):
        say("links", 0)
        original(self)

    rospy.impl.tcpros_base.TCPROSTransport._reconnect = reconnect


def watch_links():
    """Prints how many publishers are connected whenever that changes. Must be called before the node subscribes."""
    impl = rospy.topics._SubscriberImpl
    saying = threading.Lock()

    def watched(original):
        def method(self, connection):
            answer = original(self, connection)
            # Without a lock, two threads would print their numbers in any order. It is not rospy's own lock: rospy
            # may hold that while it removes a connection, and would wait for ours forever.
            with saying:
                say("links", len(self.connections or ()))
            return answer

        return method

    impl.add_connection = watched(impl.add_connection)
    impl.remove_connection = watched(impl.remove_connection)


def main():
    watch_updates()
    watch_reconnects()
    watch_links()
    arguments = rospy.myargv()
    rospy.init_node("listener")
    on_message = lambda message: say("got", message.data)
    if len(arguments) > 1:
        on_message = Summary(int(arguments[1])).on_message
    rospy.Subscriber("chatter", String, on_message, queue_size=None)
    say("ready", rospy.get_name())
    rospy.spin()


if __name__ == "__main__":
    main()
