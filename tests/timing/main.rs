//! The whole program, where a short time is the promise. These tests run one at a time, because otherwise the
//! processes of another test would be measured too. `tests/robot` has the tests that can run beside each
//! other.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

use std::sync::{Mutex, MutexGuard, PoisonError};

#[path = "../support/mod.rs"]
mod support;

/// The loops of drivers do not stall.
mod drivers;
/// Nodes that cannot be told, or do not answer, delay no other node while there is no master.
mod notifications;
/// Nodes that cannot be reached delay no other node.
mod unreachable;

/// A lock that lets one test run alone. A test takes it first, so that it is released after everything that
/// the test has started has ended.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}
