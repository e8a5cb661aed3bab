//! Growing pauses.

use std::time::{Duration, Instant};

/// When something is due next, and the pause after that.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Backoff {
    next: Instant,
    pause: Duration,
}

impl Backoff {
    /// First due at `next`, then after `pause`.
    pub(super) fn new(next: Instant, pause: Duration) -> Self {
        Self { next, pause }
    }

    pub(super) fn next(&self) -> Instant {
        self.next
    }

    /// It was done at `now`. Pauses double up to `longest`.
    pub(super) fn done(&mut self, now: Instant, longest: Duration) {
        self.next = now + self.pause;
        self.pause = (self.pause * 2).min(longest);
    }
}
