#!/usr/bin/python3
"""Several robots in network namespaces, synchronised by multimaster_fkie, each behind its own `rosrescue core`.

    measure.py --work FOLDER --rosrescue PROGRAM [--robots 10] [--deaths 100] [--minutes 60] [--seed N]

Robot I has the node /rI/teleop, which publishes /cmd_vel, and the node /rI/base, which subscribes to it, publishes
/rI/odom, subscribes to the next robot's odometry and offers /rI/reset. /cmd_vel is filtered, so each robot has its own.
What dies is a master, a worker, or both, or a link is cut for 3 to 30 s. After each death the graphs must become equal
to those at the start, and no filtered registration may be seen at any time. The exit status is 1 if anything was wrong.
Needs root.
"""

import argparse
import ctypes
import json
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
import xmlrpc.client

HERE = pathlib.Path(__file__).resolve().parent
LAN = "rrlan%d" % os.getpid()
FILTERED = ["/cmd_vel", "/rosout", "/rosout_agg"]
# Maximum time for anything on a busy computer, in seconds.
PATIENCE = 180
READ = """
import json, sys, xmlrpc.client
master = xmlrpc.client.ServerProxy(sys.argv[1])
print(json.dumps(master.getSystemState('/measure')[2]))
"""


def ip(words):
    subprocess.run(["ip"] + words.split(), check=True)


def wait(what, holds, patience=PATIENCE):
    end = time.monotonic() + patience
    while not holds():
        if time.monotonic() > end:
            print("    not in %d s: %s" % (patience, what), flush=True)
            return False
        time.sleep(0.2)
    return True


def normal(state):
    """A system state without order, as three dictionaries."""
    return [{name: sorted(nodes) for name, nodes in kind} for kind in state]


class Robot:
    def __init__(self, options, index):
        self.options, self.index, self.processes = options, index, {}
        self.name = "r%d" % index
        self.space, self.address = "%s%s" % (LAN, self.name), "10.99.0.%d" % (index + 10)
        self.uri = "http://%s:11311" % self.address
        self.home = options.work / "log" / self.name
        shutil.rmtree(self.home, ignore_errors=True)
        self.home.mkdir(parents=True)
        cable = "e%d-%d" % (os.getpid() % 100000, index)
        ip("netns add " + self.space)
        ip("-n %s link add %s type veth peer name eth0 netns %s" % (LAN, cable, self.space))
        ip("-n %s link set %s master lan up" % (LAN, cable))
        ip("-n %s link set lo up" % self.space)
        ip("-n %s addr add %s/24 dev eth0" % (self.space, self.address))
        self.join()
        self.env = dict(
            os.environ, ROS_IP=self.address, ROS_MASTER_URI=self.uri, ROS_HOME=str(self.home),
            ROS_LOG_DIR=str(self.home / "ros"), PYTHONPATH=str(options.work / "python"), PYTHONUNBUFFERED="1",
        )
        for proxy in ("http_proxy", "HTTP_PROXY"):
            self.env.pop(proxy, None)
        self.start("rosrescue", [options.rosrescue, "core", "--master-port", 11411, "--no-rosout"])

    def join(self):
        ip("-n %s link set eth0 up" % self.space)
        ip("-n %s route replace 224.0.0.0/4 dev eth0" % self.space)

    def leave(self):
        ip("-n %s link set eth0 down" % self.space)

    def inside(self, command):
        return ["ip", "netns", "exec", self.space] + [str(word) for word in command]

    def start(self, label, command):
        self.processes[label] = subprocess.Popen(
            self.inside(command), env=self.env, stdin=subprocess.DEVNULL, start_new_session=True,
            stdout=open(self.home / (label + ".log"), "w"), stderr=subprocess.STDOUT,
        )

    def start_nodes(self):
        own, other = self.name, "r%d" % ((self.index + 1) % self.options.robots)
        python, node = "/usr/bin/python3", HERE / "node.py"
        self.start("teleop", [python, node, "__ns:=/" + own, "__name:=teleop", "pub:/cmd_vel"])
        ends = ["sub:/cmd_vel", "pub:/%s/odom" % own, "sub:/%s/odom" % other, "srv:/%s/reset" % own]
        self.start("base", [python, node, "__ns:=/" + own, "__name:=base", *ends])

    def start_sync(self):
        source = self.options.work / "fkie"
        python = "/usr/bin/python3"
        self.start("discovery", [python, source / "fkie_master_discovery/nodes/master_discovery"])
        ignored = "_ignore_topics:=[%s]" % ",".join(FILTERED)
        self.start("sync", [python, source / "fkie_master_sync/nodes/master_sync", ignored])

    def status(self):
        try:
            with urllib.request.urlopen(self.uri + "/status.json", timeout=5) as page:
                return json.load(page)
        except (OSError, ValueError):
            return {}

    def graph(self):
        """The answer of rosrescue. None if there is none."""
        try:
            return normal(xmlrpc.client.ServerProxy(self.uri).getSystemState("/measure")[2])
        except (OSError, xmlrpc.client.Error):
            return None

    def master_graph(self):
        """The answer of the real master."""
        command = self.inside(["/usr/bin/python3", "-c", READ, "http://127.0.0.1:11411"])
        read = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False)
        return normal(json.loads(read.stdout)) if read.returncode == 0 else None

    def worker_pid(self):
        """The child of the guardian. The process of `ip` has become the guardian."""
        children = pathlib.Path("/proc/{0}/task/{0}/children".format(self.processes["rosrescue"].pid))
        for pid in children.read_text().split():
            if pathlib.Path("/proc", pid, "comm").read_text().strip() == "rosrescue":
                return int(pid)
        raise RuntimeError("there is no worker")

    def dead(self):
        """Labels of programs that have ended, which none of them should do."""
        return [label for label, process in self.processes.items() if process.poll() is not None]

    def end(self):
        for process in reversed(list(self.processes.values())):
            try:
                os.killpg(process.pid, signal.SIGTERM if process is self.processes["rosrescue"] else signal.SIGKILL)
            except ProcessLookupError:
                pass
        try:
            self.processes["rosrescue"].wait(15)
        except subprocess.TimeoutExpired:
            self.processes["rosrescue"].kill()
        subprocess.run(["ip", "netns", "del", self.space], check=False)


