//! Whether the file at the path is still ours and unchanged.
//!
//! Renaming its folder, unmounting its file system, truncating or overwriting it makes no write fail: all
//! writes succeed, into a file that cannot be found any more. So the path, the open file and the lock are
//! compared with what is known, and a difference latches like a failed write.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

use super::generation::failed;
use super::journal::Active;
use super::storage::{FileId, FileStatus};
use super::{Names, Storage, Store, StoreError};

/// A change by another process.
#[derive(Debug, Error)]
pub enum Change {
    /// The path does not exist.
    #[error("it was removed or renamed, or its file system was unmounted")]
    Gone,
    /// The path is another file.
    #[error("another file has taken its place")]
    Replaced,
    /// Truncated or appended to.
    #[error("it has {found} bytes instead of {expected}")]
    Length { expected: u64, found: u64 },
    /// Overwritten in place.
    #[error("a part of it was overwritten")]
    Content,
    /// The lock file's path does not exist, or is another file.
    #[error("its lock file was removed or replaced")]
    Lock,
}

/// Why a file is not reliable.
#[derive(Debug)]
enum Finding {
    Changed(Change),
    Io(io::Error),
}

impl From<io::Error> for Finding {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// Compares the disk with what should be there; see [`Store::check_job`](super::Store::check_job).
#[must_use = "nothing is checked until it has run"]
pub struct CheckJob<S: Storage> {
    storage: S,
    names: Names,
    generation: u64,
    id: FileId,
    lock_id: FileId,
    /// Length and check sum, if the content must be read.
    content: Option<(u64, u32)>,
}

#[must_use = "give it to `Store::checked`"]
pub struct Checked {
    generation: u64,
    result: Result<(), Finding>,
}

impl<S: Storage> CheckJob<S> {
    /// Checks with a few system calls. Reads the file only if it may have been overwritten.
    pub fn run(self) -> Checked {
        Checked {
            generation: self.generation,
            result: self.check(),
        }
    }

    fn check(&self) -> Result<(), Finding> {
        let (storage, path) = (&self.storage, &self.names.path);
        match storage.id_at(path)? {
            None => return Err(Finding::Changed(Change::Gone)),
            Some(id) if id != self.id => return Err(Finding::Changed(Change::Replaced)),
            Some(_) => {}
        }
        if storage.id_at(&self.names.lock())? != Some(self.lock_id) {
            return Err(Finding::Changed(Change::Lock));
        }
        match self.content {
            Some((length, crc)) if storage.checksum(path, length)? != crc => {
                Err(Finding::Changed(Change::Content))
            }
            _ => Ok(()),
        }
    }
}

impl<S: Storage> Active<S> {
    pub(super) fn length(&self) -> u64 {
        self.snapshot_bytes + self.journal_bytes
    }

    /// Compares the file's status with that after our last write. A different modification time alone proves
    /// nothing: `touch` sets it, and some file systems update it late. The content is read then.
    pub(super) fn compare(&mut self, status: &FileStatus) -> Result<(), Change> {
        let expected = self.length();
        if status.length != expected {
            let found = status.length;
            return Err(Change::Length { expected, found });
        }
        if status.modified != self.modified {
            self.modified = status.modified;
            self.suspect = true;
        }
        Ok(())
    }
}

impl<S: Storage> Store<S> {
    /// The check that the file at the path is ours and unchanged, and that the lock is ours. `None` if
    /// nothing is being recorded, or recording stops now because the length differs.
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
    /// If the file is not as expected: the store is now unprotected.
    pub fn checked(&mut self, done: Checked) -> Result<(), StoreError> {
        let active = self.active.as_ref();
        let current = active.is_some_and(|active| active.generation == done.generation);
        match done.result {
            Err(finding) if current => Err(self.lose(finding)),
            // All is well, or the checked file has been replaced since.
            _ => Ok(()),
        }
    }

    /// [`latch`](Self::latch) after a change by another process.
    pub(super) fn changed(&mut self, change: Change) -> StoreError {
        if matches!(change, Change::Lock) {
            // Taken again now, while the open file, which is locked too, keeps others out. A failure shows
            // again when the next generation is written.
            let _ = self.hold_lock();
        } else {
            // A foreign file may be at the path now: it must be kept when it is replaced.
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

    /// Makes sure that the lock at the path is ours before anything is written there.
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

    /// The name under which a file found at the path was kept; returned once.
    pub fn take_kept(&mut self) -> Option<PathBuf> {
        self.kept.take()
    }
}
