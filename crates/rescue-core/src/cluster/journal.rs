//! Records and snapshots to and from keys and values of etcd, within its limits.
//!
//! ```text
//! ROBOT/origin                        written when the journal begins; its revision identifies the journal
//! ROBOT/leader, ROBOT/alive           see `machine`
//! ROBOT/journal/N                     the records up to number N; or a reference to a blob, if they are large; or
//!                                     one to a snapshot, if record N replaced the whole state
//! ROBOT/values/blob/N/CRC/PART        a blob's records, in parts, written before the journal names them
//! ROBOT/snapshot                      a reference to the last complete snapshot: its last record, size and checksum
//! ROBOT/values/snapshot/N/CRC/PART    a snapshot of the state after record N, in the checkpoint's form
//! ```
//!
//! CRC is the checksum of the whole value. A request that the network has held up may write the parts of an earlier
//! value for the same N, and must not touch those that a reference names.

use std::ops::Range;

use thiserror::Error;

use crate::{
    checkpoint::format::{self, EncodeError, Record, RecordContent},
    cluster::merge,
};

/// Size limit of one transaction's records, in bytes. etcd refuses requests of 1.5 MiB, and one of 1 MB takes 60 ms,
/// during which nothing else is committed.
pub const BATCH_BYTES: usize = 256 << 10;
/// How many records one transaction contains at most. More are no faster.
pub const BATCH_RECORDS: usize = 2_000;
/// Size of a part of a larger value, in bytes.
const PART_BYTES: usize = 512 << 10;
/// The largest record, in bytes. etcd keeps 2 GiB by default, and a record may be in the journal and in two snapshots
/// at the same time.
pub const RECORD_BYTES_MAX: usize = 64 << 20;
/// A snapshot is due when the journal is larger than the last snapshot and than this many bytes.
const SNAPSHOT_BYTES: usize = 1 << 20;
/// A snapshot is also due at this many journal entries, because a computer that joins reads them all.
const SNAPSHOT_ENTRIES: usize = 1_000;

#[derive(Debug, Error, PartialEq)]
pub enum JournalError {
    #[error(
        "the call takes {bytes} bytes in the journal, and etcd is given {RECORD_BYTES_MAX} at most; \
         set a large parameter in parts, or give nodes a file"
    )]
    TooLarge { bytes: usize },
    #[error(transparent)]
    Encode(#[from] EncodeError),
    #[error(
        "`{key}` is not what rosrescue writes there: {why}; is another program using this prefix?"
    )]
    Damaged { key: String, why: String },
    #[error("the journal goes on with record {found} where {expected} was expected")]
    Gap { expected: u64, found: u64 },
}

impl JournalError {
    /// Whether keys of the journal are missing, or are not what rosrescue has written.
    pub fn is_damage(&self) -> bool {
        matches!(self, Self::Damaged { .. } | Self::Gap { .. })
    }
}

/// A key and its value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Put {
    pub key: String,
    pub value: Vec<u8>,
}

/// The names of all keys of a robot.
#[derive(Clone, Debug)]
pub struct Keys(String);

impl Keys {
    /// The keys of `robot`, whose name may contain slashes.
    pub fn new(robot: &str) -> Self {
        Self(format!("/{}/", robot.trim_matches('/')))
    }

    pub fn prefix(&self) -> &str {
        &self.0
    }

    pub fn leader(&self) -> String {
        format!("{}leader", self.0)
    }

    /// The key that identifies the journal; see [`View::origin`](crate::cluster::machine::View::origin).
    pub fn origin(&self) -> String {
        format!("{}origin", self.0)
    }

    pub fn alive(&self) -> String {
        format!("{}alive", self.0)
    }

    pub fn member(&self, name: &str) -> String {
        format!("{}members/{name}", self.0)
    }

    /// The entries of all computers.
    pub fn members(&self) -> Range<String> {
        // `0` follows `/` in ASCII.
        self.member("")..format!("{}members0", self.0)
    }

    pub fn journal(&self, seq: u64) -> String {
        format!("{}journal/{seq:020}", self.0)
    }

    /// All keys except parts of values.
    pub fn small(&self) -> Range<String> {
        self.0.clone()..format!("{}v", self.0)
    }

