//! Waiting for a condition, with a limit, instead of for a fixed time.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle, sleep};
use std::time::{Duration, Instant};

/// The time limit for anything that a test waits for, chosen for two busy cores.
pub(crate) const PATIENCE: Duration = Duration::from_secs(120);

const STEP: Duration = Duration::from_millis(10);

/// Longest pause between two looks at a condition. Looks are calls to rosrescue and its master, which other tests need
/// the cores for.
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
        pause(start);
    }
    None
}

/// Pauses between two looks, the longer the more time has passed since `start`.
fn pause(start: Instant) {
    sleep((start.elapsed() / 20).clamp(STEP, LONGEST_STEP));
}

/// Whether `condition` holds during all of `span`. Used for events that must *not* happen.
pub(crate) fn holds(span: Duration, mut condition: impl FnMut() -> bool) -> bool {
    let start = Instant::now();
    while start.elapsed() < span {
        if !condition() {
            return false;
        }
        pause(start);
    }
    true
}

/// Measures how busy the computer is: two threads exchange a byte, again and again, while something else is measured.
#[derive(Debug)]
pub(crate) struct Control {
    done: Arc<AtomicBool>,
    thread: JoinHandle<Duration>,
}

impl Control {
    /// How many times longer than an exchange something may take. A call of a ROS node takes some 20 turns of several
    /// processes on the processor.
    const NOISE: u32 = 50;
    const PAUSE: Duration = Duration::from_millis(5);

    pub(crate) fn start() -> Self {
        let done = Arc::new(AtomicBool::new(false));
        let (mut near, mut far) = UnixStream::pair().unwrap();
        thread::spawn(move || {
            let mut byte = [0];
            while far.read_exact(&mut byte).is_ok() && far.write_all(&byte).is_ok() {}
        });
        let stop = done.clone();
        let thread = thread::spawn(move || {
            let mut longest = Duration::ZERO;
            loop {
                let is_last = stop.load(Ordering::Relaxed);
                let start = Instant::now();
                near.write_all(&[0]).unwrap();
                near.read_exact(&mut [0]).unwrap();
                sleep(Self::PAUSE);
                longest = longest.max(start.elapsed().saturating_sub(Self::PAUSE));
                if is_last {
                    return longest;
                }
            }
        });
        Self { done, thread }
    }

    /// Ends the measurement. Returns how long something may have taken meanwhile that takes less than `limit` on a
    /// computer with nothing else to do.
    pub(crate) fn allows(self, limit: Duration) -> Duration {
        self.done.store(true, Ordering::Relaxed);
        limit + Self::NOISE * self.thread.join().unwrap()
    }
}

/// Does `work`. Panics if it takes longer than `limit`, and longer than other work did meanwhile because the computer is
/// busy.
#[track_caller]
pub(crate) fn within<T>(limit: Duration, what: &str, work: impl FnOnce() -> T) -> T {
    let control = Control::start();
    let start = Instant::now();
    let result = work();
    let took = start.elapsed();
    let allowed = control.allows(limit);
    assert!(
        took < allowed,
        "{what} took {took:?}; allowed are {allowed:?}"
    );
    result
}

/// Tells threads to end when it is dropped, even after a panic.
pub(crate) struct Finish<'a>(pub(crate) &'a AtomicBool);

impl Drop for Finish<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
