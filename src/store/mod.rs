//! The checkpoint on disk.
//!
//! A [`Store`] owns one file and its companions: it takes the lock, says what it finds
//! ([`Loaded`]), appends records, and replaces the file by a new generation when the journal has
//! outgrown the snapshot or the disk has failed. It is synchronous and never decides when to do so.
//! What may take long ([`SyncJob`], [`CompactionJob`]) is handed out to run on a blocking thread
//! while records go on being appended. `docs/checkpoint.md` has the commit procedure and what is
//! assumed about the disk.
//!
//! A failed write or sync *latches*: the file is never written again, because what a failed
//! `fsync` has dropped is reported once and then forgotten. The store is then
//! [unprotected](Store::unprotected) until [`Store::rearm`] has written a new file.

mod error;
mod generation;
mod load;
mod names;
#[cfg(test)]
mod sim;
mod storage;
#[cfg(test)]
mod tests;

use std::io;
use std::path::Path;
use std::sync::Arc;

use crate::record::{self, Checkpoint, Entry, Stamp};

pub use error::{OpenError, StoreError};
pub use generation::{Compacted, CompactionJob, SyncJob, Synced};
use generation::{Plan, append_all, failed};
use load::Found;
pub use load::Loaded;
use names::Names;
pub use storage::{Disk, Storage};

/// A journal that is smaller than this is not worth a new generation.
const COMPACTION_BYTES_MIN: u64 = 64 * 1024;
/// What is recorded while a new generation is written is kept in memory too, up to this size;
/// beyond it that generation is given up and the present file goes on.
const MEANWHILE_BYTES_MAX: usize = 16 * 1024 * 1024;
/// Room for encoding that is kept between appends.
const BUFFER_BYTES_MAX: usize = 1024 * 1024;

/// A checkpoint, locked and open.
pub struct Store<S: Storage = Disk> {
    storage: S,
    names: Names,
    /// The file that records go to.
    active: Option<Active<S>>,
    /// Why nothing is recorded. `None` only with `active`.
    unprotected: Option<String>,
    pending: Option<Pending>,
    /// Number of the last record, recorded or not: a number is never used twice.
    seq: u64,
    synced_seq: u64,
    /// The highest generation begun.
    generation: u64,
    /// Whether the file at the path is whole enough to be kept as the previous generation.
    usable: bool,
    compact_above: u64,
    buffer: Vec<u8>,
    _lock: S::Lock,
}

struct Active<S: Storage> {
    file: Arc<S::File>,
    stamp: Stamp,
    generation: u64,
    snapshot_bytes: u64,
    journal_bytes: u64,
    /// Whether everything appended is on the medium.
    clean: bool,
    /// Whether the file's name is.
    named: bool,
}

/// A new generation that is being written.
struct Pending {
    generation: u64,
    /// Bodies of the records since, each with a line feed.
    meanwhile: Vec<u8>,
    overtaken: bool,
}

/// Reads the checkpoint at `path` and changes nothing: no lock, no folder, no copies. For a disk on
/// which [`Store::open`] fails because it cannot be written.
///
/// # Errors
///
/// If the file cannot be read, is not ours or is too new.
pub fn read(path: &Path) -> Result<Option<Loaded>, OpenError> {
    let names = Names {
        path: path.to_owned(),
    };
    Ok(load::load(&Disk, &names)?.map(|found| found.loaded))
}

impl Store<Disk> {
    /// Opens the checkpoint at `path` on this machine's disk; see [`Store::open_on`].
    ///
    /// # Errors
    ///
    /// As [`Store::open_on`].
    pub fn open(path: &Path) -> Result<(Self, Option<Loaded>), OpenError> {
        Self::open_on(Disk, path)
    }
}

