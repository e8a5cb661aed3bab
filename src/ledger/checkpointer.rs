//! Keeps the checkpoint: forces the journal to the disk, checks that the file is still the one at its
//! path and as it was left, writes new generations, and re-arms after the disk has failed or somebody has
//! moved or changed the file. Beside traffic; a call waits for it with `--sync always`, and where what it
//! did is in no journal.

use std::{
    path::PathBuf,
    sync::Arc,
    time::{Duration, Instant},
};

use tokio_util::sync::CancellationToken;

use super::Ledger;
use crate::{
    checkpoint::store::{CheckJob, Store, SyncJob},
    cli::SyncPolicy,
};

/// Longest time between two checks of the file: tampering is noticed well within a second.
const LOOK: Duration = Duration::from_millis(500);
/// Time between attempts to protect an unprotected store again.
const AGAIN: Duration = Duration::from_secs(1);
/// The journal is compacted when nothing was recorded for this time,
const QUIET: Duration = Duration::from_secs(2);
/// but not more often than this: a memory card wears out.
const BETWEEN: Duration = Duration::from_secs(10);

/// Keeps the checkpoint of `ledger` at `path` until `stop`, and forces it to the disk every `sync_interval`,
/// unless the ledger's policy has it otherwise.
pub(crate) async fn run(
    ledger: Arc<Ledger>,
    path: PathBuf,
    sync_interval: Duration,
    stop: CancellationToken,
) {
    let mut checkpointer = Checkpointer {
        seq: 0,
        recorded_at: Instant::now(),
        compacted_at: None,
        failed_at: None,
        // Logged when the checkpoint was opened.
        said: ledger.unprotected(),
        sync: ledger.sync,
        ledger,
        path,
        sync_interval,
    };
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            () = checkpointer.ledger.work.notified() => {}
            () = tokio::time::sleep(LOOK) => {}
        }
        checkpointer.round(true).await;
        if checkpointer.sync != SyncPolicy::Always {
            tokio::select! {
                () = stop.cancelled() => return,
                () = checkpointer.pause() => {}
            }
        }
    }
}

struct Checkpointer {
    ledger: Arc<Ledger>,
    path: PathBuf,
    sync: SyncPolicy,
    sync_interval: Duration,
    /// The journal's last record at the last round.
    seq: u64,
    recorded_at: Instant,
    compacted_at: Option<Instant>,
    failed_at: Option<Instant>,
    /// The failure that was said last.
    said: Option<String>,
}

impl Checkpointer {
    /// Until the next sync, however long that is: the file is looked at all the same.
    async fn pause(&mut self) {
        let end = Instant::now() + self.sync_interval;
        loop {
            let rest = end.saturating_duration_since(Instant::now());
            tokio::time::sleep(rest.min(LOOK)).await;
            if rest <= LOOK {
                return;
            }
            self.round(false).await;
        }
    }

    async fn round(&mut self, sync: bool) {
        if self.ledger.with_store(|_, _| ()).is_none() {
            self.open_again().await;
        }
        self.sync(sync && self.sync != SyncPolicy::Never).await;
        // Also of what the next lines repair at once.
        self.say_protection();
        if self.compaction_is_due() {
            self.compact().await;
        }
        self.say_protection();
    }

    /// Checks the file and, if it `syncs`, brings it to the disk.
    async fn sync(&self, syncs: bool) {
        let ledger = &self.ledger;
        let jobs = ledger.with_store(|store, _| {
            let check = store.check_job();
            (check, syncs.then(|| store.sync_job()).flatten())
        });
        let (check, sync) = jobs.unwrap_or_default();
        let work = move || (check.map(CheckJob::run), sync.map(SyncJob::run));
        if let Ok((checked, synced)) = tokio::task::spawn_blocking(work).await {
            // A failure is the store's to remember and `say_protection`'s to tell.
            ledger.with_store(|store, _| {
                let _ = checked.map(|done| store.checked(done));
                let _ = synced.map(|done| store.synced(done));
            });
        }
        if !syncs {
            return;
        }
        let durable = ledger.with_store(|store, _| match store.unprotected() {
            None => store.synced_seq(),
            Some(_) => store.seq(),
        });
        // Without a store nothing has a number that anybody could wait for; one that is opened later
        // counts from where its file ends.
        if let Some(durable) = durable {
            ledger.set_durable(durable);
        }
    }

    fn compaction_is_due(&mut self) -> bool {
        let now = Instant::now();
        let due = self.ledger.checkpoint_due();
        let state = self.ledger.with_store(|store, _| {
            (
                store.unprotected().is_some(),
                store.wants_compaction(),
                store.seq(),
                store.journal_bytes(),
            )
        });
        let Some((unprotected, outgrown, seq, journal_bytes)) = state else {
            return false;
        };
        if seq != self.seq {
            self.seq = seq;
            self.recorded_at = now;
        }
        let rested = self
            .compacted_at
            .is_none_or(|at| now.duration_since(at) >= BETWEEN);
        let quiet = now.duration_since(self.recorded_at) >= QUIET;
        // A whole snapshot on a disk that is full is not to be written at every turn.
        let failed = self
            .failed_at
            .is_some_and(|at| now.duration_since(at) < AGAIN);
        !failed && (due || outgrown || unprotected || (journal_bytes > 0 && quiet && rested))
    }

    async fn compact(&mut self) {
        let ledger = &self.ledger;
        let begun = ledger.with_store(|store, checkpoint| store.begin_compaction(checkpoint()));
        let finished = match begun {
            None => return,
            Some(Err(error)) => Some(Err(error)),
            Some(Ok(job)) => match tokio::task::spawn_blocking(move || job.run()).await {
                Ok(done) => ledger.with_store(|store, _| store.finish_compaction(done)),
                Err(_) => return,
            },
        };
        match finished {
            Some(Err(error)) => {
                ledger.set_attempted(Err(&error));
                self.failed_at = Some(Instant::now());
                tracing::debug!(%error, "compaction");
            }
            _ => {
                self.compacted_at = Some(Instant::now());
                if self.sync == SyncPolicy::Always {
                    // The new file's name is not on the disk yet.
                    self.sync(true).await;
                }
                self.ledger.set_attempted(Ok(()));
            }
        }
    }

    /// The checkpoint could not be opened at the start: perhaps now. Nothing of it is read, what the
    /// memory holds is newer; but it is kept, since nobody has seen what it holds.
    async fn open_again(&self) {
        let path = self.path.clone();
        let opened = tokio::task::spawn_blocking(move || Store::open_over(&path)).await;
        if let Ok(Ok(store)) = opened {
            self.ledger.set_store(store);
        }
    }

    /// Says, once, that the state is no longer recorded, and that it is again.
    fn say_protection(&mut self) {
        let path = self.path.display();
        let kept = self.ledger.with_store(|store, _| store.take_kept());
        if let Some(kept) = kept.flatten() {
            tracing::warn!(
                checkpoint = %path, kept = %kept.display(),
                "what was at the checkpoint's path is kept under another name"
            );
        }
        let unprotected = self.ledger.unprotected();
        match (&unprotected, &self.said) {
            (Some(reason), None) => tracing::error!(
                checkpoint = %path, reason,
                "unprotected: calls are forwarded, but a crash of rosrescue itself would lose the \
                 state; free or repair the disk, and rosrescue re-arms by itself"
            ),
            (None, Some(_)) => tracing::info!(checkpoint = %path, "protected again"),
            _ => {}
        }
        self.said = unprotected;
    }
}
