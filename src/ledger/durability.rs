//! The part of the ledger that the checkpointer uses, and how calls wait for the disk.

use std::{
    path::PathBuf,
    sync::{Arc, atomic::Ordering},
};

use checkpoint_store::{Store, StoreError};
use rescue_core::checkpoint::format::Checkpoint;
use tokio::time::timeout;

use super::{
    Ledger,
    disk_jobs::{self, DISK_PATIENCE, Journal, SILENT, StoreState},
    shared::{Shared, SharedRecord},
};

/// Identifies a record that an answer may have to wait for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mark {
    /// The record's number in this computer's journal. `None` without a journal.
    pub(super) disk: Option<u64>,
    /// The record among those that the other computers get.
    pub(super) shared: Option<SharedRecord>,
}

impl Mark {
    /// The mark of the later of two records.
    pub fn max(self, other: Self) -> Self {
        Self {
            disk: self.disk.max(other.disk),
            shared: self.shared.max(other.shared),
        }
    }
}

/// Which versions of the mirror have been taken for, and written in, complete checkpoints.
#[derive(Debug, Default)]
pub(super) struct Whole {
    /// The version after the last change that has no record, so only a complete checkpoint holds it.
    pub(super) unrecorded: u64,
    /// The mirror's version in the last complete checkpoint that the store was told to write.
    pub(super) taken: u64,
    /// The mirror's version in the last complete checkpoint that was written.
    written: u64,
    /// Why the last checkpoint could not be written.
    failure: Option<String>,
}

impl Whole {
    pub(super) fn is_due(&self) -> bool {
        self.unrecorded > self.written
    }
}

impl Ledger {
    /// Identifies the last record, so that an answer can wait for it.
    pub fn mark(&self) -> Mark {
        self.lock().mark()
    }

    /// What must be safe before a call whose last record is at `mark` may be answered. `None` if it can be answered at
    /// once.
    pub fn to_await(&self, mark: Mark) -> Option<Mark> {
        let mark = Mark {
            disk: mark.disk.filter(|seq| *self.durable.borrow() < *seq),
            ..mark
        };
        (mark != Mark::default()).then_some(mark)
    }

    /// Waits until the records up to `mark` are safe: written to the file, with `--sync always` also synced, and with
    /// several computers acknowledged: in etcd, or with `--cluster-sync interval` on their way there. Does not wait for a disk that fails or is silent for [`DISK_PATIENCE`]. False
    /// if another computer leads by now and may not have the records.
    pub async fn durable(&self, mark: Mark) -> bool {
        if let Some(seq) = mark.disk {
            self.write();
            let mut durable = self.durable.subscribe();
            while *durable.borrow_and_update() < seq {
                if timeout(DISK_PATIENCE, durable.changed()).await.is_err() {
                    self.give_up_disk();
                }
            }
        }
        match mark.shared {
            Some(place) => self.acknowledged.wait(place).await,
            None => true,
        }
    }

    /// Writes the queued records to the checkpoint, in another thread, and has them synced.
    pub(super) fn save(&self) {
        self.write();
        self.work.notify_one();
    }

    /// Writes the queued records to the checkpoint, in another thread.
    pub(crate) fn write(&self) {
        #[cfg(test)]
        if self.writes_by_hand.load(Ordering::Relaxed) {
            return;
        }
        if let Some(queue) = self.store_queue() {
            queue.wake();
        }
    }

    /// Leaves the queued records to [`Self::run_jobs`], for a simulation.
    #[cfg(test)]
    pub(crate) fn write_by_hand(&self) {
        self.writes_by_hand.store(true, Ordering::Relaxed);
    }

    /// Whether records wait for the disk.
    #[cfg(test)]
    pub(crate) fn has_jobs(&self) -> bool {
        self.store_queue().is_some_and(|queue| queue.has_jobs())
    }

    /// Writes the queued records.
    #[cfg(test)]
    pub(crate) fn run_jobs(&self) {
        if let Some(queue) = self.store_queue() {
            queue.work();
        }
    }

    /// Drops the queued records, as a death of the process does.
    #[cfg(test)]
    pub(crate) fn drop_jobs(&self) {
        if let Some(queue) = self.store_queue() {
            queue.drop_jobs();
        }
    }

    /// Whether a complete checkpoint of this or a later version has been written or has failed.
    #[cfg(test)]
    pub(crate) fn has_attempted(&self, version: u64) -> bool {
        *self.attempted.borrow() >= version
    }

    fn store_queue(&self) -> Option<Arc<disk_jobs::StoreQueue>> {
        self.lock().journal.as_ref().map(Journal::store_queue)
    }

    /// Gives up on a silent disk: answers no longer wait for it, and nothing is recorded until the next complete
    /// checkpoint.
    pub(crate) fn give_up_disk(&self) {
        let inner = &mut *self.lock();
        if let Some(journal) = &mut inner.journal {
            journal.give_up(inner.seq);
        }
        self.disk_silent.notify_one();
    }