    /// As [`Self::small`], without the journal up to record `seq`.
    pub fn small_after(&self, seq: u64) -> [Range<String>; 2] {
        let all = self.small();
        [
            all.start..self.journal(0),
            self.journal(seq.saturating_add(1))..all.end,
        ]
    }

    /// The keys of the journal after record `seq`.
    pub fn journal_after(&self, seq: u64) -> Range<String> {
        self.journal(seq.saturating_add(1))..format!("{}journal0", self.0)
    }

    /// The keys to delete once there is a snapshot of the state after record `seq`: the journal before that record, and
    /// the blobs up to it. The record itself stays, because each transaction requires the journal's last entry.
    pub fn behind(&self, seq: u64) -> [Range<String>; 2] {
        let next = seq.saturating_add(1);
        [
            self.journal(0)..self.journal(seq),
            self.blob(0)..self.blob(next),
        ]
    }

    /// The keys to delete before a new journal begins: all records, values, and the snapshot.
    pub fn of_journal(&self) -> [Range<String>; 3] {
        let key = |name: &str| format!("{}{name}", self.0);
        // `0` follows `/` in ASCII.
        [
            key("journal/")..key("journal0"),
            key("snapshot")..key("snapshot\0"),
            self.values(),
        ]
    }

    /// The keys of all parts of values.
    pub fn values(&self) -> Range<String> {
        let key = |name: &str| format!("{}{name}", self.0);
        key("values/")..key("values0")
    }

    /// The number of a record that cannot be read, or not without this key, once the key is deleted. `None` for a key
    /// that is not of the journal.
    pub fn record_of(&self, key: &str) -> Option<u64> {
        if key == self.snapshot() {
            return Some(u64::MAX);
        }
        let mut names = key.strip_prefix(&self.0)?.split('/');
        match (names.next()?, names.next()?, names.next()) {
            ("journal", seq, None) => seq.parse().ok(),
            ("values", "blob", Some(seq)) => seq.parse().ok(),
            // Unlike its journal entry, a snapshot is still needed when it has replaced the journal.
            ("values", "snapshot", Some(seq)) => Some(seq.parse::<u64>().ok()?.saturating_add(1)),
            _ => None,
        }
    }

    /// The number in a journal key: its last record.
    pub fn seq_of(&self, key: &str) -> Option<u64> {
        key.strip_prefix(&self.0)?
            .strip_prefix("journal/")?
            .parse()
            .ok()
    }

    fn blob(&self, seq: u64) -> String {
        format!("{}values/blob/{seq:020}/", self.0)
    }

    pub fn snapshot(&self) -> String {
        format!("{}snapshot", self.0)
    }

    fn snapshots(&self, seq: u64) -> String {
        format!("{}values/snapshot/{seq:020}/", self.0)
    }

    /// The parts of snapshots that end before record `seq`.
    pub fn snapshots_before(&self, seq: u64) -> Range<String> {
        self.snapshots(0)..self.snapshots(seq)
    }

    /// The keys of the parts that a manifest names.
    pub fn parts(&self, manifest: &Manifest) -> Range<String> {
        let folder = manifest.folder(self);
        format!("{folder}0")..format!("{folder}:")
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Blob,
    Snapshot,
}

impl Kind {
    fn word(self) -> &'static str {
        match self {
            Self::Blob => "blob",
            Self::Snapshot => "snapshot",
        }
    }
}

/// A reference to a value that is stored in parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Manifest {
    kind: Kind,
    /// The last record that the value contains.
    pub seq: u64,
    bytes: usize,
    crc: u32,
}

impl Manifest {
    /// Whether the value is a whole state instead of records.
    pub fn is_state(&self) -> bool {
        self.kind == Kind::Snapshot
    }

    /// Splits `bytes` into parts, and returns them with the manifest, which must be written after them.
    fn split(keys: &Keys, kind: Kind, seq: u64, bytes: &[u8]) -> (Self, Vec<Put>) {
        let manifest = Self {
            kind,
            seq,
            bytes: bytes.len(),
            crc: crc32c::crc32c(bytes),
        };
        let folder = manifest.folder(keys);
        let parts = bytes
            .chunks(PART_BYTES)
            .enumerate()
            .map(|(number, part)| Put {
                key: format!("{folder}{number:06}"),
                value: part.to_vec(),
            });
        (manifest, parts.collect())
    }

