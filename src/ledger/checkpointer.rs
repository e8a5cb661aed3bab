//! Keeps the checkpoint: syncs the journal, checks that the file is still unchanged at its path, writes new
//! generations, and re-arms after a disk failure or after another process moved or changed the file. Runs
//! beside traffic. A call waits for it with `--sync always`, and if its effect is in no journal.

use std::{
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use tokio::{task::spawn_blocking, time::timeout};
use tokio_util::sync::CancellationToken;

use super::{
    Ledger,
    journal::{DISK_PATIENCE, Seen},
};
use crate::{
    checkpoint::store::{CheckJob, Store, SyncJob},
    cli::SyncPolicy,
    limit::{Pair, alarm, all_clear, rarely},
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

/// That the state is not recorded, and that it is again.
static UNPROTECTED: Pair = Pair::new();

pub(crate) struct Checkpointer {
    ledger: Arc<Ledger>,
    voice: Arc<Voice>,
    path: PathBuf,
    sync: SyncPolicy,
    sync_interval: Duration,
    /// The journal's last record in the last round.
    seq: u64,
    recorded_at: Instant,
    compacted_at: Option<Instant>,
    failed_at: Option<Instant>,
}

impl Checkpointer {
    /// Writes the first generation of the checkpoint of `ledger` at `path`. No write may be answered before:
    /// it would be in no journal. Later it is synced every `sync_interval`, unless the ledger's policy
    /// differs. Does not wait longer than [`DISK_PATIENCE`] for the disk.
    pub(crate) async fn begin(
        ledger: Arc<Ledger>,
        board: Arc<Board>,
        path: PathBuf,
        sync_interval: Duration,
    ) -> Self {
        let opened = ledger.seen_store().is_some();
        // Logged when the checkpoint was opened.
        let said = ledger.unprotected().filter(|_| !opened);
        let mut checkpointer = Self {
            seq: 0,
            recorded_at: Instant::now(),
            compacted_at: None,
            failed_at: None,
            sync: ledger.sync,
            voice: Arc::new(Voice {
                ledger: ledger.clone(),
                board,
                path: path.clone(),
                said: Mutex::new(said),
            }),
            ledger,
            path,
            sync_interval,
        };
        if timeout(DISK_PATIENCE, checkpointer.compact())
            .await
            .is_err()
        {
            checkpointer.ledger.give_up_disk();
        }
        checkpointer.voice.say_protection();
        checkpointer
    }

    /// Keeps the checkpoint until `stop`.
    pub(crate) async fn run(self, stop: CancellationToken) {
        let voice = Arc::clone(&self.voice);
        tokio::select! {
            () = stop.cancelled() => {}
            () = voice.tell_of_silence() => {}
            () = self.keep() => {}
        }
    }

    async fn keep(mut self) {
        loop {
            tokio::select! {
                () = self.ledger.work.notified() => {}
                () = tokio::time::sleep(LOOK) => {}
            }
            self.round(true).await;
            if self.sync != SyncPolicy::Always {
                self.pause().await;
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
        if self.ledger.seen_store().is_none() {
            self.open_again().await;
        }
        self.sync(sync && self.sync != SyncPolicy::Never).await;
        // Before the repair below: a failure is logged even if it is repaired at once.
        self.voice.say_protection();
        if self.compaction_is_due() {
            self.compact().await;
        }
        self.voice.say_protection();
    }

    /// The result of `work`, however long the disk takes for it. A silence is told when it is too long.
    async fn waited_for<T>(&self, work: impl Future<Output = T>, silent: impl FnOnce()) -> T {
        let mut work = std::pin::pin!(work);
        match timeout(DISK_PATIENCE, &mut work).await {
            Ok(done) => done,
            Err(_) => {
                silent();
                work.await
            }
        }
    }

    /// As [`Ledger::on_store`]. The store is not expected to be silent.
    async fn on_store<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Store) -> T + Send + 'static,
    ) -> Option<T> {
        let done = self.ledger.on_store(work);
        self.waited_for(done, || self.ledger.give_up_disk()).await
    }

    /// Checks the file and, with `syncs`, syncs it.
    async fn sync(&self, syncs: bool) {
        let jobs = self.on_store(move |store| {
            let check = store.check_job();
            (check, syncs.then(|| store.sync_job()).flatten())
        });
        let (check, sync) = jobs.await.unwrap_or_default();
        let folder = self.path.parent().map(PathBuf::from).unwrap_or_default();
        let work = spawn_blocking(move || {
            let free = free_bytes(&folder);
            (check.map(CheckJob::run), sync.map(SyncJob::run), free)
        });
        let ledger = &self.ledger;
        let done = self
            .waited_for(work, || ledger.set_sync_is_late(true))
            .await;
        ledger.set_sync_is_late(false);
        if let Ok((checked, synced, free)) = done {
            self.voice.board.update(|facts| facts.disk.free = free);
            // The store keeps a failure; `say_protection` logs it.
            let noted = self.on_store(move |store| {
                let _ = checked.map(|done| store.checked(done));
                let _ = synced.map(|done| store.synced(done));
            });
            noted.await;
        }
    }

    fn compaction_is_due(&mut self) -> bool {
        let now = Instant::now();
        let due = self.ledger.checkpoint_due();
        let Some(seen) = self.ledger.seen_store() else {
            return false;
        };
        let Seen {
            seq, journal_bytes, ..
        } = seen;
        let unprotected = seen.unprotected.is_some();
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
        !failed && (due || seen.outgrown || unprotected || (journal_bytes > 0 && quiet && rested))
    }

    async fn compact(&mut self) {
        let ledger = Arc::clone(&self.ledger);
        let begun = ledger
            .on_store_whole(|store, checkpoint| (store.seq(), store.begin_compaction(checkpoint)));
        let begun = self.waited_for(begun, || ledger.give_up_disk()).await;
        let (seq, finished) = match begun {
            None => return,
            Some((seq, Err(error))) => (seq, Some(Err(error))),
            Some((seq, Ok(job))) => match spawn_blocking(move || job.run()).await {
                Ok(done) => {
                    let finished = self.on_store(|store| store.finish_compaction(done));
                    (seq, finished.await)
                }
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
                let board = &self.voice.board;
                board.update(|facts| facts.disk.compacted = Some((now, seq)));
                if self.sync == SyncPolicy::Always {
                    // The new file's name is not on the disk yet.
                    self.sync(true).await;
                }
                ledger.set_attempted(Ok(()));
            }
        }
    }

    /// Tries to open a checkpoint that could not be opened at the start. Its contents are not restored,
    /// memory is newer; but they are unknown, so the file is kept.
    async fn open_again(&self) {
        let path = self.path.clone();
        let opened = spawn_blocking(move || Store::open_over(&path)).await;
        if let Ok(Ok(store)) = opened {
            self.ledger.set_store(store);
        }
    }
}

/// Says whether the state is recorded.
struct Voice {
    ledger: Arc<Ledger>,
    board: Arc<Board>,
    path: PathBuf,
    /// The failure that was logged last.
    said: Mutex<Option<String>>,
}

impl Voice {
    async fn tell_of_silence(&self) {
        loop {
            self.ledger.disk_silent.notified().await;
            self.say_protection();
        }
    }

    /// Logs once that the state is no longer recorded, and once that it is again; and where a file was kept that
    /// was found at the path.
    fn say_protection(&self) {
        let path = self.path.display();
        if let Some(kept) = self.ledger.take_kept() {
            rarely!(
                warn,
                checkpoint = %path, kept = %kept.display(),
                "somebody replaced or changed the checkpoint; what was there is kept under another name, \
                 and a whole one is written"
            );
        }
        let unprotected = self.ledger.unprotected();
        let mut said = self.said.lock().unwrap_or_else(PoisonError::into_inner);
        match (&unprotected, &*said) {
            (Some(reason), None) => alarm!(
                error,
                UNPROTECTED,
                checkpoint = %path, reason,
                "unprotected: nodes run as usual, but a crash of rosrescue itself would lose the state; \
                 free or repair the disk, and recording begins again by itself"
            ),
            (None, Some(_)) => {
                all_clear!(info, UNPROTECTED, checkpoint = %path, "protected again: a whole checkpoint is written")
            }
            _ => {}
        }
        let protected = unprotected.is_none();
        self.board.update(|facts| {
            if facts.disk.protected != protected {
                (facts.disk.protected, facts.disk.since) = (protected, Instant::now());
            }
        });
        *said = unprotected;
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
