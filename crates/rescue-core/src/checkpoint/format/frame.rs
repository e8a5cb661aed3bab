//! Adds and verifies check sums, and finds the undamaged parts of a damaged file.
//!
//! ```text
//! # rosrescue checkpoint v2 generation=G seq=S snapshot=LENGTH crc32c=C header=H
//! ...LENGTH bytes, the last line of which is `journal:`...
//! - {seq: 8,setParam: [...]} #H R
//! ```
//!
//! S is the number of the last record in the snapshot. C is the check sum of the snapshot, H that of the
//! first line before it, and R that of the record's line before it. All are CRC-32C in eight lower-case
//! hexadecimal digits. Every record repeats H, the *stamp*, so that a whole line that a disk brings back from
//! an older file is noticed.

use std::io::{BufRead, Write};
use std::ops::Range;

use super::{
    Checkpoint, Damage, Decoded, EncodeError, Encoded, FormatError, Record, RecordContent,
    SnapshotError, document,
};

/// The version of the format, the only one that this program reads and writes.
pub const FORMAT_VERSION: u32 = 2;

const MAGIC: &str = "# rosrescue checkpoint v";
/// Longest first line, in bytes.
const HEADER_BYTES_MAX: usize = 256;
/// Length of a record's check sums: ` #`, eight digits, a blank and eight digits.
const CHECK_BYTES: usize = 19;
const RECORD_START: &[u8] = b"- {seq: ";

/// Highest number of a generation (checkpoint file) or a record that is accepted from a file. Counting continues from
/// the numbers in a file, so a number near the maximum of `u64` could overflow. rosrescue never writes a number above
/// this limit.
const COUNT_MAX: u64 = u64::MAX / 2;

/// Connects a file's records to its snapshot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp(u32);

/// Adds the first line to a snapshot.
pub(super) fn frame_snapshot(snapshot: &[u8], seq: u64, generation: u64) -> Encoded {
    let crc = crc32c::crc32c(snapshot);
    let length = snapshot.len();
    let mut bytes = Vec::with_capacity(length + HEADER_BYTES_MAX);
    // This cannot fail, because it writes to a vector.
    let _ = write!(
        bytes,
        "{MAGIC}{FORMAT_VERSION} generation={generation} seq={seq} snapshot={length} \
         crc32c={crc:08x} header="
    );
    let stamp = Stamp(crc32c::crc32c(&bytes));
    let _ = writeln!(bytes, "{:08x}", stamp.0);
    bytes.extend_from_slice(snapshot);
    Encoded { bytes, stamp }
}

/// Appends the line of a record without its check sums.
pub fn push_body(out: &mut Vec<u8>, seq: u64, entry: &RecordContent) -> Result<(), EncodeError> {
    let start = out.len();
    let written = document::write_record(out, seq, entry);
    if written.is_err() {
        out.truncate(start);
    }
    written
}

/// Appends the check sums to the record that starts at `start`, and ends the line.
pub fn seal(out: &mut Vec<u8>, start: usize, stamp: Stamp) {
    out.extend_from_slice(b" #");
    push_hex(out, stamp.0);
    let crc = crc32c::crc32c(out.get(start..).unwrap_or_default());
    out.push(b' ');
    push_hex(out, crc);
    out.push(b'\n');
}

/// The stamp of records that are outside of any checkpoint file.
const NO_FILE: Stamp = Stamp(0);

/// Appends the line of a record that is outside of any checkpoint file.
pub fn push_record(out: &mut Vec<u8>, record: &Record) -> Result<(), EncodeError> {
    let start = out.len();
    push_body(out, record.seq, &record.entry)?;
    seal(out, start, NO_FILE);
    Ok(())
}

/// Reads lines that [`push_record`] has written.
///
/// # Errors
///
/// If the lines are not what was written. The text says why.
pub fn read_records(lines: &[u8]) -> Result<Vec<Record>, String> {
    let lines = lines
        .strip_suffix(b"\n")
        .ok_or("the last line is incomplete")?;
    let lines = lines.split(|byte| *byte == b'\n');
    let records = lines.map(|line| {
        let line = open_line(line).filter(|(_, stamp, _)| *stamp == NO_FILE);
        let (seq, _, body) = line.ok_or("a line is not a record, or is damaged")?;
        let body = std::str::from_utf8(body).map_err(|error| error.to_string())?;
        let entry = document::read_record(body)?;
        Ok(Record { seq, entry })
    });
    records.collect()
}

fn push_hex(out: &mut Vec<u8>, number: u32) {
    out.extend(
        (0..8)
            .rev()
            .map(|nibble| match (number >> (4 * nibble)) as u8 & 15 {
                digit @ 0..=9 => b'0' + digit,
                digit => b'a' + digit - 10,
            }),
    );
}

