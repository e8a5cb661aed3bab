//! The base of running on several computers, with real etcd servers on loopback.

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
/// Requests while members die, hang, are full, or are no majority.
mod requests;
/// Two state machines on a real etcd: which one leads when the other dies.
mod takeover;
/// Watches while members die, and when etcd has discarded what was watched.
mod watches;
