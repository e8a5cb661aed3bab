//! Writes a new *generation* of the checkpoint, a file that replaces the present one, while records are appended to the
//! present one.

use std::io::{self, ErrorKind};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use super::journal::Active;
use super::storage::FileId;
use super::{LogKeeper, Names, Present, Storage, Store, StoreError, SyncJob, Synced};
use rescue_core::checkpoint::format::{self, Checkpoint, Stamp};

/// Minimum size of a journal for which a new checkpoint file is written.
pub(super) const COMPACTION_BYTES_MIN: u64 = 64 * 1024;
/// Maximum size of the records that are kept in memory while a new checkpoint file is written. If they take more, the
/// new file is dropped and the present file stays in use.
pub(super) const MEANWHILE_BYTES_MAX: usize = 16 * 1024 * 1024;

pub(super) struct PendingGeneration {
    generation: u64,
    /// Records appended since the new generation was begun, each with a line feed.
    pub(super) meanwhile: Vec<u8>,
    superseded: bool,
    /// Tells the job that writes this generation whether it is still wanted. Gone if the job or its result was dropped.
    ticket: Weak<Ticket>,
}

/// Whether a new generation, a file that replaces the checkpoint, is still wanted. Locked while the job that writes it
/// renames files, so that an obsolete job cannot touch its successor's files.
#[derive(Debug)]
struct Ticket(Mutex<bool>);

impl Ticket {
    fn lock(&self) -> MutexGuard<'_, bool> {
        // A boolean stays valid even if the lock is poisoned.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A job that writes a new checkpoint file (generation); see
/// [`Store::begin_compaction`](super::Store::begin_compaction).
#[must_use = "the journal keeps growing until the job has run and has been finished"]
pub struct CompactionJob<S: Storage> {
    plan: CompactionPlan<S>,
    checkpoint: Checkpoint,
}

/// Everything that a job needs to write a new generation.
struct CompactionPlan<S: Storage> {
    storage: S,
    names: Names,
    generation: u64,
    /// The present file, if it is to become the previous generation.
    keep_present: Option<FileId>,
    /// A sync of the present file, which runs first. It is needed if some of that file's records may be durable only in
    /// the previous generation, because that is about to be replaced.
    settle: Option<SyncJob<S>>,
    /// Gets the records of the previous generation before that is replaced.
    log: Arc<Mutex<LogKeeper<S>>>,
    ticket: Arc<Ticket>,
}

/// A new checkpoint file on disk under a temporary name, or the reason why there is none.
#[must_use = "give it to `Store::finish_compaction`"]
pub struct Compacted<S: Storage> {
    generation: u64,
    settled: Option<Synced>,
    result: Result<Written<S>, StoreError>,
    _ticket: Arc<Ticket>,
}

struct Written<S: Storage> {
    file: S::File,
    stamp: Stamp,
    snapshot_bytes: u64,
    crc: u32,
    /// The file that has become the previous generation.
    previous: Option<FileId>,
    /// Whether the previous generation is the present file under a second name. If so, it also receives the records
    /// that are appended before the new generation replaces the present file.
    linked: bool,
}

impl<S: Storage> CompactionJob<S> {
    /// Encodes, writes and syncs the new generation. Blocks as long as the disk does.
    pub fn run(self) -> Compacted<S> {
        self.plan.run(&self.checkpoint)
    }
}

impl<S: Storage> CompactionPlan<S> {
    fn run(mut self, checkpoint: &Checkpoint) -> Compacted<S> {
        let settled = self.settle.take().map(SyncJob::run);
        // If the present file could not be synced, some of its records may be durable in the previous generation only.
        let is_settled = settled.as_ref().is_none_or(|done| done.error().is_none());
        let result = match is_settled {
            true => self.write(checkpoint),
            false => Err(self.names.superseded()),
        };
        Compacted {
            generation: self.generation,
            settled,
            result,
            _ticket: self.ticket,
        }
    }

    fn write(&self, checkpoint: &Checkpoint) -> Result<Written<S>, StoreError> {
        let Self {
            storage,
            names,
            generation,
            ..
        } = self;
        let generation = *generation;
        let encoded = format::encode_checkpoint(checkpoint, generation)?;
        let path = names.fresh(generation);
        let file = match self.write_at(&path, &encoded.bytes) {
            Err(StoreError::Io { source, .. })
                if matches!(
                    source.kind(),
                    ErrorKind::StorageFull | ErrorKind::QuotaExceeded
                ) && self.make_room() =>
            {
                self.write_at(&path, &encoded.bytes)
            }
            other => other,
        }?;
        super::change_log::locked(&self.log).archive(storage, names, &names.previous());
        let wanted = self.ticket.lock();
        if !*wanted {
            return Err(names.superseded());
        }
        let mut linked = true;
        let mut previous = None;
        if self.present_is_there() {
            let path = names.previous();
            linked = storage
                .link(&names.path, &path)
                .map_err(failed("keep", &path))?;
            previous = self.keep_present;
        }
        // The names of the previous and of the new generation are durable before the new one takes the path. So after a
        // loss of power, all records are in one of these two files.
        storage
            .sync_dir(names.folder())
            .map_err(failed("sync the folder of", &path))?;
        let snapshot_bytes = encoded.bytes.len() as u64;
        Ok(Written {
            file,
            stamp: encoded.stamp,
            snapshot_bytes,
            crc: crc32c::crc32c(&encoded.bytes),
            previous,
            linked,
        })
    }

