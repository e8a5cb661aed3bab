#!/usr/bin/env python3
"""A rosbridge_websocket as the node NAME, and a client of it. measure.py describes what they do and print.

    rosbridge.py FOLDER roslibpy|roslib NAME
"""

import os
import pathlib
import socket
import subprocess
import sys
import threading
import time

import roslibpy
from roslibpy.core import ServiceException

FOLDER, CLIENT, NAME = sys.argv[1:]


def say(*words):
    sys.stdout.write(" ".join(map(str, words)).replace("\n", " ") + "\n")
    sys.stdout.flush()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def start_bridge(port):
    script = pathlib.Path(FOLDER, "rosbridge_suite/rosbridge_server/scripts/rosbridge_websocket.py")
    command = [sys.executable, script, "--port", str(port), "--address", "127.0.0.1", "__name:=" + NAME]
    bridge = subprocess.Popen(command, stdout=sys.stderr)

    def watch():
        bridge.wait()
        say("shutdown")
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port)).close()
        except OSError:
            time.sleep(0.1)


def forever(what, act):
    """Runs `act` every 200 ms, one at a time, and prints how long it took."""
    number = 0
    while True:
        number += 1
        start = time.monotonic()
        try:
            act(number)
            outcome, why = what, ""
        except Exception as error:  # whatever it is, it is a failure
            outcome, why = what + "-failed", repr(error)
        say(outcome, number, round((time.monotonic() - start) * 1000), why)
        time.sleep(0.2)


def run(port):
    ros = roslibpy.Ros("127.0.0.1", port)
    ros.run()
    out = roslibpy.Topic(ros, "/%s/out" % NAME, "std_msgs/String", queue_size=100)
    out.advertise()
    heard = roslibpy.Topic(ros, "/ref_%s/out" % NAME, "std_msgs/String", queue_length=100)
    heard.subscribe(lambda message: say("heard", message["data"]))
    service = roslibpy.Service(ros, "/%s/serve" % NAME, "std_srvs/Trigger")

    def serve(_request, response):
        response["success"], response["message"] = True, ""
        return True

    service.advertise(serve)
    say("ready")

    def call(_number):
        other = roslibpy.Service(ros, "/ref_%s/serve" % NAME, "std_srvs/Trigger")
        other.call(roslibpy.ServiceRequest(), timeout=30)

    def param(number):
        value = roslibpy.Param(ros, "/%s/value" % NAME)
        value.set(number, timeout=30)
        got = value.get(timeout=30)
        if got != number:
            raise ServiceException("got %r" % got)

    for what, act in (("call", call), ("param", param)):
        threading.Thread(target=forever, args=(what, act), daemon=True).start()
    number = 0
    while True:
        number += 1
        out.publish(roslibpy.Message({"data": str(number)}))
        time.sleep(0.1)


def main():
    port = free_port()
    start_bridge(port)
    if CLIENT == "roslibpy":
        run(port)
    else:
        script = pathlib.Path(__file__).with_name("roslib.mjs")
        subprocess.run(["node", script, FOLDER, NAME, str(port)], check=True)


if __name__ == "__main__":
    main()
