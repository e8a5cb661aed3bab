#!/usr/bin/python3
"""Starves a healthy master for an hour: `rosrescue core`, its rosmaster and 100 busy processes share 0.4 of a core.

    tests/starved.py [--seconds 3600] [--busy 100] [--cores 0.4] [--program target/debug/rosrescue]

They run in a control group of their own (version 1 or 2), so the rest of the computer stays usable. Callers outside of
it make at most ten writes a second. It fails if a master dies, or if a write is not in the master at the end. Needs
root and ROS 1.
"""

import argparse
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
import xmlrpc.client

CALLERS = 4
# A caller's pause between two writes, in seconds: ten writes a second by all of them at most.
PAUSE = 0.4
REPORT = 60
# How long a start or the last comparison may take, in seconds.
PATIENCE = 600
PERIOD = 100_000


def control_group(cores):
    name = f"rosrescue-starved-{os.getpid()}"
    quota = int(cores * PERIOD)
    if os.path.isdir("/sys/fs/cgroup/cpu"):
        group = f"/sys/fs/cgroup/cpu/{name}"
        # The shares let it have its part of a core beside other programs.
        limits = {"cpu.cfs_period_us": PERIOD, "cpu.cfs_quota_us": quota, "cpu.shares": 10_000}
    else:
        group = f"/sys/fs/cgroup/{name}"
        limits = {"cpu.max": f"{quota} {PERIOD}", "cpu.weight": 1000}
    os.mkdir(group)
    for file, limit in limits.items():
        with open(f"{group}/{file}", "w") as setting:
            setting.write(str(limit))
    return group


def processes(group):
    with open(f"{group}/cgroup.procs") as file:
        return [int(line) for line in file]


def end(group):
    deadline = time.monotonic() + PATIENCE
    while (pids := processes(group)) and time.monotonic() < deadline:
        for pid in pids:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
        time.sleep(0.2)
    os.rmdir(group)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def until(what, condition):
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            if condition():
                return
        except (OSError, xmlrpc.client.Error):
            pass
        if time.monotonic() > deadline:
            sys.exit(f"did not happen within {PATIENCE} s: {what}")
        time.sleep(0.2)


def status(uri):
    with urllib.request.urlopen(f"{uri}/status.json", timeout=PATIENCE) as page:
        return json.load(page)


class Caller(threading.Thread):
    """Sets a parameter to ever larger numbers."""

    def __init__(self, uri, number, stop):
        super().__init__(daemon=True)
        self.uri, self.key, self.stop = uri, f"/starved_{number}", stop
        self.waits, self.failed = [], None

    def run(self):
        master = xmlrpc.client.ServerProxy(self.uri)
        try:
            while not self.stop.wait(PAUSE):
                begin = time.monotonic()
                answer = master.setParam("/caller", self.key, len(self.waits) + 1)
                self.waits.append(time.monotonic() - begin)
                assert answer[0] == 1, answer
        except Exception as error:  # pylint: disable=broad-except
            self.failed = error


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600)
    parser.add_argument("--busy", type=int, default=100)
    parser.add_argument("--cores", type=float, default=0.4)
    parser.add_argument("--program", default="target/debug/rosrescue")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended by a signal"))
    group = control_group(options.cores)
    try:
        with tempfile.TemporaryDirectory() as home:
            return starve(options, group, home)
    finally:
        end(group)


def starve(options, group, home):
    def join():
        with open(f"{group}/cgroup.procs", "w") as file:
            file.write(str(os.getpid()))

    def start(command, **more):
        return subprocess.Popen(command, preexec_fn=join, stdin=subprocess.DEVNULL, **more)

    port, masters = free_port(), free_port()
    uri, bare = f"http://127.0.0.1:{port}", xmlrpc.client.ServerProxy(f"http://127.0.0.1:{masters}")
    environment = {**os.environ, "ROS_HOME": home, "ROS_IP": "127.0.0.1", "ROS_MASTER_URI": uri}
    command = [options.program, "core", "-p", str(port), "--master-port", str(masters)]
    with open(f"{home}/output", "w") as log:
        core = start(command, env=environment, stdout=log, stderr=log)
    until("the master answers", lambda: bare.getPid("/starved")[0] == 1)
    pid = bare.getPid("/starved")[2]
    for _ in range(options.busy):
        start(["sh", "-c", "while :; do :; done"])

    stop = threading.Event()
    callers = [Caller(uri, number, stop) for number in range(CALLERS)]
    for caller in callers:
        caller.start()
    begin = time.monotonic()
    while (elapsed := time.monotonic() - begin) < options.seconds and core.poll() is None:
        time.sleep(min(REPORT, options.seconds - elapsed))
        waits = [wait for caller in callers for wait in caller.waits]
        print(
            f"{time.monotonic() - begin:.0f} s: {len(waits)} writes, longest {max(waits, default=0):.2f} s, "
            f"{status(uri)['deaths']} deaths of the master",
            flush=True,
        )
    stop.set()
    for caller in callers:
        caller.join(PATIENCE)

    def same():
        return all(bare.getParam("/starved", caller.key)[2] == len(caller.waits) for caller in callers)

    until("the master has every write", same)
    deaths = status(uri)["deaths"]
    with open(f"{home}/output") as log:
        lines = log.read()
    waits = sorted(wait for caller in callers for wait in caller.waits)
    print(
        f"deaths of the master: {deaths}; spared: {lines.count('but is not killed')}; "
        f"{len(waits)} writes, median {waits[len(waits) // 2]:.3f} s, longest {waits[-1]:.2f} s"
    )
    failed = [caller.failed for caller in callers if caller.failed]
    if failed or deaths or bare.getPid("/starved")[2] != pid or re.search("panicked", lines):
        print(lines)
        sys.exit(f"a master died, or a call failed: {failed}")


if __name__ == "__main__":
    main()
