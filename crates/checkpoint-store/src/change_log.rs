//! The log of changes: the records of replaced generations, for people who ask what changed and when.
//!
//! The log consists of numbered *parts* beside the checkpoint. Each is a checkpoint file: a snapshot, and after it the
//! records of as many generations as follow without a gap. The last part grows as `PATH.log-N`. When it is large, or
//! when a generation does not follow, it is compressed to `PATH.log-N.gz`, and a new part begins.
//!
//! Nothing depends on the log. It is written by the job that writes a new generation, in the background, and a failure
//! only leaves records out of the log. It is not synced, except for a compressed part before it replaces the other one.

use std::collections::{BTreeSet, HashMap};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use flate2::{Compression, read::MultiGzDecoder, write::GzEncoder};

use super::generation::append_all;
use super::load::FILE_BYTES_MAX;
use super::names::previous;
use super::{Disk, Names, Storage};
use rescue_core::checkpoint::{
    change_log::{self, Moment, Span},
    format::{self, Framed, Stamp},
};

/// Size of the records for which a new part begins, in bytes.
const PART_BYTES_MAX: u64 = 1 << 20;
/// Maximum size of the first line and the snapshot of a part, in bytes.
const SNAPSHOT_BYTES_MAX: u64 = 64 << 20;
/// Maximum size of the records in a part, in bytes. One generation can have more than [`PART_BYTES_MAX`].
const RECORDS_BYTES_MAX: u64 = 64 << 20;
/// How many bytes of a compressed part are looked at first. They contain the first line.
const FIRST_BYTES: u64 = 4096;
/// A part has at most this fraction of the log's space, so that the oldest can be removed.
const PARTS_MIN: u64 = 8;

/// Writes the log.
pub(super) struct LogKeeper<S: Storage> {
    /// Maximum size of the log in bytes. 0 keeps none.
    pub(super) bytes_max: u64,
    part: Option<OpenPart<S>>,
    /// Generations whose snapshot does not follow from the records before it.
    breaks: BTreeSet<u64>,
    /// Why records are missing. Reported once.
    pub(super) trouble: Option<String>,
}

/// The part that grows.
struct OpenPart<S: Storage> {
    file: S::File,
    stamp: Stamp,
    /// Number of the last record in the part.
    last: u64,
    /// Size of the records in the part, in bytes.
    bytes: u64,
}

impl<S: Storage> Default for LogKeeper<S> {
    fn default() -> Self {
        Self {
            bytes_max: 0,
            part: None,
            breaks: BTreeSet::new(),
            trouble: None,
        }
    }
}

