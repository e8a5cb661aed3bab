//! Appends records to the present file and syncs them.

use std::io;
use std::sync::Arc;

use super::generation::failed;
use super::storage::FileId;
use super::watch::{CheckJob, Checked, Finding, ForeignChange};
use super::{Names, Storage, Store, StoreError};
use rescue_core::checkpoint::format::{self, RecordContent, Stamp};

/// Maximum size of the encoding buffer that is kept between appends.
const BUFFER_BYTES_MAX: usize = 1024 * 1024;

/// The file to which records are appended.
pub(super) struct Active<S: Storage> {
    pub(super) file: Arc<S::File>,
    pub(super) stamp: Stamp,
    pub(super) generation: u64,
    pub(super) snapshot_bytes: u64,
    pub(super) journal_bytes: u64,
    pub(super) id: FileId,
    /// Check sum of all bytes written so far.
    pub(super) crc: u32,
    /// Modification time of the file after this store's last write.
    pub(super) modified: i128,
    /// Whether another process may have written to the file. If so, the next check must read the content.
    pub(super) suspect: bool,
    /// Whether everything that was appended has been synced.
    pub(super) clean: bool,
    /// Whether the file's name in its folder has been synced.
    pub(super) named: bool,
}

impl<S: Storage> Store<S> {
    /// Records `entries` with one write. Each entry gets a number, even if it cannot be recorded. Returns the last
    /// number. Afterwards the entries survive the death of any process. A [`sync_job`](Self::sync_job) makes them
    /// survive a loss of power as well.
    ///
    /// # Errors
    ///
    /// If the entries were not recorded. The store is then [unprotected](Self::unprotected), unless the reason is an
    /// [`EncodeError`](rescue_core::checkpoint::format::EncodeError).
    pub fn append(&mut self, entries: &[RecordContent]) -> Result<u64, StoreError> {
        let first = self.seq.saturating_add(1);
        self.seq = self.seq.saturating_add(entries.len() as u64);
        let mut encoded = Ok(());
        self.buffer.clear();
        self.buffer.shrink_to(BUFFER_BYTES_MAX);
        for (seq, entry) in (first..).zip(entries) {
            let start = self.buffer.len();
            if let Err(error) = format::push_body(&mut self.buffer, seq, entry) {
                encoded = Err(error);
            }
            let body = self.buffer.get(start..).unwrap_or_default();
            if let Some(pending) = &mut self.pending {
                pending.add(body);
            }
            if let Some(active) = &self.active
                && !body.is_empty()
            {
                format::seal(&mut self.buffer, start, active.stamp);
            }
        }
        let active = match (&mut self.active, &self.unprotected) {
            (Some(active), None) => active,
            (_, reason) => {
                let reason = reason.clone().unwrap_or_default();
                return Err(StoreError::Unprotected {
                    path: self.place.names.path.clone(),
                    reason,
                });
            }
        };
        // Before a record is acknowledged, make sure that it is not in a truncated file or behind another process's
        // bytes.
        if let Ok(status) = self.place.storage.status(&active.file)
            && let Err(change) = active.compare(&status)
        {
            return Err(self.changed(change));
        }
        active.clean &= self.buffer.is_empty();
        let length = active.length() + self.buffer.len() as u64;
        let appended = match length > self.file_bytes_max {
            // The next start could not read a larger file.
            true => Err(io::ErrorKind::FileTooLarge.into()),
            false => self.place.storage.append(&active.file, &self.buffer),
        };
        let written = match appended {
            Ok(taken) if taken == self.buffer.len() => Ok(()),
            // The missing bytes are not retried: that write would fail too, only with a clearer error.
            Ok(taken) => Err(io::Error::new(
                io::ErrorKind::StorageFull,
                format!("only {taken} of {} bytes were written", self.buffer.len()),
            )),
            Err(error) => Err(error),
        };
        match written {
            Ok(()) => {
                active.journal_bytes += self.buffer.len() as u64;
                active.crc = crc32c::crc32c_append(active.crc, &self.buffer);
                if let Ok(status) = self.place.storage.status(&active.file) {
                    active.modified = status.modified;
                    if let Err(change) = active.compare(&status) {
                        return Err(self.changed(change));
                    }
                }
                encoded?;
                Ok(self.seq)
            }
            Err(source) => Err(self.latch(failed("write", &self.place.names.path)(source))),
        }
    }

