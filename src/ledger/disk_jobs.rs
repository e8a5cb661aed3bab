//! Runs the jobs on the checkpoint's files in the order in which they were queued. One thread at a time runs them,
//! never under the ledger's lock, so a disk that hangs delays neither calls nor the mirror.

use std::{
    collections::VecDeque,
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError, TryLockError,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, Thread},
    time::Duration,
};

use checkpoint_store::Store;
use rescue_core::checkpoint::format::{Checkpoint, RecordContent};
use tokio::sync::{oneshot, watch};

use crate::cli::SyncPolicy;

/// Longest silence of the disk that calls wait for. A memory card may need 0.5 s for one write, and several can queue
/// up. The limit exists because a robot stops if calls are not answered.
pub(crate) const DISK_PATIENCE: Duration = Duration::from_secs(5);

/// Why nothing is recorded after [`DISK_PATIENCE`].
pub(crate) const SILENT: &str = "the disk has not answered for 5 s";

/// Why nothing is recorded after a job has panicked.
const PANICKED: &str = "a bug in rosrescue: a job on the checkpoint panicked; please report it";

/// Maximum number of jobs that wait for the disk: about one for each client that waits for an answer.
const JOBS_MAX: usize = 2048;

type Job = Box<dyn FnOnce(&mut Store) + Send>;

/// The ledger's access to the store. No method waits for the disk.
pub(super) struct Journal {
    shared: Arc<StoreQueue>,
    /// Whether entries are passed to the store. False after the disk was silent, until the next complete checkpoint.
    gives: bool,
}

/// The store and its queue of jobs.
pub(super) struct StoreQueue {
    jobs: Mutex<VecDeque<Job>>,
    store: Mutex<Store>,
    seen: Mutex<StoreState>,
    /// Answers to calls up to this record need not wait for the disk.
    durable: watch::Sender<u64>,
    sync: SyncPolicy,
    /// The disk's thread. `None` inside if it could not be started.
    thread: OnceLock<Option<Thread>>,
    /// Whether the [`Journal`] is gone, so the disk's thread ends.
    has_ended: AtomicBool,
}

/// The store's state after its last job.
#[derive(Clone, Debug, Default)]
pub(crate) struct StoreState {
    pub path: PathBuf,
    /// Number of the journal's last entry, whether or not it was written.
    pub seq: u64,
    pub journal_bytes: u64,
    pub snapshot_bytes: u64,
    /// Why nothing is recorded. `None` if records are written.
    pub unprotected: Option<String>,
    /// Whether the journal has grown so much that a new complete checkpoint should replace it.
    pub outgrown: bool,
    /// The name under which a foreign file at the checkpoint's path was kept.
    kept: Option<PathBuf>,
    /// How many times records were withheld from the store.
    gaps: u64,
    /// Number of the [gaps](Self::gaps) that a complete checkpoint has closed.
    gaps_over: u64,
}

impl StoreQueue {
    /// Has the disk's thread run all jobs. It costs a write less time than a task on the runtime's pool: that wakes a thread
    /// with two system calls, and the thread then waits for the pool's lock.
    pub(super) fn wake(self: &Arc<Self>) {
        let start = || {
            // Only the journal keeps the store open, and its file locked.
            let queue = Arc::downgrade(self);
            let work = move || {
                while let Some(queue) = queue.upgrade().filter(|of| !of.has_ended()) {
                    queue.work();
                    drop(queue);
                    thread::park();
                }
            };
            let started = thread::Builder::new().name("disk".to_owned()).spawn(work);
            let started = started
                .inspect_err(|error| tracing::debug!(%error, "no thread for the disk starts"));
            Some(started.ok()?.thread().clone())
        };
        match self.thread.get_or_init(start) {
            Some(thread) => thread.unpark(),
            None => {
                let queue = Arc::clone(self);
                crate::task::spawn_blocking(move || queue.work());
            }
        }
    }

    /// Runs all jobs, unless another thread is doing so. Takes as long as the disk does. If a job panics, nothing is
    /// recorded until the next complete checkpoint: the file may end in the middle of a record.
    pub(super) fn work(&self) {
        loop {
            let mut store = match self.store.try_lock() {
                Ok(store) => store,
                Err(TryLockError::Poisoned(store)) => store.into_inner(),
                Err(TryLockError::WouldBlock) => return,
            };
            while let Some(job) = self.next() {
                if catch_unwind(AssertUnwindSafe(|| job(&mut store))).is_err() {
                    store.give_up(PANICKED);
                    self.note_state(&mut store);
                }
            }
            drop(store);
            // Another thread may have queued a job while this one held the lock. This thread runs that job, too.
            if self.jobs().is_empty() {
                return;
            }
        }
    }

    fn has_ended(&self) -> bool {
        self.has_ended.load(Ordering::Acquire)
    }

    #[cfg(test)]
    pub(super) fn has_jobs(&self) -> bool {
        !self.jobs().is_empty()
    }

    #[cfg(test)]
    pub(super) fn drop_jobs(&self) {
        self.jobs().clear();
    }

    fn next(&self) -> Option<Job> {
        self.jobs().pop_front()
    }