def expected(robots):
    """Whether the robots know each other, and no filtered registration is there."""
    for robot in robots:
        graph = robot.graph()
        if not graph:
            return False
        publishers, subscribers, services = graph
        for other in robots:
            base = "/%s/base" % other.name
            if publishers.get("/%s/odom" % other.name) != [base]:
                return False
            if services.get("/%s/reset" % other.name) != [base]:
                return False
            if "/r%d/base" % ((other.index - 1) % len(robots)) not in subscribers.get("/%s/odom" % other.name, []):
                return False
    return True


def filtered(robots):
    """Registrations of other robots that the filter forbids."""
    found = []
    for robot in robots:
        for kind in (robot.graph() or [])[:2]:
            for topic in FILTERED[:1]:
                foreign = [node for node in kind.get(topic, []) if not node.startswith("/%s/" % robot.name)]
                found += ["%s at %s of %s" % (topic, robot.name, node) for node in foreign]
    return found


def kill(pid):
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        pass


def die(robot, kind, dice):
    if kind == "link":
        robot.leave()
        time.sleep(dice.uniform(3, 30))
        robot.join()
        return
    master = robot.status().get("master_pid")
    victims = [master] if kind in ("master", "both") else []
    victims += [robot.worker_pid()] if kind in ("worker", "both") else []
    for victim in victims:
        if victim:
            kill(victim)


def differences(now, before):
    """The lines in which two graphs differ."""
    if now is None:
        return ["no answer"]
    lines = []
    for kind, one, other in zip(("pub", "sub", "srv"), now, before):
        for name in sorted({*one, *other}):
            if one.get(name) != other.get(name):
                lines.append("%s %s: %s instead of %s" % (kind, name, one.get(name), other.get(name)))
    return lines


