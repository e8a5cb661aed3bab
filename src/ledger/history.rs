//! Keeps the state after each rescue next to the checkpoint.

use std::{sync::Arc, time::Instant};

use checkpoint_store::history;

use super::{Ledger, disk_jobs::StoreState};
use crate::limit::Limit;

pub(crate) struct Rescues {
    ledger: Arc<Ledger>,
    /// Maximum disk space for all kept states, in bytes; 0 keeps none.
    bytes_most: u64,
    /// Limits how often a state is kept. In a crash loop masters die every few seconds with the same state, and memory
    /// cards wear out.
    limit: Limit,
}

impl Rescues {
    pub(crate) fn new(ledger: Arc<Ledger>, bytes_most: u64) -> Self {
        Self {
            ledger,
            bytes_most,
            limit: Limit::new(),
        }
    }

    /// Keeps the present state, which a new master now holds, as the state after rescue `number`. The file is written
    /// in parallel with traffic.
    pub(crate) fn keep_rescue(&self, number: u64, now: Instant) {
        let bytes_most = self.bytes_most;
        if bytes_most == 0 || self.limit.pass(now).is_none() {
            return;
        }
        // Spares a full or broken disk unnecessary writes.
        let fits =
            |store: &StoreState| store.snapshot_bytes <= bytes_most && store.unprotected.is_none();
        let Some(StoreState { path, .. }) = self.ledger.seen_store().filter(fits) else {
            tracing::debug!(
                "not keeping the state of this rescue: not enough space, or no working disk"
            );
            return;
        };
        // The checkpoint is taken now: the health check will soon unregister dead nodes.
        let checkpoint = self.ledger.checkpoint();
        crate::task::spawn_blocking(move || {
            let kept = history::keep_rescue(&path, number, checkpoint());
            match kept.and_then(|kept| history::trim(&path, bytes_most).map(|()| kept)) {
                Ok(kept) => {
                    tracing::debug!(path = %kept.display(), "kept the state of this rescue")
                }
                Err(error) => {
                    tracing::info!(%error, "could not keep a copy of the state that this rescue restored")
                }
            }
        });
    }
}
