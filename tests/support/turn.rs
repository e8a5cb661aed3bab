//! Turns: how many tests of one program run at once.

use std::sync::{Condvar, Mutex, PoisonError};
use std::thread;

/// Number of tests that run now.
static RUNNING: Mutex<usize> = Mutex::new(0);
static ENDED: Condvar = Condvar::new();

/// The turn of a test. It ends on drop.
pub(crate) struct Turn(());

impl Drop for Turn {
    fn drop(&mut self) {
        *RUNNING.lock().unwrap_or_else(PoisonError::into_inner) -= 1;
        ENDED.notify_one();
    }
}

/// Waits until fewer than `tests` of this program's tests run for each core. A test does this first, so that its turn
/// ends after everything that it started has ended.
pub(crate) fn turn(tests: usize) -> Turn {
    let most = tests * thread::available_parallelism().map_or(1, usize::from);
    let running = RUNNING.lock().unwrap_or_else(PoisonError::into_inner);
    let running = ENDED.wait_while(running, |running| *running >= most);
    *running.unwrap_or_else(PoisonError::into_inner) += 1;
    Turn(())
}
