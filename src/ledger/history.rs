//! Keeps the state of each rescue beside the checkpoint.

use std::{sync::Arc, time::Instant};

use super::{Ledger, journal::Seen};
use crate::{checkpoint::store::history, limit::Limit};

pub(crate) struct Rescues {
    ledger: Arc<Ledger>,
    /// Most space for all that is kept, in bytes; 0 for keeping no rescue.
    bytes_most: u64,
    /// The masters of a crash loop die every few seconds, with one and the same state, and a memory card wears out.
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

    /// Keeps the present state, to which a new master has just been brought, as that of rescue `number`. It is
    /// written beside traffic.
    pub(crate) fn keep(&self, number: u64, now: Instant) {
        let bytes_most = self.bytes_most;
        if bytes_most == 0 || self.limit.pass(now).is_none() {
            return;
        }
        // A disk that is full or broken is not written to more than it must be.
        let fits = |store: &Seen| store.snapshot_bytes <= bytes_most && store.unprotected.is_none();
        let Some(Seen { path, .. }) = self.ledger.seen_store().filter(fits) else {
            tracing::debug!("the state of this rescue is not kept: no room, or no working disk");
            return;
        };
        // Now: the health check is about to take out nodes that have died.
        let checkpoint = self.ledger.checkpoint();
        tokio::task::spawn_blocking(move || {
            let kept = history::keep_rescue(&path, number, checkpoint);
            match kept.and_then(|kept| history::trim(&path, bytes_most).map(|()| kept)) {
                Ok(kept) => tracing::debug!(path = %kept.display(), "the rescue's state is kept"),
                Err(error) => tracing::info!(%error, "the state of this rescue is not kept"),
            }
        });
    }
}
