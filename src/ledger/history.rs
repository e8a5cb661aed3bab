//! Keeps the state of each rescue beside the checkpoint.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use super::Ledger;
use crate::checkpoint::store::history;

/// Rescues in a row that are kept.
const AT_ONCE: u32 = 5;
/// Then one more after this time: the masters of a crash loop die every few seconds, with one and the same state,
/// and a memory card wears out.
const REFILL: Duration = Duration::from_secs(600);

pub(crate) struct Rescues {
    ledger: Arc<Ledger>,
    /// Most space for all that is kept, in bytes; 0 for keeping no rescue.
    bytes_most: u64,
    allowance: Allowance,
}

impl Rescues {
    pub(crate) fn new(ledger: Arc<Ledger>, bytes_most: u64) -> Self {
        Self {
            ledger,
            bytes_most,
            allowance: Allowance::default(),
        }
    }

    /// Keeps the present state: a new master has just been brought to it. It is written beside traffic.
    pub(crate) fn keep(&mut self, now: Instant) {
        let bytes_most = self.bytes_most;
        if bytes_most == 0 || !self.allowance.take(now) {
            return;
        }
        let place = self.ledger.with_store(|store, _| {
            // A disk that is full or broken is not written to more than it must be.
            let fits = store.snapshot_bytes() <= bytes_most && store.unprotected().is_none();
            fits.then(|| store.path().to_owned())
        });
        let Some(path) = place.flatten() else {
            tracing::debug!("the state of this rescue is not kept: no room, or no working disk");
            return;
        };
        // Now: the health check is about to take out nodes that have died.
        let checkpoint = self.ledger.checkpoint();
        tokio::task::spawn_blocking(move || {
            let kept = history::keep_rescue(&path, &checkpoint);
            match kept.and_then(|kept| history::trim(&path, bytes_most).map(|()| kept)) {
                Ok(kept) => tracing::debug!(path = %kept.display(), "the rescue's state is kept"),
                Err(error) => tracing::info!(%error, "the state of this rescue is not kept"),
            }
        });
    }
}

/// How often something that wears out the disk may be done.
#[derive(Debug)]
struct Allowance {
    left: u32,
    refilled: Option<Instant>,
}

impl Default for Allowance {
    fn default() -> Self {
        Self {
            left: AT_ONCE,
            refilled: None,
        }
    }
}

impl Allowance {
    fn take(&mut self, now: Instant) -> bool {
        let since = *self.refilled.get_or_insert(now);
        let due = now.duration_since(since).as_secs() / REFILL.as_secs();
        let due = u32::try_from(due).unwrap_or(AT_ONCE);
        if due > 0 {
            self.left = self.left.saturating_add(due).min(AT_ONCE);
            self.refilled = Some(now);
        }
        let left = self.left.checked_sub(1);
        self.left = left.unwrap_or(0);
        left.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crash_loop_is_not_kept_whole() {
        let start = Instant::now();
        let mut allowance = Allowance::default();
        let mut taken = |seconds: std::ops::Range<u64>| {
            let times = seconds.map(|second| start + Duration::from_secs(second));
            times.filter(|now| allowance.take(*now)).count()
        };
        // One death a second: the first five, and then six in an hour.
        assert_eq!(taken(0..600), 5);
        assert_eq!(taken(600..3_601), 6);
        // After an hour of rest as at first.
        assert_eq!(taken(7_300..7_310), 5);
    }
}