/// Reads exactly eight lower-case hexadecimal digits.
fn hex(digits: &[u8]) -> Option<u32> {
    let digits = <[u8; 8]>::try_from(digits).ok()?;
    digits.iter().try_fold(0, |number: u32, digit| {
        let digit = match digit {
            b'0'..=b'9' => digit - b'0',
            b'a'..=b'f' => digit - b'a' + 10,
            _ => return None,
        };
        Some(number << 4 | u32::from(digit))
    })
}

/// Reads the number of a generation (checkpoint file) or a record.
pub(super) fn count(digits: &str) -> Option<u64> {
    digits.parse().ok().filter(|count| *count <= COUNT_MAX)
}

/// The content of the first line.
#[derive(Clone, Copy, Debug)]
pub struct Header {
    pub generation: u64,
    /// The number of the last record in the snapshot.
    pub seq: u64,
    /// Length of the snapshot in bytes.
    snapshot: u64,
    crc: u32,
    stamp: Stamp,
    /// Length of the line in bytes, with its line feed.
    length: usize,
}

/// A record's line with valid check sums.
#[derive(Debug)]
pub struct Line<'a> {
    pub seq: u64,
    offset: usize,
    body: &'a [u8],
}

/// A file split into its parts. Its YAML is not parsed yet.
#[derive(Debug)]
pub struct Framed<'a> {
    pub header: Option<Header>,
    bytes: &'a [u8],
    pub lines: Vec<Line<'a>>,
    pub torn: Option<Range<usize>>,
    pub damaged: Vec<Damage>,
    /// Whether damage follows the last valid line. Then an unknown number of records may be missing.
    pub end_lost: bool,
}

/// Reads the undamaged parts of a file.
///
/// # Errors
///
/// If it is not a checkpoint of this format.
pub fn decode(bytes: &[u8]) -> Result<Decoded, FormatError> {
    let framed = scan(bytes)?;
    let checkpoint = framed.checkpoint();
    let mut damaged = framed.damaged.clone();
    let records = framed.records(0, &mut damaged);
    Ok(Decoded {
        generation: framed.header.map_or(0, |header| header.generation),
        checkpoint,
        records,
        torn: framed.torn,
        damaged,
    })
}

/// Splits a file into its parts and verifies all check sums.
///
/// # Errors
///
/// If it is not a checkpoint of this format.
pub fn scan(bytes: &[u8]) -> Result<Framed<'_>, FormatError> {
    let header = read_header(bytes)?;
    let mut framed = Framed {
        header,
        end_lost: false,
        ..Framed::unreadable(bytes)
    };
    framed.scan_lines();
    if header.is_none() && framed.lines.is_empty() && !resembles(bytes) {
        return Err(FormatError::NotACheckpoint);
    }
    Ok(framed)
}

fn read_header(bytes: &[u8]) -> Result<Option<Header>, FormatError> {
    let head = bytes
        .get(..bytes.len().min(HEADER_BYTES_MAX))
        .unwrap_or_default();
    let Some(end) = head.iter().position(|&byte| byte == b'\n') else {
        return Ok(None);
    };
    let Some((checked, digits)) = head
        .get(..end)
        .and_then(|line| line.split_last_chunk::<8>())
    else {
        return Ok(None);
    };
    let stamp = crc32c::crc32c(checked);
    if hex(digits) != Some(stamp) {
        return Ok(None);
    }
    // From here on, the line's check sum is known to be valid.
    let Some((version, fields)) = std::str::from_utf8(checked)
        .ok()
        .and_then(|line| line.strip_prefix(MAGIC)?.split_once(' '))
    else {
        return Ok(None);
    };
    match version.parse() {
        Ok(FORMAT_VERSION) => {}
        Ok(version) => return Err(FormatError::OtherVersion { version }),
        Err(_) => return Ok(None),
    }
    let field = |name: &str| {
        fields
            .split(' ')
            .find_map(|field| field.strip_prefix(name)?.strip_prefix('='))
    };
    let header = (|| {
        Some(Header {
            generation: count(field("generation")?)?,
            seq: count(field("seq")?)?,
            snapshot: field("snapshot")?.parse().ok()?,
            crc: hex(field("crc32c")?.as_bytes())?,
            stamp: Stamp(stamp),
            length: end + 1,
        })
    })();
    Ok(header)
}

/// Length of the first line and the snapshot of a file, in bytes, according to its first line. `None` if that is not
/// valid. The file's first 256 bytes are enough.
pub fn head_length(bytes: &[u8]) -> Option<u64> {
    let header = read_header(bytes).ok()??;
    header.snapshot.checked_add(header.length as u64)
}

