//! Converts a checkpoint to and from text. The crate `checkpoint-store` reads and writes the file.
//!
//! A checkpoint is one YAML document: a first line (a comment) with lengths and check sums, the snapshot in
//! block style, and as its last key `journal:`, under which each appended line is one [`Record`] in flow
//! style. `docs/checkpoint.md` describes the format for readers.
//!
//! * `emit` converts values to YAML that YAML 1.1 and YAML 1.2 readers read alike.
//! * `yaml` converts YAML to values, from the events of serde-saphyr's parser.
//! * `frame` handles the first line and the check sums, and finds the undamaged parts of a damaged file.
//! * `document` defines which value stands under which key.

mod document;
mod emit;
mod frame;
mod rosparam;
#[cfg(test)]
mod tests;
mod yaml;

use std::net::{IpAddr, Ipv4Addr};
use std::ops::Range;

use thiserror::Error;

use ros1_master::master::{Displaced, Master, Request, Snapshot};

pub use frame::{FORMAT_VERSION, Stamp, decode};
pub use frame::{Framed, Line, head_length, push_body, push_record, read_records, scan, seal};
pub use rosparam::{for_rosparam, shown};

/// Deepest nesting that can be written and read back: the deepest value of a call (`xmlrpc` accepts 512 levels) below a
/// parameter path with half as many names. rosmaster itself cannot return a value deeper than 492 levels.
pub const DEPTH_MAX: usize = 768;

/// The facts from which a restart decides whether the session continues.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Session {
    /// Identifies the session. This is also roslaunch's `run_id`.
    pub id: String,
    /// The boot id of the kernel when the session began.
    pub boot_id: String,
    /// Whether the session ended with a clean stop.
    pub closed: bool,
    /// Identifies the masters of this checkpoint, as a part of the [`Token`](crate::replay::Token) that rosrescue
    /// leaves in each of them. It is the `id` of the first session at this checkpoint.
    pub mark: String,
    /// The master's address, if there has been a master.
    pub master_uri: Option<String>,
    /// Wall clock time of the start as text, for human readers only.
    pub started: String,
    /// The number of the present master process, as in its [`Token`](crate::replay::Token).
    pub incarnation: u64,
    /// Number of the record up to which all pending writes have reached the master.
    pub delivered: u64,
    /// The injection that has been begun last, if it is not known to have ended.
    pub announced: Option<Announced>,
    /// The port that nodes use.
    pub port: u16,
    /// With several computers: the term of the last leader whose journal this computer had read to its end, or of its own
    /// last leadership. 0 if there was none.
    pub term: u64,
    /// With several computers: the number of etcd's journal of `term`. 0 if it is unknown.
    pub cluster_journal: u64,
    /// With several computers: number of the last record in etcd's journal of `term` that this file contains. Each call
    /// that follows in this file has the next number. 0 if it is unknown, so that what is counted from it is too low.
    pub cluster_seq: u64,
    /// Wall clock time at which this was written, in milliseconds since 1970. It is a label, like [`Label::at`].
    pub at: u64,
}

impl Session {
    /// The highest number of a record that this names, or 0.
    pub fn last_seq(&self) -> u64 {
        let announced = self.announced.map_or(0, |it| it.at);
        self.delivered.max(announced)
    }
}

/// An injection that has been begun: a master with the token of `incarnation` holds the state as of record `at`. Other
/// masters lack what they lacked before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Announced {
    /// The number in the [`Token`](crate::replay::Token) that this master gets.
    pub incarnation: u64,
    /// The number of a record.
    pub at: u64,
}

/// A write that the mirror has answered and that no master is known to have run.
#[derive(Clone, Debug, PartialEq)]
pub struct PendingWrite {
    /// The number of its record.
    pub seq: u64,
    pub call: Request,
}

/// When a record was made, and who made the call. For people only: the order of records is that of their numbers, and
/// the clock may jump.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Label {
    /// Wall clock time in milliseconds since 1970. 0 if it is unknown. Without a time, no origin is recorded.
    pub at: u64,
    pub origin: Origin,
}

/// Who made a recorded call.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Origin {
    /// The caller is unknown: the call stands for a change that was noticed in the master.
    #[default]
    Unknown,
    /// rosrescue itself, for example its health check.
    Rosrescue,
    /// A program at this address, or on the computer with this address.
    At(IpAddr),
}

impl Origin {
    /// The origin whose records name none, because most calls come from this computer.
    const COMMON: Self = Self::At(IpAddr::V4(Ipv4Addr::LOCALHOST));

