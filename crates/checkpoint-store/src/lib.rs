//! Stores a checkpoint on disk.
//!
//! A checkpoint file holds a snapshot and after it the journal, to which records are appended. A [`Store`] owns one
//! such file and the files beside it, such as the lock file. It takes the lock, loads the file ([`Loaded`]), and
//! appends records. When the journal is too large or the disk has failed, it replaces the file by a new *generation*: a
//! file with a new snapshot. The old file stays beside it as the *previous generation*. All this is synchronous, and
//! the caller decides when to do it. Slow work is returned as a job ([`SyncJob`], [`CompactionJob`]) for a blocking
//! thread. While a job runs, the store can append records. `docs/checkpoint.md` describes the commit procedure and the
//! assumptions about the disk.
//!
//! A failed write or sync *latches*: the file is never written again, because a failed `fsync` reports only once that
//! data was lost. The store is then [unprotected](Store::unprotected), which means that it records nothing, until
//! [`Store::begin`] has written a new file. If another process changes the file, its folder or its lock, writes still
//! succeed. A [`CheckJob`] notices the change, which latches as well.

mod aside;
pub mod change_log;
mod error;
pub mod folder;
mod generation;
pub mod history;
mod journal;
mod load;
mod lock;
mod names;
pub mod regular_file;
#[cfg(test)]
mod sim;
mod storage;
#[cfg(test)]
mod tests;
mod watch;

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use aside::{LockedPath, Present, keep_aside, set_aside_previous};
use change_log::LogKeeper;
pub use error::{OpenError, StoreError};
use generation::{COMPACTION_BYTES_MIN, PendingGeneration};
pub use generation::{Compacted, CompactionJob};
use journal::Active;
pub use journal::{SyncJob, Synced};
pub use load::Loaded;
pub use lock::DiskLock;
pub use lock::{LockHolder, holder_of};
use names::Names;
pub use names::beside;
pub use storage::{Disk, FileId, FileStatus, Storage};
pub use watch::{CheckJob, Checked, ForeignChange};

/// Part of the name under which a damaged file is kept.
const BROKEN: &str = "broken";
/// Part of the name under which an unreadable file is kept.
const UNREADABLE: &str = "unreadable";

/// A checkpoint that is locked and open.
pub struct Store<S: Storage = Disk> {
    place: LockedPath<S>,
    /// The file that receives the records.
    active: Option<Active<S>>,
    /// Why nothing is being recorded. `None` only if `active` is set.
    unprotected: Option<String>,
    pending: Option<PendingGeneration>,
    /// Number of the last entry, recorded or not. No number is used twice.
    seq: u64,
    synced_seq: u64,
    /// The number of the last generation (checkpoint file) that was begun.
    generation: u64,
    compact_above: u64,
    file_bytes_max: u64,
    log: Arc<Mutex<LogKeeper<S>>>,
    buffer: Vec<u8>,
}

/// Reads the checkpoint at `path` without changing anything: takes no lock, creates no folder, makes no copies. It
/// works on a read-only disk, where [`Store::open`] fails.
///
/// # Errors
///
/// If the file cannot be read, is not a checkpoint, or was written by a newer version.
pub fn read(path: &Path) -> Result<Option<Loaded>, OpenError> {
    let names = Names {
        path: path.to_owned(),
    };
    Ok(load::load(&Disk, &names)?.map(|found| found.loaded))
}

impl Store<Disk> {
    /// Opens the checkpoint at `path` on this computer's disk; see [`Store::open_on`].
    ///
    /// # Errors
    ///
    /// The errors of [`Store::open_on`].
    pub fn open(path: &Path) -> Result<(Self, Option<Loaded>), OpenError> {
        Self::open_on(Disk, path)
    }

    /// Opens the checkpoint at `path` to store a state from elsewhere; see [`Store::open_over_on`].
    ///
    /// # Errors
    ///
    /// The errors of [`Store::open_over_on`].
    pub fn open_over(path: &Path) -> Result<Self, OpenError> {
        Self::open_over_on(Disk, path)
    }
}

/// The name of the previous generation: the file that the one at `path` has replaced.
pub fn previous_of(path: &Path) -> PathBuf {
    names::previous(path)
}

