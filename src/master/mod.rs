//! The Master and Parameter API as a pure state machine.

mod snapshot;

pub use snapshot::{ServiceEntry, Snapshot, SnapshotNode};
