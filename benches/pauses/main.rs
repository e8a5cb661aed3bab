//! Measures how long clients wait when the master dies: `cargo bench --bench pauses`.
//!
//! One client reads a parameter all the time, one sets a parameter, and one subscribes to a parameter that is
//! not set, as loggers do. The master is killed many times, and once stays away. This is done under
//! `rosrescue core`, behind `rosrescue proxy` with a rosmaster that is restarted at once, and with such a
//! rosmaster alone. The text below the tables explains the measurements.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a bench ends at the first thing that goes wrong"
)]

mod deaths;
#[path = "../shared/mod.rs"]
mod shared;
mod subject;

use std::time::Duration;

use clap::Args;

use crate::{
    deaths::{Death, Victims},
    shared::{caller::Seen, machine, numbers},
    subject::{Kind, Subject, Window},
};

/// Number of kills per rosrescue. It treats a sixth death of its master within a minute as a crash loop and
/// then pauses.
const KILLS_A_LIFE: usize = 5;

/// Measures the pauses that clients see when the master dies.
#[derive(Debug, Args)]
struct Options {
    /// Number of kills for each line of the table
    #[arg(
        long,
        env = "ROSRESCUE_KILLS",
        value_name = "COUNT",
        default_value_t = 100
    )]
    kills: usize,
    /// Number of registered nodes, with seven registrations each
    #[arg(long, value_name = "COUNT", default_value_t = 80)]
    nodes: usize,
    /// How long a master stays away, in seconds; 0 skips this part
    #[arg(
        long,
        env = "ROSRESCUE_AWAY_SECONDS",
        value_name = "SECONDS",
        default_value_t = 60
    )]
    away: u64,
    /// What to measure
    #[arg(long, value_name = "KIND,…", value_delimiter = ',', value_enum)]
    #[arg(default_values_t = [Kind::Core, Kind::Proxy, Kind::Bare])]
    kinds: Vec<Kind>,
    /// Measure only deaths of rosrescue: of the worker alone, or of worker and master at once, KILLS of each; nobody
    /// measures the computer's own pauses
    #[arg(long, value_name = "WHO,…", value_delimiter = ',', value_enum)]
    deaths: Vec<Victims>,
    /// Number of busy processes during this measurement
    #[arg(long, value_name = "COUNT", default_value_t = 0)]
    load: usize,
    /// Also write the tables into benches/results.md
    #[arg(long)]
    write_docs: bool,
}

fn main() {
    let Some(options) = shared::options::<Options>("pauses") else {
        return;
    };
    let (name, text) = match (options.deaths.is_empty(), options.load) {
        (true, _) => ("pauses", master_dies(&options)),
        (false, 0) => ("deaths", rosrescue_dies(&options)),
        (false, _) => ("deaths-under-load", rosrescue_dies(&options)),
    };
    println!("{text}");
    if options.write_docs {
        numbers::write_document(name, &text);
    }
}

/// The tables of deaths of the master.
fn master_dies(options: &Options) -> String {
    let lines: Vec<_> = options
        .kinds
        .iter()
        .map(|kind| kills(*kind, options))
        .collect();
    let mut text = format!(
        "{}, {} nodes, {} kills each.\n\n\
         | | read | write | write that changes nothing | bare injection | calls without an answer | answers that were no success |\n\
         |---|--:|--:|--:|--:|--:|--:|\n\
         {}\n",
        machine::describe(),
        options.nodes,
        options.kills,
        lines.concat()
    );
    if options.away > 0 {
        text += &format!(
            "Without a master for {} s:\n\n\
             | | read | write | write that changes nothing | a subscriber is notified |\n\
             |---|--:|--:|--:|--:|\n",
            options.away
        );
        for kind in options.kinds.iter().filter(|kind| **kind != Kind::Bare) {
            text += &outage(*kind, options);
        }
        text += "\n";
    }
    text + EXPLANATION.trim()
}

const EXPLANATION: &str = "
Milliseconds: median (largest) over the kills; without a master, the largest.

* *read*, *write*, *write that changes nothing*: the longest time between two answers to a client that calls `getParam`, `setParam` with a new
  value, or `subscribeParam` of a parameter that is not set. It calls all the time, a millisecond after each answer, and again a
  millisecond after each failure. Every answer counts, even a wrong one.
