//! Tests with three simulated computers, each with an etcd, a rosrescue and nodes: network namespaces on one switch.
//! Computers are killed and cut off. Two tests run at once for each core, because each needs a third of a core and waits
//! most of the time. They need root.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

use std::sync::{Condvar, Mutex, PoisonError};
use std::thread;

#[path = "../support/mod.rs"]
mod support;

mod chance;
mod computer;
mod fleet;
mod network;
mod streams;
mod traffic;

/// Cables are cut and mended.
mod cables;
/// The log's addresses of callers on several computers.
mod change_log;
/// Computers die and come back.
mod deaths;
/// The checkpoint of a computer is older than the last acknowledged write.
mod disks;
/// Loops of drivers during a takeover.
mod drivers;
/// No etcd runs.
mod etcd;
/// Handover to another computer on request.
mod handover;
/// Random failures, and a check of all promises.
mod history;
/// Writes of a computer that was cut off are merged with the others' writes.
mod lonely;
/// Two computers cannot reach each other, or only some of each other's ports.
mod pairs;
/// The leader is stopped, and continued after a takeover.
mod pauses;
/// The first start, a computer that joins, and a start after all have stopped.
mod starts;
/// Tests of the simulated computers themselves.
mod wiring;

/// Number of tests that run now.
static RUNNING: Mutex<usize> = Mutex::new(0);
static ENDED: Condvar = Condvar::new();

/// The turn of a test. It ends on drop.
struct Turn;

impl Drop for Turn {
    fn drop(&mut self) {
        *RUNNING.lock().unwrap_or_else(PoisonError::into_inner) -= 1;
        ENDED.notify_one();
    }
}

/// Waits until another test may run. A test does this first, so that its turn ends after everything that it started has
/// ended.
fn turn() -> Turn {
    let most = 2 * thread::available_parallelism().map_or(1, usize::from);
    let running = RUNNING.lock().unwrap_or_else(PoisonError::into_inner);
    let running = ENDED.wait_while(running, |running| *running >= most);
    *running.unwrap_or_else(PoisonError::into_inner) += 1;
    Turn
}

/// Number of rounds in which computers are killed, cut off or told to hand over. `ROSRESCUE_ROUNDS` changes it.
fn rounds() -> usize {
    let rounds = std::env::var("ROSRESCUE_ROUNDS");
    rounds.map_or(3, |rounds| {
        rounds.parse().expect("ROSRESCUE_ROUNDS is a number")
    })
}
