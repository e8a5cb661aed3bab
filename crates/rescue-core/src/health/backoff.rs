//! Pauses that grow from one attempt to the next.

use std::time::{Duration, Instant};

/// The time of the next attempt, and the pause after it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Backoff {
    next: Instant,
    pause: Duration,
}

impl Backoff {
    /// Schedules the first attempt at `next`, with a `pause` after it.
    pub(crate) fn new(next: Instant, pause: Duration) -> Self {
        Self { next, pause }
    }

    pub(crate) fn next(&self) -> Instant {
        self.next
    }

    /// Notes an attempt at `now`. Pauses double up to `longest`.
    pub(crate) fn done(&mut self, now: Instant, longest: Duration) {
        self.next = now + self.pause;
        self.pause = (self.pause * 2).min(longest);
    }
}