fn open_failed(doing: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> OpenError {
    let path = path.to_owned();
    move |source| OpenError::Io {
        doing,
        path,
        source,
    }
}

impl<S: Storage> Store<S> {
    /// Takes the lock of the checkpoint at `path` and loads the checkpoint. Creates its folder if needed. Copies a
    /// damaged file and an incomplete append to other names. Keeps an unreadable file under another name when it is
    /// replaced. Nothing can be recorded before [`begin`](Self::begin).
    ///
    /// # Errors
    ///
    /// If the folder or the file cannot be used, if another rosrescue uses it, if the file is not a checkpoint, or if a
    /// newer version wrote it. In all these cases the file is unchanged.
    pub fn open_on(storage: S, path: &Path) -> Result<(Self, Option<Loaded>), OpenError> {
        let mut store = Self::lock_on(storage, path)?;
        let (storage, names) = (&store.place.storage, &store.place.names);
        let Some(found) = load::load(storage, names)? else {
            // The operator has removed the file to start without it, so the previous generation must not be restored
            // later.
            names
                .remove_unfinished(storage)
                .and_then(|()| set_aside_previous(storage, names, "old"))
                .map_err(open_failed("clear the folder of", &names.path))?;
            return Ok((store, None));
        };
        let mut loaded = found.loaded;
        store.place.present = found.present;
        if store.place.present.is_none() {
            store.place.aside_kind = UNREADABLE;
        }
        // A failure here does not matter: a read-only disk can still be read.
        let _ = names.remove_unfinished(storage);
        let kept = match store.place.present {
            Some(_) => keep_aside(storage, names, &mut loaded, found.torn),
            None => Ok(()),
        };
        let bad_previous = found.bad_previous;
        let cleared = bad_previous.map_or(Ok(()), |kind| set_aside_previous(storage, names, kind));
        if let Err(error) = kept.and(cleared) {
            let path = names.path.display();
            loaded.damage.push(format!(
                "the damaged part of `{path}` could not be kept: {error}"
            ));
            // Without `present`, the damaged file is kept under another name when it is replaced.
            store.place.present = store.place.present.filter(|present| present.usable);
        }
        store.set_counts(found.seq, found.generation);
        Ok((store, Some(loaded)))
    }

    /// Takes the lock of the checkpoint at `path` to store a state from elsewhere. The present file and its
    /// previous generation are kept under other names before they are replaced.
    ///
    /// # Errors
    ///
    /// The errors of [`open_on`](Self::open_on). In all these cases no file is renamed.
    pub fn open_over_on(storage: S, path: &Path) -> Result<Self, OpenError> {
        let mut store = Self::lock_on(storage, path)?;
        let (storage, names) = (&store.place.storage, &store.place.names);
        // Numbers that the old file has used must not be used again.
        let found = load::load(storage, names)?.unwrap_or_default();
        let _ = names.remove_unfinished(storage);
        set_aside_previous(storage, names, UNREADABLE)
            .map_err(open_failed("clear the folder of", &names.path))?;
        store.place.aside_kind = UNREADABLE;
        store.set_counts(found.seq, found.generation);
        Ok(store)
    }

    /// Locks `path` without reading the file there.
    fn lock_on(storage: S, path: &Path) -> Result<Self, OpenError> {
        Ok(Self {
            place: LockedPath::lock(storage, path)?,
            active: None,
            unprotected: Some("recording has not begun yet".to_owned()),
            pending: None,
            seq: 0,
            synced_seq: 0,
            generation: 0,
            compact_above: COMPACTION_BYTES_MIN,
            file_bytes_max: load::FILE_BYTES_MAX,
            log: Arc::default(),
            buffer: Vec::new(),
        })
    }

    /// Keeps the records of replaced generations in the [log](change_log), in up to `bytes_max` bytes. 0 keeps none, and
    /// leaves the files of an earlier log alone.
    pub fn keep_log(&mut self, bytes_max: u64) {
        change_log::locked(&self.log).bytes_max = bytes_max;
    }

    /// Takes the reason why the log lacks records, if there was a new one.
    pub fn take_log_trouble(&mut self) -> Option<String> {
        // A job may be waiting for the disk with the lock held.
        self.log.try_lock().ok()?.trouble.take()
    }

    fn set_counts(&mut self, seq: u64, generation: u64) {
        (self.seq, self.synced_seq, self.generation) = (seq, seq, generation);
    }

    /// Uses no number up to `seq` for an entry from now on. Call it before the first checkpoint is begun.
    pub fn skip_to(&mut self, seq: u64) {
        let seq = self.seq.max(seq);
        self.set_counts(seq, self.generation);
    }

    /// The path of the file, with links resolved.
    pub fn path(&self) -> &Path {
        &self.place.names.path
    }

    /// Number of the last entry, recorded or not.
    pub fn seq(&self) -> u64 {
        self.seq
    }

    /// Number of the last record that is known to survive a loss of power.
    pub fn synced_seq(&self) -> u64 {
        self.synced_seq
    }

    /// The number of the last generation that was begun: how often the file has been rewritten.
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// Size of the journal in bytes.
    pub fn journal_bytes(&self) -> u64 {
        self.active
            .as_ref()
            .map_or(0, |active| active.journal_bytes)
    }

    /// Size of the snapshot and everything else before the journal, in bytes.
    pub fn snapshot_bytes(&self) -> u64 {
        self.active
            .as_ref()
            .map_or(0, |active| active.snapshot_bytes)
    }

    /// Why nothing is being recorded. `None` if records are written.
    pub fn unprotected(&self) -> Option<&str> {
        self.unprotected.as_deref()
    }

    /// Returns the name under which another process's file at the checkpoint's path was kept. Returns each name once.
    pub fn take_kept(&mut self) -> Option<PathBuf> {
        self.place.kept.take()
    }

    /// Renames the present file to `PATH.REASON-NUMBER`, so that it does not affect the next session. Removes the
    /// previous generation, or renames it too if the present file may lack records. Afterwards nothing can be recorded
    /// before the next [`begin`](Self::begin). Returns the new path, if there was a file.
    ///
    /// # Errors
    ///
    /// If the files cannot be renamed. They may then still have their old names.
    pub fn set_aside(&mut self, reason: &str) -> Result<Option<PathBuf>, StoreError> {
        self.active = None;
        self.overtake();
        let (storage, names) = (&self.place.storage, &self.place.names);
        for path in [names.previous(), names.path.clone()] {
            change_log::locked(&self.log).archive(storage, names, &path);
        }
        self.unprotected = Some("its file has been set aside".to_owned());
        self.place.set_aside(reason)
    }
}
