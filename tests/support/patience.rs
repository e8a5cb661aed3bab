//! Waiting for a condition, with a limit, instead of for a fixed time.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// The time limit for anything that a test waits for, chosen for two busy cores.
pub(crate) const PATIENCE: Duration = Duration::from_secs(120);

const STEP: Duration = Duration::from_millis(10);

/// Longest pause between two looks at a condition that comes true at some time. Looks are calls to rosrescue and its
/// master, which other tests need the cores for.
const LONGEST_STEP: Duration = Duration::from_millis(50);

/// Waits until `condition` holds. Returns false after [`PATIENCE`].
pub(crate) fn comes_true(condition: impl Fn() -> bool) -> bool {
    look_until(PATIENCE, || condition().then_some(())).is_some()
}

/// Waits until `condition` holds. Panics with `what` after [`PATIENCE`].
#[track_caller]
pub(crate) fn eventually(what: &str, mut condition: impl FnMut() -> bool) {
    eventually_some(what, || condition().then_some(()));
}

/// Waits until `look` finds something, and returns it. Panics with `what` after [`PATIENCE`].
#[track_caller]
pub(crate) fn eventually_some<T>(what: &str, look: impl FnMut() -> Option<T>) -> T {
    let Some(found) = look_until(PATIENCE, look) else {
        panic!("did not happen within {PATIENCE:?}: {what}");
    };
    found
}

/// What `look` finds within `span`.
fn look_until<T>(span: Duration, mut look: impl FnMut() -> Option<T>) -> Option<T> {
    let start = Instant::now();
    while start.elapsed() < span {
        if let found @ Some(_) = look() {
            return found;
        }
        sleep((start.elapsed() / 20).clamp(STEP, LONGEST_STEP));
    }
    None
}

/// Whether `condition` holds during all of `span`. Used for events that must *not* happen.
pub(crate) fn holds(span: Duration, mut condition: impl FnMut() -> bool) -> bool {
    let start = Instant::now();
    while start.elapsed() < span {
        if !condition() {
            return false;
        }
        sleep(STEP);
    }
    true
}

/// Tells threads to end when it is dropped, even after a panic.
pub(crate) struct Finish<'a>(pub(crate) &'a AtomicBool);

impl Drop for Finish<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
