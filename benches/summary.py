#!/usr/bin/python3
"""Writes the tables of docs/benchmarks.md and the numbers of README.md, all taken from benches/results.md.

With --check it writes nothing, and fails if one of the two is not what it would write.
"""

import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
RESULTS = (ROOT / "benches/results.md").read_text()
NONE = "–"


def section(name):
    """The text that a benchmark has written."""
    return RESULTS.split(f"<!-- {name}:begin -->")[1].split(f"<!-- {name}:end -->")[0]


def row_cells(line):
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


class Table:
    """A table of results.md: the first one of a section below a line with `title`. Empty if there is none."""

    def __init__(self, name, title=""):
        text = section(name)
        lines = text[max(text.find(title), 0):].splitlines() if title in text else []
        start = next((i for i, line in enumerate(lines) if line.startswith("|")), len(lines))
        rows = []
        for line in lines[start:]:
            if not line.startswith("|"):
                break
            rows.append(row_cells(line))
        self.head, self.rows = (rows[0], rows[2:]) if rows else ([], [])

    def cell(self, column, *labels):
        """The cell in the row that begins with `labels`."""
        for row in self.rows:
            if tuple(row[:len(labels)]) == labels and column in self.head:
                return row[self.head.index(column)]
        return NONE


def caption(name):
    """Computer, versions, date and commit of a section."""
    found = re.search(r"(?m)^(?:.* on )?(.*?rosmaster [^,;]+, [\d-]+(?:, commit \w+)?)", section(name))
    return found[1] if found else "Not measured yet"


def first(cell):
    """The first number of a cell: the median of `7.0 (8.5)`."""
    found = re.search(r"-?\d+(\.\d+)?", cell)
    return float(found[0]) if found else float("nan")


def inside(cell):
    """The number in brackets of a cell."""
    found = re.search(r"\((\d+(\.\d+)?)", cell)
    return float(found[1]) if found else float("nan")


def table(head, rows, name):
    align = "|---|" + "--:|" * (len(head) - 1)
    lines = [f"{caption(name)}:", "", "| " + " | ".join(head) + " |", align]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


PAUSES, AWAY = Table("pauses"), Table("pauses", "Without a master for")
RECOVERY = Table("table1", "With synthetic nodes")
HTTP_1_0 = Table("table1-http-1-0", "With synthetic nodes")
DEATHS, LOADED = Table("deaths"), Table("deaths-under-load")
TIMES = Table("compare", "Times of a call in ms")
RATES = Table("compare", "Calls a second (ratio")
CPU = Table("compare", "Processor time a call")
CLIENTS, SCALE = Table("compare", "### Real clients"), Table("compare", "### Scale")
CHANGES = Table("computers", "### Takeover and handover")
COSTS, LAGS = Table("computers", "### Cost of a call"), Table("computers", "### How far followers are behind")
LINKS = Table("links")

CORE, PROXY, BARE = "`rosrescue core`", "`rosrescue proxy`", "bare rosmaster"
KINDS = [CORE, PROXY, BARE]
PARTIES = ["bare rosmaster", "rosrescue core", "rosrescue proxy", "HAProxy"]


def master():
    pauses = lambda column: [PAUSES.cell(column, kind) for kind in KINDS]
    away = lambda column: [AWAY.cell(column, CORE), AWAY.cell(column, PROXY), NONE]
    rows = [
        ["longest read during a kill", *pauses("read")],
        ["longest write during a kill", *pauses("write")],
        ["calls without an answer", *pauses("calls without an answer")],
        ["longest write in the time without a master", *away("write")],
        ["a subscriber is notified, without a master", *away("a subscriber is notified")],
    ]
    return table(["ms, median (largest)", "`core`", "`proxy`", "bare rosmaster, restarted at once"], rows, "pauses")


def recovery(measured, name):
    columns = ["detection", "new port open", "whole state", "recovery alone", "its limit", "ratio", "answer"]
    rows = [[row[0], *(measured.cell(column, row[0]) for column in columns)] for row in measured.rows]
    return table(["nodes", *columns], rows, name)


