//! The whole program, where a short time is the promise: one test at a time, because another one's processes
//! would be measured too. What may run beside others is in `tests/robot`.

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
/// Who cannot be told, or does not answer, delays nobody while there is no master.
mod notifications;
/// Nodes that cannot be reached delay nobody.
mod unreachable;

/// Whoever holds this runs alone. A test takes it first, so that it is let go after all that the test has
/// started has ended.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}