impl<S: Storage> Store<S> {
    /// Takes the lock of the checkpoint at `path` and reads what is there; makes its folder if need
    /// be. A damaged file is kept under another name as well, and so is the end of an append that
    /// was cut short. Nothing can be recorded before [`begin`](Self::begin).
    ///
    /// # Errors
    ///
    /// If the folder or the file cannot be used, another rosrescue has it, or the file is not ours
    /// or too new. The file is untouched then.
    pub fn open_on(storage: S, path: &Path) -> Result<(Self, Option<Loaded>), OpenError> {
        let io = |doing, path: &Path| {
            let path = path.to_owned();
            move |source| OpenError::Io {
                doing,
                path,
                source,
            }
        };
        let path = storage
            .locate(path)
            .map_err(io("make the folder of", path))?;
        let names = Names { path };
        let lock_path = names.lock();
        let lock = storage
            .lock(&lock_path)
            .map_err(io("lock", &lock_path))?
            .map_err(|holder| OpenError::Locked {
                path: names.path.clone(),
                holder,
            })?;
        let found = load::load(&storage, &names)?;
        let present = found.is_some();
        let Found {
            mut loaded,
            seq,
            generation,
            usable,
            torn,
        } = found.unwrap_or_default();
        if present {
            // A disk that refuses these may still be read, and what was read is worth more.
            let _ = names.remove_unfinished(&storage);
            if let Err(error) = keep_aside(&storage, &names, &mut loaded, torn) {
                let path = names.path.display();
                loaded.damage.push(format!(
                    "what is damaged of `{path}` could not be kept: {error}"
                ));
            }
        } else {
            // Somebody removed the file to start afresh; its fallback must not come back later.
            names
                .remove_unfinished(&storage)
                .and_then(|()| set_aside_previous(&storage, &names, "old"))
                .map_err(io("clear the folder of", &names.path))?;
        }
        let store = Self {
            storage,
            names,
            active: None,
            unprotected: Some("it has not been begun yet".to_owned()),
            pending: None,
            seq,
            synced_seq: seq,
            generation,
            usable,
            compact_above: COMPACTION_BYTES_MIN,
            buffer: Vec::new(),
            _lock: lock,
        };
        Ok((store, present.then_some(loaded)))
    }

    /// Writes `checkpoint` as a fresh generation and returns when it is on the medium. The present
    /// file becomes the previous generation.
    ///
    /// # Errors
    ///
    /// If it cannot be written: the store is unprotected if it was before, else it goes on with the
    /// present file. If [`Checkpoint::seq`] is behind [`seq`](Self::seq), nothing is done.
    pub fn begin(&mut self, checkpoint: &Checkpoint) -> Result<(), StoreError> {
        if checkpoint.seq >= self.seq {
            self.pending = None;
        }
        let done = self.plan(checkpoint.seq)?.run(checkpoint);
        self.finish_compaction(done)?;
        match self.sync_job().map(SyncJob::run) {
            Some(done) => self.synced(done),
            None => Ok(()),
        }
    }

    /// Records `entries` with one write. Each gets a number, whether it could be recorded or not;
    /// the last one's is returned. When this returns they survive the death of every process; a
    /// [`sync_job`](Self::sync_job) makes them survive a loss of power.
    ///
    /// # Errors
    ///
    /// If they were not recorded. Unless the reason is an [`EncodeError`](record::EncodeError),
    /// the store is unprotected now.
    pub fn append(&mut self, entries: &[Entry]) -> Result<u64, StoreError> {
        let first = self.seq.saturating_add(1);
        self.seq = self.seq.saturating_add(entries.len() as u64);
        let mut encoded = Ok(());
        self.buffer.clear();
        self.buffer.shrink_to(BUFFER_BYTES_MAX);
        for (seq, entry) in (first..).zip(entries) {
            let start = self.buffer.len();
            if let Err(error) = record::push_body(&mut self.buffer, seq, entry) {
                encoded = Err(error);
            }
            let body = self.buffer.get(start..).unwrap_or_default();
            if let Some(pending) = &mut self.pending {
                pending.keep(body);
            }
            if let Some(active) = &self.active
                && !body.is_empty()
            {
                record::seal(&mut self.buffer, start, active.stamp);
            }
        }
        let active = match (&mut self.active, &self.unprotected) {
            (Some(active), None) => active,
            (_, reason) => {
                let reason = reason.clone().unwrap_or_default();
                return Err(StoreError::Unprotected {
                    path: self.names.path.clone(),
                    reason,
                });
            }
        };
        active.clean &= self.buffer.is_empty();
        let written = match self.storage.append(&active.file, &self.buffer) {
            Ok(taken) if taken == self.buffer.len() => Ok(()),
            // The rest would fail too; the next write would only say why.
            Ok(taken) => Err(io::Error::new(
                io::ErrorKind::StorageFull,
                format!("only {taken} of {} bytes were taken", self.buffer.len()),
            )),
            Err(error) => Err(error),
        };
        match written {
            Ok(()) => {
                active.journal_bytes += self.buffer.len() as u64;
                encoded?;
                Ok(self.seq)
            }
            Err(source) => Err(self.latch(failed("write", &self.names.path)(source))),
        }
    }

