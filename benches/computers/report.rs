//! Prints the results as Markdown.

use crate::{
    Measured,
    cluster::{Election, TIME_TO_LIVE},
    cost::{Cost, Through},
    day::{Day, Need},
    lag::Lag,
    rounds::{Round, Takeover},
    shared::numbers::{short, spread},
};

/// All tables with their explanations.
pub(crate) fn markdown(measured: &Measured) -> String {
    let mut parts = vec![format!(
        "{}, {} nodes; three etcd and three `rosrescue core` on this one computer, `--cluster-ttl {}`.",
        measured.machine, measured.nodes, measured.time_to_live
    )];
    if !measured.takeovers.is_empty() || !measured.handovers.is_empty() {
        parts.push(changes(measured) + CHANGES.trim_end());
    }
    if !measured.costs.is_empty() {
        parts.push(costs(&measured.costs) + COSTS.trim_end());
        parts.push(lags(&measured.lags) + LAGS.trim_end());
    }
    if let Some(day) = &measured.day {
        parts.push(a_day(day));
    }
    parts.join("\n\n")
}

const CHANGES: &str = "
* *First write*: the time until the first write that began after the change is answered. The change begins just before the SIGKILL of everything on the leading computer (guardian, worker, rosmaster, rosout and
  its etcd member), or before the call of `rosrescue/handover`. *Longest write*, *longest read*: the longest call that was answered since then, including one that was under way. One client sets a
  parameter through one of the other computers, and one reads through each of them, a millisecond after each answer.
* *Its status page*: `last_takeover.seconds` of the next leader, from the last sign of life of the previous one.
* In every other round the etcd member that dies leads etcd, which then elects another one after a silence of 1 s to 2 s (its default), or of 0.5 s to 1 s with `--heartbeat-interval 50 --election-timeout 500`.
  If the first vote is split, it takes that time once more.
* *Alone meanwhile*: rounds in which etcd had no leader for so long that a survivor was cut off from the majority and answered alone (`--alone serve`) until etcd answered.
* *Calls without an answer*, *refused*: of all clients in all rounds. After each round every answered write is there, and all nodes are registered.
";

const COSTS: &str = "
* *Single*: a `rosrescue core` without `--cluster` that runs beside the others and takes turns with them. Each client has a connection that is kept alive, and calls as soon as it has its answer. In brackets the ratio of
  the median to *single*. All members of etcd, all rosrescue processes and the clients share the same cores.
";

const LAGS: &str = "
* The time from the answer to a write at the leader until the mirror of a follower has it, for both followers; 0 if it had it before. A follower appends a record to its checkpoint under the same lock
  under which it applies it, so the length of that file is checked, every 0.1 ms. Each write is made 10 ms after both followers have the previous one. `interval` commits every 200 ms.
";

fn changes(measured: &Measured) -> String {
    let mut text = "### Takeover and handover\n\nIn ms, median (largest):\n\n\
        | | rounds | first write | longest write | longest read | its status page | alone meanwhile | calls without an answer | refused |\n\
        |---|--:|--:|--:|--:|--:|--:|--:|--:|\n"
        .to_owned();
    let takeovers = &measured.takeovers;
    let of = |election, led: Option<bool>| -> Vec<Takeover> {
        let all = takeovers.iter().filter(|of| of.election == election);
        all.filter(|of| led.is_none_or(|led| of.led_etcd == led))
            .copied()
            .collect()
    };
    let lines = [
        ("the leading computer dies", of(Election::Usual, None)),
        (
            "· and another member leads etcd",
            of(Election::Usual, Some(false)),
        ),
        (
            "· and etcd's leader with it",
            of(Election::Usual, Some(true)),
        ),
        (
            "· the same, `--election-timeout 500`",
            of(Election::Quick, None),
        ),
    ];
    for (what, some) in lines {
        let said: Vec<_> = some.iter().map(|of| of.said).collect();
        let rounds: Vec<_> = some.iter().map(|of| of.round).collect();
        text += &line(
            what,
            &rounds,
            &format!(
                "{} | {}",
                cell(&said),
                some.iter().filter(|of| of.alone).count()
            ),
        );
    }
    text += &line("planned handover", &measured.handovers, "– | –");
    let ttl = TIME_TO_LIVE.as_secs_f64() * 1e3;
    let firsts: Vec<_> = of(Election::Usual, None)
        .iter()
        .map(|of| of.round.first_write)
        .collect();
    if !firsts.is_empty() {
        let (median, largest) = spread(&firsts);
        text += &format!(
            "\nFirst write after a death, against the time to live of {ttl:.0} ms: {:+.0} ms in the median round, {:+.0} ms at most.\n",
            median - ttl,
            largest - ttl
        );
    }
    text
}