    fn jobs(&self) -> MutexGuard<'_, VecDeque<Job>> {
        self.jobs.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn seen(&self) -> MutexGuard<'_, StoreState> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn note_state(&self, store: &mut Store) {
        let mut seen = self.seen();
        seen.seq = store.seq();
        seen.journal_bytes = store.journal_bytes();
        seen.snapshot_bytes = store.snapshot_bytes();
        seen.outgrown = store.wants_compaction();
        seen.kept = store.take_kept().or_else(|| seen.kept.take());
        let unprotected = match seen.gaps > seen.gaps_over {
            true => Some(SILENT),
            false => store.unprotected(),
        };
        if seen.unprotected.as_deref() != unprotected {
            seen.unprotected = unprotected.map(str::to_owned);
        }
        drop(seen);
        // No answer waits for a failed disk.
        let waits = self.sync == SyncPolicy::Always && store.unprotected().is_none();
        self.reach(if waits {
            store.synced_seq()
        } else {
            store.seq()
        });
    }

    fn reach(&self, seq: u64) {
        super::durability::raise(&self.durable, seq);
    }
}

impl Drop for Journal {
    fn drop(&mut self) {
        self.shared.has_ended.store(true, Ordering::Release);
        if let Some(Some(thread)) = self.shared.thread.get() {
            thread.unpark();
        }
    }
}

impl Journal {
    /// Creates the journal of `store`. It raises `durable` to the last record that answers need not wait for under
    /// `sync`.
    pub(super) fn new(store: Store, durable: watch::Sender<u64>, sync: SyncPolicy) -> Self {
        let seq = store.seq();
        let seen = StoreState {
            path: store.path().to_owned(),
            unprotected: store.unprotected().map(str::to_owned),
            ..StoreState::default()
        };
        let shared = StoreQueue {
            jobs: Mutex::default(),
            store: Mutex::new(store),
            seen: Mutex::new(seen),
            durable,
            sync,
            thread: OnceLock::new(),
            has_ended: AtomicBool::new(false),
        };
        shared.reach(seq);
        Self {
            shared: Arc::new(shared),
            gives: true,
        }
    }

    /// The handle with which a thread runs the jobs.
    pub(super) fn store_queue(&self) -> Arc<StoreQueue> {
        Arc::clone(&self.shared)
    }

    /// The store's state after its last job.
    pub(super) fn seen(&self) -> StoreState {
        self.shared.seen().clone()
    }

    /// Whether records are written.
    pub(super) fn protects(&self) -> bool {
        self.gives && self.shared.seen().unprotected.is_none()
    }

    /// Takes the name under which a foreign file at the checkpoint's path was kept.
    pub(super) fn take_kept(&self) -> Option<PathBuf> {
        self.shared.seen().kept.take()
    }

    /// Passes `entries`, whose numbers end with `last`, to the store, which records them later and keeps a failure.
    pub(super) fn append(&mut self, entries: Vec<RecordContent>, last: u64) {
        if !self.gives {
            return self.shared.reach(last);
        }
        let given = self.run(move |store| {
            if let Err(error) = store.append(&entries) {
                tracing::debug!(%error, "appending to the journal failed");
            }
        });
        if given.is_none() {
            self.give_up(last);
        }
    }

    /// Runs `work` after all earlier jobs. `None` if too many jobs already wait for the disk.
    pub(super) fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Store) -> T + Send + 'static,
    ) -> Option<oneshot::Receiver<T>> {
        let (done, result) = oneshot::channel();
        let shared = Arc::clone(&self.shared);
        let job = move |store: &mut Store| {
            let result = work(store);
            shared.note_state(store);
            // The receiver may have been dropped.
            let _ = done.send(result);
        };
        let mut jobs = self.shared.jobs();
        (jobs.len() < JOBS_MAX).then(|| {
            jobs.push_back(Box::new(job));
            result
        })
    }

    /// Like [`Self::run`], for `work` that writes the complete `checkpoint` of this moment, after the entry `last`. From
    /// now on entries are passed to the store again.
    pub(super) fn run_whole<T: Send + 'static>(
        &mut self,
        last: u64,
        checkpoint: impl FnOnce() -> Checkpoint + Send + 'static,
        work: impl FnOnce(&mut Store, Checkpoint) -> T + Send + 'static,
    ) -> Option<oneshot::Receiver<T>> {
        self.gives = true;
        let gaps = self.shared.seen().gaps;
        let shared = Arc::clone(&self.shared);
        let given = self.run(move |store| {
            if shared.seen().gaps_over < gaps {
                // The file lacks the records that were withheld.
                store.give_up(SILENT);
                shared.seen().gaps_over = gaps;
            }
            work(store, checkpoint())
        });
        if given.is_none() {
            self.give_up(last);
        }
        given
    }

    /// Gives up on a silent disk: answers no longer wait for it, and the store gets no records after `last` until the next
    /// complete checkpoint.
    pub(super) fn give_up(&mut self, last: u64) {
        if std::mem::take(&mut self.gives) {
            let mut seen = self.shared.seen();
            seen.gaps += 1;
            seen.unprotected = Some(SILENT.to_owned());
        }
        self.shared.reach(last);
    }
}

#[cfg(test)]
mod tests;
