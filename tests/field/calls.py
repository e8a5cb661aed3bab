#!/usr/bin/python3
"""Measures the time of a call to a rosmaster that speaks HTTP/1.0 and has 80 nodes: bare, and through rosrescue.

    tests/field/calls.py ROSRESCUE [TURNS]      prints a table as Markdown

The three take turns of half a second, in one run: what counts is the ratio. One caller; connecting is part of a call.
"""

import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import xmlrpc.client

NODES = 80
TURN = 0.5
rosrescue = sys.argv[1]
turns = int(sys.argv[2]) if len(sys.argv) > 2 else 20


def free_port():
    """A port at which no program listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def exchange(port, body):
    """Makes one call on a new connection."""
    head = "POST /RPC2 HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n" % len(body)
    with socket.create_connection(("127.0.0.1", port)) as stream:
        stream.sendall(head.encode() + body)
        answer = b""
        while b"</methodResponse>" not in answer:
            more = stream.recv(1 << 16)
            assert more, answer
            answer += more
    return answer


class Party:
    """A master, with or without rosrescue in front of it."""

    def __init__(self, name, scratch):
        self.name, self.port, self.processes = name, free_port(), []
        environment = dict(os.environ, ROS_HOME=scratch, ROS_LOG_DIR=scratch, ROS_IP="127.0.0.1")
        self.environment = {key: value for key, value in environment.items() if key != "ROS_MASTER_URI"}
        master = free_port() if name == "proxy" else self.port
        if name == "core":
            self.start(rosrescue, "core", "-p", str(self.port))
        else:
            self.start("rosmaster", "--core", "-p", str(master))
        if name == "proxy":
            listen = "127.0.0.1:%d" % self.port
            self.start(rosrescue, "proxy", "--master", "http://127.0.0.1:%d" % master, "--listen", listen)
        self.fill()

    def start(self, *command):
        """Runs rosmaster so that it sees a kernel before 4.16."""
        command = ["setarch", os.uname().machine, "--uname-2.6", *command]
        self.processes.append(
            subprocess.Popen(command, env=self.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        )

    def fill(self):
        """Waits until the master answers, and makes seven registrations per node."""
        master = xmlrpc.client.ServerProxy("http://127.0.0.1:%d" % self.port)
        deadline = time.monotonic() + 60
        while True:
            try:
                master.getSystemState("/calls")
                break
            except OSError:
                assert time.monotonic() < deadline, self.name
                time.sleep(0.1)
        for node in range(NODES):
            name, api = "/node%d" % node, "http://127.0.0.1:%d/" % (node + 1)
            master.registerService(name, name + "/get_loggers", "rosrpc://127.0.0.1:1", api)
            master.registerService(name, name + "/set_logger_level", "rosrpc://127.0.0.1:1", api)
            master.registerPublisher(name, "/rosout", "rosgraph_msgs/Log", api)
            for topic in range(2):
                master.registerPublisher(name, "/topic%d_%d" % (node, topic), "std_msgs/String", api)
                master.registerSubscriber(name, "/topic%d_%d" % ((node + 1) % NODES, topic), "std_msgs/String", api)

    def end(self):
        for process in reversed(self.processes):
            process.send_signal(signal.SIGTERM)
            process.wait()


def body(method, *params):
    return xmlrpc.client.dumps(params, method).encode()


with tempfile.TemporaryDirectory() as scratch:
    parties = []
    try:
        for name in ["bare", "core", "proxy"]:
            os.mkdir(os.path.join(scratch, name))
            parties.append(Party(name, os.path.join(scratch, name)))
        assert exchange(parties[0].port, body("getPid", "/calls")).startswith(b"HTTP/1.0")
        print("| call | bare rosmaster | `core` | ratio | `proxy` | ratio |\n|---|--:|--:|--:|--:|--:|")
        for call in ["getParam", "setParam", "lookupNode", "getSystemState"]:
            times = {party.name: [] for party in parties}
            number = 0
            for party in parties:
                exchange(party.port, body("setParam", "/calls", "/gain", 0))
            for turn in range(turns):
                for place in range(len(parties)):
                    party = parties[(turn + place) % len(parties)]
                    end = time.monotonic() + TURN
                    while time.monotonic() < end:
                        number += 1
                        params = {
                            "getParam": ["/gain"],
                            "setParam": ["/gain", number],
                            "lookupNode": ["/node7"],
                            "getSystemState": [],
                        }[call]
                        request = body(call, "/calls", *params)
                        begin = time.monotonic()
                        answer = exchange(party.port, request)
                        times[party.name].append(time.monotonic() - begin)
                        assert answer.split(b"\r\n")[0].endswith(b"200 OK"), answer
            bare, core, proxy = (statistics.median(times[party.name]) * 1e3 for party in parties)
            print("| %s | %.2f | %.2f | %.2f | %.2f | %.2f |" % (call, bare, core, core / bare, proxy, proxy / bare))
    finally:
        for party in parties:
            party.end()
