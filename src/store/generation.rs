//! Writing a new generation of the file, and the sync of the present one: what may run on a
//! blocking thread while calls go on being recorded.

use std::io;
use std::sync::Arc;

use super::names::Names;
use super::{Storage, StoreError};
use crate::record::{self, Checkpoint, Stamp};

/// Writes a new generation; from [`Store::begin_compaction`](super::Store::begin_compaction).
#[must_use = "the journal goes on growing until the job has run and has been finished"]
pub struct CompactionJob<S: Storage> {
    pub(super) plan: Plan<S>,
    pub(super) checkpoint: Checkpoint,
}

/// Where a new generation goes.
pub(super) struct Plan<S: Storage> {
    pub(super) storage: S,
    pub(super) names: Names,
    pub(super) generation: u64,
    /// Whether the present file becomes the previous generation.
    pub(super) keep_present: bool,
}

/// A new generation on disk under a name of its own, or why there is none.
#[must_use = "give it to `Store::finish_compaction`"]
pub struct Compacted<S: Storage> {
    pub(super) generation: u64,
    pub(super) result: Result<Written<S>, StoreError>,
}

pub(super) struct Written<S: Storage> {
    pub(super) file: S::File,
    pub(super) stamp: Stamp,
    pub(super) snapshot_bytes: u64,
    /// Whether the previous generation is the present file itself, so that it has what is appended
    /// to that until the new one takes its place.
    pub(super) linked: bool,
}

impl<S: Storage> CompactionJob<S> {
    /// Encodes, writes and syncs; blocks as long as the disk does.
    pub fn run(self) -> Compacted<S> {
        self.plan.run(&self.checkpoint)
    }
}

impl<S: Storage> Plan<S> {
    pub(super) fn run(self, checkpoint: &Checkpoint) -> Compacted<S> {
        Compacted {
            generation: self.generation,
            result: self.write(checkpoint),
        }
    }

    fn write(self, checkpoint: &Checkpoint) -> Result<Written<S>, StoreError> {
        let Self {
            storage,
            names,
            generation,
            keep_present,
        } = self;
        let encoded = record::encode_checkpoint(checkpoint, generation)?;
        let path = names.fresh(generation);
        let file = storage.create(&path).map_err(failed("create", &path))?;
        let written =
            append_all(&storage, &file, &encoded.bytes).and_then(|()| storage.sync(&file));
        written.map_err(failed("write", &path))?;
        let mut linked = true;
        if keep_present {
            let previous = names.previous();
            linked = match storage.link(&names.path, &previous) {
                // Somebody removed it; a new one is the best that can be done.
                Err(error) if error.kind() == io::ErrorKind::NotFound => true,
                other => other.map_err(failed("keep", &previous))?,
            };
        }
        // Both names are on the medium before the new generation takes the path: whatever part of
        // the rest a loss of power undoes, the records are in one of the two.
        storage
            .sync_dir(names.folder())
            .map_err(failed("sync the folder of", &path))?;
        let snapshot_bytes = encoded.bytes.len() as u64;
        Ok(Written {
            file,
            stamp: encoded.stamp,
            snapshot_bytes,
            linked,
        })
    }
}

/// Brings everything that was appended so far to the medium; from
/// [`Store::sync_job`](super::Store::sync_job).
#[must_use = "nothing is synced until it has run"]
pub struct SyncJob<S: Storage> {
    pub(super) storage: S,
    pub(super) file: Arc<S::File>,
    /// The names, if the folder is to be synced too.
    pub(super) names: Option<Names>,
    pub(super) generation: u64,
    pub(super) seq: u64,
}

/// How a sync went.
#[must_use = "give it to `Store::synced`"]
pub struct Synced {
    pub(super) generation: u64,
    pub(super) seq: u64,
    pub(super) named: bool,
    pub(super) result: io::Result<()>,
}

impl<S: Storage> SyncJob<S> {
    /// Syncs; blocks as long as the disk does.
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

/// Appends all of `bytes`, in as many writes as it takes.
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

/// Says what was done to which file when it failed.
pub(super) fn failed(
    doing: &'static str,
    path: &std::path::Path,
) -> impl FnOnce(io::Error) -> StoreError {
    move |source| StoreError::Io {
        doing,
        path: path.to_owned(),
        source,
    }
}