    /// The other computer from which the call came. `None` for this one, and if it is unknown.
    pub fn other_computer(self) -> Option<IpAddr> {
        match self {
            Self::At(address) => Some(address).filter(|address| !address.is_loopback()),
            Self::Unknown | Self::Rosrescue => None,
        }
    }

    /// Notes in `state` from where the nodes of `call`, which has been applied, have registered. What rosrescue
    /// registers for a node does not tell.
    pub fn note_in(self, state: &mut Master, call: &Request) {
        if let Self::At(_) = self {
            state.note_origin(call, self.other_computer());
        }
    }
}

/// The content of a record.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RecordContent {
    /// A write that was answered with success.
    Call {
        call: Request,
        /// Whether the mirror answered the write before a master had run it.
        pending: bool,
        label: Label,
    },
    /// New facts about the session, which replace the previous ones.
    Session(Box<Session>),
}

impl RecordContent {
    /// A write that a master has run, without a label.
    pub fn call(call: Request) -> Self {
        Self::labelled(call, Label::default())
    }

    /// A write that a master has run.
    pub fn labelled(call: Request, label: Label) -> Self {
        Self::Call {
            call,
            pending: false,
            label,
        }
    }
}

/// A line of the journal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    /// The number of the record. It grows by one with each record, also when a new file replaces the old one.
    pub seq: u64,
    pub entry: RecordContent,
}

/// A whole state and its position in the journal.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checkpoint {
    /// Number of the last record in `snapshot`. 0 if there was none.
    pub seq: u64,
    pub session: Session,
    pub snapshot: Snapshot,
    /// The writes in `snapshot` that no master has run yet, in order.
    pub pending: Vec<PendingWrite>,
    /// Nodes that must shut down because another node has taken their name. Some of them may not have been told yet.
    pub displaced: Vec<Displaced>,
    /// Whether the state is exactly what the records before it give. False after a change without a record. Not written
    /// to the file.
    pub follows: bool,
}

/// The text of a checkpoint, and the stamp for its records.
#[derive(Debug)]
pub struct Encoded {
    /// The whole file up to its first record.
    pub bytes: Vec<u8>,
    /// Connects the records that follow to these bytes.
    pub stamp: Stamp,
}

/// Why a state or a record cannot be encoded.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum EncodeError {
    /// A value is nested too deeply to be read back.
    #[error("a parameter is nested deeper than {limit} levels; it cannot be kept in a checkpoint")]
    TooDeep {
        /// The deepest nesting allowed: [`DEPTH_MAX`].
        limit: usize,
    },
}

/// Why a file cannot be read.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum FormatError {
    /// No part of the file belongs to a checkpoint.
    #[error("not a rosrescue checkpoint")]
    NotACheckpoint,
    /// A rosrescue with another format wrote the file, which is undamaged.
    #[error("written in checkpoint format {version}; this rosrescue reads format {known}", known = FORMAT_VERSION)]
    OtherVersion {
        /// The format version in its first line.
        version: u32,
    },
}

/// Why the snapshot of a file cannot be used.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum SnapshotError {
    /// The first line is damaged.
    #[error("the first line is damaged")]
    Header,
    /// The file ends inside the snapshot.
    #[error("the snapshot ends after {found} of {expected} bytes")]
    Truncated {
        /// Number of bytes according to the first line.
        expected: u64,
        found: u64,
    },
    /// The content is not what was written.
    #[error("the snapshot's check sum is {found:08x}, not {expected:08x}")]
    Checksum { expected: u32, found: u32 },
    /// The content is what was written, but not a valid snapshot.
    #[error("the snapshot is complete but not valid: {why}")]
    Content { why: String },
}

/// A damaged place in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// Position in bytes from the start of the file.
    pub offset: usize,
    pub why: String,
}

/// The readable parts of a file.
#[derive(Debug)]
pub struct Decoded {
    /// The number of this file among all that were written at its path. 0 if the first line is damaged.
    pub generation: u64,
    /// The snapshot, or why it cannot be used.
    pub checkpoint: Result<Checkpoint, SnapshotError>,
    /// The undamaged records, in order.
    pub records: Vec<Record>,
    /// The position of an incomplete append at the end.
    pub torn: Option<Range<usize>>,
    /// All other damage.
    pub damaged: Vec<Damage>,
}

/// Encodes a new file that holds `checkpoint` and no records yet.
///
/// ```
/// use rescue_core::checkpoint::format::{self, Checkpoint, Record, RecordContent, Session};
///
/// let fresh = format::encode_checkpoint(&Checkpoint::default(), 1)?;
/// let entry = RecordContent::Session(Box::default());
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

/// Encodes `record` as a line for a file with this `stamp`, including the line feed.
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
