//! Tests of the whole program for short times. They run one at a time, because otherwise the processes of another test
//! would be measured too. `tests/robot` has the tests that can run side by side.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

use std::sync::{Mutex, MutexGuard, PoisonError};

#[path = "../support/mod.rs"]
mod support;

/// Loops of drivers do not stall.
mod drivers;
/// Without a master, nodes that cannot be notified or do not answer delay no other node.
mod notifications;
/// Nodes that cannot be reached delay no other node.
mod unreachable;

/// Lock for tests that must not run side by side. A test takes it first, so that it is released after everything that
/// the test started has ended.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}
