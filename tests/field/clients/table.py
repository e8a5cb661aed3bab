#!/usr/bin/python3
"""Writes the results between the marks of docs/compatibility.md.

    table.py clients|robots FOLDER DOCUMENT
"""

import datetime
import importlib.metadata
import json
import pathlib
import re
import subprocess
import sys

CLIENTS = [
    "rosnodejs", "roslibpy", "roslib", "roslisp", "rosrust", "rosrust_async", "roslibrust", "xmlrpc2", "xmlrpc3",
]
SHOWN = {"roslibpy": "rosbridge_suite, roslibpy", "roslib": "rosbridge_suite, roslib",
         "xmlrpc2": "xmlrpclib, Python 2", "xmlrpc3": "xmlrpc.client, Python 3"}


def output(*command):
    return subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False).stdout


def versions(work):
    """The version of each client that is installed in `work`."""
    found = {}
    bridge = re.search(r"<version>(.*)</version>", read(work / "rosbridge_suite/rosbridge_suite/package.xml"))
    for package in ("rosnodejs", "roslib", "@foxglove/ros1"):
        found[package] = json.loads(read(work / "node_modules" / package / "package.json") or "{}").get("version")
    for crate in ("rosrust", "rosrust_async", "roslibrust", "ros-core-rs"):
        lock = read(pathlib.Path(__file__).with_name("rust") / "Cargo.lock")
        version = re.search('name = "%s"\nversion = "(.*)"' % crate, lock)
        found[crate] = version and version[1]
    for path in importlib.metadata.distributions(path=[str(p) for p in work.glob("venv/lib/python*/site-packages")]):
        if path.metadata["Name"] == "roslibpy":
            found["roslibpy"] = path.version
    for client in ("roslib", "roslibpy"):
        found[client] = "%s, %s" % (bridge and bridge[1], found.get(client))
    found["roslisp"] = output("dpkg-query", "-W", "-f", "${Version}", "roslisp")
    found["xmlrpc2"], found["xmlrpc3"] = "2.7", output("/usr/bin/python3", "-V").split()[-1]
    return found


def read(path):
    return path.read_text() if path.exists() else ""


def cell(counts):
    """`lost of messages; failed of calls; the longest`."""
    if not isinstance(counts, dict):
        return "not tried"
    parts = ["%d of %d" % (counts["lost"], counts["heard"] + counts["lost"])] if counts["heard"] else []
    parts.append("%d of %d, %.1f s" % (counts["failed"], counts["calls"], counts["longest"] / 1000))
    if counts["silent"]:
        parts.append("**silent: %s**" % ", ".join(counts["silent"]))
    return "; ".join(parts)


def namesake(one):
    if not one:
        return "not tried"
    return one["first"] + ("" if one["second"] else "; the second one, too, or does not work")


def clients(work):
    results = json.loads(read(work / "result.json") or "{}")
    skipped = dict(line.split("\t", 1) for line in read(work / "skipped").splitlines())
    installed = versions(work)
    yield "Measured on %s on Debian's rosmaster." % datetime.date.today().isoformat()
    yield ""
    yield ("| client | | master killed | worker killed | both killed | 60 s without a master | a node that starts then "
           "| its namesake then | namesakes with a master |")
    yield "|---|---|---|---|---|---|---|---|---|"
    for client in CLIENTS:
        label = "%s (%s)" % (SHOWN.get(client, client), installed.get(client))
        for mode in ("bare", "core", "proxy"):
            one = results.get(mode, {}).get(client)
            if one is None or "start" in one:
                reason = skipped.get(client, "not run") if one is None else one["start"]
                yield "| %s | `%s` | not tried: %s |%s" % (label, mode, reason, " |" * 6)
                continue
            if mode == "bare":
                quiet, named = cell(one.get("quiet")), namesake(one.get("namesakes"))
                yield "| %s | bare | 20 s without a death: %s |%s %s |" % (label, quiet, " |" * 5, named)
                continue
            cells = [cell(one.get(window)) for window in ("master", "worker", "both", "away")]
            cells.append({True: "works", None: "not tried"}.get(one.get("newcomers"), "**does not work**"))
            cells += [namesake(one.get("namesakes_away")), namesake(one.get("namesakes"))]
            yield "| %s | `%s` | %s |" % (label, mode, " | ".join(cells))
    yield ""
    yield "| master behind `proxy` | calls pass | what rosrescue says, and after how long |"
    yield "|---|---|---|"
    for master, one in json.loads(read(work / "masters.json") or "{}").items():
        said = re.sub(r"http://\S+", "http://…", one["said"])
        yield "| %s (%s) | %s | %s, %.1f s |" % (
            master, installed.get(master), "yes" if one["open"] else "no", said, one.get("after_ms", 0) / 1000)


def robots(work):
    one = json.loads(read(work / "result.json") or "{}")
    deaths = one.get("deaths", {})
    yield "| robots | deaths | minutes | longest until all graphs were as before | wrong |"
    yield "|---|---|---|---|---|"
    yield "| %s | %d: %s | %s | %s s | %s |" % (
        one.get("robots"), sum(deaths.values()), ", ".join("%s %d" % pair for pair in sorted(deaths.items())),
        one.get("minutes"), one.get("longest_s"), "; ".join(one.get("wrong", [])) or "nothing")
    yield ""
    yield "Measured on %s, seed %s." % (datetime.date.today().isoformat(), one.get("seed"))


def main():
    what, work, document = sys.argv[1], pathlib.Path(sys.argv[2]), pathlib.Path(sys.argv[3])
    lines = {"clients": clients, "robots": robots}[what](work)
    begin, end = "<!-- %s: begin -->" % what, "<!-- %s: end -->" % what
    text = document.read_text()
    before, rest = text.split(begin)
    document.write_text("%s%s\n\n%s\n\n%s%s" % (before, begin, "\n".join(lines), end, rest.split(end)[1]))


if __name__ == "__main__":
    main()