/// Whether a file without a valid first line and without a valid record is a damaged checkpoint and not another
/// program's file. It counts as a checkpoint if it is empty, begins with zeros (as after a crash of the computer), or
/// still has most of the start of the first line or of the document.
fn resembles(bytes: &[u8]) -> bool {
    let contains = |what: &[u8]| bytes.windows(what.len()).any(|window| window == what);
    let differing = bytes
        .iter()
        .zip(MAGIC.as_bytes())
        .filter(|(a, b)| a != b)
        .count();
    differing * 4 <= bytes.len().min(MAGIC.len())
        || bytes.iter().take(HEADER_BYTES_MAX).all(|&byte| byte == 0)
        || contains(b"\nsession:\n") && contains(b"\njournal:\n")
}

impl Header {
    /// Connects the file's records to its snapshot.
    pub fn stamp(&self) -> Stamp {
        self.stamp
    }
}

impl<'a> Line<'a> {
    /// Wall clock time in the line, in milliseconds since 1970; see [`Label::at`](super::Label::at). 0 without a time.
    pub fn time(&self) -> u64 {
        time_at_end(self.body).unwrap_or(0)
    }

    /// The line without its check sums, as [`push_body`] writes it.
    pub fn body(&self) -> &'a [u8] {
        self.body
    }

    /// Whether the record is about a parameter.
    pub fn is_about_param(&self) -> bool {
        let body = std::str::from_utf8(self.body);
        body.is_ok_and(|body| body.contains("Param: ["))
    }
}

impl<'a> Framed<'a> {
    /// A file without any undamaged part.
    pub fn unreadable(bytes: &'a [u8]) -> Self {
        let (lines, damaged) = (Vec::new(), Vec::new());
        Self {
            header: None,
            bytes,
            lines,
            torn: None,
            damaged,
            end_lost: true,
        }
    }

    /// The verified snapshot.
    pub fn checkpoint(&self) -> Result<Checkpoint, SnapshotError> {
        std::str::from_utf8(self.snapshot()?)
            .map_err(|error| error.to_string())
            .and_then(document::read_snapshot)
            .map_err(|why| SnapshotError::Content { why })
    }

