#!/usr/bin/python3
"""Runs other client libraries through deaths of master and worker, each beside a rospy node.

    measure.py --work FOLDER --rosrescue PROGRAM [--clients a,b] [--modes core,proxy] [--kills 3] [--away 60]

A client is a program that is given a name NAME and runs one node `/NAME`, beside a rospy node `/ref_NAME`
(reference.py). Each of the two

* publishes the numbers from 1 on `/OWN/out`, ten per second, and prints `heard NUMBER` for those of the other node;
* calls the other node's service `/OTHER/serve` five times a second, with a lookup each time: `call NUMBER MS`;
* sets and reads the parameter `/NAME/value` (the rospy node only reads): `param NUMBER MS`;
* prints `call-failed NUMBER MS WHY` or `param-failed NUMBER MS WHY` if that fails;
* prints `ready`, and `shutdown` when it is told to shut down.

All clients run side by side behind one rosrescue. Writes the lines of the tables to FOLDER/result.json, and all output
to FOLDER/log.
"""

import argparse
import json
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import threading
import time
import urllib.request
import xmlrpc.client

HERE = pathlib.Path(__file__).resolve().parent
NODES = HERE.parent.parent / "nodes"
KINDS = ("master", "worker", "both")
# Maximum time for anything on a busy computer, in seconds.
PATIENCE = 120


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait(what, holds, patience=PATIENCE):
    """Waits until `holds` is true. Returns whether that was in time."""
    end = time.monotonic() + patience
    while not holds():
        if time.monotonic() > end:
            print("    not in %d s: %s" % (patience, what), flush=True)
            return False
        time.sleep(0.05)
    return True


