#!/usr/bin/python3
"""A quiet node. Usage: node.py [pub:TOPIC|sub:TOPIC|srv:SERVICE]...

Publishers send one message each second, with the node's name. Says `from NAME` for the first message of each
publisher on a subscribed topic, and `shutdown` at its end.
"""

import rospy
from std_msgs.msg import String
from std_srvs.srv import Trigger, TriggerResponse

heard = set()


def hear(message):
    if message.data not in heard:
        heard.add(message.data)
        print("from", message.data, flush=True)


def main():
    rospy.init_node("node", disable_rosout=True)
    publishers = []
    for argument in rospy.myargv()[1:]:
        kind, _, name = argument.partition(":")
        if kind == "pub":
            publishers.append(rospy.Publisher(name, String, queue_size=10))
        elif kind == "sub":
            rospy.Subscriber(name, String, hear)
        else:
            rospy.Service(name, Trigger, lambda _request: TriggerResponse(True, ""))
    print("ready", flush=True)
    while not rospy.is_shutdown():
        for publisher in publishers:
            publisher.publish(rospy.get_name())
        try:
            rospy.sleep(1)
        except rospy.ROSInterruptException:
            break
    print("shutdown", flush=True)


if __name__ == "__main__":
    main()
