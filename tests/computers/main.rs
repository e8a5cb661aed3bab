//! Tests with three simulated computers, each with an etcd, a rosrescue and nodes: network namespaces on one switch.
//! Computers are killed and cut off. Two tests run at once for each core, because each needs a third of a core and waits
//! most of the time. They need root.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

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

/// Waits for the turn of a test; see [`support::turn`].
fn turn() -> support::Turn {
    support::turn(3)
}

/// Number of rounds in which computers are killed, cut off or told to hand over: `usual`, or `ROSRESCUE_ROUNDS`.
fn rounds(usual: usize) -> usize {
    let rounds = std::env::var("ROSRESCUE_ROUNDS");
    rounds.map_or(usual, |rounds| {
        rounds.parse().expect("ROSRESCUE_ROUNDS is a number")
    })
}
