//! Checks whether the file at the path is unchanged and still the one that this store writes.
//!
//! Writes still succeed after the folder was renamed, the file system unmounted, or the file truncated or overwritten.
//! But the next start would not find the written records. So the path, the open file and the lock are compared with
//! what the store knows. A difference *latches*, as a failed write does: the store records nothing more to this file.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

use super::generation::failed;
use super::journal::Active;
use super::storage::{FileId, FileStatus};
use super::{Names, Storage, Store, StoreError};

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
    Lock,
}

/// Why the file cannot be trusted.
#[derive(Debug)]
enum Finding {
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
    generation: u64,
    result: Result<(), Finding>,
}

impl<S: Storage> CheckJob<S> {
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
            return Err(Finding::Changed(ForeignChange::Lock));
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

impl<S: Storage> Store<S> {
    /// A job that checks whether the file at the path and the lock are those of this store, and unchanged. `None` if
    /// nothing is being recorded, or if the status of the open file is already wrong, which stops recording.
    pub fn check_job(&mut self) -> Option<CheckJob<S>> {
        let active = self.active.as_mut()?;
        let status = self.storage.status(&active.file);
        let compared = match status {
            Ok(status) => active.compare(&status).map_err(Finding::Changed),
            Err(error) => Err(Finding::Io(error)),
        };
        let content = std::mem::take(&mut active.suspect);
        let content = content.then(|| (active.length(), active.crc));
        let (generation, id) = (active.generation, active.id);
        if let Err(finding) = compared {
            self.lose(finding);
            return None;
        }
        Some(CheckJob {
            storage: self.storage.clone(),
            names: self.names.clone(),
            generation,
            id,
            lock_id: self.lock_id,
            content,
        })
    }

    /// Notes the result of a check.
    ///
    /// # Errors
    ///
    /// If the check found a difference. The store is now [unprotected](Self::unprotected).
    pub fn checked(&mut self, done: Checked) -> Result<(), StoreError> {
        let active = self.active.as_ref();
        let current = active.is_some_and(|active| active.generation == done.generation);
        match done.result {
            Err(finding) if current => Err(self.lose(finding)),
            // All is well, or the checked file has been replaced since.
            _ => Ok(()),
        }
    }

    /// Stops recording to the present file for good, because another process has made `change`.
    pub(super) fn changed(&mut self, change: ForeignChange) -> StoreError {
        if matches!(change, ForeignChange::Lock) {
            // The lock is taken again now. Meanwhile the open file, which is locked too, keeps other processes out. If
            // the lock cannot be taken, the next generation reports it.
            let _ = self.hold_lock();
        } else {
            // Another process's file may be at the path now. Without `present`, that file is kept under another name
            // when it is replaced.
            self.present = None;
        }
        let path = self.names.path.clone();
        self.latch(StoreError::Changed { path, change })
    }

    fn lose(&mut self, finding: Finding) -> StoreError {
        match finding {
            Finding::Changed(change) => self.changed(change),
            Finding::Io(error) => self.latch(failed("check", &self.names.path)(error)),
        }
    }

    /// Makes sure that this store holds the lock at the path, before anything is written there.
    pub(super) fn hold_lock(&mut self) -> Result<(), StoreError> {
        let path = self.names.lock();
        let renewed = self.storage.renew_lock(&mut self.lock, &path);
        let renewed = renewed.and_then(|renewed| {
            self.lock_id = self.storage.lock_id(&self.lock)?;
            Ok(renewed)
        });
        let error = match renewed {
            Ok(Ok(())) => return Ok(()),
            Ok(Err(holder)) => StoreError::Taken {
                path: self.names.path.clone(),
                holder,
            },
            Err(error) => failed("lock", &path)(error),
        };
        Err(self.latch(error))
    }

    /// Returns the name under which another process's file at the checkpoint's path was kept. Returns each name once.
    pub fn take_kept(&mut self) -> Option<PathBuf> {
        self.kept.take()
    }
}