    /// Stops recording to the present file for good, because the disk did not answer and the file lacks records.
    /// `reason` is shown to the user.
    pub fn give_up(&mut self, reason: &str) {
        self.latch(failed("write", &self.place.names.path)(io::Error::new(
            io::ErrorKind::TimedOut,
            reason,
        )));
    }

    /// Stops recording to the present file for good, because of `error`.
    pub(super) fn latch(&mut self, error: StoreError) -> StoreError {
        self.unprotected = Some(error.to_string());
        if self.active.take().is_some_and(|active| !active.named)
            && let Some(present) = &mut self.place.present
        {
            // It is unknown how much of the file is durable. The previous generation is durable, so this file must not
            // replace it.
            present.usable = false;
        }
        error
    }

    /// A job that syncs what has been written to the file. `None` if everything written is synced.
    pub fn sync_job(&self) -> Option<SyncJob<S>> {
        let active = self
            .active
            .as_ref()
            .filter(|active| !active.clean || !active.named)?;
        Some(SyncJob {
            storage: self.place.storage.clone(),
            file: Arc::clone(&active.file),
            names: (!active.named).then(|| self.place.names.clone()),
            generation: active.generation,
            seq: self.seq,
        })
    }

    /// Notes the result of a sync.
    ///
    /// # Errors
    ///
    /// If the sync of the present file failed. The store is now [unprotected](Self::unprotected).
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
            (Err(source), Some(_)) => {
                Err(self.latch(failed("sync", &self.place.names.path)(source)))
            }
            // This sync belongs to a file that has been replaced since. The new file has the same records and is not
            // synced yet.
            (Err(_), None) => Ok(()),
        }
    }

    /// A job that checks whether the file at the path and the lock are those of this store, and unchanged. `None` if
    /// nothing is being recorded, or if the status of the open file is already wrong, which stops recording.
    pub fn check_job(&mut self) -> Option<CheckJob<S>> {
        let job = CheckJob::prepare(&self.place, self.active.as_mut()?);
        job.map_err(|finding| self.distrust(finding)).ok()
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
            Err(finding) if current => Err(self.distrust(finding)),
            // All is well, or the checked file has been replaced since.
            _ => Ok(()),
        }
    }

    /// Stops recording to the present file for good, because another process has made `change`.
    fn changed(&mut self, change: ForeignChange) -> StoreError {
        if matches!(change, ForeignChange::LockReplaced) {
            // The lock is taken again now. Meanwhile the open file, which is locked too, keeps other processes out. If
            // the lock cannot be taken, the next generation reports it.
            let _ = self.place.hold_lock();
        } else {
            // Another process's file may be at the path now. Without `present`, that file is kept under another name
            // when it is replaced.
            self.place.present = None;
        }
        let path = self.place.names.path.clone();
        self.latch(StoreError::Changed { path, change })
    }

    fn distrust(&mut self, finding: Finding) -> StoreError {
        match finding {
            Finding::Changed(change) => self.changed(change),
            Finding::Io(error) => self.latch(failed("check", &self.place.names.path)(error)),
        }
    }
}

/// A job that syncs everything appended so far; see [`Store::sync_job`](super::Store::sync_job).
#[must_use = "nothing is synced until it has run"]
pub struct SyncJob<S: Storage> {
    pub(super) storage: S,
    pub(super) file: Arc<S::File>,
    /// Set if the folder must be synced too.
    pub(super) names: Option<Names>,
    generation: u64,
    seq: u64,
}

/// The result of a sync.
#[must_use = "give it to `Store::synced`"]
pub struct Synced {
    generation: u64,
    seq: u64,
    pub(super) named: bool,
    pub(super) result: io::Result<()>,
}

impl Synced {
    /// Why the sync failed.
    pub fn error(&self) -> Option<&io::Error> {
        self.result.as_ref().err()
    }
}

impl<S: Storage> SyncJob<S> {
    /// Runs the sync. Blocks as long as the disk does.
    pub fn run(self) -> Synced {
        let mut result = self.storage.sync(&self.file);
        if let (Ok(()), Some(names)) = (&result, &self.names) {
            result = self.storage.sync_dir(names.folder());
        }
        let Self {
            generation,
            seq,
            names,
            ..
        } = self;
        Synced {
            generation,
            seq,
            named: names.is_some(),
            result,
        }
    }
}
