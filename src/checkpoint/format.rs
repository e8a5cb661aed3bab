//! The checkpoint's text: what a file holds, to and from bytes. Pure; the file itself is
//! [`store`](crate::checkpoint::store)'s.
//!
//! A checkpoint is one YAML document: a first line (a comment) that frames and guards the snapshot,
//! the snapshot in block style, and a last key `journal:` under which every appended line is one
//! [`Record`] in flow style. `docs/checkpoint.md` describes the format for people.
//!
//! * `emit`: values to YAML that YAML 1.1 and 1.2 readers take alike.
//! * `yaml`: YAML to values, on the events of serde-saphyr's parser.
//! * `frame`: the first line, the records' check sums, and what of a damaged file is whole.
//! * `document`: which value stands under which key.

mod document;
mod emit;
mod frame;
#[cfg(test)]
mod tests;
mod yaml;

use std::ops::Range;

use thiserror::Error;

use crate::master::Snapshot;
use crate::xmlrpc::Call;

pub use frame::{FORMAT_VERSION, Stamp, decode};
pub(crate) use frame::{Framed, push_body, scan, seal};

/// Levels of nesting that can be written and read back: those of the deepest value of a call
/// (`xmlrpc` takes 512) below a parameter path of half as many names. rosmaster itself cannot return
/// a value deeper than 492 levels.
pub const DEPTH_MAX: usize = 768;

/// What a restart needs to know to tell whether the robot's run goes on.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Session {
    /// Names the run; the `run_id` of roslaunch.
    pub id: String,
    /// The kernel's boot id when the session began.
    pub boot_id: String,
    /// Whether the session ended by an orderly stop.
    pub closed: bool,
    /// The caller id that marks the incarnation of the master.
    pub mark: String,
    /// Where the master was, if there was one yet.
    pub master_uri: Option<String>,
    /// Wall clock time of the start as text, for people only.
    pub started: String,
    /// Number of the master's incarnation, which its token bears.
    pub incarnation: u64,
    /// All pending writes up to this record have reached the master. A snapshot's pending writes
    /// count as of the snapshot's last record.
    pub delivered: u64,
}

/// What one record says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Entry {
    /// A write that was answered with success.
    Call {
        call: Call,
        /// Whether the mirror answered it and no master had run it yet.
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
    /// Its number: one more than that of the record before, over all generations of the file.
    pub seq: u64,
    pub entry: Entry,
}

/// A whole state, and where in the journal it stands.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checkpoint {
    /// Number of the last record whose effect `snapshot` contains; 0 if there was none.
    pub seq: u64,
    pub session: Session,
    /// The master's state.
    pub snapshot: Snapshot,
    /// Those of the writes in `snapshot` that no master has run yet, in order.
    pub pending: Vec<Call>,
}

/// A checkpoint's text, and the stamp that its records must carry.
#[derive(Debug)]
pub struct Encoded {
    /// The whole file before its first record.
    pub bytes: Vec<u8>,
    /// Ties records to these bytes.
    pub stamp: Stamp,
}

/// Why something cannot be written.
#[derive(Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum EncodeError {
    /// A value that could not be read back.
    #[error("a parameter is nested deeper than {limit} levels; it cannot be kept in a checkpoint")]
    TooDeep {
        /// [`DEPTH_MAX`].
        limit: usize,
    },
}

/// Why a file is not for us to read.
#[derive(Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum DecodeError {
    /// Neither the first line nor anything else in it is ours.
    #[error("not a rosrescue checkpoint")]
    NotACheckpoint,
    /// An intact file of a later rosrescue.
    #[error("written in checkpoint format {version}; this rosrescue knows up to {known}", known = FORMAT_VERSION)]
    NewerVersion {
        /// The format that its first line names.
        version: u32,
    },
}

/// Why a snapshot cannot be used.
#[derive(Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum SnapshotError {
    /// The first line is not as it was written.
    #[error("the first line is damaged")]
    Header,
    /// The file ends inside the snapshot.
    #[error("the snapshot ends after {found} of {expected} bytes")]
    Truncated {
        /// Bytes according to the first line.
        expected: u64,
        found: u64,
    },
    /// Some byte differs.
    #[error("the snapshot's check sum is {found:08x}, not {expected:08x}")]
    Checksum {
        /// According to the first line.
        expected: u32,
        found: u32,
    },
    /// The bytes are those that were written, and yet do not make a snapshot.
    #[error("the snapshot is whole and does not make sense: {why}")]
    Content {
        /// What is wrong.
        why: String,
    },
}

/// A place in a file that is not as it was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// Where, in bytes from the start of the file.
    pub offset: usize,
    /// What is wrong there.
    pub why: String,
}

/// All that could be read of a file.
#[derive(Debug)]
pub struct Decoded {
    /// Counts the rewritings of the file; 0 if the first line is damaged.
    pub generation: u64,
    /// The snapshot, if it is whole.
    pub checkpoint: Result<Checkpoint, SnapshotError>,
    /// The whole records in order.
    pub records: Vec<Record>,
    /// The bytes at the end of an append that was cut short, if it was.
    pub torn: Option<Range<usize>>,
    /// Everything else that is wrong.
    pub damaged: Vec<Damage>,
}

/// The bytes of a fresh file that holds `checkpoint` and no record yet.
///
/// ```
/// use rosrescue::checkpoint::format::{self, Checkpoint, Entry, Record, Session};
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

/// The line of `record` in the file whose stamp is `stamp`, its line feed included.
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