    /// The file's text up to its first record. Its check sums are verified, its YAML is not.
    pub fn head(&self) -> Result<&'a [u8], SnapshotError> {
        let length = self.snapshot()?.len() + self.header.map_or(0, |header| header.length);
        Ok(self.bytes.get(..length).unwrap_or_default())
    }

    /// The file's text with only those records that `keeps` is true for.
    ///
    /// # Errors
    ///
    /// If there is no usable snapshot.
    pub fn thinned(
        &self,
        mut keeps: impl FnMut(&Line<'_>) -> bool,
    ) -> Result<Vec<u8>, SnapshotError> {
        let mut text = self.head()?.to_vec();
        for line in self.lines.iter().filter(|line| keeps(line)) {
            let end = line.offset + line.body.len() + CHECK_BYTES + 1;
            text.extend_from_slice(self.bytes.get(line.offset..end).unwrap_or_default());
        }
        Ok(text)
    }

    /// Wall clock time of the snapshot, in milliseconds since 1970; see [`Session::at`](super::Session::at). 0 without a
    /// time.
    pub fn taken_at(&self) -> u64 {
        let head = self.head().ok().and_then(|it| std::str::from_utf8(it).ok());
        let session = head.and_then(|head| head.split("\nnodes:").next());
        let at = session.and_then(|session| session.rsplit_once("\n  at: "));
        at.and_then(|(_, at)| at.lines().next()?.parse().ok())
            .unwrap_or(0)
    }

    /// The text of the verified snapshot.
    fn snapshot(&self) -> Result<&'a [u8], SnapshotError> {
        let header = self.header.ok_or(SnapshotError::Header)?;
        let behind = self.bytes.get(header.length..).unwrap_or_default();
        let snapshot = usize::try_from(header.snapshot)
            .ok()
            .and_then(|length| behind.get(..length))
            .ok_or(SnapshotError::Truncated {
                expected: header.snapshot,
                found: behind.len() as u64,
            })?;
        let found = crc32c::crc32c(snapshot);
        if found != header.crc {
            return Err(SnapshotError::Checksum {
                expected: header.crc,
                found,
            });
        }
        Ok(snapshot)
    }

    /// The records with numbers above `after`. A line with valid check sums and invalid content is added to `damaged`.
    pub fn records(&self, after: u64, damaged: &mut Vec<Damage>) -> Vec<Record> {
        let lines = self.lines.iter().filter(|line| line.seq > after);
        lines
            .filter_map(|line| {
                let entry = std::str::from_utf8(line.body)
                    .map_err(|error| error.to_string())
                    .and_then(document::read_record);
                match entry {
                    Ok(entry) => Some(Record {
                        seq: line.seq,
                        entry,
                    }),
                    Err(why) => {
                        let why = format!("record {} is not valid: {why}", line.seq);
                        damaged.push(Damage {
                            offset: line.offset,
                            why,
                        });
                        None
                    }
                }
            })
            .collect()
    }

    /// Finds the valid lines of the journal, and describes the damage of the others. If the first line is damaged, it
    /// is unknown where the journal starts. All lines are searched in that case. This is safe, because no line of a
    /// snapshot looks like a record.
    fn scan_lines(&mut self) {
        let start = match self.header {
            Some(header) => usize::try_from(header.snapshot)
                .map_or(usize::MAX, |length| length.saturating_add(header.length)),
            None => 0,
        };
        let mut stamp = self.header.map(|header| header.stamp);
        let mut offset = start;
        // Where the bytes after the last valid line start, and whether they look like an incomplete append.
        let mut tail: Option<(usize, bool)> = None;
        let mut tail_damage: Vec<Damage> = Vec::new();
        let mut rest = self.bytes.get(start..).unwrap_or_default();
        while !rest.is_empty() {
            let at = offset;
            // This cannot fail, because it reads from memory. It is the fastest way to find the line's end.
            let line_length = (&mut &*rest).skip_until(b'\n').unwrap_or(rest.len());
            let (line, behind) = rest.split_at(line_length);
            (rest, offset) = (behind, offset + line_length);
            let complete = line.last() == Some(&b'\n');
            let text = line.strip_suffix(b"\n").unwrap_or(line);
            let journal = self.header.is_some() || !self.lines.is_empty();
            if !journal && !text.starts_with(RECORD_START) {
                continue;
            }
            let before = self.lines.last().map(|line| line.seq);
            let before = before.or_else(|| self.header.map(|header| header.seq));
            let problem = match open_line(text) {
                Some((seq, mark, body))
                    if stamp.is_none_or(|stamp| stamp == mark)
                        && before.is_none_or(|before| before < seq) =>
                {
                    stamp = Some(mark);
                    self.lines.push(Line {
                        seq,
                        offset: at,
                        body,
                    });
                    self.damaged.append(&mut tail_damage);
                    tail = None;
                    continue;
                }
                Some((seq, ..)) => (format!("record {seq} belongs to an earlier file"), true),
                None if complete && !text.contains(&0) => {
                    ("a record's check sum does not match".to_owned(), false)
                }
                None => ("a record is incomplete".to_owned(), true),
            };
            let (why, unwritten) = problem;
            tail_damage.push(Damage { offset: at, why });
            let (from, all) = tail.unwrap_or((at, true));
            tail = Some((from, all && unwritten));
        }
        match tail {
            Some((from, true)) => self.torn = Some(from..self.bytes.len()),
            Some((_, false)) => {
                self.damaged.append(&mut tail_damage);
                self.end_lost = true;
            }
            None => {}
        }
    }
}

/// The time at the end of a record's line, before its origin. Such a text cannot be inside of a value, because a line
/// without a label ends in `]` or `true`.
fn time_at_end(body: &[u8]) -> Option<u64> {
    let text = std::str::from_utf8(body).ok()?;
    let text = text.trim_end_matches('}');
    let text = match text.ends_with('"') {
        true => text.rsplit_once(", from: ")?.0,
        false => text,
    };
    let (before, digits) = text.rsplit_once(": ")?;
    let is_time = [",t", " at"].iter().any(|key| before.ends_with(key));
    is_time.then(|| digits.parse().ok()).flatten()
}

/// Number, stamp and body of a line with valid check sums.
fn open_line(line: &[u8]) -> Option<(u64, Stamp, &[u8])> {
    let (checked, digits) = line.split_last_chunk::<8>()?;
    let checked = checked.strip_suffix(b" ")?;
    if hex(digits)? != crc32c::crc32c(checked) {
        return None;
    }
    let body_end = line.len().checked_sub(CHECK_BYTES)?;
    let (body, mark) = checked.split_at_checked(body_end)?;
    let stamp = Stamp(hex(mark.strip_prefix(b" #")?)?);
    let rest = body.strip_prefix(RECORD_START)?;
    let digits = rest.split(|&byte| byte == b',').next()?;
    let seq = count(std::str::from_utf8(digits).ok()?)?;
    Some((seq, stamp, body))
}