    /// Whether the present file is to be kept and is still at the path.
    fn present_is_there(&self) -> bool {
        let there = self.storage.id_at(&self.names.path).ok().flatten();
        there.is_some() && there == self.keep_present
    }

    /// Writes `bytes` to a file at `path` and syncs it.
    fn write_at(&self, path: &Path, bytes: &[u8]) -> Result<S::File, StoreError> {
        let storage = &self.storage;
        let file = storage.create(path).map_err(failed("create", path))?;
        append_all(storage, &file, bytes)
            .and_then(|()| storage.sync(&file))
            .map_err(failed("write", path))?;
        Ok(file)
    }

    /// Removes the log, or if there is none, the previous generation, which would be replaced anyway. Never removes the
    /// present file, because it is the only copy until the new generation is complete.
    fn make_room(&self) -> bool {
        if super::change_log::locked(&self.log).remove(&self.storage, &self.names) {
            return true;
        }
        let wanted = self.ticket.lock();
        *wanted && self.present_is_there() && self.storage.remove(&self.names.previous()).is_ok()
    }
}

impl<S: Storage> Store<S> {
    /// Writes `checkpoint` to a new file and syncs it. The new file replaces the present one, which is kept as the
    /// previous generation.
    ///
    /// # Errors
    ///
    /// If the file cannot be written. If the store was [unprotected](Self::unprotected), it stays so; if not, it
    /// continues to use the present file. It is also an error if [`Checkpoint::seq`] is behind [`seq`](Self::seq); then
    /// nothing is written.
    pub fn begin(&mut self, checkpoint: &Checkpoint) -> Result<(), StoreError> {
        if checkpoint.seq >= self.seq {
            self.overtake();
        }
        let done = self.plan(checkpoint)?.run(checkpoint);
        self.finish_compaction(done)?;
        match self.sync_job().map(SyncJob::run) {
            Some(done) => self.synced(done),
            None => Ok(()),
        }
    }

    /// Whether the journal is so large that a new checkpoint file should be written.
    pub fn wants_compaction(&self) -> bool {
        !self.is_busy()
            && self.active.as_ref().is_some_and(|active| {
                active.journal_bytes > active.snapshot_bytes.max(self.compact_above)
            })
    }

    /// Begins a new checkpoint file with `checkpoint`, which must be current: its [`Checkpoint::seq`] equals
    /// [`seq`](Self::seq). Run the job in any thread, continue to append, then pass the result to
    /// [`finish_compaction`](Self::finish_compaction). This also ends the [unprotected](Self::unprotected) state while
    /// calls continue.
    ///
    /// # Errors
    ///
    /// If the checkpoint is behind the journal, or another new file is being written.
    pub fn begin_compaction(
        &mut self,
        checkpoint: Checkpoint,
    ) -> Result<CompactionJob<S>, StoreError> {
        let plan = self.plan(&checkpoint)?;
        Ok(CompactionJob { plan, checkpoint })
    }

    fn plan(&mut self, checkpoint: &Checkpoint) -> Result<CompactionPlan<S>, StoreError> {
        let seq = checkpoint.seq;
        if seq < self.seq {
            return Err(StoreError::Stale {
                snapshot: seq,
                journal: self.seq,
            });
        }
        if self.is_busy() {
            return Err(StoreError::Busy);
        }
        self.place.hold_lock().map_err(|error| self.latch(error))?;
        self.seq = seq;
        self.generation += 1;
        let generation = self.generation;
        if !checkpoint.follows || self.active.is_none() {
            super::change_log::locked(&self.log).breaks_at(generation);
        }
        let ticket = Arc::new(Ticket(Mutex::new(true)));
        self.pending = Some(PendingGeneration {
            generation,
            meanwhile: Vec::new(),
            superseded: false,
            ticket: Arc::downgrade(&ticket),
        });
        let unsettled = self.active.as_ref().is_some_and(|active| !active.named);
        Ok(CompactionPlan {
            storage: self.place.storage.clone(),
            names: self.place.names.clone(),
            generation,
            keep_present: self
                .place
                .present
                .filter(|present| present.usable)
                .map(|present| present.id),
            settle: if unsettled { self.sync_job() } else { None },
            log: Arc::clone(&self.log),
            ticket,
        })
    }

    fn is_busy(&self) -> bool {
        let ticket = self.pending.as_ref().map(|pending| &pending.ticket);
        ticket.is_some_and(|ticket| ticket.strong_count() > 0)
    }

