//! Errors of the store.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

use super::ForeignChange;
use rescue_core::checkpoint::format::EncodeError;

/// Why a checkpoint cannot be opened. The files are unchanged.
#[derive(Debug, Error)]
pub enum OpenError {
    #[error(
        "the checkpoint `{}` is in use by another rosrescue{}; stop that one or choose another file with --checkpoint",
        path.display(),
        holder.map(|pid| format!(" (process {pid})")).unwrap_or_default()
    )]
    Locked {
        path: PathBuf,
        /// The process id of the lock's holder, if known.
        holder: Option<u32>,
    },
    /// The file is not a checkpoint.
    #[error("`{}` is not a rosrescue checkpoint; move it away or choose another with --checkpoint", path.display())]
    NotACheckpoint { path: PathBuf },
    /// A rosrescue with another checkpoint format wrote the file.
    #[error(
        "`{}` was written in checkpoint format {version} by another version of rosrescue; use that version, or move the file away",
        path.display()
    )]
    OtherVersion { path: PathBuf, version: u32 },
    /// The operating system reported an error.
    #[error(
        "cannot {doing} `{}`: {source}; make it readable and writable for this user or choose another file with --checkpoint",
        path.display()
    )]
    Io {
        doing: &'static str,
        /// The file or folder that could not be used.
        path: PathBuf,
        source: io::Error,
    },
}

impl OpenError {
    /// The text of this error. Leaves out the advice if the operating system reported the error.
    pub fn without_advice(&self) -> String {
        match self {
            Self::Io {
                doing,
                path,
                source,
            } => format!("cannot {doing} `{}`: {source}", path.display()),
            other => other.to_string(),
        }
    }
}

/// Why the store could not do what it was asked to do, such as record a call. rosrescue forwards the call nevertheless.
#[derive(Debug, Error)]
pub enum StoreError {
    /// An earlier operation failed, or [`begin`](super::Store::begin) was not called yet.
    #[error("`{}` records nothing: {reason}", path.display())]
    Unprotected { path: PathBuf, reason: String },
    /// The operating system reported an error.
    #[error("cannot {doing} `{}`: {source}", path.display())]
    Io {
        doing: &'static str,
        path: PathBuf,
        source: io::Error,
    },
    /// Another process has changed the file.
    #[error("another process changed `{}`: {change}", path.display())]
    Changed {
        path: PathBuf,
        change: ForeignChange,
    },
    /// Another rosrescue took the lock after the lock file had been removed.
    #[error(
        "`{}` is in use by another rosrescue{} now; stop one of the two",
        path.display(),
        holder.map(|pid| format!(" (process {pid})")).unwrap_or_default()
    )]
    Taken {
        path: PathBuf,
        /// The process id of the lock's holder, if known.
        holder: Option<u32>,
    },
    /// The snapshot is older than the journal.
    #[error(
        "a snapshot as of record {snapshot} cannot replace a journal that has reached record {journal}; take a new snapshot"
    )]
    Stale {
        /// The number of the last record in the snapshot.
        snapshot: u64,
        /// The number of the last record in the journal.
        journal: u64,
    },
    /// A new checkpoint file is already being written.
    #[error("another generation of the checkpoint is being written; finish that one first")]
    Busy,
    /// The new checkpoint file is obsolete, because a later one was begun, the file was set aside, or too much was
    /// recorded while it was written.
    #[error("the new generation of `{}` was superseded and has been dropped; begin another", path.display())]
    Overtaken { path: PathBuf },
    /// The state or the record cannot be encoded.
    #[error(transparent)]
    Encode(#[from] EncodeError),
}