fn line(what: &str, rounds: &[Round], said: &str) -> String {
    if rounds.is_empty() {
        return String::new();
    }
    let of = |number: fn(&Round) -> f64| cell(&rounds.iter().map(number).collect::<Vec<_>>());
    let sum = |number: fn(&Round) -> usize| rounds.iter().map(number).sum::<usize>();
    format!(
        "| {what} | {} | {} | {} | {} | {said} | {} | {} |\n",
        rounds.len(),
        of(|round| round.first_write),
        of(|round| round.write),
        of(|round| round.read),
        sum(|round| round.failed),
        sum(|round| round.refused),
    )
}

fn cell(numbers: &[f64]) -> String {
    let (median, largest) = spread(numbers);
    format!("{} ({})", short(median), short(largest))
}

fn costs(costs: &[Cost]) -> String {
    let mut text = "### Cost of a call\n\nIn ms, median, 99th percentile:\n\n\
        | call | callers | `--cluster-sync` | etcd's data | single | through the leader | through a follower | calls a second |\n\
        |---|--:|---|---|--:|--:|--:|--:|\n"
        .to_owned();
    for three in costs.chunks(Through::ALL.len()) {
        let of = |through| three.iter().find(|cost| cost.through == through);
        let [Some(single), Some(leader), Some(follower)] = Through::ALL.map(of) else {
            continue;
        };
        let cell = |cost: &Cost| {
            let ratio = cost.median / single.median;
            let (median, p99) = (short(cost.median), short(cost.p99));
            match cost.through {
                Through::Single => format!("{median}, {p99}"),
                _ => format!("{median}, {p99} ({ratio:.1})"),
            }
        };
        let rates = [single, leader, follower].map(|cost| short(cost.calls_per_second));
        text += &format!(
            "| {} | {} | {} | {} | {} | {} | {} | {} |\n",
            single.call,
            single.connections,
            single.sync,
            single.data,
            cell(single),
            cell(leader),
            cell(follower),
            rates.join(", ")
        );
    }
    text
}

fn lags(lags: &[Lag]) -> String {
    let mut text = "### How far followers are behind\n\nIn ms:\n\n\
        | `--cluster-sync` | etcd's data | other clients that write | median | 99th percentile | largest |\n\
        |---|---|--:|--:|--:|--:|\n"
        .to_owned();
    for lag in lags {
        let [median, p99, largest] = [lag.median, lag.p99, lag.largest].map(short);
        let (sync, data, others) = (lag.sync, lag.data, lag.others);
        text += &format!("| {sync} | {data} | {others} | {median} | {p99} | {largest} |\n");
    }
    text
}

fn a_day(day: &Day) -> String {
    let mb = |bytes: u64| short(bytes as f64 / f64::from(1 << 20));
    let row = |what: &str, of: &Need| {
        let numbers = [of.database, of.in_use, of.folder, of.memory].map(mb);
        format!("| {what} | {} |\n", numbers.join(" | "))
    };
    let mut text =
        "### A robot's day in etcd\n\nIn MiB, of the member of etcd that needs most:\n\n\
        | | database | in use of it | its whole folder | memory |\n|---|--:|--:|--:|--:|\n"
            .to_owned();
    text += &row("at first", &day.before);
    text += &row(&format!("after {} hours", day.hours), &day.after);
    text += &format!("| at most | | | | {} |\n", mb(day.peak_memory));
    text += &format!(
        "\n* {} requests were played in {:.0} s, etcd's data on {}: each second a write, of one parameter of 50, and a sign of life half a second after it (a write is one, too); every 5 s what each computer \
         says of itself, with a lease; a snapshot after 1,000 writes; every 300 s etcd is told to forget what is older than the 300 s before. They are the leader's own transactions, but for one comparison, 16 at a \
         time; the leases end after 2 s instead of 15.\n\
         * *Its whole folder*: as allocated, with etcd's log, which has files of 64 MB that are kept until etcd's own snapshot after 100,000 transactions.",
        day.transactions, day.seconds, day.data
    );
    text
}
