"""What every test node says, and how: one line per event on standard output, flushed at once.

    ready NAME              the node is registered and at work
    sent N                  talker: message N has been published
    got PUBLISHER N         listener: message N of PUBLISHER has arrived
    gap PUBLISHER M N       listener that says only some messages: behind M came N, which is not the next
    pause PUBLISHER MS      such a listener: the longest time between two messages since the last such line
    links N                 talker, listener: the number of live TCPROS links is now N
    update TOPIC URI...     listener: a publisherUpdate with these publishers came
    called N                service server: the Nth call was answered
    reply NAME              service client: the server that calls itself NAME answered
    value JSON              parameter user: what the cached parameter is now (null if unset)
    reads N                 parameter reader: N times it was read
    pass MS                 driver: the longest pass of its loop since the last such line
    done WHAT               late node: it has got through
    again TEXT              late node: its user has to make the call again
    failed TEXT             something that should have worked did not

Nodes run with Python 2.7, too: tests/field takes them to old releases.

The roscpp nodes say the same (lines.h). `tests/support/node.rs` reads it.
"""

import sys
import threading
import time

import rospy

# A signal may end the node, and with it its links, while it says something.
_lock = threading.RLock()
# Python 2 has no monotonic clock.
now = getattr(time, "monotonic", time.time)


def say(*words):
    """Prints one line, whole, whatever the other threads print."""
    line = " ".join(str(word) for word in words) + "\n"
    with _lock:
        sys.stdout.write(line)
        sys.stdout.flush()


def ticks(hz):
    """Yields HZ times a second, until the node ends."""
    rate = rospy.Rate(hz)
    while not rospy.is_shutdown():
        yield
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            return
