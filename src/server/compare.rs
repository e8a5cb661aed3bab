//! Finds changes that bypassed rosrescue, by comparing the master's answers to clients with the
//! mirror.

use std::{
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

use ros1_master::{
    master::{Method, Request},
    xmlrpc::{self, Reply},
};

use super::calls::Calls;
use crate::upstream::RawReply;

/// Shortest time between two comparisons, because each decodes the whole answer.
const PAUSE: Duration = Duration::from_secs(1);

/// When the next comparison may begin.
#[derive(Debug, Default)]
pub struct Comparisons(Mutex<Option<Instant>>);

impl Comparisons {
    /// Whether a comparison begins now.
    fn begin(&self, now: Instant) -> bool {
        let mut not_before = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let begins = not_before.is_none_or(|at| at <= now);
        if begins {
            *not_before = Some(now + PAUSE);
        }
        begins
    }
}

impl Calls {
    /// The mirror's version if `read` is `getSystemState` and no write to the master is unanswered. Otherwise `None`,
    /// because answer and mirror cannot be compared.
    pub(super) fn comparable(&self, read: Option<&Request>) -> Option<u64> {
        let shows_graph = read.is_some_and(|read| *read.method() == Method::GetSystemState);
        (shows_graph && self.write_queue.unanswered_since().is_none())
            .then(|| self.ledger.version())
    }

    /// Compares the master's answer to `read` with the mirror, in parallel with traffic. If they differ, the master is
    /// examined again. `version` is the result of [`Self::comparable`] before the read.
    pub(super) fn compare(&self, read: Option<&Request>, version: Option<u64>, raw: &RawReply) {
        // A write that ran meanwhile may or may not be part of the answer.
        let (Some(read), Some(version)) = (read, version) else {
            return;
        };
        if self.comparable(Some(read)) != Some(version) || !self.compared.begin(Instant::now()) {
            return;
        }
        let (ledger, read, body) = (self.ledger.clone(), read.clone(), raw.body.clone());
        crate::task::spawn_blocking(move || {
            let Ok(Reply::Value(shown)) = xmlrpc::decode_reply(&body) else {
                return;
            };
            let mirrored = ledger.exact_answer(&read);
            if mirrored.is_some_and(|mirrored| mirrored != shown) && ledger.version() == version {
                ledger.doubt();
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comparisons_are_a_second_apart() {
        let (start, comparisons) = (Instant::now(), Comparisons::default());
        assert!(comparisons.begin(start));
        assert!(!comparisons.begin(start + PAUSE / 2));
        assert!(comparisons.begin(start + PAUSE));
        assert!(!comparisons.begin(start + PAUSE));
    }
}
