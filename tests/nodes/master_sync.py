#!/usr/bin/python3
"""Makes the calls of multimaster_fkie's master_discovery and master_sync, in one direction, without their ROS nodes.

    master_sync.py OWN REMOTE NAMESPACE IGNORED...

Twice a second it reads the state of the master at REMOTE, as master_discovery does, and registers the nodes below
NAMESPACE with the master at OWN, under their own names and addresses, as master_sync does. It unregisters whatever the
remote master no longer has. Topics in IGNORED are left out, as by `_ignore_topics`. A subscriber that it has registered
is told of the publishers at both masters. After each pass that changed something it prints `synced JSON` with all
present registrations.
"""

import json
import sys
import time
import xmlrpc.client

NAME = "/master_sync"


def ask(master, calls):
    """The values of many calls, made in one multicall. None for each call that failed."""
    multi = xmlrpc.client.MultiCall(master)
    for method, *params in calls:
        getattr(multi, method)(NAME, *params)
    return [value if code == 1 else None for code, _, value in multi()] if calls else []


def remote_state(remote, namespace, ignored):
    """The registrations to make: (kind, node, topic or service, type or address, node's address)."""
    (publishers, subscribers, services), types = ask(remote, [("getSystemState",), ("getTopicTypes",)])
    types = dict(types)
    found = [
        (kind, node, topic, types.get(topic, "*"))
        for kind, listed in (("pub", publishers), ("sub", subscribers))
        for topic, nodes in listed
        for node in nodes
        if topic not in ignored
    ]
    names = [service for service, _ in services]
    at = dict(zip(names, ask(remote, [("lookupService", name) for name in names])))
    found += [("srv", node, service, at[service]) for service, nodes in services for node in nodes if at[service]]
    found = [one for one in found if one[1].startswith(namespace)]
    nodes = sorted({node for _, node, _, _ in found})
    uris = dict(zip(nodes, ask(remote, [("lookupNode", node) for node in nodes])))
    return {(*one, uris[one[1]]) for one in found if uris[one[1]]}


def unregister(kind, node, name, what, uri):
    return {
        "pub": ("unregisterPublisher", name, uri),
        "sub": ("unregisterSubscriber", name, uri),
        "srv": ("unregisterService", name, what),
    }[kind]


def register(kind, node, name, what, uri):
    return {
        "pub": ("registerPublisher", name, what, uri),
        "sub": ("registerSubscriber", name, what, uri),
        "srv": ("registerService", name, what, uri),
    }[kind]


def apply(own, remote, known, wanted):
    """Brings the master at OWN from `known` to `wanted`."""
    gone, new = sorted(known - wanted), sorted(wanted - known)
    multi = xmlrpc.client.MultiCall(own)
    for make, entries in ((unregister, gone), (register, new)):
        for one in entries:
            method, *params = make(*one)
            getattr(multi, method)(one[1], *params)
    results = list(multi())[len(gone):]
    for (kind, _, topic, _, uri), (code, _, publishers) in zip(new, results):
        if kind == "sub" and code == 1 and publishers:
            listed = ask(remote, [("getSystemState",)])[0][0]
            nodes = [node for name, nodes in listed if name == topic for node in nodes]
            there = ask(remote, [("lookupNode", node) for node in nodes])
            both = sorted({*publishers, *filter(None, there)})
            xmlrpc.client.ServerProxy(uri).publisherUpdate(NAME, topic, both)


def main():
    own, remote, namespace, *ignored = sys.argv[1:]
    own, remote = xmlrpc.client.ServerProxy(own), xmlrpc.client.ServerProxy(remote)
    known = set()
    while True:
        try:
            wanted = remote_state(remote, namespace, ignored)
            if wanted != known:
                apply(own, remote, known, wanted)
                known = wanted
                print("synced", json.dumps(sorted(known)), flush=True)
        except (OSError, xmlrpc.client.Error) as error:
            # One of the masters is away for a moment.
            print("again", error, flush=True)
        time.sleep(0.5)


if __name__ == "__main__":
    main()
