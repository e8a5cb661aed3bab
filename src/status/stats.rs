//! Counters for the status page and the metrics.

use std::sync::atomic::{AtomicU64, Ordering};

use super::call_times::CallTimes;

/// A count of events. It only grows.
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

/// Defines a struct of counters that also lists their names and meanings.
macro_rules! counters {
    ($($name:ident = $meaning:literal,)*) => {
        /// Counters since this process started.
        #[derive(Debug, Default)]
        pub struct Stats {
            $(#[doc = $meaning] pub $name: Counter,)*
            pub(crate) times: CallTimes,
        }

        impl Stats {
            /// Name, meaning and value of each counter.
            pub fn list(&self) -> Vec<(&'static str, &'static str, u64)> {
                vec![$((stringify!($name), $meaning, self.$name.value()),)*]
            }
        }
    };
}

counters! {
    calls = "calls that clients made",
    calls_from_mirror = "reads that the mirror answered while a master was running, see --reads",
    calls_without_master = "calls that the mirror answered because the master was away or late",
    calls_unanswered = "calls that only a master could answer and that timed out, see --hold",
    writes_recorded = "successful writes that were journaled",
    write_batches = "batches of writes sent to the master",
    notifications_sent = "notifications that rosrescue sent to nodes in the master's place",
    requests_not_understood = "requests that rosrescue could not decode and forwarded unchanged",
    requests_refused = "requests that were refused, see security.md",
    divergences = "replies in which the mirror and the master differed",
    dead_nodes_reaped = "dead nodes of this computer that were unregistered without a rescue",
    shutdowns_prevented = "shutdown calls of the master that would have reached the wrong node and were prevented",
    shutdowns_misdirected = "shutdown calls of the master that may have reached the wrong node",
    masters_restored = "masters to which the state was restored",
}
