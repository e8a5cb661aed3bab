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
//! [unprotected](Store::unprotected) until [`Store::rearm`] has written a new file. What somebody else does
//! to the file, its folder or its lock makes no write fail; a [`CheckJob`] finds it, and it latches too.

mod aside;
mod error;
mod generation;
mod journal;
mod load;
mod lock;
mod names;
#[cfg(test)]
mod sim;
mod storage;
#[cfg(test)]
mod tests;
mod watch;

use std::path::{Path, PathBuf};

use aside::{keep_aside, set_aside_previous};
pub use error::{OpenError, StoreError};
use generation::{COMPACTION_BYTES_MIN, Pending};
pub use generation::{Compacted, CompactionJob};
use journal::Active;
pub use journal::{SyncJob, Synced};
pub use load::Loaded;
pub use lock::DiskLock;
use names::Names;
pub use storage::{Disk, FileId, FileStatus, Storage};
pub use watch::{Change, CheckJob, Checked};

/// The kinds of names under which is kept what was damaged,
const BROKEN: &str = "broken";
/// and what could not be read.
const UNREADABLE: &str = "unreadable";

/// The file that we know to be at the path.
#[derive(Clone, Copy, Debug)]
struct Present {
    id: FileId,
    /// Whether it is whole enough to be kept as the previous generation.
    usable: bool,
}

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
    /// What else is at the path is kept before it is replaced.
    present: Option<Present>,
    /// What it is called then,
    aside_kind: &'static str,
    /// and where the last one went.
    kept: Option<PathBuf>,
    compact_above: u64,
    file_bytes_max: u64,
    buffer: Vec<u8>,
    lock: S::Lock,
    lock_id: FileId,
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

    /// Opens the checkpoint at `path` for a state that does not come from there; see
    /// [`Store::open_over_on`].
    ///
    /// # Errors
    ///
    /// As [`Store::open_over_on`].
    pub fn open_over(path: &Path) -> Result<Self, OpenError> {
        Self::open_over_on(Disk, path)
    }
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
    /// Takes the lock of the checkpoint at `path` and reads what is there; makes its folder if need
    /// be. A damaged file is kept under another name as well, and so is the end of an append that
    /// was cut short. What cannot be read is kept when something takes its place. Nothing can be
    /// recorded before [`begin`](Self::begin).
    ///
    /// # Errors
    ///
    /// If the folder or the file cannot be used, another rosrescue has it, or the file is not ours
    /// or too new. The file is untouched then.
    pub fn open_on(storage: S, path: &Path) -> Result<(Self, Option<Loaded>), OpenError> {
        let mut store = Self::lock_on(storage, path)?;
        let (storage, names) = (&store.storage, &store.names);
        let Some(found) = load::load(storage, names)? else {
            // Somebody removed the file to start afresh; its fallback must not come back later.
            names
                .remove_unfinished(storage)
                .and_then(|()| set_aside_previous(storage, names, "old"))
                .map_err(open_failed("clear the folder of", &names.path))?;
            return Ok((store, None));
        };
        let mut loaded = found.loaded;
        store.present = found.present;
        if store.present.is_none() {
            store.aside_kind = UNREADABLE;
        }
        // A disk that refuses these may still be read, and what was read is worth more.
        let _ = names.remove_unfinished(storage);
        let kept = match store.present {
            Some(_) => keep_aside(storage, names, &mut loaded, found.torn),
            None => Ok(()),
        };
        let bad_previous = found.bad_previous;
        let cleared = bad_previous.map_or(Ok(()), |kind| set_aside_previous(storage, names, kind));
        if let Err(error) = kept.and(cleared) {
            let path = names.path.display();
            loaded.damage.push(format!(
                "what is damaged of `{path}` could not be kept: {error}"
            ));
            // Kept when something takes its place, then.
            store.present = store.present.filter(|present| present.usable);
        }
        store.set_counts(found.seq, found.generation);
        Ok((store, Some(loaded)))
    }

    /// Takes the lock of the checkpoint at `path` for a state that does not come from there: whatever
    /// is there now, and its previous generation, is kept under another name before something takes
    /// its place.
    ///
    /// # Errors
    ///
    /// As [`open_on`](Self::open_on): what is no checkpoint, and might be a folder of somebody's, is not
    /// renamed either.
    pub fn open_over_on(storage: S, path: &Path) -> Result<Self, OpenError> {
        let mut store = Self::lock_on(storage, path)?;
        let (storage, names) = (&store.storage, &store.names);
        // Its numbers must not be used again.
        let found = load::load(storage, names)?.unwrap_or_default();
        let _ = names.remove_unfinished(storage);
        set_aside_previous(storage, names, UNREADABLE)
            .map_err(open_failed("clear the folder of", &names.path))?;
        store.aside_kind = UNREADABLE;
        store.set_counts(found.seq, found.generation);
        Ok(store)
    }

    /// A store that knows nothing of what is at `path`, which is locked.
    fn lock_on(storage: S, path: &Path) -> Result<Self, OpenError> {
        let path = storage
            .locate(path)
            .map_err(open_failed("make the folder of", path))?;
        let names = Names { path };
        let lock_path = names.lock();
        let lock = storage
            .lock(&names.path, &lock_path)
            .map_err(open_failed("lock", &lock_path))?
            .map_err(|holder| OpenError::Locked {
                path: names.path.clone(),
                holder,
            })?;
        let lock_id = storage
            .lock_id(&lock)
            .map_err(open_failed("lock", &lock_path))?;
        Ok(Self {
            storage,
            names,
            active: None,
            unprotected: Some("it has not been begun yet".to_owned()),
            pending: None,
            seq: 0,
            synced_seq: 0,
            generation: 0,
            present: None,
            aside_kind: BROKEN,
            kept: None,
            compact_above: COMPACTION_BYTES_MIN,
            file_bytes_max: load::FILE_BYTES_MAX,
            buffer: Vec::new(),
            lock,
            lock_id,
        })
    }

    fn set_counts(&mut self, seq: u64, generation: u64) {
        (self.seq, self.synced_seq, self.generation) = (seq, seq, generation);
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
