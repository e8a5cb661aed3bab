//! Writes a new generation of the file while calls are still recorded.

use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use super::journal::Active;
use super::storage::FileId;
use super::{Names, Present, Storage, Store, StoreError, SyncJob, Synced};
use rescue_core::checkpoint::format::{self, Checkpoint, Stamp};

/// A smaller journal is not worth a new generation.
pub(super) const COMPACTION_BYTES_MIN: u64 = 64 * 1024;
/// Records made while a new generation is written are also kept in memory, up to this size. Beyond it the new
/// generation is dropped and the present file stays in use.
pub(super) const MEANWHILE_BYTES_MAX: usize = 16 * 1024 * 1024;

pub(super) struct Pending {
    generation: u64,
    /// Bodies of the records made meanwhile, each with a line feed.
    pub(super) meanwhile: Vec<u8>,
    superseded: bool,
    /// Dangles if the job or its result was dropped unfinished.
    ticket: Weak<Ticket>,
}

/// Whether a generation is still wanted. Locked while its job renames files, so that a superseded job cannot
/// touch its successor's files.
#[derive(Debug)]
struct Ticket(Mutex<bool>);

impl Ticket {
    fn lock(&self) -> MutexGuard<'_, bool> {
        // A poisoned boolean is still valid.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Writes a new generation; see [`Store::begin_compaction`](super::Store::begin_compaction).
#[must_use = "the journal goes on growing until the job has run and has been finished"]
pub struct CompactionJob<S: Storage> {
    plan: Plan<S>,
    checkpoint: Checkpoint,
}

/// What a job needs to write a new generation.
struct Plan<S: Storage> {
    storage: S,
    names: Names,
    generation: u64,
    /// The present file, if it becomes the previous generation.
    keep_present: Option<FileId>,
    /// Runs first if the present file is kept: some of its records may be on the medium only in the older
    /// generation.
    settle: Option<SyncJob<S>>,
    ticket: Arc<Ticket>,
}

/// A new generation on disk under a temporary name, or why there is none.
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
    /// The new previous generation.
    previous: Option<FileId>,
    /// Whether the previous generation is the present file itself. Then it also gets what is appended until
    /// the new one replaces it.
    linked: bool,
}

impl<S: Storage> CompactionJob<S> {
    /// Encodes, writes and syncs. Blocks as long as the disk does.
    pub fn run(self) -> Compacted<S> {
        self.plan.run(&self.checkpoint)
    }
}

impl<S: Storage> Plan<S> {
    fn run(mut self, checkpoint: &Checkpoint) -> Compacted<S> {
        let settled = self.settle.take().map(SyncJob::run);
        Compacted {
            generation: self.generation,
            settled,
            result: self.write(checkpoint),
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
                if source.kind() == io::ErrorKind::StorageFull && self.make_room() =>
            {
                self.write_at(&path, &encoded.bytes)
            }
            other => other,
        }?;
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
        // Both names are on the medium before the new generation takes the path. So whatever a loss of power
        // undoes later, the records are in one of the two files.
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

    /// Whether the present file is to be kept and is still at its path.
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

    /// Removes the previous generation, which is about to be replaced anyway. Never the present file: it is
    /// the only copy until there is a new one.
    fn make_room(&self) -> bool {
        let wanted = self.ticket.lock();
        *wanted && self.present_is_there() && self.storage.remove(&self.names.previous()).is_ok()
    }
}

impl<S: Storage> Store<S> {
    /// Writes `checkpoint` as a new generation and syncs it. The present file becomes the previous
    /// generation.
    ///
    /// # Errors
    ///
    /// If it cannot be written: the store stays unprotected if it was, otherwise it keeps using the present
    /// file. If [`Checkpoint::seq`] is behind [`seq`](Self::seq), nothing is done.
    pub fn begin(&mut self, checkpoint: &Checkpoint) -> Result<(), StoreError> {
        if checkpoint.seq >= self.seq {
            self.overtake();
        }
        let done = self.plan(checkpoint.seq)?.run(checkpoint);
        self.finish_compaction(done)?;
        match self.sync_job().map(SyncJob::run) {
            Some(done) => self.synced(done),
            None => Ok(()),
        }
    }

    /// Whether the journal is large enough for a new generation.
    pub fn wants_compaction(&self) -> bool {
        !self.is_busy()
            && self.active.as_ref().is_some_and(|active| {
                active.journal_bytes > active.snapshot_bytes.max(self.compact_above)
            })
    }

    /// Begins a new generation with `checkpoint`, which must be current: its [`Checkpoint::seq`] is
    /// [`seq`](Self::seq). Run the job on any thread, continue to append, then pass its result to
    /// [`finish_compaction`](Self::finish_compaction). Also re-arms an unprotected store beside traffic.
    ///
    /// # Errors
    ///
    /// If the checkpoint is behind the journal or another generation is being written.
    pub fn begin_compaction(
        &mut self,
        checkpoint: Checkpoint,
    ) -> Result<CompactionJob<S>, StoreError> {
        let plan = self.plan(checkpoint.seq)?;
        Ok(CompactionJob { plan, checkpoint })
    }

