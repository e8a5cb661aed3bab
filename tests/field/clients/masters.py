#!/usr/bin/python3
"""Tests masters other than rosmaster behind `rosrescue proxy`: whether calls pass, and if not, which error comes how soon.

    masters.py --work FOLDER --rosrescue PROGRAM

Writes FOLDER/masters.json.
"""

import argparse
import json
import os
import pathlib
import time
import xmlrpc.client

from measure import HERE, Process, Stage, free_port, wait

CALLS = [
    ("getPid",), ("getUri",), ("getSystemState",), ("getTopicTypes",), ("setParam", "/a", 1), ("getParam", "/a"),
    ("getParamNames",), ("registerService", "/s", "rosrpc://127.0.0.1:1", "http://127.0.0.1:1/"),
    ("lookupService", "/s"), ("unregisterService", "/s", "rosrpc://127.0.0.1:1"),
]


def answers(uri):
    """The master's answer to each call and to a multicall, or a text for each call that fails."""
    master, found = xmlrpc.client.ServerProxy(uri), {}
    for method, *params in CALLS:
        try:
            found[method] = getattr(master, method)("/measure", *params)
        except (OSError, xmlrpc.client.Error) as error:
            found[method] = repr(error)
    multi = xmlrpc.client.MultiCall(master)
    multi.getPid("/measure")
    try:
        found["system.multicall"] = list(multi())
    except (OSError, xmlrpc.client.Error) as error:
        found["system.multicall"] = repr(error)
    return found


def look(options, label, command):
    port, front = free_port(), free_port()
    env = dict(
        os.environ, ROS_IP="127.0.0.1", ROS_MASTER_URI="http://127.0.0.1:%d" % port,
        NODE_PATH=str(options.work / "node_modules"), ROS_HOME=str(options.work / "log"),
    )
    log = options.work / "log"
    log.mkdir(exist_ok=True)
    checkpoint = log / (label + ".yaml")
    checkpoint.unlink(missing_ok=True)
    master = Process(label, [word or port for word in command], env, log)
    result = {"bare": None, "said": "", "open": False}
    rescue = None
    try:
        if not wait(label + " listens", lambda: Stage.listens(port), 20):
            return result
        start = time.monotonic()
        uri, listen = "http://127.0.0.1:%d" % port, "127.0.0.1:%d" % front
        # This comes first, because the calls below change the master.
        rescue = Process(
            label + "-rosrescue",
            [options.rosrescue, "proxy", "-m", uri, "-l", listen, "--checkpoint", checkpoint], env, log,
        )
        warned = lambda: [line for line in list(rescue.lines) if "WARN" in line[1]]
        opened = lambda: any("pass" in words for _, words in list(rescue.lines))
        wait("rosrescue has seen " + label, lambda: warned() or opened(), 20)
        result["open"] = bool(opened())
        if warned():
            at, words = warned()[0]
            result["said"], result["after_ms"] = " ".join(words[2:]), round((at - start) * 1000)
        if result["open"]:
            result["behind"] = answers("http://" + listen)
        result["bare"] = answers(uri)
    finally:
        if rescue:
            # A clean stop, because the worker has a process group of its own.
            rescue.popen.terminate()
            rescue.popen.wait(20)
        master.end()
    return result


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--work", type=lambda path: pathlib.Path(path).resolve(), required=True)
    parser.add_argument("--rosrescue", type=lambda path: pathlib.Path(path).resolve(), required=True)
    options = parser.parse_args()
    results = {
        "ros-core-rs": look(options, "ros-core-rs", [options.work / "rust/debug/ros-core-rs"]),
        "@foxglove/ros1": look(options, "foxglove", ["node", HERE / "foxglove_master.js", None]),
    }
    (options.work / "masters.json").write_text(json.dumps(results, indent=1))
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
