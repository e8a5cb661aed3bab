//! Counts the links that are not made when many nodes start at once: `cargo bench --bench links`.
//!
//! rospy or roscpp nodes start at the same moment. When all are ready, and a few seconds later at most, each
//! subscriber must be connected to exactly the publishers in the master's state. For rospy nodes it also
//! counts how often an answer to `registerSubscriber` was overtaken by a newer `publisherUpdate`. A failure
//! is printed with the node, the topic, and what each node was told when. With `--profile dev` nothing is
//! rebuilt after `cargo build`.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a bench ends at the first thing that goes wrong"
)]

#[path = "../shared/mod.rs"]
mod shared;

use std::{path::PathBuf, process::ExitCode, time::Duration};

use clap::{Args, ValueEnum};

use crate::shared::{
    machine, numbers,
    support::{
        Library, PROGRAM,
        links::{self, Order, Place, Plan},
    },
};

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Mode {
    /// A rosmaster without rosrescue
    Bare,
    /// `rosrescue core`
    Core,
    /// `rosrescue proxy`
    Proxy,
    /// `rosrescue proxy` whose master is dead while the nodes start
    StandingIn,
    /// `rosrescue core` whose master and worker are killed while the nodes start
    Kills,
    /// The follower of two `rosrescue core --cluster` (needs etcd: `. tests/install_etcd.sh`)
    Follower,
}

impl Mode {
    fn place(self) -> Place {
        match self {
            Self::Bare => Place::Bare,
            Self::Core => Place::Core,
            Self::Proxy => Place::Proxy,
            Self::StandingIn => Place::StandingIn,
            Self::Kills => Place::Kills,
            Self::Follower => Place::Follower,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Nodes {
    Rospy,
    Roscpp,
}

/// Counts the links that starts of many nodes do not make.
#[derive(Debug, Args)]
struct Options {
    /// The masters at which nodes start; the modes take turns
    #[arg(
        long = "mode",
        value_name = "MODE,…",
        value_delimiter = ',',
        value_enum
    )]
    #[arg(default_values_t = [Mode::Bare, Mode::Core, Mode::Proxy, Mode::StandingIn])]
    modes: Vec<Mode>,
    /// Number of starts in each mode
    #[arg(long, value_name = "COUNT", default_value_t = 5)]
    starts: u64,
    /// Number of nodes that start together
    #[arg(long, value_name = "COUNT", default_value_t = 12)]
    nodes: usize,
    /// Number of links; each topic has one publisher and three subscribers
    #[arg(long, value_name = "COUNT", default_value_t = 720)]
    links: usize,
    /// The client library of the nodes
    #[arg(long, value_enum, default_value_t = Nodes::Rospy)]
    library: Nodes,
    /// Each node registers in a random order of its own instead of topic by topic
    #[arg(long)]
    shuffled: bool,
    /// Number of busy processes beside the nodes
    #[arg(long, value_name = "COUNT", default_value_t = 0)]
    load: usize,
    /// How long a link may take after the last node was ready, in seconds; a quarter more for each busy
    /// process
    #[arg(long, value_name = "SECONDS", default_value_t = 6.0)]
    wait: f64,
    /// Stop at the first start that misses a link
    #[arg(long)]
    stop: bool,
    /// Seed of the first start; later starts use the next numbers [default: the process id]
    #[arg(long, value_name = "NUMBER")]
    seed: Option<u64>,
    /// The rosrescue to test [default: the one that was just built]
    #[arg(long, value_name = "FILE")]
    rosrescue: Option<PathBuf>,
    /// Also write the table into benches/results.md
    #[arg(long)]
    write_docs: bool,
}

/// The results of all starts in one mode.
#[derive(Debug, Default)]
struct Row {
    starts: usize,
    links: usize,
    never_made: usize,
    wrong: usize,
    overtaken: usize,
    went_back: usize,
    times: Vec<f64>,
}

fn main() -> ExitCode {
    let Some(options) = shared::options::<Options>("links") else {
        return ExitCode::SUCCESS;
    };
    if let Some(program) = &options.rosrescue {
        let program = program.canonicalize().expect("--rosrescue: no such file");
        PROGRAM.set(program).expect("rosrescue was already started");
    }
    let plan = Plan {
        library: match options.library {
            Nodes::Rospy => Library::Rospy,
            Nodes::Roscpp => Library::Roscpp,
        },
        nodes: options.nodes,
        links: options.links,
        order: if options.shuffled {
            Order::Shuffled
        } else {
            Order::Same
        },
        load: options.load,
        wait: Duration::from_secs_f64(options.wait),
    };
    let first = options
        .seed
        .unwrap_or_else(|| u64::from(std::process::id()) << 20);
    let mut rows: Vec<_> = options
        .modes
        .iter()
        .map(|mode| (*mode, Row::default()))
        .collect();
    let mut whole = true;
    'all: for seed in first..first + options.starts {
        for (mode, row) in &mut rows {
            whole &= one(*mode, &plan, seed, row);
            if options.stop && !whole {
                break 'all;
            }
        }
    }
    let text = table(&rows, &plan, first);
    println!("{text}");
    if options.write_docs {
        numbers::write_document("links", text.trim_end());
    }
    if whole {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

/// Runs one start. Returns whether nothing was missed.
fn one(mode: Mode, plan: &Plan, seed: u64, row: &mut Row) -> bool {
    let start = links::start(mode.place(), plan, seed);
    let found = [
        ("never made", &start.never_made, &mut row.never_made),
        ("links that the state lacks", &start.wrong, &mut row.wrong),
        ("overtaken", &start.overtaken, &mut row.overtaken),
        ("went back", &start.went_back, &mut row.went_back),
    ];
    let mut whole = true;
    for (what, cases, count) in found {
        *count += cases.len();
        for case in cases {
            println!("{mode:?}, seed {seed}, {what}: {case}");
            whole = false;
        }
    }
    row.starts += 1;
    row.links += start.links;
    row.times.push(start.time.as_secs_f64() * 1e3);
    eprintln!(
        "{mode:?}, seed {seed}: {:.0?}; {} starts, {} links, {} never made, {} overtaken",
        start.time, row.starts, row.links, row.never_made, row.overtaken
    );
    whole
}

fn table(rows: &[(Mode, Row)], plan: &Plan, seed: u64) -> String {
    let median = |row: &Row| numbers::spread(&row.times).0;
    let bare = rows.iter().find(|(mode, _)| *mode == Mode::Bare);
    let bare = bare.map_or(f64::NAN, |(_, row)| median(row));
    let mut text = format!(
        "{}; {} {:?} nodes, {} links a start, {:?} order, load {}, seeds from {seed}\n\n\
         | | starts | links | never made | not of the state | answers overtaken | went back | start in ms | ratio to bare |\n\
         |---|--:|--:|--:|--:|--:|--:|--:|--:|\n",
        machine::describe(),
        plan.nodes,
        plan.library,
        plan.links,
        plan.order,
        plan.load,
    );
    for (mode, row) in rows {
        let Row {
            starts,
            links,
            never_made,
            wrong,
            overtaken,
            went_back,
            ..
        } = row;
        let time = median(row);
        text += &format!(
            "| {mode:?} | {starts} | {links} | {never_made} | {wrong} | {overtaken} | {went_back} | {time:.0} | {:.2} |\n",
            time / bare
        );
    }
    text
}
