//! Three computers, each with an etcd, a rosrescue and nodes of its own: network namespaces on one switch. They are
//! killed and cut off. One test at a time: each keeps the machine busy. Needs root.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

use std::sync::{Mutex, MutexGuard, PoisonError};

#[path = "../support/mod.rs"]
mod support;

mod chance;
mod computer;
mod fleet;
mod network;
mod streams;
mod traffic;

/// Cables are cut, and mended.
mod cables;
/// Computers die, and come back.
mod deaths;
/// A computer's disk is older than what was acknowledged.
mod disks;
/// Loops of drivers, while another computer takes over.
mod drivers;
/// etcd is away altogether.
mod etcd;
/// Another computer leads because somebody says so.
mod handover;
/// Calls of all computers under random failures, and whether all that was promised was kept.
mod history;
/// What the log says about calls of other computers.
mod log;
/// What a computer that was cut off has written meets what others have.
mod lonely;
/// Two computers do not see each other, or not all of each other.
mod pairs;
/// A leader stands still, and goes on when another one leads.
mod pauses;
/// The first start, one that joins, and a start after all have stopped.
mod starts;
/// The harness itself.
mod wiring;

/// Whoever holds this runs alone. A test takes it first, so that it is let go after all that the test has
/// started has ended.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// How often computers are killed, cut off and told to hand over.
fn rounds() -> usize {
    let rounds = std::env::var("ROSRESCUE_ROUNDS");
    rounds.map_or(3, |rounds| {
        rounds.parse().expect("ROSRESCUE_ROUNDS is a number")
    })
}
