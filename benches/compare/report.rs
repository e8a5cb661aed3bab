//! Prints the results as Markdown.

use crate::{
    Measured, Small,
    calls::{Cell, Seen},
    notify::Notify,
    party::Kind,
    robots::Times,
    scale::Row,
    shared::numbers::{short, spread},
};

/// All tables with their explanations.
pub(crate) fn markdown(measured: &Measured) -> String {
    let mut parts = vec![format!(
        "{}; {} s for each number, in {} turns.",
        measured.machine, measured.seconds, measured.turns
    )];
    if let Some(cells) = &measured.calls {
        parts.push(calls(cells) + CALLS.trim_end());
    }
    if let Some(cells) = &measured.versions {
        let text = calls(cells).replacen("### Calls", "### This version and an earlier one", 1);
        parts.push(text.trim_end().to_owned());
    }
    if let Some(times) = &measured.robots {
        parts.push(robots(times) + ROBOTS.trim_end());
    }
    if let Some(measured) = &measured.notify {
        parts.push(notify(measured) + NOTIFY.trim_end());
    }
    if let Some(rows) = &measured.scale {
        parts.push(scale(rows) + SCALE.trim_end());
    }
    match &measured.small {
        Some(Small::Measured(share, cells)) => parts.push(format!(
            "### A small computer\n\nAll that is measured, and what measures, on one core with {:.0} % of its time \
             (a bandwidth quota of 2.5 ms in each 10 ms for their cgroup).\n\n{}",
            share * 1e2,
            calls(cells).trim_start_matches("### Calls\n\n").trim_end()
        )),
        Some(Small::Impossible(reason)) => parts.push(format!(
            "### A small computer\n\nNot measured: {reason}."
        )),
        None => {}
    }
    parts.join("\n\n")
}

const CALLS: &str = "
* Each party has its own rosmaster, started in the same way, and the parties take turns. Each connection is kept alive and makes its next call as soon as it has its answer.
  One thread makes all calls, on the same cores. If a connection was closed, the call is repeated on a new one, as Python's client does; the JSON has their number.
  HAProxy runs in http mode with one thread, nginx with one worker and kept-alive connections to its master.
* *Times*: from just before a call is sent until its whole answer has arrived.
* *Calls a second*: of all connections together.
* *Processor time*: user and system time per call of everything in front of the master (guardian and worker of rosrescue) + that of its master.
* *registerPublisher*: in turn with `unregisterPublisher`. *multicall of 101*: 100 times `setParam` and one `deleteParam`, as from `roslaunch`. *KB*, *MB*: size of the answer. Each write
  sets another value.
* Combinations that take seconds per call are left out: 5 MB, 10,000 parameters and multicalls over 64 or 512 connections.
";

const ROBOTS: &str = "
* *A storm of 100 nodes*: all connect at once and make 15 calls each, one after another, like a starting node: publishers, subscribers, services, parameters. Time until
  the last answer, median (largest).
* *`roslaunch`*: 30 rospy and 10 roscpp nodes and 500 parameters. Time from its start until the last node has registered. Most of it is the start of Python programs.
";

const NOTIFY: &str = "
* *Calls a second*: six writers for 5 s in each turn. Each has its own parameter and its own publisher, which comes and goes, with random pauses of up to 4 ms between calls.
  Four nodes subscribe to all of them, and answer after 1 ms. *Notified by then*: the share of notifications that had arrived when the last call was answered; the rest are queued.
* *Twelve rospy nodes*: started together, with 20 publishers and 60 subscribers each. Time until the last has registered.
* A usual rosmaster notifies nodes with 3 threads, the one of `core` with 32.
";

const SCALE: &str = "
* *A write*, *a read*: `setParam` and `getParam` of one parameter by one client, medians. A node has ten registrations.
* *Compaction*: while one client sets a value of 8 KB and another one reads, without pause. Time from the first sight of the new file until it is the checkpoint.
  *Longest call*: read, write, from 200 ms before the compaction on; in brackets, during the rest of the time.
* *Restart*: guardian and worker are killed and started again. Time from the start to the first answer to a read. *Recovery*: the master is killed. Time from the shut gate to the open
  one, including the start of a rosmaster. *Recovery alone*: from the open port of the new rosmaster on.
* *Memory*: resident memory of guardian and worker together, at first and at the end.
";