    /// Stops recording, for good as far as the present file is concerned.
    fn latch(&mut self, error: StoreError) -> StoreError {
        self.unprotected = Some(error.to_string());
        self.active = None;
        error
    }

    /// The work that brings what was appended to the medium; `None` if there is none.
    pub fn sync_job(&self) -> Option<SyncJob<S>> {
        let active = self
            .active
            .as_ref()
            .filter(|active| !active.clean || !active.named)?;
        Some(SyncJob {
            storage: self.storage.clone(),
            file: Arc::clone(&active.file),
            names: (!active.named).then(|| self.names.clone()),
            generation: active.generation,
            seq: self.seq,
        })
    }

    /// Takes note of a sync.
    ///
    /// # Errors
    ///
    /// If it failed: the store is unprotected now.
    pub fn synced(&mut self, done: Synced) -> Result<(), StoreError> {
        let active = self
            .active
            .as_mut()
            .filter(|active| active.generation == done.generation);
        match (done.result, active) {
            (Ok(()), active) => {
                self.synced_seq = self.synced_seq.max(done.seq);
                if let Some(active) = active {
                    active.named |= done.named;
                    active.clean |= done.seq == self.seq;
                }
                Ok(())
            }
            (Err(source), Some(_)) => Err(self.latch(failed("sync", &self.names.path)(source))),
            // Of a file that has been replaced since; what it held is in its successor, which is
            // not synced yet.
            (Err(_), None) => Ok(()),
        }
    }

    /// Whether the journal has outgrown the snapshot, so that a new generation is worth writing.
    pub fn wants_compaction(&self) -> bool {
        self.pending.is_none()
            && self.active.as_ref().is_some_and(|active| {
                active.journal_bytes > active.snapshot_bytes.max(self.compact_above)
            })
    }

