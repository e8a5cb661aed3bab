//! Tests with three simulated computers, each with an etcd, a rosrescue and nodes: network namespaces on one switch.
//! Computers are killed and cut off. Two tests run at once, because each keeps a processor busy. They need root.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

use std::sync::{
    Mutex, MutexGuard, PoisonError,
    atomic::{AtomicUsize, Ordering},
};

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
/// The log's addresses of callers on several computers.
mod log;
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

/// Waits for one of two turns, which the tests take alternately. A test does this first, so that its turn ends after
/// everything that it started has ended.
fn turn() -> MutexGuard<'static, ()> {
    static TESTS: AtomicUsize = AtomicUsize::new(0);
    static TURNS: [Mutex<()>; 2] = [const { Mutex::new(()) }; 2];
    let turn = &TURNS[TESTS.fetch_add(1, Ordering::Relaxed) % TURNS.len()];
    turn.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Number of rounds in which computers are killed, cut off or told to hand over. `ROSRESCUE_ROUNDS` changes it.
fn rounds() -> usize {
    let rounds = std::env::var("ROSRESCUE_ROUNDS");
    rounds.map_or(3, |rounds| {
        rounds.parse().expect("ROSRESCUE_ROUNDS is a number")
    })
}
