//! Keeps the checkpoint: syncs the journal, checks that the file is still unchanged at its path, writes new
//! generations, and re-arms after a disk failure or after another process moved or changed the file. Runs
//! beside traffic. A call waits for it with `--sync always`, and if its effect is in no journal.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, Instant},
};

use tokio_util::sync::CancellationToken;

use super::Ledger;
use crate::{
    checkpoint::store::{CheckJob, Store, SyncJob},
    cli::SyncPolicy,
    limit::rarely,
    status::Board,
};

/// Longest time between two checks of the file: tampering is noticed well within a second.
const LOOK: Duration = Duration::from_millis(500);
/// Time between attempts to protect an unprotected store again.
const AGAIN: Duration = Duration::from_secs(1);
/// The journal is compacted after this time without a record,
const QUIET: Duration = Duration::from_secs(2);
/// but not more often than this: a memory card wears out.
const BETWEEN: Duration = Duration::from_secs(10);

pub(crate) struct Checkpointer {
    ledger: Arc<Ledger>,
    board: Arc<Board>,
    path: PathBuf,
    sync: SyncPolicy,
    sync_interval: Duration,
    /// The journal's last record in the last round.
    seq: u64,
    recorded_at: Instant,
    compacted_at: Option<Instant>,
    failed_at: Option<Instant>,
    /// The failure that was logged last.
    said: Option<String>,
}

impl Checkpointer {
    /// Writes the first generation of the checkpoint of `ledger` at `path`. No write may be answered before:
    /// it would be in no journal. Later it is synced every `sync_interval`, unless the ledger's policy
    /// differs.
    pub(crate) async fn begin(
        ledger: Arc<Ledger>,
        board: Arc<Board>,
        path: PathBuf,
        sync_interval: Duration,
    ) -> Self {
        let opened = ledger.with_store(|_, _| ()).is_some();
        let mut checkpointer = Self {
            seq: 0,
            recorded_at: Instant::now(),
            compacted_at: None,
            failed_at: None,
            // Logged when the checkpoint was opened.
            said: ledger.unprotected().filter(|_| !opened),
            sync: ledger.sync,
            ledger,
            board,
            path,
            sync_interval,
        };
        checkpointer.compact().await;
        checkpointer.say_protection();
        checkpointer
    }

    /// Keeps the checkpoint until `stop`.
    pub(crate) async fn run(mut self, stop: CancellationToken) {
        loop {
            tokio::select! {
                () = stop.cancelled() => return,
                () = self.ledger.work.notified() => {}
                () = tokio::time::sleep(LOOK) => {}
            }
            self.round(true).await;
            if self.sync != SyncPolicy::Always {
                tokio::select! {
                    () = stop.cancelled() => return,
                    () = self.pause() => {}
                }
            }
        }
    }

    /// Until the next sync. In between, however long that is, the file is still checked.
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
        // Before the repair below: a failure is logged even if it is repaired at once.
        self.say_protection();
        if self.compaction_is_due() {
            self.compact().await;
        }
        self.say_protection();
    }

    /// Checks the file and, with `syncs`, syncs it.
    async fn sync(&self, syncs: bool) {
        let ledger = &self.ledger;
        let jobs = ledger.with_store(|store, _| {
            let check = store.check_job();
            (check, syncs.then(|| store.sync_job()).flatten())
        });
        let (check, sync) = jobs.unwrap_or_default();
        let folder = self.path.parent().map(PathBuf::from).unwrap_or_default();
        let work = move || {
            let free = free_bytes(&folder);
            (check.map(CheckJob::run), sync.map(SyncJob::run), free)
        };
        if let Ok((checked, synced, free)) = tokio::task::spawn_blocking(work).await {
            self.board.update(|facts| facts.disk.free = free);
            // The store keeps a failure; `say_protection` logs it.
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
        // Without a store there are no records to wait for; a store opened later counts from the end of its
        // file.
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
        // On a full disk, do not write a whole snapshot in every round.
        let failed = self
            .failed_at
            .is_some_and(|at| now.duration_since(at) < AGAIN);
        !failed && (due || outgrown || unprotected || (journal_bytes > 0 && quiet && rested))
    }

    async fn compact(&mut self) {
        let ledger = &self.ledger;
        let mut seq = 0;
        let begun = ledger.with_store(|store, checkpoint| {
            seq = store.seq();
            store.begin_compaction(checkpoint())
        });
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
                let now = Instant::now();
                self.compacted_at = Some(now);
                self.board
                    .update(|facts| facts.disk.compacted = Some((now, seq)));
                if self.sync == SyncPolicy::Always {
                    // The new file's name is not on the disk yet.
                    self.sync(true).await;
                }
                self.ledger.set_attempted(Ok(()));
            }
        }
    }

    /// Tries to open a checkpoint that could not be opened at the start. Its contents are not restored,
    /// memory is newer; but they are unknown, so the file is kept.
    async fn open_again(&self) {
        let path = self.path.clone();
        let opened = tokio::task::spawn_blocking(move || Store::open_over(&path)).await;
        if let Ok(Ok(store)) = opened {
            self.ledger.set_store(store);
        }
    }

    /// Logs once that the state is no longer recorded, and once that it is again.
    fn say_protection(&mut self) {
        let path = self.path.display();
        let kept = self.ledger.with_store(|store, _| store.take_kept());
        if let Some(kept) = kept.flatten() {
            rarely!(
                warn,
                checkpoint = %path, kept = %kept.display(),
                "somebody replaced or changed the checkpoint; what was there is kept under another name, \
                 and a whole one is written"
            );
        }
        let unprotected = self.ledger.unprotected();
        match (&unprotected, &self.said) {
            (Some(reason), None) => rarely!(
                error,
                checkpoint = %path, reason,
                "unprotected: nodes run as usual, but a crash of rosrescue itself would lose the state; \
                 free or repair the disk, and recording begins again by itself"
            ),
            (None, Some(_)) => {
                rarely!(info, checkpoint = %path, "protected again: a whole checkpoint is written")
            }
            _ => {}
        }
        let protected = unprotected.is_none();
        self.board.update(|facts| {
            if facts.disk.protected != protected {
                (facts.disk.protected, facts.disk.since) = (protected, Instant::now());
            }
        });
        self.said = unprotected;
    }
}

/// Bytes that are free in `folder`.
fn free_bytes(folder: &Path) -> Option<u64> {
    let folder = match folder.as_os_str().is_empty() {
        true => Path::new("."),
        false => folder,
    };
    let disk = rustix::fs::statvfs(folder).ok()?;
    Some(disk.f_bavail.saturating_mul(disk.f_frsize))
}
