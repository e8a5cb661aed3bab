//! Tests of the whole program for short times. They run one at a time, because otherwise the processes of another test
//! would be measured too. `tests/robot` has the tests that can run side by side.

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
