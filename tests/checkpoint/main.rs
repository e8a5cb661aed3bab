//! The checkpoint without ROS: its bytes, its YAML, and the store on a real disk.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

/// Damage of any kind to the bytes of a file.
mod damaged_bytes;
/// SIGKILL to a process that records.
mod kill;
mod log;
/// The store on a disk: locks, generations, compaction.
mod store;
/// How Python reads a checkpoint.
mod yaml;
