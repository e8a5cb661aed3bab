//! Maintains the checkpoint: syncs the journal, checks that the file is unchanged, and writes new complete checkpoints.
//! It starts recording again after a disk failure, and after another process has moved or changed the file. It runs in
//! parallel with traffic. A call waits for it only with `--sync always`, or if no journal has the call's effect.

use std::{
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use checkpoint_store::{CheckJob, Store, SyncJob};
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use super::{
    Ledger,
    disk_jobs::{DISK_PATIENCE, StoreState},
};
use crate::{
    cli::SyncPolicy,
    limit::{AlarmLimit, alarm, all_clear, rarely},
    status::Board,
};

/// Longest time between two checks of the file, so that tampering is noticed well within a second.
const LOOK: Duration = Duration::from_millis(500);
/// Pause between two attempts to record again after a failure.
const AGAIN: Duration = Duration::from_secs(1);
/// Time without a new record after which the journal is compacted.
const QUIET: Duration = Duration::from_secs(2);
/// Shortest time between two compactions, because each one wears out memory cards.
const BETWEEN: Duration = Duration::from_secs(10);

/// Limits the log lines about a failure to record the state, and about its end.
static UNPROTECTED: AlarmLimit = AlarmLimit::new();

pub(crate) struct Checkpointer {
    ledger: Arc<Ledger>,
    voice: Arc<Voice>,
    path: PathBuf,
    sync: SyncPolicy,
    sync_interval: Duration,
    /// Maximum size of the log of changes, in bytes.
    log_bytes: u64,
    /// The number of the journal's last record when the file was last checked.
    seq: u64,
    recorded_at: Instant,
    compacted_at: Option<Instant>,
    failed_at: Option<Instant>,
}

impl Checkpointer {
    /// Writes the first complete checkpoint of `ledger` at `path`. Before that, no write may be answered, because no
    /// journal would have it. Later the file is synced every `sync_interval`, unless the ledger's sync policy says
    /// otherwise. A log of changes with up to `log_bytes` is kept beside it. Waits for the disk for [`DISK_PATIENCE`] at
    /// most.
    pub(crate) async fn begin(
        ledger: Arc<Ledger>,
        board: Arc<Board>,
        path: PathBuf,
        sync_interval: Duration,
        log_bytes: u64,
    ) -> Self {
        let opened = ledger.seen_store().is_some();
        // A checkpoint that could not be opened was already logged at the start.
        let reported = ledger.unprotected().filter(|_| !opened);
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
                reported: Mutex::new(reported),
            }),
            ledger,
            path,
            sync_interval,
            log_bytes,
        };
        if timeout(DISK_PATIENCE, checkpointer.compact())
            .await
            .is_err()
        {
            checkpointer.ledger.give_up_disk();
        }
        checkpointer.voice.report_protection();
        checkpointer
    }

    /// Maintains the checkpoint until `stop`.
    pub(crate) async fn run(self, stop: CancellationToken) {
        let voice = Arc::clone(&self.voice);
        tokio::select! {
            () = stop.cancelled() => {}
            () = voice.report_silence() => {}
            () = self.save() => {}
        }
    }

    async fn save(mut self) {
        loop {
            self.work_or_look().await;
            self.round(true).await;
            if self.sync != SyncPolicy::Always {
                self.pause().await;
            }
        }
    }

    /// Waits until the next sync. The file is still checked during a long pause.
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
        // Logs before the repair below, so that a failure is logged even if it is repaired at once.
        self.voice.report_protection();
        if self.compaction_is_due() {
            self.compact().await;
        }
        self.voice.report_protection();
    }

    /// Waits for the result of `work`, however long the disk takes. Calls `silent` when the disk has been silent for
    /// [`DISK_PATIENCE`].
    async fn await_disk<T>(&self, work: impl Future<Output = T>, silent: impl FnOnce()) -> T {
        let mut work = std::pin::pin!(work);
        match timeout(DISK_PATIENCE, &mut work).await {
            Ok(done) => done,
            Err(_) => {
                silent();
                work.await
            }
        }
    }

    /// Like [`Ledger::on_store`], but gives up on a disk that is silent for [`DISK_PATIENCE`].
    async fn on_store<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Store) -> T + Send + 'static,
    ) -> Option<T> {
        let done = self.ledger.on_store(work);
        self.await_disk(done, || self.ledger.give_up_disk()).await
    }

    /// Checks the file, and syncs it if `syncs`.
    async fn sync(&self, syncs: bool) {
        let jobs = self.on_store(move |store| {
            let check = store.check_job();
            (check, syncs.then(|| store.sync_job()).flatten())
        });
        let (check, sync) = jobs.await.unwrap_or_default();
        let folder = self.path.parent().map(PathBuf::from).unwrap_or_default();
        let work = crate::task::spawn_blocking(move || {
            let free = free_bytes(&folder);
            (check.map(CheckJob::run), sync.map(SyncJob::run), free)
        });
        let ledger = &self.ledger;
        let done = self
            .await_disk(work, || ledger.set_sync_is_late(true))
            .await;
        ledger.set_sync_is_late(false);
        if let Ok((checked, synced, free)) = done {
            self.voice.board.update(|facts| facts.disk.free = free);
            // The store keeps a failure, and `report_protection` logs it.
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
        let StoreState {
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
        // A full disk must not cause a write of the whole snapshot in each round.
        let failed = self
            .failed_at
            .is_some_and(|at| now.duration_since(at) < AGAIN);
        !failed && (due || seen.outgrown || unprotected || (journal_bytes > 0 && quiet && rested))
    }

    async fn compact(&mut self) {
        let ledger = Arc::clone(&self.ledger);
        let begun = ledger
            .on_store_whole(|store, checkpoint| (store.seq(), store.begin_compaction(checkpoint)));
        let begun = self.await_disk(begun, || ledger.give_up_disk()).await;
        let (seq, finished) = match begun {
            None => return,
            Some((seq, Err(error))) => (seq, Some(Err(error))),
            Some((seq, Ok(job))) => match self.sync_meanwhile(move || job.run()).await {
                Ok(done) => {
                    let finished = self.on_store(|store| {
                        let finished = store.finish_compaction(done);
                        (finished, store.take_log_trouble())
                    });
                    let (finished, trouble) = finished.await.unzip();
                    if let Some(reason) = trouble.flatten() {
                        rarely!(
                            warn,
                            reason,
                            "the log of changes has a gap; the state itself is recorded as usual"
                        );
                    }
                    (seq, finished)
                }
                Err(_) => return,
            },
        };
        match finished {
            Some(Err(error)) => {
                ledger.set_attempted(Err(&error));
                self.failed_at = Some(Instant::now());
                tracing::debug!(%error, "compaction failed");
            }
            // The new file has not become the present one. The next round tries again.
            None => {}
            Some(Ok(())) => {
                let now = Instant::now();
                self.compacted_at = Some(now);
                let board = &self.voice.board;
                board.update(|facts| facts.disk.compacted = Some((now, seq)));
                if self.sync == SyncPolicy::Always {
                    // The new file's name must be synced, too.
                    self.sync(true).await;
                }
                ledger.set_attempted(Ok(()));
            }
        }
    }

    /// Runs `job` in another thread. A slow disk may take seconds for a whole checkpoint, so the present file is synced
    /// meanwhile.
    async fn sync_meanwhile<T: Send + 'static>(
        &self,
        job: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, tokio::task::JoinError> {
        let mut job = crate::task::spawn_blocking(job);
        loop {
            let due = async {
                match self.sync {
                    SyncPolicy::Always => self.work_or_look().await,
                    _ => tokio::time::sleep(self.sync_interval).await,
                }
            };
            tokio::select! {
                done = &mut job => return done,
                () = due => self.sync(self.sync != SyncPolicy::Never).await,
            }
        }
    }

    /// Waits until there is something to write, or until the file must be checked.
    async fn work_or_look(&self) {
        tokio::select! {
            () = self.ledger.work.notified() => {}
            () = tokio::time::sleep(LOOK) => {}
        }
    }

    /// Tries again to open a checkpoint that could not be opened at the start. The file is kept, because its contents
    /// are unknown. Its state is not used, because the state in memory is newer.
    async fn open_again(&self) {
        let path = self.path.clone();
        let opened = crate::task::spawn_blocking(move || Store::open_over(&path)).await;
        if let Ok(Ok(mut store)) = opened {
            store.keep_log(self.log_bytes);
            self.ledger.set_store(store);
        }
    }
}

/// Reports whether the state is recorded.
struct Voice {
    ledger: Arc<Ledger>,
    board: Arc<Board>,
    path: PathBuf,
    /// The last failure that was logged.
    reported: Mutex<Option<String>>,
}

impl Voice {
    async fn report_silence(&self) {
        loop {
            self.ledger.disk_silent.notified().await;
            self.report_protection();
        }
    }

    /// Logs once that the state is no longer recorded, and once that it is again. Also logs under which name a foreign
    /// file at the checkpoint's path was kept.
    fn report_protection(&self) {
        let path = self.path.display();
        if let Some(kept) = self.ledger.take_kept() {
            rarely!(
                warn,
                checkpoint = %path, kept = %kept.display(),
                "the file at the checkpoint's path is not the one that this process has written; it is kept under another name, and a new checkpoint is written"
            );
        }
        let unprotected = self.ledger.unprotected();
        let mut reported = self.reported.lock().unwrap_or_else(PoisonError::into_inner);
        match (&unprotected, &*reported) {
            (Some(reason), None) => alarm!(
                error,
                UNPROTECTED,
                checkpoint = %path, reason,
                "unprotected: nodes run as usual, but a crash of rosrescue itself would lose the state; \
                 free space on the disk or repair it; recording resumes by itself"
            ),
            (None, Some(_)) => {
                all_clear!(info, UNPROTECTED, checkpoint = %path, "protected again: a complete checkpoint has been written")
            }
            _ => {}
        }
        let protected = unprotected.is_none();
        self.board.update(|facts| {
            if facts.disk.protected != protected {
                (facts.disk.protected, facts.disk.since) = (protected, Instant::now());
            }
        });
        *reported = unprotected;
    }
}

/// Free bytes in `folder`.
fn free_bytes(folder: &Path) -> Option<u64> {
    let folder = match folder.as_os_str().is_empty() {
        true => Path::new("."),
        false => folder,
    };
    let disk = rustix::fs::statvfs(folder).ok()?;
    Some(disk.f_bavail.saturating_mul(disk.f_frsize))
}
