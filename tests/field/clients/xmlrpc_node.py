#!/usr/bin/env python
"""A node made of nothing but the XML-RPC of Python 2 or 3: the API of a node, and calls to the master. It registers a
publisher and a service but accepts no connections. It prints the lines in measure.py, and `told` for each notification.
"""

import os
import sys
import threading
import time

try:
    from xmlrpc.client import ServerProxy
    from xmlrpc.server import SimpleXMLRPCServer
except ImportError:
    from SimpleXMLRPCServer import SimpleXMLRPCServer
    from xmlrpclib import ServerProxy

NAME = "/" + sys.argv[1]
MASTER = os.environ["ROS_MASTER_URI"]
TOPIC, REFERENCE, KEY = NAME + "/out", "/ref_" + sys.argv[1] + "/out", NAME + "/value"
ASKED = {
    "getPid": lambda *_: os.getpid(),
    "getMasterUri": lambda *_: MASTER,
    "getPublications": lambda *_: [[TOPIC, "std_msgs/String"]],
    "getSubscriptions": lambda *_: [[REFERENCE, "std_msgs/String"]],
    "publisherUpdate": lambda _caller, topic, uris: say("told", topic, *uris) or 0,
    "paramUpdate": lambda _caller, key, value: say("told", key, value) or 0,
    "shutdown": lambda *_: os.write(1, b"shutdown\n") and threading.Timer(0.2, os._exit, [0]).start() or 0,
}


def say(*words):
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


class Node(SimpleXMLRPCServer):
    def _dispatch(self, method, params):
        if method not in ASKED:
            return [-1, "no " + method, 0]
        return [1, "", ASKED[method](*params)]


def call(method, *params):
    # One connection for each, as in rospy.
    code, message, value = getattr(ServerProxy(MASTER), method)(NAME, *params)
    if code != 1:
        raise ValueError(message)
    return value


def main():
    node = Node(("127.0.0.1", 0), logRequests=False, allow_none=True)
    uri = "http://127.0.0.1:%d/" % node.server_address[1]
    thread = threading.Thread(target=node.serve_forever)
    thread.daemon = True
    thread.start()
    call("registerPublisher", TOPIC, "std_msgs/String", uri)
    call("registerSubscriber", REFERENCE, "std_msgs/String", uri)
    call("registerService", NAME + "/named", "rosrpc://127.0.0.1:1", uri)
    call("subscribeParam", uri, "/ref_value" + NAME)
    say("ready")
    number = 0
    while True:
        number += 1
        start = time.time()
        try:
            call("setParam", KEY, number)
            got = call("getParam", KEY)
            if got != number:
                raise ValueError("got %r" % got)
            if call("lookupNode", NAME) != uri:
                raise ValueError("another node has the name")
            if call("lookupService", NAME + "/named") != "rosrpc://127.0.0.1:1":
                raise ValueError("another service")
            outcome, why = "param", ""
        except Exception as error:
            outcome, why = "param-failed", str(error).replace("\n", " ")
        say(outcome, number, int((time.time() - start) * 1000), why)
        time.sleep(0.2)


if __name__ == "__main__":
    main()
