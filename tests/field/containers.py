#!/usr/bin/python3
"""Kills the master and rosrescue in containers, and checks that nodes in other containers notice nothing.

Layouts, each with nodes of rospy and roscpp in a container of their own:

    bridge   master, rosrescue as `proxy`, nodes on a network with names
    host     the same on the host's network
    vendor   a vendor's container with a roscore and nodes of its own, which know nothing of rosrescue; rosrescue beside
             it with --resync-interval, and other nodes that use rosrescue

The victims are the master's and rosrescue's container in turn; of the vendor's container only the roscore, or its
rosmaster, which a loop in that container starts again. A container is killed by `podman kill` and started after a pause,
or its process is killed and the restart policy starts it at once, or it is removed and made again.

After each kill: no gap between the numbers of messages, no link made or lost, no node's process ended, a parameter was
read all the time that the master was away, `rostopic list` works during the outage and after it, and the master has all
publishers and subscribers. Prints each failure, a row of Markdown for each layout, and the times until calls pass to a
new master.

A Linux bridge takes the lowest hardware address of its ports, so that address may change when a container is started or
killed. Podman's name server is at the bridge, and containers that remember the old address cannot reach it for up to a
minute. So the bridge gets a fixed address, unless --moving-bridge is given.
"""

import argparse
import http.client
import json
import os
import random
import shlex
import shutil
import socket
import statistics
import subprocess
import sys
import threading
import time
import xmlrpc.client

PODMAN = shlex.split(os.environ.get("PODMAN", "podman"))
LIMITS = shlex.split(os.environ.get("LIMITS", ""))
PAUSES = [0, 0.5, 1, 2, 3, 5, 8, 12, 20]
# Until everything must be well after a container was started. It includes the start of a rosmaster on a busy computer.
PATIENCE = 90


def podman(*arguments, check=True):
    done = subprocess.run([*PODMAN, *arguments], capture_output=True, text=True)
    if check and done.returncode:
        raise RuntimeError("podman %s: %s" % (" ".join(arguments), done.stderr))
    return done.stdout.strip()


def within(seconds, what):
    """Waits until `what` returns something true, and returns it; the last result after `seconds`."""
    end = time.monotonic() + seconds
    while True:
        try:
            result = what()
        except (OSError, xmlrpc.client.Error, http.client.HTTPException, ValueError, RuntimeError):
            result = None
        if result or time.monotonic() > end:
            return result
        time.sleep(0.05)


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Transport(xmlrpc.client.Transport):
    """Limits the time of a call."""

    def make_connection(self, host):
        connection = super().make_connection(host)
        connection.timeout = 5
        return connection


