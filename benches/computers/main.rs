//! Several computers: measures the times of a takeover, a handover and a write, with three real etcd servers
//! and three `rosrescue core` on loopback: `cargo bench --bench computers`.
//!
//! Prints tables as Markdown and writes all numbers as JSON. The text below the tables explains the numbers.
//! `tests/install_etcd.sh` provides an etcd.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a bench ends at the first thing that goes wrong"
)]

mod cluster;
mod cost;
mod day;
mod lag;
mod report;
mod rounds;
#[expect(dead_code, reason = "only a part is used here")]
#[path = "../../tests/cluster/servers.rs"]
mod servers;
#[path = "../shared/mod.rs"]
mod shared;

use std::{
    path::{Path, PathBuf},
    time::Instant,
};

use clap::{Args, ValueEnum};
use serde::Serialize;

use crate::{
    cluster::{Cluster, Data, Election, Sync},
    cost::Single,
    // For `servers`.
    shared::{machine, numbers, support},
};

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Part {
    /// The leading computer dies
    Takeover,
    /// The leading computer hands over
    Handover,
    /// The time of a write and a read, and how far followers are behind
    Cost,
    /// What etcd needs after a day
    Day,
}

/// Measures several computers.
#[derive(Debug, Args)]
struct Options {
    /// What to measure
    #[arg(long, value_name = "PART,…", value_delimiter = ',', value_enum)]
    #[arg(default_values_t = [Part::Takeover, Part::Handover, Part::Cost, Part::Day])]
    parts: Vec<Part>,
    /// Number of deaths of the leading computer, and of handovers; half as many additional deaths with a
    /// quicker election of etcd
    #[arg(
        long,
        env = "ROSRESCUE_KILLS",
        value_name = "COUNT",
        default_value_t = 20
    )]
    kills: usize,
    /// Number of registered nodes, with seven registrations each
    #[arg(long, value_name = "COUNT", default_value_t = 80)]
    nodes: usize,
    /// Length of each measurement of a call, in seconds; there are 24 for each place of etcd's data
    #[arg(
        long,
        env = "ROSRESCUE_BENCH_SECONDS",
        value_name = "SECONDS",
        default_value_t = 0.8
    )]
    seconds: f64,
    /// Number of turns among which that time is divided; the parties alternate
    #[arg(long, value_name = "COUNT", default_value_t = 3)]
    turns: usize,
    /// Number of hours of a robot's life to play
    #[arg(long, value_name = "COUNT", default_value_t = 24)]
    hours: u32,
    /// Where etcd stores its data; everything but the time of calls is measured with the first one only
    #[arg(long, value_name = "DATA,…", value_delimiter = ',', value_enum)]
    #[arg(default_values_t = [Data::Disk, Data::Memory])]
    data: Vec<Data>,
    /// File for all numbers as JSON [default: computers.json in Cargo's target folder]
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Also write the tables of all parts into benches/results.md
    #[arg(long, conflicts_with = "parts")]
    write_docs: bool,
}

/// Everything that was measured.
#[derive(Debug, Default, Serialize)]
struct Measured {
    machine: String,
    nodes: usize,
    /// In seconds.
    time_to_live: f64,
    takeovers: Vec<rounds::Takeover>,
    handovers: Vec<rounds::Round>,
    costs: Vec<cost::Cost>,
    lags: Vec<lag::Lag>,
    day: Option<day::Day>,
}

fn main() {
    let Some(options) = shared::options::<Options>("computers") else {
        return;
    };
    let begin = Instant::now();
    let measured = measure(&options);
    let text = report::markdown(&measured);
    println!("{text}");
    eprintln!("that took {:.0?}", begin.elapsed());
    let json = options.json.unwrap_or_else(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
        folder.with_file_name("computers.json")
    });
    let numbers = serde_json::to_string_pretty(&measured).expect("JSON");
    numbers::write(&json, &numbers);
    if options.write_docs {
        numbers::write_document("computers", &text);
    }
}

fn measure(options: &Options) -> Measured {
    let mut measured = Measured {
        machine: machine::describe(),
        nodes: options.nodes,
        time_to_live: cluster::TIME_TO_LIVE.as_secs_f64(),
        ..Measured::default()
    };
    let needs = |part| options.parts.contains(&part);
    let first = options.data.first().copied().unwrap_or(Data::Disk);
    if needs(Part::Takeover) || needs(Part::Handover) {
        let mut cluster = Cluster::start(Sync::Always, first, Election::Usual, options.nodes);
        if needs(Part::Handover) {
            let rounds = 0..options.kills;
            measured.handovers = rounds.map(|at| rounds::handover(&cluster, at)).collect();
        }
        if needs(Part::Takeover) {
            let rounds = 0..options.kills;
            measured.takeovers = rounds
                .map(|at| rounds::takeover(&mut cluster, at, at % 2 == 1))
                .collect();
        }
    }
    if needs(Part::Takeover) {
        let mut cluster = Cluster::start(Sync::Always, first, Election::Quick, options.nodes);
        let rounds = 0..options.kills / 2;
        let takeovers = rounds.map(|at| rounds::takeover(&mut cluster, at, true));
        measured.takeovers.extend(takeovers);
    }
    if needs(Part::Cost) {
        let single = Single::start();
        for data in &options.data {
            for sync in [Sync::Always, Sync::Interval] {
                let cluster = Cluster::start(sync, *data, Election::Usual, options.nodes);
                let (seconds, turns) = (options.seconds, options.turns.max(1));
                measured
                    .costs
                    .extend(cost::measure(&single, &cluster, seconds, turns));
                measured.lags.extend(lag::measure(&cluster, seconds));
            }
        }
    }
    measured.day = needs(Part::Day).then(|| day::play(options.hours, first, options.nodes));
    measured
}