    /// Begins a new generation with `checkpoint`, taken as of now: its [`Checkpoint::seq`] is
    /// [`seq`](Self::seq). Run the job anywhere, go on appending, then give its result to
    /// [`finish_compaction`](Self::finish_compaction). Also the way to re-arm an unprotected store
    /// beside traffic. A job that is dropped instead is ended by [`begin`](Self::begin).
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
        if self.pending.is_some() {
            return Err(StoreError::Busy);
        }
        self.seq = seq;
        self.generation += 1;
        let generation = self.generation;
        self.pending = Some(Pending {
            generation,
            meanwhile: Vec::new(),
            overtaken: false,
        });
        Ok(Plan {
            storage: self.storage.clone(),
            names: self.names.clone(),
            generation,
            keep_present: self.usable,
        })
    }

    /// Adds what was recorded meanwhile to the new generation and puts it in the present file's
    /// place. Quick: it waits for no disk that can give a file two names.
    ///
    /// # Errors
    ///
    /// If there is no new generation. The present file goes on as it was, and the next compaction
    /// is wanted when it has doubled.
    pub fn finish_compaction(&mut self, done: Compacted<S>) -> Result<(), StoreError> {
        let fresh = self.names.fresh(done.generation);
        let pending = self
            .pending
            .take_if(|pending| pending.generation == done.generation);
        let finished = self.switch(pending, done);
        if finished.is_err() {
            // It may not be there at all; if it stays, the next start removes it.
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
        let Some(pending) = pending.filter(|pending| !pending.overtaken) else {
            return Err(StoreError::Overtaken {
                path: self.names.path.clone(),
            });
        };
        let mut journal = Vec::with_capacity(pending.meanwhile.len());
        for body in pending
            .meanwhile
            .split(|&byte| byte == b'\n')
            .filter(|body| !body.is_empty())
        {
            let start = journal.len();
            journal.extend_from_slice(body);
            record::seal(&mut journal, start, written.stamp);
        }
        append_all(&self.storage, &written.file, &journal)
            .and_then(|()| match written.linked {
                true => Ok(()),
                // The one case in which it waits: on file systems such as FAT.
                false => self.storage.sync(&written.file),
            })
            .map_err(failed("write", &fresh))?;
        if let Err(source) = self.storage.rename(&fresh, &self.names.path) {
            // Which file the path names now, nobody knows.
            return Err(self.latch(failed("replace", &self.names.path)(source)));
        }
        self.active = Some(Active {
            file: Arc::new(written.file),
            stamp: written.stamp,
            generation: done.generation,
            snapshot_bytes: written.snapshot_bytes,
            journal_bytes: journal.len() as u64,
            clean: journal.is_empty(),
            named: false,
        });
        self.usable = true;
        self.unprotected = None;
        self.compact_above = COMPACTION_BYTES_MIN;
        Ok(())
    }

    /// Ends being unprotected: [`begin`](Self::begin) under the name that says why.
    ///
    /// # Errors
    ///
    /// As `begin`; try again later.
    pub fn rearm(&mut self, checkpoint: &Checkpoint) -> Result<(), StoreError> {
        self.begin(checkpoint)
    }

    /// Gives the present file another name, `PATH.REASON-NUMBER`, and its previous generation too,
    /// so that neither has a part in what comes next. Nothing can be recorded before the next
    /// [`begin`](Self::begin). Returns the file's new path, if there was a file.
    ///
    /// # Errors
    ///
    /// If they cannot be renamed: they may still be where they were.
    pub fn set_aside(&mut self, reason: &str) -> Result<Option<std::path::PathBuf>, StoreError> {
        self.active = None;
        self.pending = None;
        self.unprotected = Some("its file has been set aside".to_owned());
        self.usable = false;
        let kind: String = reason
            .chars()
            .map(|letter| {
                if letter.is_ascii_alphanumeric() {
                    letter
                } else {
                    '-'
                }
            })
            .collect();
        let path = &self.names.path;
        // The previous generation first: left behind alone it could come back.
        let moved = set_aside_previous(&self.storage, &self.names, &kind).and_then(|()| {
            let aside = self.names.aside(&self.storage, &kind)?;
            let moved = rename_if_there(&self.storage, path, &aside)?;
            self.storage.sync_dir(self.names.folder())?;
            Ok(moved.then_some(aside))
        });
        moved.map_err(failed("set aside", path))
    }

    /// Writes a last generation, which `checkpoint` says is closed, and stops recording.
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

    /// Where the file is, links resolved.
    pub fn path(&self) -> &Path {
        &self.names.path
    }

    /// Number of the last record, recorded or not.
    pub fn seq(&self) -> u64 {
        self.seq
    }

    /// Number of the last record that is known to survive a loss of power.
    pub fn synced_seq(&self) -> u64 {
        self.synced_seq
    }

    /// How often the file has been written anew.
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// Size of the journal in bytes.
    pub fn journal_bytes(&self) -> u64 {
        self.active
            .as_ref()
            .map_or(0, |active| active.journal_bytes)
    }

    /// Size of what precedes the journal in bytes.
    pub fn snapshot_bytes(&self) -> u64 {
        self.active
            .as_ref()
            .map_or(0, |active| active.snapshot_bytes)
    }

    /// Why nothing is recorded; `None` if all is well.
    pub fn unprotected(&self) -> Option<&str> {
        self.unprotected.as_deref()
    }
}

impl Pending {
    fn keep(&mut self, body: &[u8]) {
        self.overtaken |= self.meanwhile.len() + body.len() >= MEANWHILE_BYTES_MAX;
        if self.overtaken {
            self.meanwhile = Vec::new();
        } else if !body.is_empty() {
            self.meanwhile.extend_from_slice(body);
            self.meanwhile.push(b'\n');
        }
    }
}

/// Keeps what is damaged, and says under which name.
fn keep_aside(
    storage: &impl Storage,
    names: &Names,
    loaded: &mut Loaded,
    torn: Option<Vec<u8>>,
) -> io::Result<()> {
    if let (Some(bytes), Some(sentence)) = (torn, &mut loaded.torn) {
        let aside = names.aside(storage, "torn")?;
        let file = storage.create(&aside)?;
        append_all(storage, &file, &bytes)?;
        sentence.push_str(&format!("; they are kept as `{}`", aside.display()));
    }
    if !loaded.damage.is_empty() {
        let aside = names.aside(storage, "broken")?;
        storage.link(&names.path, &aside)?;
        loaded
            .damage
            .push(format!("the damaged file is kept as `{}`", aside.display()));
    }
    Ok(())
}

fn set_aside_previous(storage: &impl Storage, names: &Names, kind: &str) -> io::Result<()> {
    let previous = names.previous();
    let aside = names.aside(storage, kind)?;
    rename_if_there(storage, &previous, &aside).map(|_| ())
}

fn rename_if_there(storage: &impl Storage, from: &Path, to: &Path) -> io::Result<bool> {
    match storage.rename(from, to) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}
