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

mod aside;
mod error;
mod generation;
mod journal;
mod load;
mod names;
#[cfg(test)]
mod sim;
mod storage;
#[cfg(test)]
mod tests;

use std::path::Path;

use aside::{keep_aside, set_aside_previous};
pub use error::{OpenError, StoreError};
use generation::{COMPACTION_BYTES_MIN, Pending};
pub use generation::{Compacted, CompactionJob};
use journal::Active;
pub use journal::{SyncJob, Synced};
use load::Found;
pub use load::Loaded;
use names::Names;
pub use storage::{Disk, Storage};

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
    file_bytes_max: u64,
    buffer: Vec<u8>,
    _lock: S::Lock,
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
            file_bytes_max: load::FILE_BYTES_MAX,
            buffer: Vec::new(),
            _lock: lock,
        };
        Ok((store, present.then_some(loaded)))
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