def run(options, robots, dice):
    """The errors that were found, and what was done."""
    for robot in robots:
        wait("%s serves" % robot.name, lambda robot=robot: robot.status().get("open") is True)
        robot.start_nodes()
    for robot in robots:
        robot.start_sync()
    if not wait("all robots know each other", lambda: expected(robots), 600):
        for robot in robots:
            print(robot.name, json.dumps(robot.graph()), flush=True)
        return ["the robots do not find each other"], {}
    # Private topics of the synchronisation are filtered as well.
    before = None
    while before != (before := [robot.graph() for robot in robots]):
        time.sleep(5)
    print("%d robots, %d nodes each" % (len(robots), len({n for k in before[0] for ns in k.values() for n in ns})))
    wrong, done, longest, start = [], {}, 0.0, time.monotonic()
    for number in range(options.deaths):
        if time.monotonic() - start > options.minutes * 60:
            break
        robot, kind = dice.choice(robots), dice.choice(["master", "worker", "both", "link"])
        die(robot, kind, dice)
        done[kind] = done.get(kind, 0) + 1
        since = time.monotonic()

        def same():
            wrong.extend(filtered(robots))
            return all(one.graph() == graph for one, graph in zip(robots, before))

        quiet = wait("all graphs are what they were", same)
        quiet = quiet and wait("%s is open" % robot.name, lambda: robot.status().get("open") is True)
        # The health check has finished and changed nothing that matters.
        wait("the health check", lambda: robot.status().get("last_recovery", {}).get("health_check_ms") is not None)
        # The synchronisation may be changing something, but ends with the same state.
        if not wait("the master of " + robot.name, lambda: robot.master_graph() == before[robot.index], 60):
            lines = differences(robot.master_graph(), before[robot.index])
            wrong += ["master of %s: %s" % (robot.name, line) for line in lines]
        longest = max(longest, time.monotonic() - since)
        if not quiet:
            for one, graph in zip(robots, before):
                wrong += ["%s: %s" % (one.name, line) for line in differences(one.graph(), graph)]
        dead = ["%s of %s" % (label, one.name) for one in robots for label in one.dead()]
        wrong += ["ended: " + label for label in dead]
        print("%3d %-6s of %-3s %5.1f s %s" % (
            number + 1, kind, robot.name, time.monotonic() - since, wrong[:3] or ""), flush=True)
        if wrong:
            break
    # The synchronisation still works.
    own = robots[0]
    own.start("late", ["/usr/bin/python3", HERE / "node.py", "__ns:=/r0", "__name:=late", "pub:/r0/late"])
    late = lambda: all((one.graph() or [{}])[0].get("/r0/late") == ["/r0/late"] for one in robots)
    if not wait("all robots know a new node", late):
        wrong.append("sync does not go on")
    for robot in robots:
        for log in robot.home.glob("*.log"):
            if log.name in ("base.log", "teleop.log") and "shutdown" in log.read_text().split():
                wrong.append("%s of %s was told to shut down" % (log.stem, robot.name))
    minutes = (time.monotonic() - start) / 60
    return wrong, {"robots": len(robots), "deaths": done, "minutes": round(minutes, 1), "longest_s": round(longest, 1)}


def stop(*_):
    raise SystemExit("stopped")


def main():
    signal.signal(signal.SIGTERM, stop)
    parser = argparse.ArgumentParser()
    parser.add_argument("--work", type=lambda path: pathlib.Path(path).resolve(), required=True)
    parser.add_argument("--rosrescue", type=lambda path: pathlib.Path(path).resolve(), required=True)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--deaths", type=int, default=100)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 32))
    options = parser.parse_args()
    print("seed %d" % options.seed, flush=True)
    ip("netns add " + LAN)
    robots = []
    try:
        ip("-n %s link add lan type bridge mcast_snooping 0" % LAN)
        ip("-n %s addr add 10.99.0.1/24 dev lan" % LAN)
        ip("-n %s link set lan up" % LAN)
        # The rest runs on a host in the network that the robots share.
        enter(LAN)
        for index in range(options.robots):
            robots.append(Robot(options, index))
        wrong, done = run(options, robots, random.Random(options.seed))
    finally:
        for robot in robots:
            robot.end()
        subprocess.run(["ip", "netns", "del", LAN], check=False)
    done.update(wrong=wrong, seed=options.seed)
    print(json.dumps(done, indent=1))
    (options.work / "result.json").write_text(json.dumps(done))
    sys.exit(1 if wrong else 0)


def enter(space):
    """Moves this process into a network namespace, like os.setns of Python 3.12."""
    file = os.open("/run/netns/" + space, os.O_RDONLY)
    if ctypes.CDLL(None, use_errno=True).setns(file, 0x40000000) != 0:
        raise OSError(ctypes.get_errno(), "setns")


if __name__ == "__main__":
    main()
