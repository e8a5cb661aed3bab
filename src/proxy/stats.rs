//! Counters of what went through, for the status page and the metrics.

use std::sync::atomic::{AtomicU64, Ordering};

/// One number that only grows.
#[derive(Debug, Default)]
pub struct Counter(AtomicU64);

impl Counter {
    /// Adds one.
    pub fn count(&self) {
        self.add(1);
    }

    /// Adds `number`.
    pub fn add(&self, number: u64) {
        self.0.fetch_add(number, Ordering::Relaxed);
    }

    /// The number now.
    pub fn value(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// What is counted, from the start of this process.
#[derive(Debug, Default)]
pub struct Stats {
    /// Calls that clients made.
    pub calls: Counter,
    /// Calls that were answered by the mirror, because the gate was shut or the master's answer broke off.
    pub stood_in: Counter,
    /// Calls that waited at the shut gate.
    pub parked: Counter,
    /// Calls whose connection was closed because the gate stayed shut.
    pub hold_expired: Counter,
    /// Mutating calls that the master accepted and the journal holds.
    pub recorded: Counter,
    /// Round trips to the master in which mutating calls travelled.
    pub journeys: Counter,
    /// Requests that could not be decoded, and were forwarded as they were.
    pub undecoded: Counter,
    /// Replies in which the mirror and the master differed.
    pub divergences: Counter,
    /// Requests that were turned away at the door.
    pub refused: Counter,
    /// Masters that were brought to the mirror's state.
    pub injections: Counter,
}

impl Stats {
    /// Names, meanings and values, for pages.
    pub fn list(&self) -> [(&'static str, &'static str, u64); 10] {
        [
            ("calls", "calls that clients made", self.calls.value()),
            (
                "stood_in",
                "calls answered by the mirror: the gate was shut, or the master's answer broke off",
                self.stood_in.value(),
            ),
            (
                "parked",
                "calls that waited at the shut gate",
                self.parked.value(),
            ),
            (
                "hold_expired",
                "calls that waited in vain",
                self.hold_expired.value(),
            ),
            (
                "recorded",
                "mutating calls accepted and journaled",
                self.recorded.value(),
            ),
            (
                "journeys",
                "round trips of mutating calls",
                self.journeys.value(),
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
                "requests turned away at the door",
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
