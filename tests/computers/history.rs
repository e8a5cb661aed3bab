//! Writes, reads and notifications on three computers under random failures. The checker compares what clients saw with
//! the promises; it knows nothing about the implementation.
//!
//! `ROSRESCUE_FAULTS` sets the number of failures and `ROSRESCUE_SEED` the random numbers. Without `ROSRESCUE_FAULTS` a
//! few short failures are played.

use std::fs;
use std::thread::sleep;
use std::time::{Duration, Instant};

use crate::chance::Chance;
use crate::fleet::Fleet;
use crate::network::COUNT;
use crate::support::{holds, params};
use crate::turn;

mod checker;
mod clients;
mod faults;

use checker::violations;
use clients::Clients;
use faults::{Fault, Lasting};

/// How many failures are played by default.
const FAULTS: usize = 6;
/// After this many failures, nothing fails for a while, and the history is checked.
const CHAPTER: usize = 8;
/// The longest time that a failure lasts.
const LONGEST: Duration = Duration::from_secs(5);
/// How long an acknowledged write may take to reach all computers after they agree on a state.
const SETTLE: Duration = Duration::from_secs(30);
/// Pause before the state is checked again, for notifications that arrive late.
const LATE: Duration = Duration::from_secs(2);

#[test]
fn every_promise_is_kept_under_random_failures() {
    let _turn = turn();
    let mut chance = Chance::new();
    let all = std::env::var("ROSRESCUE_FAULTS");
    let all = all.map_or(FAULTS, |all| {
        all.parse().expect("ROSRESCUE_FAULTS is a number")
    });
    let mut fleet = Fleet::start(&["--alone", "serve"]);
    let (mut left, mut calls) = (all, 0);
    for number in 0.. {
        let count = left.min(CHAPTER);
        calls += chapter(&mut fleet, &format!("history_{number}"), count, &mut chance);
        left -= count;
        if left == 0 {
            break;
        }
    }
    println!("{all} failures, {calls} calls that were answered, and no promise was broken");
}

/// Plays `count` failures, some at the same time, and checks the history. Returns the number of answered calls.
#[track_caller]
fn chapter(fleet: &mut Fleet, name: &str, count: usize, chance: &mut Chance) -> usize {
    let begin = Instant::now();
    let say = |what: &str| println!("{name}, {:.2?}: {what}", begin.elapsed());
    fleet.await_whole();
    let mut clients = Clients::start(fleet, name, chance.below(1 << 40) as u64);
    let mut lasting: Option<Lasting> = None;
    for _ in 0..count {
        let fault = match std::env::var_os("ROSRESCUE_FAULTS") {
            Some(_) => Fault::roll(chance),
            None => Fault::roll_short(chance),
        };
        if lasting.as_ref().is_some_and(|of| of.meets(&fault)) {
            let over = lasting.take().unwrap();
            say(&format!("the end of {:?}", over.fault));
            over.end(fleet);
        }
        say(&format!("{fault:?}"));
        let begun = fault.begin(fleet, &clients, chance);
        sleep(chance.time(LONGEST));
        match begun {
            Some(begun) if lasting.is_none() && chance.one_in(3) => lasting = Some(begun),
            Some(begun) => {
                say(&format!("the end of {:?}", begun.fault));
                begun.end(fleet);
            }
            None => {}
        }
        if lasting.is_none() && chance.one_in(2) {
            fleet.await_whole();
        }
    }
    if let Some(over) = lasting {
        say(&format!("the end of {:?}", over.fault));
        over.end(fleet);
    }
    for computer in &mut fleet.computers {
        computer.await_answers();
    }
    say("nothing fails any more");
    fleet.await_whole();
    sleep(chance.time(Duration::from_secs(1)));
    clients.quiet();
    say("nobody writes any more");
    let answered = clients.answered();
    judge(fleet, &clients, name);
    say(&format!("{answered} calls are as promised"));
    drop(clients);
    for index in 0..COUNT {
        if fleet.computers[index].talker.is_none() {
            fleet.start_nodes(index);
        }
    }
    fleet.await_flow(&[0, 1, 2]);
    fleet.assert_nodes_live();
    let leader = &fleet.computers[fleet.await_whole()];
    leader.within(|| leader.client().ok("deleteParam", params!["/test", name]));
    answered
}

/// Panics with all broken promises.
#[track_caller]
fn judge(fleet: &Fleet, clients: &Clients, name: &str) {
    // The first look may wait long.
    let mut looked: Option<Instant> = None;
    let look = || {
        let state = fleet.await_same_state();
        let mut wrong = violations(&clients.history(fleet), &clients.end(&state));
        wrong.extend(clients.topic_wrongs(&state));
        wrong
    };
    loop {
        let mut wrong = look();
        if wrong.is_empty() {
            holds(LATE, || true);
            wrong = look();
            if wrong.is_empty() {
                return;
            }
        }
        if looked.get_or_insert_with(Instant::now).elapsed() > SETTLE {
            let history = clients.history(fleet);
            let file = fleet.scratch.path(format!("{name}.txt"));
            fs::write(&file, format!("{history:#?}")).unwrap();
            for computer in &fleet.computers {
                let log = fleet.scratch.path(format!("{name}-{}.log", computer.name));
                fs::write(log, computer.ever_logged("").join("\n")).unwrap();
            }
            let all = wrong.join("\n");
            panic!(
                "{name}: {} promises are broken (all calls: {file:?}):\n{all}",
                wrong.len()
            );
        }
    }
}
