#!/usr/bin/python3
"""Many nodes that start at the same moment and register as fast as they can. Usage: links.py FOLDER

`FOLDER/plan.json` lists the nodes: {NAME: [["pub"|"sub", TOPIC]...]}. This process imports rospy once, starts a process
for each node, and prints `loaded` when all exist. They begin when the FIFO `FOLDER/go` is opened for writing, and each
one prints `ready NAME URI BEGIN END`. When `FOLDER/end` is opened for writing, each one writes `FOLDER/NAME.json` and
prints `written NAME`. The file has what the node asked and was told about each topic, and when, on the computer's
monotonic clock.

In rospy, lists of publishers reach the connecting thread from two places: the answer of registerSubscriber, and
publisherUpdate. This program wraps both, so the events of a topic are in the order in which the lists are passed on.
"""

import gc
import json
import os
import sys
import threading
import time
import traceback

import rospy
import rospy.impl.masterslave
import rospy.impl.registration
import rospy.topics
from std_msgs.msg import String

events = []
_lock = threading.Lock()
_thread = threading.local()


def say(*words):
    """Prints one line in one piece, because the processes share the pipe."""
    os.write(1, (" ".join(str(word) for word in words) + "\n").encode())


def note(what, topic, uris=()):
    """Records an event of a topic."""
    events.append((time.monotonic(), what, topic, list(uris)))


def watch():
    """Records all events. Must be called before the node's server starts."""
    manager, handler = rospy.impl.registration.RegManager, rospy.impl.masterslave.ROSHandler
    subscriber = rospy.topics._SubscriberImpl
    hand_over, told = manager.publisher_update, handler.publisherUpdate
    added, connected = manager.reg_added, subscriber.add_connection

    def publisher_update(self, topic, uris):
        with _lock:
            # rospy passes on the list of an update once for each publisher in it.
            note(getattr(_thread, "source", "answer"), topic, uris)
            return hand_over(self, topic, uris)

    def update(self, caller_id, topic, publishers):
        _thread.source = "update"
        try:
            return told(self, caller_id, topic, publishers)
        finally:
            del _thread.source

    def reg_added(self, name, data_type_or_uri, kind):
        note("asks " + kind, name)
        added(self, name, data_type_or_uri, kind)
        note("asked " + kind, name)

    def add_connection(self, connection):
        note("link", self.resolved_name, [connection.endpoint_id])
        return connected(self, connection)

    manager.publisher_update, handler.publisherUpdate = publisher_update, update
    manager.reg_added, subscriber.add_connection = reg_added, add_connection


def run(folder, name, ends):
    """Runs one node."""
    watch()
    open(os.path.join(folder, "go")).close()
    begin = time.monotonic()
    rospy.init_node(name, disable_signals=True)
    kept = []
    for kind, topic in ends:
        if kind == "pub":
            kept.append(rospy.Publisher(topic, String, queue_size=1))
        else:
            kept.append(rospy.Subscriber(topic, String, lambda _message: None))
    say("ready", rospy.get_name(), rospy.get_node_uri(), "%.6f" % begin, "%.6f" % time.monotonic())
    open(os.path.join(folder, "end")).close()
    path = os.path.join(folder, name + ".json")
    with open(path, "w") as file:
        json.dump(events, file)
    say("written", rospy.get_name())
    time.sleep(3600)


def main():
    folder = sys.argv[1]
    with open(os.path.join(folder, "plan.json")) as file:
        plan = json.load(file)
    gc.freeze()
    for name, ends in plan.items():
        if os.fork() == 0:
            try:
                run(folder, name, ends)
            except BaseException:  # pylint: disable=broad-except
                traceback.print_exc()
            finally:
                os._exit(1)
    say("loaded")
    while True:
        pid, status = os.wait()
        say("ended", pid, status)


if __name__ == "__main__":
    main()
