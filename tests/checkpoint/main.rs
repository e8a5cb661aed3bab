//! Tests of the checkpoint without ROS: its bytes, its YAML, and the store on a real disk.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod change_log;
/// Files with damaged bytes.
mod damaged_bytes;
/// SIGKILL for a process that records.
mod kill;
/// The store on a disk: locks, generations, compaction.
mod store;
/// PyYAML reads a checkpoint like rosrescue.
mod yaml;
