//! How long those who use the master wait when it dies: `cargo bench --bench pauses`.
//!
//! A client that reads a parameter all the time, one that registers a publisher all the time, and a stream
//! of messages at 200 Hz, over many SIGKILLs of the master: under `rosrescue core`, behind `rosrescue proxy`
//! with a rosmaster that is started again at once, and with such a rosmaster alone. What is measured how is said below
//! the table.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a bench ends at the first thing that goes wrong"
)]

mod caller;
#[path = "../shared/mod.rs"]
mod shared;
mod subject;

use std::fmt::Write;

use clap::Args;

use crate::{
    shared::machine,
    subject::{Kind, Subject, Window},
};

/// A sixth death of its own master within a minute counts as a crash loop for rosrescue, which then pauses.
const KILLS_A_LIFE: usize = 5;

/// Measures the pauses that clients see when the master dies.
#[derive(Debug, Args)]
struct Options {
    /// Kills for each line of the table
    #[arg(long, value_name = "COUNT", default_value_t = 100)]
    kills: usize,
    /// What to measure
    #[arg(long, value_name = "KIND,…", value_delimiter = ',', value_enum)]
    #[arg(default_values_t = [Kind::Core, Kind::Proxy, Kind::Bare])]
    kinds: Vec<Kind>,
}

fn main() {
    let Some(options) = shared::options::<Options>("pauses") else {
        return;
    };
    let mut lines = String::new();
    for kind in options.kinds {
        let (mut quiet, mut kills) = (Vec::new(), Vec::new());
        while kills.len() < options.kills {
            let mut subject = Subject::start(kind);
            let life = match kind {
                Kind::Core => KILLS_A_LIFE,
                Kind::Proxy | Kind::Bare => usize::MAX,
            };
            for _ in 0..life.min(options.kills - kills.len()) {
                quiet.push(subject.window(|_| {}));
                let window = subject.window(Subject::kill_master);
                eprintln!("{kind}: {window:.1?}");
                kills.push(window);
                subject.repair();
            }
        }
        let forgotten = kills.iter().filter(|window| window.forgotten).count();
        line(&mut lines, kind, "", &kills, &forgotten.to_string());
        line(&mut lines, kind, ", nobody killed", &quiet, "–");
    }
    println!("{}, {} kills each.\n", machine::describe(), options.kills);
    println!(
        "| | read | registration | stream at 200 Hz | calls without an answer | reads that said \
         \"not set\" | kills after which the nodes are unknown |"
    );
    println!("|---|--:|--:|--:|--:|--:|--:|");
    println!("{lines}");
    println!("{}", EXPLANATION.trim());
}

const EXPLANATION: &str = "
Milliseconds, median (largest) over the kills.

* *read*, *registration*: the longest time between two answers that a client got which calls `getParam` or `registerPublisher` all the time, a
  millisecond after each answer, and again a millisecond after each failure. Any answer counts, a wrong one too.
* *stream*: the longest time between two messages of a roscpp talker at a roscpp listener; 5 ms is none.
* *calls without an answer*: refused or cut off. rospy's and roscpp's `getParam` fail then.
* The rosmaster of `proxy` and the bare one are started again at once by the bench, and `core` does so itself.
* *nobody killed*: the same in as many spans of half a second without a kill.
";

/// One line of the table.
fn line(lines: &mut String, kind: Kind, what: &str, windows: &[Window], forgotten: &str) {
    let cell = |of: fn(&Window) -> f64| {
        let mut times: Vec<_> = windows.iter().map(of).collect();
        times.sort_by(f64::total_cmp);
        let last = times.last().copied().unwrap_or(f64::NAN);
        let median = times.get(times.len() / 2).copied().unwrap_or(f64::NAN);
        format!("{median:.1} ({last:.1})")
    };
    let sum = |of: fn(&Window) -> usize| windows.iter().map(of).sum::<usize>();
    writeln!(
        lines,
        "| {kind}{what} | {} | {} | {} | {} | {} | {forgotten} |",
        cell(|window| window.read),
        cell(|window| window.registration),
        cell(|window| window.stream),
        sum(|window| window.failed),
        sum(|window| window.unset),
    )
    .expect("a string");
}