class Process:
    """A program whose output is kept, with the time of each line."""

    def __init__(self, label, command, env, log):
        self.label, self.lines = label, []
        self.log = open(log / (label + ".log"), "w")
        self.popen = subprocess.Popen(
            [str(word) for word in command], env=env, text=True, errors="replace",
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.popen.stdout:
            now = time.monotonic()
            self.log.write("%.3f %s" % (now, line))
            self.log.flush()
            self.lines.append((now, line.split()))

    def said(self, word, since=0.0, until=float("inf")):
        return [(at, words) for at, words in list(self.lines) if since <= at <= until and words[:1] == [word]]

    def lives(self):
        return self.popen.poll() is None

    def end(self):
        """Kills the program and everything that it has started."""
        try:
            os.killpg(self.popen.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self.popen.wait()


def kill(pid):
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        pass


class Stage:
    """A master, rosrescue in front of it unless `mode` is `bare`, and the environment of the nodes."""

    def __init__(self, options, mode):
        self.options, self.mode, self.all = options, mode, []
        self.port, self.master_port = free_port(), free_port()
        self.uri = "http://127.0.0.1:%d" % self.port
        self.home = options.work / "log" / mode
        shutil.rmtree(self.home, ignore_errors=True)
        self.home.mkdir(parents=True)
        self.away = self.home / "away"
        # Where message types are found; see run.sh.
        messages = str(options.work / "messages")
        self.env = dict(
            os.environ, ROS_IP="127.0.0.1", ROS_MASTER_URI=self.uri, ROS_HOME=str(self.home),
            ROS_LOG_DIR=str(self.home / "ros"), NODE_PATH=str(options.work / "node_modules"),
            ROS_PACKAGE_PATH="%s:%s/rosbridge_suite" % (messages, options.work), CMAKE_PREFIX_PATH=messages,
            PYTHONUNBUFFERED="1",
            PYTHONPATH=":".join([str(options.work / "rosbridge_suite/python"), os.environ.get("PYTHONPATH", "")]),
        )
        for proxy in ("http_proxy", "HTTP_PROXY"):
            self.env.pop(proxy, None)
        if mode == "bare":
            self.master_port = self.port
        if mode != "core":
            self.start_master()
        self.rescue = None
        common = ["--checkpoint", self.home / "latest-chkpt.yaml"]
        if mode == "core":
            command = ["core", "-p", self.port, "--rosmaster", NODES / "waiting_rosmaster.py"]
        elif mode == "proxy":
            command = ["proxy", "-m", "http://127.0.0.1:%d" % self.master_port, "-l", "127.0.0.1:%d" % self.port]
        if mode != "bare":
            self.rescue = self.start("rosrescue", [options.rosrescue] + command + common)

    def begin(self):
        """Waits until calls pass, and starts the programs that all clients share."""
        if self.rescue and not wait("rosrescue serves", self.open):
            raise RuntimeError("rosrescue does not serve")
        options = self.options
        if {"roslib", "roslibpy"} & set(options.clients):
            rosapi = options.work / "rosbridge_suite/rosapi/scripts/rosapi_node"
            self.start("rosapi", [options.work / "venv/bin/python", rosapi, "__name:=rosapi"])

    def start(self, label, command):
        process = Process(label, command, self.env, self.home)
        self.all.append(process)
        return process

    def start_master(self):
        program = self.options.master or [NODES / "waiting_rosmaster.py", "--core", "-p", self.master_port]
        self.master = self.start("master", program)
        assert wait("the master listens", lambda: self.listens(self.master_port))

    @staticmethod
    def listens(port):
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    def status(self):
        try:
            with urllib.request.urlopen(self.uri + "/status.json", timeout=5) as page:
                return json.load(page)
        except (OSError, ValueError):
            return {}

    def open(self):
        return self.status().get("open") is True

    def master_pid(self):
        return self.master.popen.pid if self.mode != "core" else self.status()["master_pid"]

    def worker_pid(self):
        """The child of the guardian that runs rosrescue."""
        for stat in pathlib.Path("/proc").glob("[0-9]*/stat"):
            try:
                name, _, rest = stat.read_text().partition("(")[2].rpartition(")")
            except OSError:
                continue
            if name == "rosrescue" and int(rest.split()[1]) == self.rescue.popen.pid:
                return int(stat.parent.name)
        raise RuntimeError("there is no worker")

    def kill(self, kind):
        """Causes one death, and waits until calls pass to a master again."""
        victims = []
        if kind in ("master", "both"):
            victims.append(self.master_pid())
        if kind in ("worker", "both"):
            victims.append(self.worker_pid())
        for victim in victims:
            kill(victim)
        if "worker" not in kind and self.mode == "core":
            wait("the death is noticed", lambda: self.status().get("master_pid") != victims[0], 10)
        if kind != "worker" and self.mode == "proxy":
            self.master.end()
            time.sleep(0.5)
            self.start_master()
        wait("recovery", self.open)

    def end(self):
        if self.rescue:
            self.rescue.popen.terminate()
            try:
                self.rescue.popen.wait(20)
            except subprocess.TimeoutExpired:
                print("    rosrescue does not stop", flush=True)
        for process in reversed(self.all):
            process.end()


def client_command(options, client, name):
    """The command that starts the node `name` of `client`."""
    rust = options.work / "rust" / "debug" / client
    if client in ("rosrust", "rosrust_async", "roslibrust"):
        return [rust, name]
    if client == "rosnodejs":
        return ["env", "ROS_PACKAGE_PATH=%s/messages" % options.work, "node", HERE / "rosnodejs.js", name]
    if client == "roslisp":
        return ["sbcl", "--script", HERE / "roslisp.lisp", name]
    if client in ("roslibpy", "roslib"):
        return [options.work / "venv" / "bin" / "python", HERE / "rosbridge.py", options.work, client, name]
    if client == "xmlrpc2":
        return [options.python2, HERE / "xmlrpc_node.py", name]
    assert client == "xmlrpc3", client
    return ["/usr/bin/python3", HERE / "xmlrpc_node.py", name]


# What a client cannot do. `serve`: its service closes connections of rospy, because these name no type.
LACKS = {
    "roslibrust": {"param"},
    "rosrust_async": {"serve"},
    "xmlrpc2": {"heard", "call"},
    "xmlrpc3": {"heard", "call"},
}


class Pair:
    """A client and the rospy node beside it."""

    def __init__(self, stage, client, name):
        self.stage, self.client, self.name = stage, client, name
        self.reference = stage.start("ref_" + name, ["/usr/bin/python3", HERE / "reference.py", name])
        self.node = stage.start(name, client_command(stage.options, client, name))
        self.lacks = LACKS.get(client, set())

    def kinds(self):
        """The words that both print when they work, as `(process, word)`."""
        words = [word for word in ("heard", "call", "param") if word not in self.lacks]
        both = [(process, word) for process in (self.reference, self.node) for word in words]
        return [one for one in both if not ("serve" in self.lacks and one == (self.reference, "call"))]

    def whole(self, since):
        return all(process.said(word, since) for process, word in self.kinds())

    def counts(self, since, until):
        """Counts what succeeded and what failed between two times."""
        sums = {"heard": 0, "lost": 0, "calls": 0, "failed": 0, "longest": 0, "silent": [], "why": []}
        for process, word in self.kinds():
            said = process.said(word, since, until)
            if not said or said[-1][0] < until - 5:
                sums["silent"].append("%s: %s" % (process.label, word))
            if word == "heard":
                numbers = [int(words[1]) for _, words in said]
                sums["heard"] += len(numbers)
                if numbers:
                    sums["lost"] += max(numbers) - min(numbers) + 1 - len(set(numbers))
                continue
            failed = process.said(word + "-failed", since, until)
            sums["calls"] += len(said) + len(failed)
            sums["failed"] += len(failed)
            sums["why"] += [" ".join(words[1:]) for _, words in failed][:5]
            times = [int(words[2]) for _, words in said + failed]
            sums["longest"] = max([sums["longest"], *times])
        return sums


def namesakes(stage, pair, patience=15):
    """Starts a second node with the name of the one in `pair`. Returns how the first one reacts."""
    master = xmlrpc.client.ServerProxy(stage.uri)
    first, before = pair.node, master.lookupNode("/measure", "/" + pair.name)[2]
    start = time.monotonic()
    pair.node = stage.start(pair.name + "_again", client_command(stage.options, pair.client, pair.name))
    wait("namesake of " + pair.name, lambda: first.said("shutdown") or not first.lives(), patience)
    told = bool(first.said("shutdown"))
    wait("the end of the first " + pair.name, lambda: not first.lives(), 3 if told else 0)
    outcome = {(True, False): "ends", (False, False): "ends", (True, True): "stops, its process goes on"}.get(
        (told, first.lives()), "goes on"
    )
    works = wait("the second %s works" % pair.name, lambda: pair.whole(start + 0.5), 30)
    after = master.lookupNode("/measure", "/" + pair.name)[2]
    return {"first": outcome, "second": works, "registered": after != before and bool(after)}


def measure(options, mode):
    """Measures all spans of time in a mode: {client: {window: counts}}."""
    print("==", mode, flush=True)
    stage = Stage(options, mode)
    results = {client: {} for client in options.clients}
    try:
        stage.begin()
        pairs = {client: Pair(stage, client, client) for client in options.clients}
        for client, pair in list(pairs.items()):
            if not wait("%s works" % client, lambda pair=pair: pair.whole(0)):
                results[client]["start"] = "does not work at the start"
                del pairs[client]
        if mode == "bare":
            # Counts losses and failures without any death.
            since = time.monotonic()
            time.sleep(20)
            for client, pair in pairs.items():
                results[client]["quiet"] = pair.counts(since, time.monotonic())
            for client, pair in pairs.items():
                results[client]["namesakes"] = namesakes(stage, pair)
            return results

        def window(name, since, over):
            until = time.monotonic()
            for client, pair in over.items():
                results[client][name] = pair.counts(since, until)
                print("  %-8s %-14s %s" % (name, client, results[client][name]), flush=True)

        for kind in KINDS:
            since = time.monotonic()
            for _ in range(options.kills):
                stage.kill(kind)
                # Fewer deaths than a crash loop has.
                time.sleep(12)
            window(kind, since, pairs)
        # A long time without a master, during which nodes start and displace each other.
        since = time.monotonic()
        stage.away.touch()
        kill(stage.master_pid())
        wait("the mirror stands in", lambda: stage.status().get("open") is False)
        late = {client: Pair(stage, client, "late_" + client) for client in pairs}
        for client, pair in late.items():
            works = wait("a new %s works" % client, lambda pair=pair: pair.whole(0), 40)
            results[client]["newcomers"] = works
        for client, pair in late.items():
            if results[client]["newcomers"]:
                results[client]["namesakes_away"] = namesakes(stage, pair)
        time.sleep(max(0.0, since + options.away - time.monotonic()))
        assert stage.status().get("open") is False, "a master came unasked"
        print("  away for %d s" % (time.monotonic() - since), flush=True)
        window("away", since, pairs)
        since = time.monotonic()
        stage.away.unlink()
        if mode == "proxy":
            stage.master.end()
            stage.start_master()
        wait("recovery", stage.open)
        time.sleep(12)
        window("back", since, pairs)
        for client, pair in pairs.items():
            results[client]["namesakes"] = namesakes(stage, pair)
        results["rosrescue"] = {key: stage.status().get(key) for key in ("version", "counters")}
    finally:
        stage.end()
    return results


def stop(*_):
    raise SystemExit("stopped")


def main():
    signal.signal(signal.SIGTERM, stop)
    parser = argparse.ArgumentParser()
    parser.add_argument("--work", type=lambda path: pathlib.Path(path).resolve(), required=True)
    parser.add_argument("--rosrescue", type=lambda path: pathlib.Path(path).resolve(), required=True)
    parser.add_argument("--clients", type=lambda text: text.split(","), required=True)
    parser.add_argument("--modes", type=lambda text: text.split(","), default=["bare", "core", "proxy"])
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--away", type=float, default=60)
    parser.add_argument("--python2", default="python2")
    parser.add_argument("--master", nargs="*", default=None)
    options = parser.parse_args()
    path = options.work / "result.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    for mode in options.modes:
        results.setdefault(mode, {}).update(measure(options, mode))
        path.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
