//! Pauses that grow.

use std::time::{Duration, Instant};

/// When something is to be done next, and how long the pause after that is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Backoff {
    next: Instant,
    pause: Duration,
}

impl Backoff {
    /// For the first time at `next`, and again after `pause`.
    pub(super) fn new(next: Instant, pause: Duration) -> Self {
        Self { next, pause }
    }

    pub(super) fn next(&self) -> Instant {
        self.next
    }

    /// It is done now. Pauses double up to `longest`.
    pub(super) fn done(&mut self, now: Instant, longest: Duration) {
        self.next = now + self.pause;
        self.pause = (self.pause * 2).min(longest);
    }
}
