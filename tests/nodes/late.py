#!/usr/bin/python3
"""On SIGUSR1 it publishes, subscribes, offers a service, sets a parameter and reads `/gain`, which is 7, into its cache,
all at the same time, and prints when each is done. It prints `again` when a call fails that its user must repeat.
"""

import signal
import threading
import time

import rospy
from roscpp.srv import GetLoggers, GetLoggersResponse
from std_msgs.msg import String

from lines import say

kept = []


def insist(call):
    """Repeats a call whose failure rospy reports to the user instead of trying again itself."""
    while not rospy.is_shutdown():
        try:
            return call()
        except Exception as error:
            say("again", type(error).__name__, error)
            time.sleep(0.2)


def read_gain():
    """Fails unless it reads the value that is set."""
    if rospy.get_param_cached("/gain", None) != 7:
        say("failed", "it got its default")


STEPS = {
    "set": lambda: insist(lambda: rospy.set_param("~late", 1)),
    "publish": lambda: kept.append(rospy.Publisher("~published", String, queue_size=1)),
    "subscribe": lambda: kept.append(rospy.Subscriber("~subscribed", String, lambda _message: None)),
    "offer": lambda: kept.append(rospy.Service("~offered", GetLoggers, lambda _request: GetLoggersResponse([]))),
    "read": lambda: insist(read_gain),
}


def step(name):
    """Runs one of the steps."""
    try:
        STEPS[name]()
        say("done", name)
    except Exception as error:
        say("failed", name, type(error).__name__, error)


def start(_signal, _frame):
    """Runs all steps."""
    for name in STEPS:
        threading.Thread(target=step, args=(name,), daemon=True).start()


def main():
    rospy.init_node("late")
    signal.signal(signal.SIGUSR1, start)
    say("ready", rospy.get_name())
    while not rospy.is_shutdown():
        time.sleep(0.05)


if __name__ == "__main__":
    main()
