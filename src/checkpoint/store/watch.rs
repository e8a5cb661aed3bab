//! Whether the file at the path is still the one that we write, and as we left it.
//!
//! Renaming its folder, unmounting its file system, cutting it off or overwriting it makes no write
//! fail: all goes well into a file that nobody will find. So the path, the open file and the lock
//! are compared with what we know, and what does not fit latches like a failed write.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

use super::generation::failed;
use super::journal::Active;
use super::storage::{FileId, FileStatus};
use super::{Names, Storage, Store, StoreError};

/// What somebody else did to the checkpoint.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum Change {
    /// The path names nothing.
    #[error("it was removed or renamed, or its file system was unmounted")]
    Gone,
    /// The path names another file.
    #[error("another file has taken its place")]
    Replaced,
    /// Truncated, or something was appended.
    #[error("it has {found} bytes instead of {expected}")]
    Length {
        /// Bytes that we wrote.
        expected: u64,
        found: u64,
    },
    /// Overwritten in place.
    #[error("a part of it was overwritten")]
    Content,
    /// The lock file's path names nothing, or another file.
    #[error("its lock file was removed or replaced")]
    Lock,
}

/// Why a file cannot be relied on.
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

/// Compares what is on disk with what should be there; from
/// [`Store::check_job`](super::Store::check_job).
#[must_use = "nothing is checked until it has run"]
pub struct CheckJob<S: Storage> {
    storage: S,
    names: Names,
    generation: u64,
    id: FileId,
    lock_id: FileId,
    /// Length and check sum, if the content is to be read.
    content: Option<(u64, u32)>,
}

/// What a check found.
#[must_use = "give it to `Store::checked`"]
pub struct Checked {
    generation: u64,
    result: Result<(), Finding>,
}

impl<S: Storage> CheckJob<S> {
    /// Checks; a few system calls, unless the file seems to have been overwritten and must be read.
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

    /// Compares the file's status with how we left it. Another time of modification alone proves
    /// nothing: `touch` sets it, and some file systems do so late. The content is read then.
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
    /// The work that finds out whether the file is still the one at the path and as we left it, and
    /// the lock ours; `None` if nothing is being recorded, or no longer, because its length already
    /// tells.
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

    /// Takes note of a check.
    ///
    /// # Errors
    ///
    /// If the file is not what it should be: the store is unprotected now.
    pub fn checked(&mut self, done: Checked) -> Result<(), StoreError> {
        let active = self.active.as_ref();
        let current = active.is_some_and(|active| active.generation == done.generation);
        match done.result {
            Err(finding) if current => Err(self.lose(finding)),
            // Or it was of a file that has been replaced since.
            _ => Ok(()),
        }
    }

    /// [`latch`](Self::latch) because of what somebody else did.
    pub(super) fn changed(&mut self, change: Change) -> StoreError {
        if matches!(change, Change::Lock) {
            // While the open file, which is locked too, still keeps others out. A failure comes up again
            // when the next generation is written.
            let _ = self.hold_lock();
        } else {
            // Whatever is at the path now is not ours to replace without keeping it.
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

    /// Takes care that the lock at the path is ours before anything is written there.
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

    /// Under which name something was kept that was found at the path; told once.
    pub fn take_kept(&mut self) -> Option<PathBuf> {
        self.kept.take()
    }
}
