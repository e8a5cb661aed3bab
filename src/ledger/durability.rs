//! The ledger's side of the checkpointer, and how calls wait for it.

use super::{Inner, Ledger, shared::Agreed};
use crate::checkpoint::{
    format::Checkpoint,
    store::{Store, StoreError},
};
use crate::cli::SyncPolicy;

/// Where a record is: what an answer may have to wait for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mark {
    /// Its number in our own journal; none without one.
    pub(super) disk: Option<u64>,
    /// Its place among the writes that other computers are given.
    pub(super) shared: Option<Agreed>,
}

impl Mark {
    /// The later one of two.
    pub fn max(self, other: Self) -> Self {
        Self {
            disk: self.disk.max(other.disk),
            shared: self.shared.max(other.shared),
        }
    }
}

/// Progress of whole checkpoints, in versions of the mirror.
#[derive(Debug, Default)]
pub(super) struct Whole {
    /// After the last change that is in no journal.
    pub(super) unrecorded: u64,
    /// In the last checkpoint that was taken,
    taken: u64,
    /// and in the last that was written.
    written: u64,
    /// Why the last one could not be written.
    failure: Option<String>,
}

impl Whole {
    fn is_due(&self) -> bool {
        self.unrecorded > self.written
    }
}

impl Ledger {
    /// Where the last record is.
    pub fn mark(&self) -> Mark {
        self.lock().mark()
    }

    /// What must be safe before a call whose last record is at `mark` is answered; none if nothing must.
    pub fn to_await(&self, mark: Mark) -> Option<Mark> {
        let mark = Mark {
            disk: mark.disk.filter(|_| self.sync == SyncPolicy::Always),
            ..mark
        };
        (mark != Mark::default()).then_some(mark)
    }

    /// Returns when the records up to `mark` are safe: on the disk, or the disk has failed; and where other
    /// computers find them. False if another one leads by now and may not have them.
    pub async fn durable(&self, mark: Mark) -> bool {
        if let Some(seq) = mark.disk {
            let mut durable = self.durable.subscribe();
            // We own the sender.
            let _ = durable.wait_for(|reached| *reached >= seq).await;
        }
        match mark.shared {
            Some(place) => self.agreed(place).await,
            None => true,
        }
    }

    /// The journal up to `seq` is on the disk, or the disk has failed.
    pub fn set_durable(&self, seq: u64) {
        raise(&self.durable, seq);
    }

    /// The version to wait for with [`Self::attempted`] until the file holds the mirror as it is now. None if
    /// it does, or if the file cannot be written.
    pub fn unwritten(&self) -> Option<u64> {
        let inner = self.lock();
        let store = inner.store.as_ref();
        let works = store.is_some_and(|store| store.unprotected().is_none());
        let whole = &inner.whole;
        (works && whole.failure.is_none() && whole.is_due()).then_some(whole.unrecorded)
    }

    /// Returns when a whole checkpoint of this or a later version of the mirror has been written, or has
    /// failed.
    pub async fn attempted(&self, version: u64) {
        let mut attempted = self.attempted.subscribe();
        // We own the sender.
        let _ = attempted.wait_for(|reached| *reached >= version).await;
    }

    /// Notes the result of the whole checkpoint that was taken last.
    pub fn set_attempted(&self, result: Result<(), &StoreError>) {
        let mut inner = self.lock();
        let whole = &mut inner.whole;
        let taken = whole.taken;
        if result.is_ok() {
            whole.written = taken;
        }
        whole.failure = result.err().map(ToString::to_string);
        drop(inner);
        raise(&self.attempted, taken);
    }

    /// Runs `work` on the store, if there is one, and on a function that takes a checkpoint of the same
    /// moment.
    pub fn with_store<T>(
        &self,
        work: impl FnOnce(&mut Store, &mut dyn FnMut() -> Checkpoint) -> T,
    ) -> Option<T> {
        let mut inner = self.lock();
        let mut store = inner.store.take()?;
        let seq = store.seq();
        let result = work(&mut store, &mut || {
            inner.whole.taken = inner.version;
            Checkpoint {
                seq,
                ..inner.checkpoint()
            }
        });
        inner.store = Some(store);
        Some(result)
    }

    /// Sets a new store, which holds nothing yet.
    pub fn set_store(&self, store: Store) {
        self.lock().store = Some(store);
    }

    /// The checkpoint to write now.
    pub fn checkpoint(&self) -> Checkpoint {
        self.lock().checkpoint()
    }

    /// Whether the mirror has changed without a journaled call since the last checkpoint.
    pub fn checkpoint_due(&self) -> bool {
        self.lock().whole.is_due()
    }

    /// Why the state is not recorded; none if it is.
    pub fn unprotected(&self) -> Option<String> {
        let inner = self.lock();
        let Some(store) = &inner.store else {
            return Some("the checkpoint could not be opened".to_owned());
        };
        // Then the journal alone is not enough.
        let failure = inner.whole.failure.as_deref();
        let failure = failure.filter(|_| inner.whole.is_due());
        store.unprotected().or(failure).map(str::to_owned)
    }
}

impl Inner {
    pub(super) fn checkpoint(&self) -> Checkpoint {
        Checkpoint {
            seq: self.seq(),
            session: self.session.clone(),
            pending: self
                .pending
                .calls()
                .iter()
                .cloned()
                .map(Into::into)
                .collect(),
            snapshot: self.mirror.snapshot(),
        }
    }
}

fn raise(to: &tokio::sync::watch::Sender<u64>, value: u64) {
    to.send_if_modified(|reached| {
        let more = value > *reached;
        *reached = value.max(*reached);
        more
    });
}