pub(super) fn locked<S: Storage>(log: &Mutex<LogKeeper<S>>) -> MutexGuard<'_, LogKeeper<S>> {
    // After a panic the part may lack records. A gap begins a new part.
    log.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<S: Storage> LogKeeper<S> {
    /// Notes that the snapshot of this generation does not follow from the records before it.
    pub(super) fn breaks_at(&mut self, generation: u64) {
        if self.bytes_max > 0 {
            self.breaks.insert(generation);
        }
    }

    /// Adds the records of the generation at `path` that the log lacks. A failure leaves them out.
    pub(super) fn archive(&mut self, storage: &S, names: &Names, path: &Path) {
        if self.bytes_max == 0 {
            return;
        }
        if let Err(error) = self.try_archive(storage, names, path)
            && error.kind() != io::ErrorKind::NotFound
        {
            self.part = None;
            let path = path.display();
            self.trouble = Some(format!("cannot add the records of `{path}`: {error}"));
        }
    }

    fn try_archive(&mut self, storage: &S, names: &Names, path: &Path) -> io::Result<()> {
        let bytes = names.read(storage, path)?;
        let framed = format::scan(&bytes).map_err(io::Error::other)?;
        let Some(header) = framed.header else {
            return Ok(());
        };
        let breaks = self.breaks.contains(&header.generation);
        self.breaks = self.breaks.split_off(&header.generation);
        let full = self.bytes_max.min(PARTS_MIN * PART_BYTES_MAX) / PARTS_MIN;
        let follows = |part: &OpenPart<S>| header.seq <= part.last && part.bytes < full;
        let part = match self.part.take().filter(|part| !breaks && follows(part)) {
            Some(part) => Some(part),
            None => self.begin(storage, names, &framed)?,
        };
        // The same generation may come again with more records.
        self.breaks.remove(&header.generation);
        self.part = part.map(|part| part.add(storage, &framed)).transpose()?;
        self.trim(storage, names)
    }

    /// Begins a new part with the snapshot of `framed`. `None` if there is no usable snapshot, or not enough space.
    fn begin(
        &mut self,
        storage: &S,
        names: &Names,
        framed: &Framed<'_>,
    ) -> io::Result<Option<OpenPart<S>>> {
        let (Some(header), Ok(head)) = (framed.header, framed.head()) else {
            return Ok(None);
        };
        let parts = names.log_parts(storage)?;
        for &(number, closed) in &parts {
            if !closed && let Err(error) = close(storage, names, number) {
                // The part stays as it is, and can be read.
                let path = names.log_part(number);
                let path = path.display();
                self.trouble = Some(format!("cannot compress `{path}`: {error}"));
            }
        }
        if head.len() as u64 > SNAPSHOT_BYTES_MAX.min(self.bytes_max / 2) {
            return Ok(None);
        }
        let last = parts.last().map_or(0, |(number, _)| *number);
        let number = names.next_log_part(storage, last)?;
        let file = storage.create(&names.log_part(number))?;
        append_all(storage, &file, head)?;
        Ok(Some(OpenPart {
            file,
            stamp: header.stamp(),
            last: header.seq,
            bytes: 0,
        }))
    }

    /// Removes the oldest parts until the others fit.
    fn trim(&mut self, storage: &S, names: &Names) -> io::Result<()> {
        let mut total: u64 = 0;
        for (number, closed) in names.log_parts(storage)?.into_iter().rev() {
            let path = names.log_part_at(number, closed);
            total = total.saturating_add(storage.length_at(&path)?);
            if total > self.bytes_max {
                storage.remove(&path)?;
                if !closed {
                    self.part = None;
                }
            }
        }
        Ok(())
    }

    /// Removes the whole log. Returns whether that made room.
    pub(super) fn remove(&mut self, storage: &S, names: &Names) -> bool {
        if self.bytes_max == 0 {
            return false;
        }
        self.part = None;
        let parts = names.log_parts(storage).unwrap_or_default().into_iter();
        let mut removed = parts.filter(|(number, closed)| {
            storage.remove(&names.log_part_at(*number, *closed)).is_ok()
        });
        let any = removed.next().is_some();
        removed.for_each(drop);
        if any {
            self.trouble = Some("removed the log, because the disk is full".to_owned());
        }
        any
    }
}

impl<S: Storage> OpenPart<S> {
    /// Adds those records of `framed` that follow the last record of this part of the log, up to the first gap in their
    /// numbers, or until the part is full.
    fn add(mut self, storage: &S, framed: &Framed<'_>) -> io::Result<Self> {
        let mut lines = Vec::new();
        let mut last = self.last;
        for line in &framed.lines {
            let size = self.bytes + (lines.len() + line.body().len()) as u64;
            if line.seq == last + 1 && size < RECORDS_BYTES_MAX {
                let start = lines.len();
                lines.extend_from_slice(line.body());
                format::seal(&mut lines, start, self.stamp);
                last = line.seq;
            }
        }
        append_all(storage, &self.file, &lines)?;
        self.last = last;
        self.bytes += lines.len() as u64;
        Ok(self)
    }
}

/// Compresses a part that no longer grows.
fn close(storage: &impl Storage, names: &Names, number: u64) -> io::Result<()> {
    let (open, closed) = (names.log_part(number), names.closed_log_part(number));
    // What others have planted under the name of the compressed file is replaced.
    if storage.length_at(&closed).is_err() {
        let bytes = storage.read(&open, SNAPSHOT_BYTES_MAX + RECORDS_BYTES_MAX)?;
        let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
        encoder.write_all(&bytes)?;
        let packed = encoder.finish()?;
        // If a crash leaves this file, the next start removes it.
        let fresh = super::names::beside(&closed, ".new");
        let file = storage.create(&fresh)?;
        append_all(storage, &file, &packed)
            .and_then(|()| storage.sync(&file))
            .and_then(|()| storage.rename(&fresh, &closed))
            .inspect_err(|_| drop(storage.remove(&fresh)))?;
    }
    storage.remove(&open)
}

