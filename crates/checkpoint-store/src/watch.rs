//! Checks whether the file at the path is unchanged and still the one that this store writes.
//!
//! Writes still succeed after the folder was renamed, the file system unmounted, or the file truncated or overwritten.
//! But the next start would not find the written records. So the path, the open file and the lock are compared with
//! what the store knows. A difference *latches*, as a failed write does: the store records nothing more to this file.

use std::io;

use thiserror::Error;

use super::aside::LockedPath;
use super::journal::Active;
use super::storage::{FileId, FileStatus};
use super::{Names, Storage};

/// A change made by another process.
#[derive(Debug, Error)]
pub enum ForeignChange {
    /// Nothing is at the path any more.
    #[error("it was removed or renamed, or its file system was unmounted")]
    Gone,
    /// Another file is at the path.
    #[error("another file has taken its place")]
    Replaced,
    /// The file was truncated or appended to.
    #[error("it has {found} bytes instead of {expected}")]
    Length { expected: u64, found: u64 },
    /// The file was overwritten in place.
    #[error("a part of it was overwritten")]
    Content,
    /// The lock file is gone, or another file is in its place.
    #[error("its lock file was removed or replaced")]
    LockReplaced,
}

/// Why the file cannot be trusted.
#[derive(Debug)]
pub(super) enum Finding {
    Changed(ForeignChange),
    Io(io::Error),
}

impl From<io::Error> for Finding {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// A job that compares the disk with what the store expects; see [`Store::check_job`](super::Store::check_job).
#[must_use = "nothing is checked until it has run"]
pub struct CheckJob<S: Storage> {
    storage: S,
    names: Names,
    generation: u64,
    id: FileId,
    lock_id: FileId,
    /// Length and check sum to compare, if the content must be read.
    content: Option<(u64, u32)>,
}

#[must_use = "give it to `Store::checked`"]
pub struct Checked {
    pub(super) generation: u64,
    pub(super) result: Result<(), Finding>,
}

impl<S: Storage> CheckJob<S> {
    /// Prepares a check that `place` still holds the `active` file. Here it compares only the metadata of the open file
    /// (`fstat`), and fails if these show a change.
    pub(super) fn prepare(place: &LockedPath<S>, active: &mut Active<S>) -> Result<Self, Finding> {
        let status = place.storage.status(&active.file)?;
        active.compare(&status).map_err(Finding::Changed)?;
        let content = std::mem::take(&mut active.suspect);
        Ok(Self {
            storage: place.storage.clone(),
            names: place.names.clone(),
            generation: active.generation,
            id: active.id,
            lock_id: place.lock_id,
            content: content.then(|| (active.length(), active.crc)),
        })
    }

    /// Runs the check with a few system calls. Reads the file only if it may have been overwritten.
    pub fn run(self) -> Checked {
        Checked {
            generation: self.generation,
            result: self.check(),
        }
    }

    fn check(&self) -> Result<(), Finding> {
        let (storage, path) = (&self.storage, &self.names.path);
        match storage.id_at(path)? {
            None => return Err(Finding::Changed(ForeignChange::Gone)),
            Some(id) if id != self.id => return Err(Finding::Changed(ForeignChange::Replaced)),
            Some(_) => {}
        }
        if storage.id_at(&self.names.lock())? != Some(self.lock_id) {
            return Err(Finding::Changed(ForeignChange::LockReplaced));
        }
        match self.content {
            Some((length, crc)) if storage.checksum(path, length)? != crc => {
                Err(Finding::Changed(ForeignChange::Content))
            }
            _ => Ok(()),
        }
    }
}

impl<S: Storage> Active<S> {
    pub(super) fn length(&self) -> u64 {
        self.snapshot_bytes + self.journal_bytes
    }

    /// Compares the file's status with its status after this store's last write. If only the modification time differs,
    /// the next check reads the content, because `touch` changes that time too, and some file systems update it late.
    pub(super) fn compare(&mut self, status: &FileStatus) -> Result<(), ForeignChange> {
        let expected = self.length();
        if status.length != expected {
            let found = status.length;
            return Err(ForeignChange::Length { expected, found });
        }
        if status.modified != self.modified {
            self.modified = status.modified;
            self.suspect = true;
        }
        Ok(())
    }
}
