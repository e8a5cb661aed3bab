//! What several computers stand on, with real etcd servers on loopback.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

#[path = "../support/mod.rs"]
mod support;

mod servers;

/// Users, passwords and certificates.
mod access;
/// The robot's state in etcd, from one computer to the other.
mod replica;
/// Requests, when members die, hang, are full, or are no majority.
mod requests;
/// Two machines on a real etcd: who leads when one dies.
mod takeover;
/// Changes, when members die, and when they are forgotten.
mod watches;