/// A file that has a part of the history of a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogFile {
    pub path: PathBuf,
    content: Content,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Content {
    Checkpoint,
    PreviousGeneration,
    /// A part of the log.
    Part {
        closed: bool,
    },
    /// The file is named like a part, but others have planted or renamed it.
    Foreign,
}

impl LogFile {
    /// Reads and decompresses the file: a checkpoint with a snapshot and records.
    ///
    /// # Errors
    ///
    /// If it cannot be read or decompressed, or is a planted file.
    pub fn read(&self) -> io::Result<Vec<u8>> {
        self.read_on(&Disk)
    }

    pub(super) fn read_on(&self, storage: &impl Storage) -> io::Result<Vec<u8>> {
        let part_max = SNAPSHOT_BYTES_MAX + RECORDS_BYTES_MAX;
        match self.content {
            Content::Checkpoint => storage.read_named(&self.path, FILE_BYTES_MAX),
            Content::PreviousGeneration => storage.read(&self.path, FILE_BYTES_MAX),
            Content::Part { closed: false } => storage.read(&self.path, part_max),
            Content::Part { closed: true } => decompress(&storage.read(&self.path, part_max)?),
            Content::Foreign => {
                // Names the reason if it is about the file and not about its number.
                storage.length_at(&self.path)?;
                Err(io::Error::other("no part of the log has such a number"))
            }
        }
    }
}

/// Decompresses a closed part of the log. Stops as soon as the part is larger than its first line allows.
///
/// # Errors
///
/// If `bytes` are not such a part.
pub fn decompress(bytes: &[u8]) -> io::Result<Vec<u8>> {
    let mut decoder = MultiGzDecoder::new(bytes);
    let mut text = Vec::new();
    decoder.by_ref().take(FIRST_BYTES).read_to_end(&mut text)?;
    if text.is_empty() {
        // A crash came before the first line.
        return Ok(text);
    }
    let head = format::head_length(&text).filter(|head| *head <= SNAPSHOT_BYTES_MAX);
    let Some(head) = head else {
        return Err(io::Error::other("it is not a part of the log"));
    };
    let limit = head + RECORDS_BYTES_MAX;
    decoder
        .take(limit.saturating_sub(FIRST_BYTES))
        .read_to_end(&mut text)?;
    match text.len() as u64 >= limit {
        true => Err(io::Error::other(
            "it is not a part of the log: it is too large",
        )),
        false => Ok(text),
    }
}

/// Lists the files that together have the history of the checkpoint at `path`, oldest first: the parts of the log, the
/// previous generation, and the checkpoint itself. Their records may overlap. Links in `path` must be resolved. Planted
/// files that only have the name of a part are among them; reading one fails and says why.
///
/// # Errors
///
/// If the folder cannot be read.
pub fn files(path: &Path) -> io::Result<Vec<LogFile>> {
    let names = Names {
        path: path.to_owned(),
    };
    files_on(&Disk, &names)
}

pub(super) fn files_on(storage: &impl Storage, names: &Names) -> io::Result<Vec<LogFile>> {
    let parts = names.log_parts(storage)?;
    let foreign = names.false_log_parts(storage)?.into_iter();
    let mut numbered: Vec<_> = foreign
        .map(|(number, path)| {
            let content = Content::Foreign;
            (number, LogFile { path, content })
        })
        .collect();
    // After a crash, a part may be there in both forms.
    let is_twice = |number: u64, closed: bool| !closed && parts.contains(&(number, true));
    let parts = parts
        .iter()
        .filter(|(number, closed)| !is_twice(*number, *closed));
    numbered.extend(parts.map(|&(number, closed)| {
        let path = names.log_part_at(number, closed);
        let content = Content::Part { closed };
        (number, LogFile { path, content })
    }));
    numbered.sort_by_key(|(number, _)| *number);
    let mut files: Vec<_> = numbered.into_iter().map(|(_, file)| file).collect();
    files.push(LogFile {
        path: previous(&names.path),
        content: Content::PreviousGeneration,
    });
    files.push(LogFile {
        path: names.path.clone(),
        content: Content::Checkpoint,
    });
    Ok(files)
}

