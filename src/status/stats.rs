//! Counters for the status page and the metrics.

use std::sync::atomic::{AtomicU64, Ordering};

/// A number that only grows.
#[derive(Debug, Default)]
pub struct Counter(AtomicU64);

impl Counter {
    pub fn count(&self) {
        self.add(1);
    }

    pub fn add(&self, number: u64) {
        self.0.fetch_add(number, Ordering::Relaxed);
    }

    pub fn value(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Counters since the start of this process.
#[derive(Debug, Default)]
pub struct Stats {
    /// Calls by clients.
    pub calls: Counter,
    /// Reads that the mirror answered while there was a master.
    pub mirrored: Counter,
    /// Calls that the mirror answered: the master was away, or did not answer in time.
    pub stood_in: Counter,
    /// Calls closed without an answer: only a master could answer, and none came in time.
    pub hold_expired: Counter,
    /// Successful writes that were journaled.
    pub recorded: Counter,
    /// Round trips to the master with writes.
    pub batches: Counter,
    /// Notifications that rosrescue sent to nodes.
    pub notifications: Counter,
    /// Requests that could not be decoded and were forwarded unchanged.
    pub undecoded: Counter,
    /// Replies in which the mirror and the master differed.
    pub divergences: Counter,
    /// Requests refused by the checks on their head.
    pub refused: Counter,
    /// Masters that were brought to the mirror's state.
    pub injections: Counter,
}

impl Stats {
    /// Names, meanings and values, for pages.
    pub fn list(&self) -> [(&'static str, &'static str, u64); 11] {
        [
            ("calls", "calls that clients made", self.calls.value()),
            (
                "mirrored",
                "reads answered by the mirror while there was a master, see --reads",
                self.mirrored.value(),
            ),
            (
                "stood_in",
                "calls answered by the mirror: the master was away, or did not answer in time",
                self.stood_in.value(),
            ),
            (
                "hold_expired",
                "calls that waited for a master in vain",
                self.hold_expired.value(),
            ),
            (
                "recorded",
                "writes answered with success and journaled",
                self.recorded.value(),
            ),
            (
                "batches",
                "round trips to the master with writes",
                self.batches.value(),
            ),
            (
                "notifications",
                "notifications that rosrescue sent to nodes",
                self.notifications.value(),
            ),
            (
                "undecoded",
                "requests forwarded without being understood",
                self.undecoded.value(),
            ),
            (
                "divergences",
                "replies in which mirror and master differed",
                self.divergences.value(),
            ),
            (
                "refused",
                "requests refused by the checks on their head",
                self.refused.value(),
            ),
            (
                "injections",
                "masters brought to the mirror's state",
                self.injections.value(),
            ),
        ]
    }
}