    fn plan(&mut self, seq: u64) -> Result<Plan<S>, StoreError> {
        if seq < self.seq {
            return Err(StoreError::Stale {
                snapshot: seq,
                journal: self.seq,
            });
        }
        if self.is_busy() {
            return Err(StoreError::Busy);
        }
        self.hold_lock()?;
        self.seq = seq;
        self.generation += 1;
        let generation = self.generation;
        let ticket = Arc::new(Ticket(Mutex::new(true)));
        self.pending = Some(Pending {
            generation,
            meanwhile: Vec::new(),
            superseded: false,
            ticket: Arc::downgrade(&ticket),
        });
        let unsettled = self.active.as_ref().is_some_and(|active| !active.named);
        Ok(Plan {
            storage: self.storage.clone(),
            names: self.names.clone(),
            generation,
            keep_present: self
                .present
                .filter(|present| present.usable)
                .map(|present| present.id),
            settle: if unsettled { self.sync_job() } else { None },
            ticket,
        })
    }

    fn is_busy(&self) -> bool {
        let ticket = self.pending.as_ref().map(|pending| &pending.ticket);
        ticket.is_some_and(|ticket| ticket.strong_count() > 0)
    }

    /// Invalidates the generation being written: from now on it touches only its own file.
    pub(super) fn overtake(&mut self) {
        if let Some(ticket) = self
            .pending
            .take()
            .and_then(|pending| pending.ticket.upgrade())
        {
            *ticket.lock() = false;
        }
    }

    /// Appends the records made meanwhile to the new generation and moves it to the path. Quick: it waits for
    /// the disk only where the file system has no hard links.
    ///
    /// # Errors
    ///
    /// If there is no new generation. The present file stays in use, and the next compaction is due when it
    /// has doubled.
    pub fn finish_compaction(&mut self, mut done: Compacted<S>) -> Result<(), StoreError> {
        let fresh = self.names.fresh(done.generation);
        let pending = self
            .pending
            .take_if(|pending| pending.generation == done.generation);
        let settled = done.settled.take().map_or(Ok(()), |it| self.synced(it));
        let finished = settled.and_then(|()| self.switch(pending, done));
        if finished.is_err() {
            // It may not exist. If it stays, the next start removes it.
            let _ = self.storage.remove(&fresh);
            let journal = self
                .active
                .as_ref()
                .map_or(0, |active| active.journal_bytes);
            self.compact_above = journal.saturating_mul(2).max(COMPACTION_BYTES_MIN);
        }
        finished
    }

    fn switch(&mut self, pending: Option<Pending>, done: Compacted<S>) -> Result<(), StoreError> {
        let fresh = self.names.fresh(done.generation);
        let written = done.result?;
        let Some(pending) = pending.filter(|pending| !pending.superseded) else {
            return Err(self.names.superseded());
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
        append_all(&self.storage, &written.file, &journal)
            .and_then(|()| match written.linked {
                true => Ok(()),
                // The only wait: on file systems such as FAT.
                false => self.storage.sync(&written.file),
            })
            .map_err(failed("write", &fresh))?;
        let status = self
            .storage
            .status(&written.file)
            .map_err(failed("check", &fresh))?;
        if let Err(source) = self.take_path(&fresh, written.previous) {
            // It is unknown which file is at the path now.
            return Err(self.latch(failed("replace", &self.names.path)(source)));
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
        self.present = Some(Present {
            id: status.id,
            usable: true,
        });
        self.unprotected = None;
        self.compact_above = COMPACTION_BYTES_MIN;
        Ok(())
    }

    /// Ends being unprotected. Same as [`begin`](Self::begin).
    ///
    /// # Errors
    ///
    /// As `begin`; try again later.
    pub fn rearm(&mut self, checkpoint: &Checkpoint) -> Result<(), StoreError> {
        self.begin(checkpoint)
    }

    /// Writes a last generation, marked as closed in `checkpoint`, and stops recording.
    ///
    /// # Errors
    ///
    /// As [`begin`](Self::begin).
    pub fn close(&mut self, checkpoint: &Checkpoint) -> Result<(), StoreError> {
        self.begin(checkpoint)?;
        self.active = None;
        self.unprotected = Some("it is closed".to_owned());
        Ok(())
    }
}

impl Pending {
    pub(super) fn keep(&mut self, body: &[u8]) {
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
            0 => return Err(io::ErrorKind::WriteZero.into()),
            taken => rest = rest.get(taken..).unwrap_or_default(),
        }
    }
    Ok(())
}

/// Adds to an error what failed, and on which file.
pub(super) fn failed(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> StoreError {
    move |source| StoreError::Io {
        doing,
        path: path.to_owned(),
        source,
    }
}