/// A state of the history, and the file from which it was rebuilt.
#[derive(Debug)]
pub struct PastState {
    pub path: PathBuf,
    /// Size of the file in bytes, decompressed.
    pub bytes: u64,
    pub moment: Moment,
    /// Why later files could not be used, one sentence each.
    pub unread: Vec<String>,
    /// Whether records after this state have the time of the state or an earlier one: the clock was set back.
    pub is_set_back: bool,
}

/// The times in compressed parts that were read before. Such a part never changes.
#[derive(Debug, Default)]
pub struct KnownTimes(HashMap<PathBuf, Span>);

/// Why there is no state of a time.
#[derive(Debug, thiserror::Error)]
pub enum NoPast {
    #[error("cannot read the folder of the log: {0}")]
    Folder(#[from] io::Error),
    /// The whole history is later. The files that could not be used have one sentence each.
    #[error("there is no state of this time or an earlier one")]
    Later(Vec<String>),
}

/// Rebuilds the state that the history of the checkpoint at `path` had at `time`, in milliseconds since 1970: before the
/// first record with a later time. Links in `path` must be resolved.
///
/// # Errors
///
/// If there is no usable state of that time.
pub fn past_state(path: &Path, time: u64, known: &mut KnownTimes) -> Result<PastState, NoPast> {
    let files = files(path)?;
    known
        .0
        .retain(|path, _| files.iter().any(|file| file.path == *path));
    let mut found: Option<PastState> = None;
    // Why files after the one in `found` could not be used.
    let mut unread = Vec::new();
    let mut is_over = false;
    for file in files {
        match read_past(&file, time, is_over, known) {
            Ok((span, state)) => {
                if let Some(state) = state {
                    unread.clear();
                    found = Some(state);
                } else if let Some(found) = &mut found
                    && span.earliest <= time
                {
                    let seq = found.moment.seq;
                    let is_set_back = || {
                        let text = file.read().unwrap_or_default();
                        change_log::is_set_back_after(&text, seq, time)
                    };
                    found.is_set_back |= span.snapshot_seq >= seq || is_set_back();
                }
                is_over |= span.latest > time;
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) if !is_over => {
                let shown = file.path.display();
                unread.push(format!("cannot use `{shown}`: {error}"));
            }
            Err(_) => {}
        }
    }
    match found {
        Some(found) => Ok(PastState { unread, ..found }),
        None => Err(NoPast::Later(unread)),
    }
}

/// Reads the times in `file`, and its state at `time` if the history before it is not later (`is_over`).
fn read_past(
    file: &LogFile,
    time: u64,
    is_over: bool,
    known: &mut KnownTimes,
) -> io::Result<(Span, Option<PastState>)> {
    let is_fixed = file.content == Content::Part { closed: true };
    let mut text = None;
    let span = match known.0.get(&file.path).filter(|_| is_fixed) {
        Some(span) => *span,
        None => change_log::span(text.insert(file.read()?)).map_err(io::Error::other)?,
    };
    if is_fixed {
        known.0.insert(file.path.clone(), span);
    }
    if is_over {
        return Ok((span, None));
    }
    let text = match text {
        Some(text) => text,
        None => file.read()?,
    };
    let moment = change_log::moment(&text, time).map_err(io::Error::other)?;
    let state = moment.map(|moment| PastState {
        bytes: text.len() as u64,
        path: file.path.clone(),
        is_set_back: moment.is_set_back,
        moment,
        unread: Vec::new(),
    });
    Ok((span, state))
}

/// The time at which the history of the checkpoint at `path` begins, in milliseconds since 1970. `None` if it is unknown.
pub fn oldest(path: &Path) -> Option<u64> {
    let files = files(path).ok()?.into_iter();
    let mut times = files.filter_map(|file| {
        let text = file.read().ok()?;
        Some(format::scan(&text).ok()?.taken_at()).filter(|at| *at > 0)
    });
    times.next()
}
