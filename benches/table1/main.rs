//! Measures the paper's Table 1: how long a recovery of the master takes, compared with the best possible
//! time on this computer.
//!
//! `cargo bench --bench table1` prints it as Markdown. The real rosmaster is killed with SIGKILL under
//! `rosrescue core`, with synthetic and with real rospy nodes. Each has two publishers and two subscribers,
//! which makes seven registrations together with those that every node has.
//!
//! Between any two kills, the same computer measures the best possible recovery at that moment ([`limit`]).
//! The text below the tables explains the columns ([`table::markdown`]).

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a bench ends at the first thing that goes wrong"
)]

mod limit;
mod robot;
#[path = "../shared/mod.rs"]
mod shared;
mod table;

use clap::Args;

use crate::{
    robot::{Kind, Robot},
    shared::numbers,
    table::Row,
};

/// Number of kills per rosrescue. It treats a sixth death of its master within a minute as a crash loop and
/// then pauses.
const KILLS_A_LIFE: usize = 5;

/// Measures the paper's Table 1 with the real rosmaster.
#[derive(Debug, Args)]
struct Options {
    /// Numbers of nodes
    #[arg(long, value_name = "COUNT,…", value_delimiter = ',')]
    #[arg(default_values_t = [1, 5, 10, 20, 40, 80])]
    nodes: Vec<usize>,
    /// Number of kills for each number of synthetic nodes; 0 for none
    #[arg(long, value_name = "COUNT", default_value_t = 10)]
    synthetic: usize,
    /// Number of kills for each number of real rospy nodes; 0 for none
    #[arg(long, value_name = "COUNT", default_value_t = 3)]
    real: usize,
    /// Also write the tables into benches/results.md
    #[arg(long)]
    write_docs: bool,
}

fn main() {
    let Some(options) = shared::options::<Options>("table1") else {
        return;
    };
    let kinds = [
        (Kind::Synthetic, options.synthetic),
        (Kind::Real, options.real),
    ];
    let tables: Vec<_> = kinds
        .into_iter()
        .filter(|(_, kills)| *kills > 0)
        .map(|(kind, kills)| {
            let measured = options.nodes.iter().map(|nodes| row(kind, *nodes, kills));
            (kind, measured.collect())
        })
        .collect();
    let text = table::markdown(&tables);
    println!("{text}");
    if options.write_docs {
        let name = match std::env::var_os("ROSRESCUE_HTTP_1_0") {
            Some(_) => "table1-http-1-0",
            None => "table1",
        };
        numbers::write_document(name, &text);
    }
}

/// Kills the master of a robot with this many nodes again and again.
fn row(kind: Kind, nodes: usize, kills: usize) -> Row {
    let mut row = Row::new(nodes);
    while row.kills() < kills {
        let mut robot = Robot::start(kind, nodes);
        for _ in 0..KILLS_A_LIFE.min(kills - row.kills()) {
            robot.settle();
            let best = limit::measure(&robot);
            robot.let_live();
            robot.settle();
            let ours = robot.kill_master();
            eprintln!("{kind}, {nodes} nodes: {ours:.1?}, the limit: {best:.1?}");
            row.push(ours, best);
        }
    }
    row
}