    /// What the keys of all parts begin with.
    fn folder(&self, keys: &Keys) -> String {
        let of = match self.kind {
            Kind::Blob => keys.blob(self.seq),
            Kind::Snapshot => keys.snapshots(self.seq),
        };
        format!("{of}{:08x}/", self.crc)
    }

    fn text(&self) -> Vec<u8> {
        let Self {
            kind,
            seq,
            bytes,
            crc,
        } = self;
        format!("{} seq={seq} bytes={bytes} crc32c={crc:08x}\n", kind.word()).into_bytes()
    }

    /// Reads `value` as a manifest. `None` if it is something else.
    pub fn read(value: &[u8]) -> Option<Self> {
        let line = std::str::from_utf8(value).ok()?.strip_suffix('\n')?;
        let mut words = line.split(' ');
        let kind = words.next()?;
        let kind = [Kind::Blob, Kind::Snapshot]
            .into_iter()
            .find(|of| of.word() == kind)?;
        Some(Self {
            kind,
            seq: words.next()?.strip_prefix("seq=")?.parse().ok()?,
            bytes: words.next()?.strip_prefix("bytes=")?.parse().ok()?,
            crc: u32::from_str_radix(words.next()?.strip_prefix("crc32c=")?, 16).ok()?,
        })
    }

    /// Joins the value's `parts`, which are sorted by key, and checks their size and checksum.
    pub fn assemble(&self, keys: &Keys, parts: &[Vec<u8>]) -> Result<Vec<u8>, JournalError> {
        let whole = parts.concat();
        if whole.len() == self.bytes && crc32c::crc32c(&whole) == self.crc {
            return Ok(whole);
        }
        let found = whole.len();
        Err(JournalError::Damaged {
            key: keys.parts(self).start,
            why: format!(
                "{found} bytes were read of {}, or not those that were written",
                self.bytes
            ),
        })
    }
}

/// The records that one transaction adds to the journal.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct JournalBatch {
    /// How many of the given records `entry` contains.
    pub count: usize,
    pub entry: Option<Put>,
}

/// Takes as many of the first `records` as fit into one transaction.
///
/// # Errors
///
/// [`JournalError::TooLarge`] if the first record is too large for the journal. Such a call must not be run: see
/// [`check_size`].
pub fn pack(keys: &Keys, records: &[Record]) -> Result<JournalBatch, JournalError> {
    let (mut value, mut seq, mut count) = (Vec::new(), 0, 0);
    for record in records.iter().take(BATCH_RECORDS) {
        let before = value.len();
        format::push_record(&mut value, record)?;
        if count > 0 && value.len() > BATCH_BYTES {
            value.truncate(before);
            break;
        }
        (seq, count) = (record.seq, count + 1);
    }
    if count == 0 {
        return Ok(JournalBatch::default());
    }
    check_size(value.len())?;
    if value.len() > BATCH_BYTES {
        // A large record gets a transaction of its own.
        value = Manifest::split(keys, Kind::Blob, seq, &value).0.text();
    }
    let key = keys.journal(seq);
    let entry = Some(Put { key, value });
    Ok(JournalBatch { count, entry })
}

/// The parts of a large record, which must be written before its transaction, one by one. Without the transaction
/// they have no effect.
///
/// # Errors
///
/// [`JournalError::TooLarge`].
pub fn parts(keys: &Keys, record: &Record) -> Result<Vec<Put>, JournalError> {
    let mut value = Vec::new();
    format::push_record(&mut value, record)?;
    check_size(value.len())?;
    match value.len() > BATCH_BYTES {
        true => Ok(Manifest::split(keys, Kind::Blob, record.seq, &value).1),
        false => Ok(Vec::new()),
    }
}

/// Checks whether a call's record of this size fits into the journal. Must be called before the call is run.
pub fn check_size(bytes: usize) -> Result<(), JournalError> {
    match bytes > RECORD_BYTES_MAX {
        true => Err(JournalError::TooLarge { bytes }),
        false => Ok(()),
    }
}