class Layout:
    def __init__(self, kind, options, chance):
        self.kind, self.options, self.chance = kind, options, chance
        self.tag = "rosrescue-field-%d" % os.getpid()
        self.failures = []
        self.kills = {}
        self.returns = []
        self.away = False
        self.ended = threading.Event()
        self.reads = self.read_longest = 0
        self.commands = {}
        self.said = os.path.join(options.said, kind)
        shutil.rmtree(self.said, ignore_errors=True)
        os.makedirs(self.said)
        os.chmod(self.said, 0o777)
        self.host = kind == "host"
        self.port, self.master_port = (free_port(), free_port()) if self.host else (11311, 11312)
        if kind == "vendor":
            self.master_port = 11311
        self.master = "vendor" if kind == "vendor" else "master"
        self.inside = kind == "vendor"

    # Containers

    def full(self, name):
        return "%s-%s" % (self.tag, name)

    def host_of(self, name):
        return "127.0.0.1" if self.host else self.full(name)

    def run(self, name, image, command, *more):
        network = "host" if self.host else self.tag
        own = "ROS_IP=127.0.0.1" if self.host else "ROS_HOSTNAME=" + self.full(name)
        uri = "http://%s:%d" % (self.host_of("rosrescue"), self.port)
        arguments = ["run", "--detach", "--name", self.full(name), *LIMITS, "--network", network, "--tmpfs", "/tmp"]
        arguments += ["--volume", os.path.abspath(self.options.nodes) + ":/nodes:ro", "--volume", self.said + ":/said"]
        arguments += ["--env", own, "--env", "ROS_MASTER_URI=" + uri, "--env", "PYTHONDONTWRITEBYTECODE=1"]
        self.commands[name] = [*arguments, *more, image, *command]
        podman(*self.commands[name])

    def node(self, name, program, *arguments):
        line = "exec /nodes/%s %s __name:=%s >/said/%s 2>/said/%s.err" % (program, " ".join(arguments), name, name, name)
        self.run(name, self.options.ros, ["sh", "-c", line])

    def address(self, name):
        if self.host:
            return "127.0.0.1"
        format = "{{(index .NetworkSettings.Networks \"%s\").IPAddress}}" % self.tag
        return podman("inspect", "--format", format, self.full(name))

    def state(self, name):
        return podman("inspect", "--format", "{{.State.Running}} {{.State.Pid}} {{.RestartCount}}", self.full(name))

    def start(self):
        if not self.host:
            podman("network", "create", self.tag)
        if self.inside:
            # ROS_MASTER_URI of the vendor's programs is their own roscore.
            loop = """
                export ROS_MASTER_URI=http://localhost:11311
                (until rostopic list; do sleep 1; done
                /nodes/talker.py 20 quiet __name:=vendor_talker >/said/vendor_talker 2>/said/vendor_talker.err &
                exec /nodes/listener.py 20 __name:=vendor_listener >/said/vendor_listener 2>/said/vendor_listener.err) &
                while :; do roscore; sleep $(cat /said/pause); done >/said/roscore 2>&1"""
            self.pause(1)
            self.run("vendor", self.options.ros, ["sh", "-c", loop], "--restart", "always")
        else:
            command = ["rosmaster", "--core", "-p", str(self.master_port)]
            self.run("master", self.options.ros, command, "--restart", "always")
        proxy = ["proxy", "--master", "http://%s:%d" % (self.host_of(self.master), self.master_port)]
        if self.inside:
            proxy += ["--resync-interval", "1"]
        podman("volume", "create", self.tag)
        self.run("rosrescue", self.options.image, proxy, "--restart", "always", "--volume", self.tag + ":/var/lib/rosrescue")
        if not self.host and not self.options.moving_bridge:
            bridge = podman("network", "inspect", "--format", "{{.NetworkInterface}}", self.tag)
            with open("/sys/class/net/%s/address" % bridge) as file:
                address = file.read().strip()
            # Setting even the present address keeps it.
            subprocess.run(["ip", "link", "set", bridge, "address", address], check=True)
        self.find()
        if not within(30, lambda: self.status()["open"]):
            raise RuntimeError("rosrescue does not pass calls")
        self.talkers, self.listeners = ["talker_py", "talker_cpp"], ["listener_py", "listener_cpp"]
        self.node("talker_py", "talker.py", "50", "quiet")
        self.node("talker_cpp", "talker", "50", "quiet")
        self.node("listener_py", "listener.py", "20")
        self.node("listener_cpp", "listener", "20")
        self.run("probe", self.options.ros, ["sleep", "infinity"])
        self.nodes = [*self.talkers, *self.listeners]
        if self.inside:
            self.talkers.append("vendor_talker")
            self.listeners.append("vendor_listener")
        self.call().setParam("/driver", "/field", [1, "two"])
        if not within(40, lambda: self.graph() and self.flows({})):
            raise RuntimeError("the nodes do not find each other: %s" % self.call().getSystemState("/driver"))
        time.sleep(1)
        self.began = {node: self.state(node) for node in self.nodes}
        self.first = {name: len(self.lines(name)) for name in self.listeners + self.talkers}
        threading.Thread(target=self.read_always, daemon=True).start()

    def stop(self):
        self.ended.set()
        for name in self.commands:
            podman("rm", "--force", "--time", "0", "--volumes", self.full(name), check=False)
        podman("volume", "rm", "--force", self.tag, check=False)
        if not self.host:
            podman("network", "rm", "--force", self.tag, check=False)

    def pause(self, seconds):
        with open(os.path.join(self.said, "pause"), "w") as file:
            file.write(str(seconds))

    # What can be seen

    def find(self):
        self.at = self.address("rosrescue")

    def call(self):
        return xmlrpc.client.ServerProxy("http://%s:%d" % (self.at, self.port), transport=Transport())

    def status(self):
        connection = http.client.HTTPConnection(self.at, self.port, timeout=5)
        connection.request("GET", "/status.json")
        return json.load(connection.getresponse())

    def graph(self):
        """Whether the master, not the mirror, knows all nodes."""
        publishers, subscribers, _ = self.call().getSystemState("/driver")[2]
        publishers, subscribers = dict(publishers), dict(subscribers)
        return (
            set("/" + name for name in self.talkers) == set(publishers.get("/chatter", []))
            and set("/" + name for name in self.listeners) == set(subscribers.get("/chatter", []))
            and self.status()["open"]
        )

    def lines(self, name):
        with open(os.path.join(self.said, name)) as file:
            return file.read().splitlines()

    def got(self):
        """The last number of each talker at each listener."""
        last = {}
        for listener in self.listeners:
            for line in self.lines(listener):
                if line.startswith("got "):
                    _, talker, number = line.split()
                    last[listener, talker] = int(number)
        return last

    def flows(self, before):
        """Whether each listener has got messages of each talker since `before`."""
        now = self.got()
        pairs = [(listener, "/" + talker) for listener in self.listeners for talker in self.talkers]
        return all(now.get(pair, 0) > before.get(pair, 0) for pair in pairs)

    def read_always(self):
        """Reads a parameter with a new connection ten times a second while rosrescue is there."""
        while not self.ended.wait(0.1):
            if self.away:
                continue
            began = time.monotonic()
            try:
                answer = self.call().getParam("/driver", "/field")
            except Exception as error:
                answer = [0, repr(error), None]
            if self.away:
                continue
            self.reads += 1
            self.read_longest = max(self.read_longest, time.monotonic() - began)
            if answer[0] != 1 or answer[2] != [1, "two"]:
                self.fail("a parameter was read as %s" % (answer,))

    def rostopic(self, when):
        """Runs a new `rostopic list`. The name of a container that was started may need a moment to be known."""
        began = time.monotonic()
        command = [*PODMAN, "exec", self.full("probe"), "timeout", "20", "rostopic", "list"]
        while True:
            tried = time.monotonic()
            listed = subprocess.run(command, capture_output=True, text=True)
            if "/chatter" in listed.stdout.split():
                break
            if time.monotonic() - began > 40:
                self.fail("rostopic list %s: %r" % (when, listed))
                return
        if tried > began + 1:
            print("%s: rostopic list %s worked only after %.1f s" % (self.kind, when, tried - began), flush=True)

    def fail(self, text):
        self.failures.append(text)
        print("%s: FAILED: %s" % (self.kind, text), flush=True)

    # Kills

    def kill(self, victim, way, pause):
        name = self.full(victim)
        moment = None
        if victim == "vendor":
            self.pause(pause)
            if way == "roscore":
                # The parts of roscore do not survive it, as in a container that is for roscore alone.
                podman("exec", name, "pkill", "-KILL", "-f", "bin/(roscore|rosmaster)|lib/rosout", check=False)
            else:
                podman("exec", name, "pkill", "-KILL", "-f", "bin/rosmaster", check=False)
            self.during(pause)
            return None
        if victim == "rosrescue":
            self.away = True
        if way == "policy":
            moment = time.monotonic()
            os.kill(int(self.state(victim).split()[1]), 9)
        elif way == "start":
            podman("kill", "--signal", "KILL", name)
            podman("wait", name)
            self.during(pause if victim == self.master else pause / 4)
            moment = time.monotonic()
            podman("start", name)
        else:
            podman("rm", "--force", "--time", "0", name)
            self.during(pause if victim == self.master else pause / 4)
            moment = time.monotonic()
            podman(*self.commands[victim])
        return moment

    def during(self, pause):
        """Spends the time of an outage."""
        end = time.monotonic() + pause
        if pause >= 3 and not self.away:
            self.rostopic("while the master was away")
        time.sleep(max(0, end - time.monotonic()))

    def once(self, number, victim, way, pause):
        before = self.got()
        status = self.status()
        met, old = status["recoveries"], status["started"]
        moment = self.kill(victim, way, pause)
        if victim == "rosrescue":
            # The old one may need a moment to die.
            within(PATIENCE, lambda: self.find() or (self.status()["started"] != old and self.status()["ready"]))
            self.away = False
        listens = None
        if victim == "master" and within(PATIENCE, lambda: self.listens()):
            listens = time.monotonic()
        if not within(PATIENCE, lambda: self.status()["open"] and (victim == "rosrescue" or self.status()["recoveries"] > met)):
            self.fail("kill %d: rosrescue does not pass calls: %s" % (number, self.status()["condition"]))
        passed = time.monotonic()
        if listens:
            self.returns.append((pause, way, passed - moment, passed - listens))
            print("%s %d: %s after %g s: open %.2f s after its start, %.2f s after it listened" % (
                self.kind, number, way, pause, passed - moment, passed - listens), flush=True)
        else:
            print("%s %d: %s %s after %g s" % (self.kind, number, victim, way, pause), flush=True)
        if not within(10, self.graph):
            self.fail("kill %d: the master has %s" % (number, self.call().getSystemState("/driver")))
        published = self.call().getPublishedTopics("/driver", "")
        if ["/chatter", "std_msgs/String"] not in published[2]:
            self.fail("kill %d: getPublishedTopics: %s" % (number, published))
        self.rostopic("after kill %d" % number)
        if not within(5, lambda: self.flows(before)):
            self.fail("kill %d: messages stopped: %s" % (number, self.got()))
        for node, state in self.began.items():
            if self.state(node) != state:
                self.fail("kill %d: %s was %s and is %s" % (number, node, state, self.state(node)))
                self.began[node] = self.state(node)
        for name, first in self.first.items():
            new = self.lines(name)[first:]
            for line in new:
                if line.split()[0] in ("gap", "links"):
                    self.fail("kill %d: %s said %s" % (number, name, line))
            self.first[name] += len(new)
        self.kills[victim] = self.kills.get(victim, 0) + 1

    def listens(self):
        with socket.create_connection((self.address("master"), self.master_port), timeout=0.3):
            return True

    def play(self, kills):
        self.start()
        begin = self.got()
        if self.kind == "bridge":
            if podman("healthcheck", "run", self.full("rosrescue")):
                self.fail("the health check says that rosrescue is not healthy")
        ways = ["start", "policy", "start", "new"]
        pauses = []
        for number in range(1, kills + 1):
            victim = self.master if number % 2 or self.options.only_master else "rosrescue"
            if not pauses:
                pauses = PAUSES[:]
                self.chance.shuffle(pauses)
            pause = pauses.pop() if victim == self.master else self.chance.choice(PAUSES[:6])
            way = ways[number % 3 if self.options.only_master else number // 2 % 4]
            if victim == "vendor":
                way = ("roscore", "rosmaster")[number // 2 % 2]
            self.once(number, victim, way, 0 if way == "policy" else pause)
        if self.inside:
            refused = sum("run_id on parameter server does not match" in line for line in self.lines("roscore"))
            if refused:
                self.fail("%d times a new roscore ended because rosrescue had restored /run_id before it" % refused)
        # A node that starts now finds everybody.
        self.node("late", "listener.py", "20")
        late = os.path.join(self.said, "late")
        everybody = lambda: set(line.split()[1] for line in open(late) if line.startswith("got "))
        if not within(20, lambda: everybody() == set("/" + name for name in self.talkers)):
            self.fail("a node that starts at the end hears only %s" % everybody())
        end = self.got()
        messages = sum(end[pair] - begin[pair] for pair in begin)
        pauses = [float(line.split()[2]) for name in self.listeners for line in self.lines(name) if line.startswith("pause ")]
        updates = sum(line.startswith("update ") for name in self.listeners for line in self.lines(name))
        print("| %s | %s | %d | %.0f | %d, longest %.2f s | %d | %d |" % (
            self.kind, ", ".join("%d of %s" % (count, name) for name, count in sorted(self.kills.items())), messages,
            max(pauses), self.reads, self.read_longest, updates, len(self.failures)), flush=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--image", required=True)
    parser.add_argument("--ros", required=True)
    parser.add_argument("--nodes", required=True)
    parser.add_argument("--said", required=True, help="folder for what the nodes print")
    parser.add_argument("--kills", default="bridge=44,host=28,vendor=28")
    parser.add_argument("--only-master", action="store_true", help="rosrescue is not killed")
    parser.add_argument("--moving-bridge", action="store_true", help="let the bridge change its hardware address")
    parser.add_argument("--seed", type=int, default=None)
    options = parser.parse_args()
    options.said = os.path.abspath(options.said)
    seed = options.seed if options.seed is not None else random.randrange(10**6)
    print("--seed %d" % seed, flush=True)
    failures = 0
    for part in options.kills.split(","):
        kind, kills = part.split("=")
        layout = Layout(kind, options, random.Random("%d %s" % (seed, kind)))
        try:
            layout.play(int(kills))
        except Exception as error:
            layout.fail("%s: %s" % (type(error).__name__, error))
            for name in ("rosrescue", layout.master):
                subprocess.run([*PODMAN, "logs", "--tail", "10", layout.full(name)])
        finally:
            with open(os.path.join(layout.said, "log"), "w") as log:
                subprocess.run([*PODMAN, "logs", layout.full("rosrescue")], stdout=log, stderr=log)
            layout.stop()
        failures += len(layout.failures)
        if layout.returns:
            since_start, since_listening = ([one[at] for one in layout.returns] for at in (2, 3))
            print("%s: %d new masters; calls passed after %.2f s (median), %.2f s (longest) from the container's start,"
                  " %.2f and %.2f s from listening" % (kind, len(layout.returns), statistics.median(since_start),
                  max(since_start), statistics.median(since_listening), max(since_listening)), flush=True)
    print("failures: %d" % failures)
    sys.exit(failures > 0)


if __name__ == "__main__":
    main()