    /// Notes whether a sync takes longer than [`DISK_PATIENCE`].
    pub(super) fn set_sync_is_late(&self, late: bool) {
        self.sync_is_late.store(late, Ordering::Relaxed);
        self.disk_silent.notify_one();
    }

    /// The version to wait for with [`Self::attempted`] until the file holds the mirror's present state. `None` if it
    /// already does, or if the file cannot be written.
    pub fn unwritten(&self) -> Option<u64> {
        let inner = self.lock();
        let journal = inner.journal.as_ref();
        let works = journal.is_some_and(|journal| journal.seen().unprotected.is_none());
        let whole = &inner.whole;
        (works && whole.failure.is_none() && whole.is_due()).then_some(whole.unrecorded)
    }

    /// Waits until a complete checkpoint of this or a later version has been written or has failed. A disk that is
    /// silent for [`DISK_PATIENCE`] counts as failed.
    pub async fn attempted(&self, version: u64) {
        let mut attempted = self.attempted.subscribe();
        let attempt = attempted.wait_for(|reached| *reached >= version);
        if timeout(DISK_PATIENCE, attempt).await.is_err() {
            self.give_up_disk();
        }
    }

    /// Notes the result of the last complete checkpoint.
    pub fn set_attempted(&self, result: Result<(), &StoreError>) {
        let inner = &mut *self.lock();
        let was_due = inner.whole.is_due();
        let whole = &mut inner.whole;
        let taken = whole.taken;
        if result.is_ok() {
            whole.written = taken;
        }
        whole.failure = result.err().map(ToString::to_string);
        // A record of the session that was made meanwhile lacks the number of etcd's journal.
        let is_shared = !matches!(inner.shared, Shared::Single);
        inner.session_unwritten |= is_shared && was_due && !inner.whole.is_due();
        raise(&self.attempted, taken);
    }

    /// Runs `work` on the store after all earlier records were written. `None` without a store. Waits for the disk.
    pub async fn on_store<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Store) -> T + Send + 'static,
    ) -> Option<T> {
        let result = self.lock().journal.as_ref()?.run(work)?;
        self.write();
        result.await.ok()
    }

    /// Like [`Self::on_store`], for `work` that writes a checkpoint of the present state.
    pub async fn on_store_whole<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Store, Checkpoint) -> T + Send + 'static,
    ) -> Option<T> {
        let result = {
            let inner = &mut *self.lock();
            let checkpoint = inner.checkpoint();
            // The checkpoint replaces the journal and lacks that call, so its answer makes a new record.
            inner.ahead = None;
            inner.whole.taken = inner.version;
            let journal = inner.journal.as_mut()?;
            journal.run_whole(inner.seq, checkpoint, work)?
        };
        self.write();
        result.await.ok()
    }

    /// The store's state after its last job. `None` without a store.
    pub(crate) fn seen_store(&self) -> Option<StoreState> {
        Some(self.lock().journal.as_ref()?.seen())
    }

    /// Takes the name under which a foreign file at the checkpoint's path was kept.
    pub(super) fn take_kept(&self) -> Option<PathBuf> {
        self.lock().journal.as_ref()?.take_kept()
    }

    /// Sets a new store, which is still empty. Records are numbered after the ones of the store, and after those that
    /// there have been without a store.
    pub fn set_store(&self, mut store: Store) {
        let mut inner = self.lock();
        store.skip_to(inner.seq);
        inner.seq = store.seq();
        let journal = Journal::new(store, self.durable.clone(), self.sync);
        (inner.journal, inner.ahead) = (Some(journal), None);
    }

    /// The checkpoint of this moment, which the returned function makes. With a large state that takes long.
    pub(crate) fn checkpoint(&self) -> impl FnOnce() -> Checkpoint + Send + use<> {
        self.lock().checkpoint()
    }

    /// Whether the mirror has changed without a record since the last checkpoint.
    pub fn checkpoint_due(&self) -> bool {
        self.lock().whole.is_due()
    }

    /// Why the state is not recorded. `None` if the state is recorded.
    pub fn unprotected(&self) -> Option<String> {
        let inner = self.lock();
        let Some(journal) = &inner.journal else {
            return Some("the checkpoint could not be opened".to_owned());
        };
        // After a failed checkpoint the journal alone is not enough.
        let failure = inner.whole.failure.as_deref();
        let failure = failure.filter(|_| inner.whole.is_due());
        let late = self.sync_is_late.load(Ordering::Relaxed).then_some(SILENT);
        let unprotected = journal.seen().unprotected;
        unprotected.or_else(|| failure.or(late).map(str::to_owned))
    }
}

/// Raises the value of `to` to `value`, if that is higher.
pub(super) fn raise(to: &tokio::sync::watch::Sender<u64>, value: u64) {
    to.send_if_modified(|reached| {
        let more = value > *reached;
        *reached = value.max(*reached);
        more
    });
}
