"""What every test node prints: one line per event on standard output, flushed at once.

    ready NAME              the node is registered and running
    sent N                  talker: message N has been published
    got PUBLISHER N         listener: message N of PUBLISHER has arrived
    gap PUBLISHER M N       listener that prints only some messages: N came after M and is not the next one
    pause PUBLISHER MS      such a listener: the longest time between two messages since the last such line
    links N                 talker, listener: the number of live TCPROS links is now N
    update TOPIC URI...     listener: a publisherUpdate with these publishers has arrived
    called N                service server: the Nth call was answered
    reply NAME              service client: the server named NAME has answered
    value JSON              parameter user: the present value of the cached parameter (null if unset)
    reads N                 parameter reader: it has been read N times
    pass MS                 driver: the longest pass of its loop since the last such line
    done WHAT               late node: this call has succeeded
    again TEXT              late node: its user must repeat the call
    failed TEXT             something that should have worked has not

Nodes also run with Python 2.7, because tests/field runs them on old releases.

The roscpp nodes print the same lines (lines.h). `tests/support/node.rs` reads them.
"""

import sys
import threading
import time

import rospy

# A signal may end the node, and so its links, while it prints a line.
_lock = threading.RLock()
# Python 2 has no monotonic clock.
now = getattr(time, "monotonic", time.time)


def say(*words):
    """Prints one whole line, whatever other threads print."""
    line = " ".join(str(word) for word in words) + "\n"
    with _lock:
        sys.stdout.write(line)
        sys.stdout.flush()


def ticks(hz):
    """Yields `hz` times a second until the node ends."""
    rate = rospy.Rate(hz)
    while not rospy.is_shutdown():
        yield
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            return
