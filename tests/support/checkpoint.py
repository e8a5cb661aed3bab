#!/usr/bin/python3
"""Compares a checkpoint, as PyYAML's safe loader reads it, with the parameters of a living master.

Usage: checkpoint.py FILE MASTER_URI. Prints `same`, or the first difference. Types, texts and the order
of the keys count. No line of rosrescue takes part in this.
"""

import datetime
import sys
import xmlrpc.client

import yaml


def canonical(value):
    """`value` with its type, in the same form for a value from YAML and one from the master."""
    if isinstance(value, dict):
        return "struct", [(key, canonical(member)) for key, member in value.items()]
    if isinstance(value, list) and len(value) == 1 and isinstance(value[0], tuple):
        kind, text = value[0]  # a type that YAML lacks
        return kind, text
    if isinstance(value, list):
        return "array", [canonical(element) for element in value]
    if isinstance(value, xmlrpc.client.DateTime):
        return "dateTime.iso8601", value.value
    if isinstance(value, datetime.datetime):  # a type that YAML has
        return "dateTime.iso8601", value.strftime("%Y%m%dT%H:%M:%S")
    if isinstance(value, xmlrpc.client.Binary):
        return "bytes", value.data
    return type(value).__name__, repr(value) if isinstance(value, float) else value


def replay(parameters, journal):
    """Applies the calls in the journal to `parameters`."""
    for record in journal or []:
        params = record.get("setParam") or record.get("deleteParam")
        if params is None:
            continue
        names = params[1].strip("/").split("/")
        tree = parameters
        for name in names[:-1]:
            if not isinstance(tree.get(name), dict):
                tree[name] = {}
            tree = tree[name]
        if "setParam" in record:
            tree[names[-1]] = params[2]
        else:
            del tree[names[-1]]
    return parameters


def difference(ours, theirs, path=""):
    """Describes the first difference."""
    if ours[0] == theirs[0] == "struct" and [k for k, _ in ours[1]] == [k for k, _ in theirs[1]]:
        for (key, mine), (_, yours) in zip(ours[1], theirs[1]):
            found = difference(mine, yours, path + "/" + key)
            if found:
                return found
        return None
    if ours == theirs:
        return None
    return "%s is %.300r in the checkpoint and %.300r in the master" % (path or "/", ours, theirs)


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        documents = list(yaml.safe_load_all(file))
    if len(documents) != 1:
        sys.exit("the checkpoint has %d documents" % len(documents))
    parameters = replay(documents[0]["parameters"], documents[0]["journal"])
    master = xmlrpc.client.ServerProxy(sys.argv[2])
    _code, _text, real = master.getParam("/test", "/")
    print(difference(canonical(parameters), canonical(real)) or "same")


if __name__ == "__main__":
    main()
