//! The client of etcd and the robot's state in etcd, with real etcd servers on loopback.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

#[path = "../support/mod.rs"]
mod support;

mod servers;

/// Access with users, passwords and certificates.
mod access;
/// The robot's state in etcd, read by another computer.
mod replica;
/// Requests while members of etcd die, hang, are full, or have no majority.
mod requests;
/// Two state machines on a real etcd: one of them leads when the other dies.
mod takeover;
/// Watches while members of etcd die, and after etcd has compacted the watched revisions.
mod watches;
