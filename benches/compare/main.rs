//! Compares rosrescue with a bare rosmaster, HAProxy and nginx in one run: `cargo bench --bench compare`.
//!
//! There are five parts: single kinds of calls over few and many connections; real clients (many nodes that start at
//! once, and `roslaunch`); writes that notify nodes; how times grow with the state; and the first part again on a
//! simulated small computer. A sixth part, `--parts versions --before FILE`, compares with an earlier rosrescue. It
//! prints tables as Markdown, draws a picture, and writes all numbers as JSON. The text below each table explains its
//! numbers.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a bench ends at the first thing that goes wrong"
)]

mod calls;
mod notify;
mod party;
mod picture;
mod relays;
mod report;
mod robots;
mod scale;
#[path = "../shared/mod.rs"]
mod shared;
mod small;

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::{Args, ValueEnum};
use serde::Serialize;

use crate::{
    party::Kind,
    shared::{
        machine,
        numbers::{self, write},
    },
    small::SmallComputer,
};

const PICTURE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/compare.svg");

/// Length of each turn of the writes that notify, in seconds.
const NOTIFY_SECONDS: f64 = 5.0;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Part {
    /// One kind of call at a time, over 1 to 512 connections
    Calls,
    /// 100 nodes that start at once, and `roslaunch`
    Robots,
    /// Writes that notify nodes, and rospy nodes that start together
    Notify,
    /// How times grow with the state
    Scale,
    /// The calls on one core at a quarter of its speed
    Small,
    /// Some of the calls with this version and with that of `--before`; not measured by default
    Versions,
}

/// Compares rosrescue with a bare rosmaster, HAProxy and nginx.
#[derive(Debug, Args)]
struct Options {
    /// What to measure
    #[arg(long, value_name = "PART,…", value_delimiter = ',', value_enum)]
    #[arg(default_values_t = [Part::Calls, Part::Robots, Part::Notify, Part::Scale, Part::Small])]
    parts: Vec<Part>,
    /// Length of each of some 200 measurements of one party, in seconds
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
    /// Number of starts of 100 nodes for each party
    #[arg(long, value_name = "COUNT", default_value_t = 5)]
    storms: usize,
    /// Number of launches of 40 nodes for each party
    #[arg(long, value_name = "COUNT", default_value_t = 3)]
    launches: usize,
    /// Number of turns of the writes that notify, and of starts of rospy nodes, for each party
    #[arg(long, value_name = "COUNT", default_value_t = 5)]
    notifies: usize,
    /// An earlier rosrescue, for `--parts versions`
    #[arg(long, value_name = "FILE", required_if_eq("parts", "versions"))]
    before: Option<PathBuf>,
    /// File for all numbers as JSON; the picture is written beside it as SVG [default: compare.json in Cargo's
    /// target folder]
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Also write the tables of all parts into benches/results.md, and the picture into docs/
    #[arg(long, conflicts_with = "parts")]
    write_docs: bool,
}

/// Everything that was measured.
#[derive(Debug, Default, Serialize)]
struct Measured {
    machine: String,
    seconds: f64,
    turns: usize,
    calls: Option<Vec<calls::Cell>>,
    versions: Option<Vec<calls::Cell>>,
    robots: Option<Vec<robots::Times>>,
    notify: Option<notify::Notify>,
    scale: Option<Vec<scale::Row>>,
    small: Option<Small>,
}

#[derive(Debug, Serialize)]
enum Small {
    /// The share of a core that was really available, and the results.
    Measured(f64, Vec<calls::Cell>),
    /// The reason why nothing was measured.
    Impossible(String),
}

fn main() -> ExitCode {
    let Some(options) = shared::options::<Options>("compare") else {
        return ExitCode::SUCCESS;
    };
    let needs = |part| options.parts.contains(&part);
    let missing = relays::missing();
    if (needs(Part::Calls) || needs(Part::Small)) && !missing.is_empty() {
        eprintln!(
            "compare: some programs are not installed; run: apt-get install {}",
            missing.join(" ")
        );
        return ExitCode::FAILURE;
    }
    if let Some(before) = &options.before {
        let before = before.canonicalize().expect("--before: no such file");
        party::BEFORE.set(before).expect("set once");
    }
    let measured = measure(&options);
    let text = report::markdown(&measured);
    println!("{text}");
    let json = options.json.unwrap_or_else(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
        folder.with_file_name("compare.json")
    });
    let picture = measured.calls.as_deref().map(picture::svg);
    let numbers = serde_json::to_string_pretty(&measured).expect("JSON");
    write(&json, &numbers);
    if let Some(picture) = &picture {
        write(&json.with_extension("svg"), picture);
    }
    if options.write_docs {
        numbers::write_document("compare", &text);
        if let Some(picture) = &picture {
            write(Path::new(PICTURE), picture);
        }
    }
    ExitCode::SUCCESS
}

fn measure(options: &Options) -> Measured {
    let (seconds, turns) = (options.seconds, options.turns.max(1));
    let of = |kinds: &[Kind], plan| calls::measure(&party::start(kinds), plan, seconds, turns);
    let calls = |plan| of(&Kind::ALL, plan);
    let needs = |part| options.parts.contains(&part);
    Measured {
        machine: machine::describe(),
        seconds,
        turns,
        calls: needs(Part::Calls).then(|| calls(calls::WHOLE)),
        versions: needs(Part::Versions).then(|| of(&Kind::VERSIONS, calls::VERSIONS)),
        robots: needs(Part::Robots).then(|| robots::measure(options.storms, options.launches)),
        notify: needs(Part::Notify).then(|| notify::measure(NOTIFY_SECONDS, options.notifies)),
        scale: needs(Part::Scale).then(|| scale::measure(seconds)),
        small: needs(Part::Small).then(|| match SmallComputer::enter() {
            Ok(computer) => Small::Measured(computer.share(), calls(calls::SMALLER)),
            Err(reason) => Small::Impossible(reason),
        }),
    }
}