fn calls(cells: &[Cell]) -> String {
    let tables = [
        (
            "Times of a call in ms, median (99th percentile):",
            (|seen, _| format!("{} ({})", short(seen.median_ms), short(seen.p99_ms)))
                as fn(&Seen, &Seen) -> String,
        ),
        (
            "Calls a second (ratio to the bare rosmaster):",
            |seen, bare| {
                let ratio = seen.calls_per_second / bare.calls_per_second;
                format!("{} ({ratio:.2})", short(seen.calls_per_second))
            },
        ),
        (
            "Processor time a call in µs, before the master + the master:",
            |seen, _| format!("{:.0} + {:.0}", seen.own_cpu_us, seen.master_cpu_us),
        ),
    ];
    let parties = cells.first().map_or([].as_slice(), |cell| &cell.parties);
    let names: Vec<_> = parties.iter().map(|seen| seen.party.to_string()).collect();
    let (names, rule) = (names.join(" | "), "--:|".repeat(names.len()));
    let mut text = "### Calls\n".to_owned();
    for (title, cell_text) in tables {
        text += &format!("\n{title}\n\n| call | connections | {names} |\n|---|--:|{rule}\n");
        for cell in cells {
            let bare = cell.of(Kind::Bare);
            let texts: Vec<_> = cell
                .parties
                .iter()
                .map(|seen| cell_text(seen, bare))
                .collect();
            let texts = texts.join(" | ");
            text += &format!("| {} | {} | {texts} |\n", cell.call, cell.connections);
        }
    }
    text
}

fn robots(times: &[Times]) -> String {
    let names = Kind::OURS.map(|kind| kind.to_string()).join(" | ");
    let mut text = format!("### Real clients\n\nIn ms:\n\n| | {names} |\n|---|--:|--:|--:|\n");
    let lines = [
        (
            "a storm of 100 nodes",
            (|times| &times.storm_ms) as fn(&Times) -> &Vec<f64>,
        ),
        ("`roslaunch`", |times| &times.launch_ms),
    ];
    for (what, of) in lines {
        if of(&times[0]).is_empty() {
            continue;
        }
        let bare = spread(of(&times[0])).0;
        let cells = times.iter().map(|times| {
            let (median, largest) = spread(of(times));
            format!("{median:.0} ({largest:.0}), {:.2}", median / bare)
        });
        let cells: Vec<_> = cells.collect();
        text += &format!("| {what} | {} |\n", cells.join(" | "));
    }
    text
}

fn notify(measured: &Notify) -> String {
    let mut text = "### Writes that notify\n\n\
        | | calls a second | ratio | time of a call in ms, median (99th percentile) | notified by then | twelve rospy nodes in ms, median (largest) | ratio |\n\
        |---|--:|--:|--:|--:|--:|--:|\n"
        .to_owned();
    let first = &measured.writes[0];
    for writes in &measured.writes {
        let at = |share: f64| writes.calls_ms[(writes.calls_ms.len() as f64 * share) as usize];
        let bare = spread(&measured.starts[0].ms).0;
        let starts = measured
            .starts
            .iter()
            .find(|starts| starts.name == writes.name);
        let starts = starts.map_or_else(
            || "| ".to_owned(),
            |starts| {
                let (median, largest) = spread(&starts.ms);
                format!("{median:.0} ({largest:.0}) | {:.2}", median / bare)
            },
        );
        text += &format!(
            "| {} | {:.0} | {:.2} | {} ({}) | {:.0} % | {starts} |\n",
            writes.name,
            writes.calls_per_second,
            writes.calls_per_second / first.calls_per_second,
            short(at(0.5)),
            short(at(0.99)),
            writes.told() * 1e2,
        );
    }
    text
}

fn scale(rows: &[Row]) -> String {
    let mut text = "### Scale\n\n`rosrescue core`, in ms, median (largest):\n\n\
        | parameters | nodes | a write | a read | compaction | longest call | restart | recovery | recovery alone | memory in MB |\n\
        |--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n"
        .to_owned();
    let cell = |numbers: &[f64]| {
        let (median, largest) = spread(numbers);
        format!("{} ({})", short(median), short(largest))
    };
    for row in rows {
        let mb = |kib: u64| format!("{:.1}", kib as f64 / 1024.0);
        let cells = [
            row.params.to_string(),
            row.nodes.to_string(),
            short(row.write_ms),
            short(row.read_ms),
            cell(&row.compactions_ms),
            format!(
                "{}, {} ({}, {})",
                short(row.longest_ms[0]),
                short(row.longest_ms[1]),
                short(row.otherwise_ms[0]),
                short(row.otherwise_ms[1])
            ),
            cell(&row.restarts_ms),
            cell(&row.recoveries_ms),
            cell(&row.injections_ms),
            format!("{}, {}", mb(row.memory_kib), mb(row.memory_after_kib)),
        ];
        text += &format!("| {} |\n", cells.join(" | "));
    }
    text
}