def deaths(measured, name):
    columns = ["longest wait for a read", "for a write", "calls without an answer"]
    rows = [[f"`{row[0]}`", *(measured.cell(column, row[0]) for column in columns)] for row in measured.rows]
    return table(["killed", *columns], rows, name)


def calls():
    rows = []
    for call in ["getParam, 250 bytes", "setParam"]:
        rows.append([f"{call}, one caller, ms", *(TIMES.cell(party, call, "1") for party in PARTIES)])
        rows.append([f"{call}, 64 callers, a second", *(RATES.cell(party, call, "64") for party in PARTIES)])
    for what, row in [("100 nodes start at once, ms", "a storm of 100 nodes"), ("`roslaunch` of 40 nodes, ms", "`roslaunch`")]:
        rows.append([what, *(CLIENTS.cell(party, row) for party in PARTIES)])
    return table(["", *PARTIES], rows, "compare")


def computers():
    def change(column, row):
        return CHANGES.cell(column, row)

    def cost(column, call, sync):
        return COSTS.cell(column, call, "1", sync, "disk")

    def lag(sync, others):
        return LAGS.cell("largest", sync, "disk", others)

    always, interval, follower = "always", "interval", "through a follower"
    rows = [
        ["the leader's computer dies: first write after", change("first write", "the leading computer dies")],
        ["· with `--election-timeout 500`", change("first write", "· the same, `--election-timeout 500`")],
        ["planned handover: longest write", change("longest write", "planned handover")],
        ["a write, `--cluster-sync always`", cost("through the leader", "setParam", always)],
        ["a write, `--cluster-sync interval`", cost("through the leader", "setParam", interval)],
        ["a write without other computers", cost("single", "setParam", always)],
        ["a read through a follower", cost(follower, "getParam", always)],
        ["a read without other computers", cost("single", "getParam", always)],
        ["a follower is behind by at most, `always`", lag(always, "0")],
        ["a follower is behind by at most, `interval`", lag(interval, "0")],
    ]
    return table(["ms, median (largest); of calls median, 99th percentile", ""], rows, "computers")


def links():
    columns = ["links", "never made", "answers overtaken", "start in ms", "ratio to bare"]
    names = {"Bare": "bare rosmaster", "Core": "`core`", "Proxy": "`proxy`", "StandingIn": "while the mirror stands in",
             "Kills": "master and worker killed meanwhile", "Follower": "a follower's nodes"}
    rows = [[names[row[0]], *(LINKS.cell(column, row[0]) for column in columns)] for row in LINKS.rows]
    return table(["", *columns], rows, "links")


def scale():
    columns = ["a write", "a read", "restart", "recovery", "memory in MB"]
    rows = [[*row[:2], *(SCALE.cell(column, *row[:2]) for column in columns)] for row in SCALE.rows]
    return table(["parameters", "nodes", *columns], rows, "compare")


