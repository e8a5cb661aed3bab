//! Tests of the whole program for short times. One test runs at a time for each core, because otherwise mostly the
//! processes of other tests would be measured. `tests/robot` has the tests of which many run side by side.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

#[path = "../support/mod.rs"]
mod support;

/// Loops of drivers do not stall.
mod drivers;
/// Without a master, nodes that cannot be notified or do not answer delay no other node.
mod notifications;
/// Nodes that cannot be reached delay no other node.
mod unreachable;

/// Waits for the turn of a test; see [`support::turn`].
fn turn() -> support::Turn {
    support::turn(1)
}