/// Decodes the records in a value of etcd: an entry of the journal, or the joined parts of one that is too large for a
/// single value (a *blob*). Errors name `key`.
pub fn decode_records(key: &str, value: &[u8]) -> Result<Vec<Record>, JournalError> {
    format::read_records(value).map_err(|why| JournalError::Damaged {
        key: key.to_owned(),
        why,
    })
}

/// The parts of a snapshot (`bytes`, the state after record `seq`), and the value to write at [`Keys::snapshot`]
/// after them.
pub fn snapshot(keys: &Keys, seq: u64, bytes: &[u8]) -> (Vec<Put>, Put) {
    let (manifest, parts) = Manifest::split(keys, Kind::Snapshot, seq, bytes);
    let (key, value) = (keys.snapshot(), manifest.text());
    (parts, Put { key, value })
}

/// The parts of the state that replaces the whole previous state as record `seq`, and the journal entry that refers to
/// these parts.
pub fn state(keys: &Keys, seq: u64, bytes: &[u8]) -> (Vec<Put>, Put) {
    let (manifest, parts) = Manifest::split(keys, Kind::Snapshot, seq, bytes);
    let (key, value) = (keys.journal(seq), manifest.text());
    (parts, Put { key, value })
}

/// How far a mirror has followed the journal, and the journal's size.
#[derive(Clone, Copy, Debug, Default)]
pub struct Progress {
    /// The number of the last record that the mirror contains.
    pub seq: u64,
    entries: usize,
    bytes: usize,
    snapshot_bytes: usize,
}

impl Progress {
    /// The progress after a snapshot of `snapshot_bytes`, with the state after record `seq`, was read or written.
    pub fn after_snapshot(seq: u64, snapshot_bytes: usize) -> Self {
        Self {
            seq,
            snapshot_bytes,
            ..Self::default()
        }
    }

    /// Notes that the mirror follows a journal entry with these `records`, whose size is `bytes` as far as it is known.
    /// Returns the records that are new.
    ///
    /// # Errors
    ///
    /// [`JournalError::Gap`] if a record is missing before them, so that the journal must be read again.
    pub fn take(
        &mut self,
        records: Vec<Record>,
        bytes: usize,
    ) -> Result<Vec<Record>, JournalError> {
        let mut expected = self.seq + 1;
        let new: Vec<_> = records
            .into_iter()
            .filter(|record| record.seq > self.seq)
            .collect();
        for record in &new {
            let found = record.seq;
            if found != expected {
                return Err(JournalError::Gap { expected, found });
            }
            expected += 1;
        }
        if !new.is_empty() {
            self.entries += 1;
            // A leader has no entries of its own records, and the entry of a large record only names its parts.
            self.bytes += bytes.max(new.iter().map(weight).sum());
            self.seq = expected - 1;
        }
        Ok(new)
    }

    /// Notes that record `seq`, whose size is `bytes`, replaces the whole state.
    pub fn take_state(&mut self, seq: u64, bytes: usize) {
        self.entries += 1;
        self.bytes += bytes;
        self.seq = seq;
    }

    /// Notes that a snapshot of this size (`bytes`) was written. It holds the state at progress `then`, so the journal
    /// up to there no longer counts.
    pub fn snapshot_written(&mut self, then: Self, bytes: usize) {
        self.entries = self.entries.saturating_sub(then.entries);
        self.bytes = self.bytes.saturating_sub(then.bytes);
        self.snapshot_bytes = bytes;
    }

    /// Whether the leader is to write a snapshot.
    pub fn wants_snapshot(&self) -> bool {
        self.entries >= SNAPSHOT_ENTRIES || self.bytes > self.snapshot_bytes.max(SNAPSHOT_BYTES)
    }
}

/// The size of a record's values in bytes.
pub(super) fn weight(record: &Record) -> usize {
    match &record.entry {
        RecordContent::Call { call, .. } => merge::weight(call),
        RecordContent::Session(_) => 0,
    }
}

#[cfg(test)]
mod tests;