def targets():
    def met(value, limit, smaller=True):
        """The value, and whether it meets the target."""
        if value != value:
            return "not measured"
        return f"{value:.3g}: " + ("yes" if (value <= limit if smaller else value >= limit) else "**no**")

    def both(*texts):
        return "; ".join(texts)

    def pause(column, kind):
        return first(PAUSES.cell(column, kind))

    def injection(kind):
        return 1.3 * first(PAUSES.cell("bare injection", kind)) + 5

    def ratio(call):
        return inside(RATES.cell("rosrescue core", call, "64"))

    def time(party, call):
        return first(TIMES.cell(party, call, "1"))

    def front(party):
        return first(CPU.cell(party, "getParam, 250 bytes", "1"))

    read, storm = "getParam, 250 bytes", CLIENTS.cell("rosrescue core", "a storm of 100 nodes")
    rows = [
        ["longest read during a kill: 10 ms", both(f"`core` {met(pause('read', CORE), 10)}", f"`proxy` {met(pause('read', PROXY), 10)}"),
         "the reads of `proxy` are on their way to the master when it dies"],
        ["longest write during a kill: 1.3 times the bare injection plus 5 ms",
         both(f"`core` {met(pause('write', CORE), injection(CORE))}", f"`proxy` {met(pause('write', PROXY), injection(PROXY))}"), ""],
        ["without a master: a write 10 ms, a notification 20 ms",
         both(met(first(AWAY.cell("write", CORE)), 10), met(first(AWAY.cell("a subscriber is notified", CORE)), 20)), ""],
        ["recovery alone: 1.3 times a bare multicall; detection 5 ms",
         both(met(first(RECOVERY.cell("ratio", "80")), 1.3), met(first(RECOVERY.cell("detection", "80")), 5)), ""],
        ["`core`, a read of one caller: half the time of bare; 64 callers: 3 times the throughput",
         both(met(time("rosrescue core", read) / time("bare rosmaster", read), 0.5), met(ratio(read), 3, False)), ""],
        ["`core`, 64 writers: 2.5 times the throughput of bare",
         both(f"`setParam` {met(ratio('setParam'), 2.5, False)}", f"`registerPublisher` {met(ratio('registerPublisher'), 2.5, False)}"), ""],
        ["a start of 100 nodes: half the time of bare", met(first(storm.split(",")[-1]), 0.5), ""],
        ["a forwarded read: 10 µs more than HAProxy, 1.3 times its processor time",
         both(met(1e3 * (time("rosrescue proxy", read) - time("HAProxy", read)), 10), met(front("rosrescue proxy") / front("HAProxy"), 1.3)),
         "60 % of the processor time is spent in the kernel"],
        ["memory: 12 MB at rest, 48 with 1,000 nodes and 10,000 parameters",
         both(met(first(SCALE.cell("memory in MB", "10", "1")), 12), met(first(SCALE.cell("memory in MB", "10000", "1000").split(",")[-1]), 48)),
         "guardian and worker together; pages that they share count twice"],
    ]
    lines = ["| target | met? | |", "|---|---|---|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def readme():
    number = lambda cell: f"{first(cell):.0f}"
    ratio = first(TIMES.cell("rosrescue core", "getParam, 250 bytes", "1")) / first(TIMES.cell("bare rosmaster", "getParam, 250 bytes", "1"))
    write = [TIMES.cell(party, "setParam", "1") for party in ["rosrescue core", "bare rosmaster"]]
    return "\n".join([
        f"Medians with 80 nodes ({caption('pauses')}):",
        "",
        f"* **Rescue:** {number(RECOVERY.cell('whole state', '80'))} ms from `kill -9` to the whole state in a new master."
        f" Starting rosmaster takes {number(RECOVERY.cell('new port open', '80'))} ms of it.",
        f"* **Pauses:** during a kill, the longest read takes {number(PAUSES.cell('read', CORE))} ms and the longest write {number(PAUSES.cell('write', CORE))} ms.",
        f"* **Cost:** a `getParam` takes {ratio:.1f} times as long as with a bare rosmaster. A single write takes {first(write[0]):.2f} ms instead of {first(write[1]):.2f}.",
    ])


BLOCKS = {
    "docs/benchmarks.md": {
        "master": master,
        "recovery": lambda: recovery(RECOVERY, "table1"),
        "recovery-http-1-0": lambda: recovery(HTTP_1_0, "table1-http-1-0"),
        "deaths": lambda: deaths(DEATHS, "deaths"),
        "deaths-under-load": lambda: deaths(LOADED, "deaths-under-load"),
        "calls": calls,
        "computers": computers,
        "links": links,
        "scale": scale,
        "targets": targets,
    },
    "README.md": {"measured": readme},
}


def main():
    stale = []
    for path, blocks in BLOCKS.items():
        before = text = (ROOT / path).read_text()
        for name, block in blocks.items():
            begin, end = (f"<!-- {name}:{mark} -->" for mark in ["begin", "end"])
            head, rest = text.split(begin)
            text = f"{head}{begin}\n{block()}\n{end}{rest.split(end)[1]}"
        if text != before:
            stale.append(path)
            if "--check" not in sys.argv:
                (ROOT / path).write_text(text)
    if "--check" in sys.argv and stale:
        sys.exit(f"not what benches/summary.py writes: {', '.join(stale)}")


if __name__ == "__main__":
    main()