* *bare injection*: one multicall that gives the same state to another rosmaster of the same kind, before each kill.
* *calls without an answer*: refused or cut off. rospy's and roscpp's `getParam` fail in this case.
* *a subscriber is notified*: the time from a `registerPublisher`, one per second, until a subscriber of the topic has its `publisherUpdate`: median (largest).
* The bench itself restarts the rosmaster of `proxy` and the bare one at once; `core` restarts its own.
* *no kills*: the same in as many spans of half a second without a kill.
";

/// Median and maximum, as a table cell.
fn cell(times: impl IntoIterator<Item = f64>) -> String {
    let mut times: Vec<_> = times.into_iter().collect();
    times.sort_by(f64::total_cmp);
    match (times.get(times.len() / 2), times.last()) {
        (Some(median), Some(last)) => format!("{median:.1} ({last:.1})"),
        _ => "–".to_owned(),
    }
}

/// Measures two lines of the first table: with kills and without.
fn kills(kind: Kind, options: &Options) -> String {
    let (mut quiet, mut kills, mut injections) = (Vec::new(), Vec::new(), Vec::new());
    while kills.len() < options.kills {
        let mut subject = Subject::start(kind, options.nodes);
        let life = match kind {
            Kind::Core => KILLS_A_LIFE,
            Kind::Proxy => usize::MAX,
            // A bare rosmaster has forgotten its nodes after one kill.
            Kind::Bare => 1,
        };
        for _ in 0..life.min(options.kills - kills.len()) {
            if kind != Kind::Bare {
                injections.push(subject.bare_injection());
            }
            quiet.push(subject.window(|_| {}));
            let window = subject.window(Subject::kill_master);
            eprintln!(
                "{kind}: read {:.1}, write {:.1}, write that changes nothing {:.1}, injection {:.1?}",
                window.read.pause,
                window.write.pause,
                window.idle.pause,
                injections.last()
            );
            kills.push(window);
            subject.repair();
        }
    }
    let line = |what: &str, windows: &[Window], injections: &[f64]| {
        let count =
            |of: fn(&Seen) -> usize| -> usize { windows.iter().flat_map(all).map(of).sum() };
        format!(
            "| {kind}{what} | {} | {} | {} | {} | {} | {} |\n",
            cell(windows.iter().map(|window| window.read.pause)),
            cell(windows.iter().map(|window| window.write.pause)),
            cell(windows.iter().map(|window| window.idle.pause)),
            cell(injections.iter().copied()),
            count(|seen| seen.failed),
            count(|seen| seen.refused),
        )
    };
    line("", &kills, &injections) + &line(", no kills", &quiet, &[])
}

fn all(window: &Window) -> [&Seen; 3] {
    [&window.read, &window.write, &window.idle]
}

/// Measures a line of the second table.
fn outage(kind: Kind, options: &Options) -> String {
    let mut subject = Subject::start(kind, options.nodes);
    let (window, notified) = subject.outage(Duration::from_secs(options.away));
    eprintln!("{kind}, notified after {notified:.1?}");
    let failed: usize = all(&window)
        .map(|seen| seen.failed + seen.refused)
        .iter()
        .sum();
    assert_eq!(failed, 0, "{window:?}");
    format!(
        "| {kind} | {:.1} | {:.1} | {:.1} | {} |\n",
        window.read.pause,
        window.write.pause,
        window.idle.pause,
        cell(notified)
    )
}

/// The table of deaths of rosrescue.
fn rosrescue_dies(options: &Options) -> String {
    let mut text = format!(
        "{}, {} nodes, {} deaths each, {} busy processes beside them.\n\n\
         | killed | longest wait for a read | for a write | waits over 150 ms | calls without an answer |\n\
         |---|--:|--:|--:|--:|\n",
        machine::describe(),
        options.nodes,
        options.kills,
        options.load
    );
    for victims in &options.deaths {
        let deaths = deaths::measure(*victims, options.kills, options.nodes, options.load);
        let both = |death: &Death| [death.read, death.write];
        let long = deaths
            .iter()
            .flat_map(both)
            .filter(|seen| seen.pause > 150.0);
        let failed: usize = deaths.iter().flat_map(both).map(|seen| seen.failed).sum();
        text += &format!(
            "| {victims:?} | {} | {} | {} | {failed} |\n",
            cell(deaths.iter().map(|death| death.read.pause)),
            cell(deaths.iter().map(|death| death.write.pause)),
            long.count(),
        );
    }
    text += "\nMilliseconds: median (largest) over the deaths.";
    text
}