    /// Makes the generation that is being written obsolete: from now on its job touches only its own temporary file.
    pub(super) fn overtake(&mut self) {
        if let Some(ticket) = self
            .pending
            .take()
            .and_then(|pending| pending.ticket.upgrade())
        {
            *ticket.lock() = false;
        }
    }

    /// Appends the records that came since [`begin_compaction`](Self::begin_compaction) to the new checkpoint file, and
    /// moves that file to the checkpoint's path. This is quick, because it waits for the disk only if the file system
    /// has no hard links.
    ///
    /// # Errors
    ///
    /// If the new file cannot be written or is obsolete. The present file then stays in use, and
    /// [`wants_compaction`](Self::wants_compaction) becomes true when its journal has doubled in size. If the new file
    /// could not be moved to the path, the store is [unprotected](Self::unprotected).
    pub fn finish_compaction(&mut self, mut done: Compacted<S>) -> Result<(), StoreError> {
        let fresh = self.place.names.fresh(done.generation);
        let pending = self
            .pending
            .take_if(|pending| pending.generation == done.generation);
        let settled = done.settled.take().map_or(Ok(()), |it| self.synced(it));
        let finished = settled.and_then(|()| self.switch(pending, done));
        if finished.is_err() {
            // The new file may not exist. If it cannot be removed, the next start removes it.
            let _ = self.place.storage.remove(&fresh);
            let journal = self
                .active
                .as_ref()
                .map_or(0, |active| active.journal_bytes);
            self.compact_above = journal.saturating_mul(2).max(COMPACTION_BYTES_MIN);
        }
        finished
    }

    fn switch(
        &mut self,
        pending: Option<PendingGeneration>,
        done: Compacted<S>,
    ) -> Result<(), StoreError> {
        let fresh = self.place.names.fresh(done.generation);
        let written = done.result?;
        let Some(pending) = pending.filter(|pending| !pending.superseded) else {
            return Err(self.place.names.superseded());
        };
        let mut journal = Vec::with_capacity(pending.meanwhile.len());
        for body in pending
            .meanwhile
            .split(|&byte| byte == b'\n')
            .filter(|body| !body.is_empty())
        {
            let start = journal.len();
            journal.extend_from_slice(body);
            format::seal(&mut journal, start, written.stamp);
        }
        append_all(&self.place.storage, &written.file, &journal)
            .and_then(|()| match written.linked {
                true => Ok(()),
                // Only file systems without hard links, such as FAT, wait here.
                false => self.place.storage.sync(&written.file),
            })
            .map_err(failed("write", &fresh))?;
        let status = self
            .place
            .storage
            .status(&written.file)
            .map_err(failed("check", &fresh))?;
        if let Err(source) = self.place.take_path(&fresh, written.previous) {
            // It is unknown which file is at the path now, so recording stops.
            return Err(self.latch(failed("replace", &self.place.names.path)(source)));
        }
        self.active = Some(Active {
            file: Arc::new(written.file),
            stamp: written.stamp,
            generation: done.generation,
            snapshot_bytes: written.snapshot_bytes,
            journal_bytes: journal.len() as u64,
            id: status.id,
            crc: crc32c::crc32c_append(written.crc, &journal),
            modified: status.modified,
            suspect: false,
            clean: journal.is_empty(),
            named: false,
        });
        self.place.present = Some(Present {
            id: status.id,
            usable: true,
        });
        self.unprotected = None;
        self.compact_above = COMPACTION_BYTES_MIN;
        Ok(())
    }

    /// Writes `checkpoint`, which must be marked as closed, to a last new file, and stops recording.
    ///
    /// # Errors
    ///
    /// The errors of [`begin`](Self::begin).
    pub fn close(&mut self, checkpoint: &Checkpoint) -> Result<(), StoreError> {
        self.begin(checkpoint)?;
        self.active = None;
        self.unprotected = Some("it is closed".to_owned());
        Ok(())
    }
}

impl PendingGeneration {
    pub(super) fn add(&mut self, body: &[u8]) {
        self.superseded |= self.meanwhile.len() + body.len() >= MEANWHILE_BYTES_MAX;
        if self.superseded {
            self.meanwhile = Vec::new();
        } else if !body.is_empty() {
            self.meanwhile.extend_from_slice(body);
            self.meanwhile.push(b'\n');
        }
    }
}

/// Appends all of `bytes`, in as many writes as needed.
pub(super) fn append_all<S: Storage>(storage: &S, file: &S::File, bytes: &[u8]) -> io::Result<()> {
    let mut rest = bytes;
    while !rest.is_empty() {
        match storage.append(file, rest)? {
            0 => return Err(ErrorKind::WriteZero.into()),
            taken => rest = rest.get(taken..).unwrap_or_default(),
        }
    }
    Ok(())
}

/// Adds the operation and the file to an error.
pub(super) fn failed(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> StoreError {
    move |source| StoreError::Io {
        doing,
        path: path.to_owned(),
        source,
    }
}
