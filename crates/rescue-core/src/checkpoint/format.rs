//! The checkpoint's text, to and from bytes. Pure; The crate `checkpoint-store` handles the file.
//!
//! A checkpoint is one YAML document: a first line (a comment) with lengths and check sums, the snapshot in
//! block style, and a last key `journal:` under which every appended line is one [`Record`] in flow style.
//! `docs/checkpoint.md` describes the format for people.
//!
//! * `emit`: values to YAML that YAML 1.1 and 1.2 readers read alike.
//! * `yaml`: YAML to values, from the events of serde-saphyr's parser.
//! * `frame`: the first line, check sums, and the whole parts of a damaged file.
//! * `document`: which value stands under which key.

mod document;
mod emit;
mod frame;
mod rosparam;
#[cfg(test)]
mod tests;
mod yaml;

use std::ops::Range;

use thiserror::Error;

use crate::master::{Displaced, Snapshot};
use crate::xmlrpc::Call;

pub use frame::{FORMAT_VERSION, Stamp, decode};
pub use frame::{Framed, push_body, push_record, read_records, scan, seal};
pub use rosparam::{for_rosparam, shown};

/// Deepest nesting that can be written and read back: the deepest value of a call (`xmlrpc` accepts 512)
/// below a parameter path of half as many names. rosmaster itself cannot return a value deeper than 492
/// levels.
pub const DEPTH_MAX: usize = 768;

/// What a restart needs to decide whether the session continues.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Session {
    /// Identifies the session; the `run_id` of roslaunch.
    pub id: String,
    /// The kernel's boot id when the session began.
    pub boot_id: String,
    /// Whether the session ended by an orderly stop.
    pub closed: bool,
    /// The session's part of the incarnation token: the `id` of the first session at this checkpoint; see
    /// [`Token`](crate::replay::Token).
    pub mark: String,
    /// The master's address, if there was one yet.
    pub master_uri: Option<String>,
    /// Wall clock time of the start as text, for people only.
    pub started: String,
    /// Number of the master's incarnation, as in its token.
    pub incarnation: u64,
    /// All pending writes up to this record have reached the master. A snapshot's pending writes have the
    /// number of its last record.
    pub delivered: u64,
    /// The port that nodes use; 0 if an earlier version wrote the session.
    pub port: u16,
    /// The last term in which this computer led several; 0 if it never did.
    pub term: u64,
    /// In that term: the number of the last record in the computers' journal in etcd whose effect this file
    /// holds. Each call that follows has the next number. Smaller, if it is not known.
    pub cluster_seq: u64,
}

/// The content of a record.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Entry {
    /// A write that was answered with success.
    Call {
        call: Call,
        /// Whether the mirror answered it before a master had run it.
        pending: bool,
    },
    /// Replaces the session.
    Session(Session),
}

impl Entry {
    /// A write that the master has run.
    pub fn call(call: Call) -> Self {
        let pending = false;
        Self::Call { call, pending }
    }
}

/// One line of the journal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    /// One more than the previous record's, across all generations of the file.
    pub seq: u64,
    pub entry: Entry,
}

/// A whole state and its place in the journal.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checkpoint {
    /// Number of the last record whose effect `snapshot` contains; 0 if there was none.
    pub seq: u64,
    pub session: Session,
    pub snapshot: Snapshot,
    /// The writes in `snapshot` that no master has run yet, in order.
    pub pending: Vec<Call>,
    /// Nodes that may not have been told to shut down.
    pub displaced: Vec<Displaced>,
}

/// A checkpoint's text, and the stamp that its records must carry.
#[derive(Debug)]
pub struct Encoded {
    /// The whole file up to its first record.
    pub bytes: Vec<u8>,
    /// Ties records to these bytes.
    pub stamp: Stamp,
}

/// Why something cannot be encoded.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum EncodeError {
    /// A value that could not be read back.
    #[error("a parameter is nested deeper than {limit} levels; it cannot be kept in a checkpoint")]
    TooDeep {
        /// [`DEPTH_MAX`].
        limit: usize,
    },
}

/// Why a file is not read.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum DecodeError {
    /// Nothing in it belongs to a checkpoint.
    #[error("not a rosrescue checkpoint")]
    NotACheckpoint,
    /// An intact file of a newer rosrescue.
    #[error("written in checkpoint format {version}; this rosrescue knows up to {known}", known = FORMAT_VERSION)]
    NewerVersion {
        /// The format in its first line.
        version: u32,
    },
}

/// Why a snapshot cannot be used.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum SnapshotError {
    /// The first line is damaged.
    #[error("the first line is damaged")]
    Header,
    /// The file ends inside the snapshot.
    #[error("the snapshot ends after {found} of {expected} bytes")]
    Truncated {
        /// Bytes according to the first line.
        expected: u64,
        found: u64,
    },
    /// The content differs from what was written.
    #[error("the snapshot's check sum is {found:08x}, not {expected:08x}")]
    Checksum { expected: u32, found: u32 },
    /// The bytes are as written, but are not a valid snapshot.
    #[error("the snapshot is whole and does not make sense: {why}")]
    Content { why: String },
}

/// A damaged place in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// In bytes from the start of the file.
    pub offset: usize,
    pub why: String,
}

/// The readable parts of a file.
#[derive(Debug)]
pub struct Decoded {
    /// The file's generation; 0 if the first line is damaged.
    pub generation: u64,
    /// The snapshot, if it is whole.
    pub checkpoint: Result<Checkpoint, SnapshotError>,
    /// The whole records in order.
    pub records: Vec<Record>,
    /// The bytes of a torn append at the end, if any.
    pub torn: Option<Range<usize>>,
    /// All other damage.
    pub damaged: Vec<Damage>,
}

/// The bytes of a new file that holds `checkpoint` and no record yet.
///
/// ```
/// use rescue_core::checkpoint::format::{self, Checkpoint, Entry, Record, Session};
///
/// let fresh = format::encode_checkpoint(&Checkpoint::default(), 1)?;
/// let entry = Entry::Session(Session::default());
/// let record = Record { seq: 1, entry };
/// let line = format::encode_record(&record, fresh.stamp)?;
///
/// let file = format::decode(&[fresh.bytes, line].concat()).expect("our own file");
/// assert_eq!(file.checkpoint, Ok(Checkpoint::default()));
/// assert_eq!(file.records, [record]);
/// # Ok::<(), format::EncodeError>(())
/// ```
///
/// # Errors
///
/// [`EncodeError::TooDeep`] for a parameter that is nested deeper than [`DEPTH_MAX`].
pub fn encode_checkpoint(checkpoint: &Checkpoint, generation: u64) -> Result<Encoded, EncodeError> {
    let body = document::write_snapshot(checkpoint)?;
    Ok(frame::frame_snapshot(&body, checkpoint.seq, generation))
}

/// The line of `record` for a file with this `stamp`, with its line feed.
///
/// # Errors
///
/// [`EncodeError::TooDeep`] for a value that is nested deeper than [`DEPTH_MAX`].
pub fn encode_record(record: &Record, stamp: Stamp) -> Result<Vec<u8>, EncodeError> {
    let mut line = Vec::with_capacity(128);
    push_body(&mut line, record.seq, &record.entry)?;
    seal(&mut line, 0, stamp);
    Ok(line)
}
