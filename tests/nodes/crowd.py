#!/usr/bin/python3
"""Starts, kills, stops and replaces many small nodes at random, some at the ports of dead ones.

crowd.py ROUNDS SEED: ends with status 1 if a living node is not registered, if a node is shut down although no other
program has taken its name, or if a dead node stays registered.
"""

import os
import random
import select
import signal
import socketserver
import sys
import time
import xmlrpc.client
import xmlrpc.server

MASTER = os.environ["ROS_MASTER_URI"]
# A node is asked for its process id 2 s after its registration.
WATCHED_AFTER = 5
# How long a watched node may stay registered after its death on a busy computer.
PATIENCE = 20
ALIVE_MOST = 40


class Server(socketserver.ThreadingMixIn, xmlrpc.server.SimpleXMLRPCServer):
    daemon_threads = True


class Node:
    def __init__(self, name, port):
        self.name, self.since = name, time.monotonic()
        self.stopped = self.was_stopped = False
        self.reader, writer = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            try:
                run(name, port, writer)
            finally:
                os._exit(1)
        os.close(writer)
        self.port = int(self.line() or 0)

    def line(self):
        """The next word of the node; empty when it has ended."""
        return os.read(self.reader, 16).decode()

    def api(self):
        return f"http://127.0.0.1:{self.port}/"


def run(name, port, writer):
    server = Server(("127.0.0.1", port), logRequests=False, allow_none=True)

    def shut_down(*_):
        os.write(writer, b"shutdown")
        os._exit(0)

    server.register_function(shut_down, "shutdown")
    server.register_function(lambda *_: [1, "", os.getpid()], "getPid")
    topics = [["/crowd", "std_msgs/String"], [name, "std_msgs/String"]]
    server.register_function(lambda *_: [1, "", topics], "getPublications")
    for method in ["getSubscriptions", "publisherUpdate", "paramUpdate"]:
        server.register_function(lambda *_: [1, "", []], method)
    api = f"http://127.0.0.1:{server.server_address[1]}/"
    master = xmlrpc.client.ServerProxy(MASTER)
    for topic in ["/crowd", name]:
        master.registerPublisher(name, topic, "std_msgs/String", api)
    os.write(writer, str(server.server_address[1]).encode())
    server.serve_forever()


class Crowd:
    def __init__(self, seed):
        self.dice = random.Random(seed)
        self.master = xmlrpc.client.ServerProxy(MASTER)
        self.alive, self.dead, self.names = {}, {}, 0
        self.counts = dict.fromkeys(["started", "reused", "killed", "stopped", "displaced", "reaped"], 0)
        self.slowest = 0

    def start(self, name=None, port=0):
        if name is None:
            self.names += 1
            name = f"/crowd{self.names}"
        before = self.alive.pop(name, None)
        self.dead.pop(name, None)
        node = Node(name, port)
        if not node.port:
            # Another program has the port.
            os.close(node.reader)
            if before:
                self.alive[name] = before
            return
        self.counts["started"] += 1
        self.counts["reused"] += port > 0
        self.alive[name] = node
        if before:
            self.counts["displaced"] += 1
            # The master tells it to shut down, unless it is stopped.
            try:
                os.kill(before.pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
            os.close(before.reader)

    def kill(self, node):
        self.counts["killed"] += 1
        os.kill(node.pid, signal.SIGKILL)
        os.close(node.reader)
        del self.alive[node.name]
        node.killed = time.monotonic()
        # A node that was stopped may not have answered.
        node.watched = node.killed - node.since > WATCHED_AFTER and not node.was_stopped
        self.dead[node.name] = node

    def toggle(self, node):
        self.counts["stopped"] += not node.stopped
        os.kill(node.pid, signal.SIGCONT if node.stopped else signal.SIGSTOP)
        node.stopped = not node.stopped
        node.was_stopped = True

    def round(self):
        nodes = list(self.alive.values())
        dice = self.dice.random()
        if dice < 0.4 or not nodes:
            if len(nodes) < ALIVE_MOST:
                ghosts = list(self.dead.values())
                if ghosts and self.dice.random() < 0.7:
                    ghost = self.dice.choice(ghosts)
                    kind = self.dice.random()
                    # Another name at the ghost's port, the ghost's name at another port, or the same node again.
                    if kind < 0.5:
                        self.start(None, ghost.port)
                    elif kind < 0.8:
                        self.start(ghost.name, 0)
                    else:
                        self.start(ghost.name, ghost.port)
                else:
                    self.start()
            return
        node = self.dice.choice(nodes)
        if dice < 0.65:
            self.kill(node)
        elif dice < 0.85:
            self.toggle(node)
        else:
            self.start(node.name)

    def check(self):
        readers = {node.reader: node for node in self.alive.values()}
        for reader in select.select(list(readers), [], [], 0)[0]:
            raise SystemExit(f"innocent: {readers[reader].name} was shut down")
        topics = dict(self.master.getSystemState("/test")[2][0])
        registered = set(topics.get("/crowd", []))
        for name in self.alive:
            if name not in registered or name not in topics:
                raise SystemExit(f"living node {name} is not registered")
        for name, node in list(self.dead.items()):
            took = time.monotonic() - node.killed
            if name not in registered:
                if node.watched:
                    self.slowest = max(self.slowest, took)
                    self.counts["reaped"] += 1
                del self.dead[name]
            elif node.watched and took > PATIENCE:
                raise SystemExit(f"dead node {name} is still registered after {took:.1f} s")


def main():
    # Children that have ended leave no zombies.
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    rounds, seed = int(sys.argv[1]), int(sys.argv[2])
    crowd = Crowd(seed)
    try:
        for _ in range(rounds):
            crowd.round()
            # A pace at which some nodes live long enough to be watched.
            time.sleep(0.1)
            crowd.check()
        while any(node.watched for node in crowd.dead.values()):
            time.sleep(0.1)
            crowd.check()
    finally:
        for node in crowd.alive.values():
            os.kill(node.pid, signal.SIGKILL)
    print(f"passed: {crowd.counts}, slowest {crowd.slowest:.2f} s", flush=True)


main()
