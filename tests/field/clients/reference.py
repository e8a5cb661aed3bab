#!/usr/bin/python3
"""A rospy node that communicates with one client in every way. measure.py describes what it does and prints.

    reference.py NAME
"""

import sys
import threading
import time

import rospy
from std_msgs.msg import String
from std_srvs.srv import Trigger, TriggerResponse

NAME = sys.argv[1]


def say(*words):
    sys.stdout.write(" ".join(map(str, words)).replace("\n", " ") + "\n")
    sys.stdout.flush()


def forever(what, act):
    """Runs `act` every 200 ms, one at a time, and prints how long it took."""
    number = 0
    while not rospy.is_shutdown():
        number += 1
        start = time.monotonic()
        try:
            act()
            outcome, why = what, ""
        except Exception as error:  # whatever it is, it is a failure
            outcome, why = what + "-failed", error
        say(outcome, number, round((time.monotonic() - start) * 1000), why)
        time.sleep(0.2)


def main():
    rospy.init_node("ref_" + NAME)
    out = rospy.Publisher("/ref_%s/out" % NAME, String, queue_size=100)
    rospy.Subscriber("/%s/out" % NAME, String, lambda message: say("heard", message.data))
    rospy.Service("/ref_%s/serve" % NAME, Trigger, lambda _request: TriggerResponse(True, ""))
    say("ready")

    def call():
        rospy.ServiceProxy("/%s/serve" % NAME, Trigger)()

    def read():
        rospy.get_param("/%s/value" % NAME)

    for what, act in (("call", call), ("param", read)):
        threading.Thread(target=forever, args=(what, act), daemon=True).start()
    number = 0
    while not rospy.is_shutdown():
        number += 1
        out.publish(str(number))
        time.sleep(0.1)
    say("shutdown")


if __name__ == "__main__":
    main()
