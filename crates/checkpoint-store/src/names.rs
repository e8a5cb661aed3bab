//! The names of the files beside a checkpoint.

use std::io;
use std::path::{Path, PathBuf};

use super::load::FILE_BYTES_MAX;
use super::{BROKEN, Storage, StoreError};

/// Number of files of one kind to keep. Older ones are removed, so that daily starts do not fill the disk.
const ASIDE_MAX: usize = 10;

/// Highest number in the name of a file beside the checkpoint. Counting continues from the numbers that are there, so a
/// planted number must not be near the end of a type. No robot gets this far: that takes a part of the log per second
/// for 30 years.
const NUMBER_MAX: u64 = 999_999_999;

/// The paths of a checkpoint and of the files beside it, such as the lock file. All are in one folder.
#[derive(Clone, Debug)]
pub(super) struct Names {
    pub(super) path: PathBuf,
}

impl Names {
    fn with(&self, suffix: &str) -> PathBuf {
        beside(&self.path, suffix)
    }

    pub(super) fn lock(&self) -> PathBuf {
        self.with(".lock")
    }

    pub(super) fn previous(&self) -> PathBuf {
        previous(&self.path)
    }

    pub(super) fn fresh(&self, generation: u64) -> PathBuf {
        self.numbered("new", generation)
    }

    /// The file of part `number` of the log while it grows.
    pub(super) fn log_part(&self, number: u64) -> PathBuf {
        self.numbered("log", number)
    }

    /// The compressed file of part `number` of the log.
    pub(super) fn closed_log_part(&self, number: u64) -> PathBuf {
        self.with(&format!(".log-{number}.gz"))
    }

    /// The parts of the log, oldest first: the number of each, and whether it is compressed.
    pub(super) fn log_parts(&self, storage: &impl Storage) -> io::Result<Vec<(u64, bool)>> {
        let part = |ending: &String| {
            let number = ending.strip_prefix("log-")?;
            let closed = number.strip_suffix(".gz");
            Some((number_in(closed.unwrap_or(number))?, closed.is_some()))
        };
        let mut parts: Vec<_> = self.endings(storage)?.iter().filter_map(part).collect();
        parts.retain(|(number, closed)| is_ours(storage, &self.log_part_at(*number, *closed)));
        parts.sort_unstable();
        Ok(parts)
    }

    /// Files that are named like a part of the log but cannot be one: others have planted or renamed them. With the
    /// number of each, or 0 if it cannot be.
    pub(super) fn false_log_parts(
        &self,
        storage: &impl Storage,
    ) -> io::Result<Vec<(u64, PathBuf)>> {
        let foreign = |ending: &String| {
            let name = ending.strip_prefix("log-")?;
            let digits = name.strip_suffix(".gz").unwrap_or(name);
            let is_number = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
            let path = self.with(&format!(".{ending}"));
            let number = number_in(digits);
            let is_part = number.is_some() && is_ours(storage, &path);
            (is_number && !is_part).then(|| (number.unwrap_or(0), path))
        };
        Ok(self.endings(storage)?.iter().filter_map(foreign).collect())
    }

    /// The file of part `number` of the log, compressed or not.
    pub(super) fn log_part_at(&self, number: u64, closed: bool) -> PathBuf {
        match closed {
            true => self.closed_log_part(number),
            false => self.log_part(number),
        }
    }

    /// The number of the next part of the log. Leaves out numbers that others have planted.
    ///
    /// # Errors
    ///
    /// If the last part has the highest possible number.
    pub(super) fn next_log_part(&self, storage: &impl Storage, last: u64) -> io::Result<u64> {
        self.next_number(storage, last, |number| {
            vec![self.log_part(number), self.closed_log_part(number)]
        })
    }

    /// The first number after `last` whose file names are free.
    fn next_number(
        &self,
        storage: &impl Storage,
        last: u64,
        files: impl Fn(u64) -> Vec<PathBuf>,
    ) -> io::Result<u64> {
        for number in last.saturating_add(1)..=NUMBER_MAX {
            let mut is_free = true;
            for file in files(number) {
                is_free &= storage.id_at(&file)?.is_none();
            }
            if is_free {
                return Ok(number);
            }
        }
        let path = self.path.display();
        Err(io::Error::other(format!(
            "a file beside `{path}` has the highest possible number, {NUMBER_MAX}; remove it"
        )))
    }

    /// Reads the checkpoint itself or a file beside it.
    pub(super) fn read(&self, storage: &impl Storage, path: &Path) -> io::Result<Vec<u8>> {
        match path == self.path {
            true => storage.read_named(path, FILE_BYTES_MAX),
            false => storage.read(path, FILE_BYTES_MAX),
        }
    }

    pub(super) fn superseded(&self) -> StoreError {
        let path = self.path.clone();
        StoreError::Overtaken { path }
    }

    pub(super) fn folder(&self) -> &Path {
        self.path.parent().unwrap_or_else(|| Path::new("/"))
    }

    /// For each name in the folder that starts with the checkpoint's name and a dot: the rest of the name.
    fn endings(&self, storage: &impl Storage) -> io::Result<Vec<String>> {
        let stem = self.path.file_name().unwrap_or_default().to_string_lossy() + ".";
        let names = storage.list(self.folder())?.into_iter();
        Ok(names
            .filter_map(|name| name.strip_prefix(&*stem).map(str::to_owned))
            .collect())
    }

    /// The numbers of our files named `PATH.KIND-NUMBER`, lowest first.
    pub(super) fn numbers(&self, storage: &impl Storage, kind: &str) -> io::Result<Vec<u64>> {
        let number = |ending: &String| number_in(ending.strip_prefix(kind)?.strip_prefix('-')?);
        let mut numbers: Vec<u64> = self.endings(storage)?.iter().filter_map(number).collect();
        numbers.retain(|number| is_ours(storage, &self.numbered(kind, *number)));
        numbers.sort_unstable();
        Ok(numbers)
    }

    pub(super) fn numbered(&self, kind: &str, number: u64) -> PathBuf {
        self.with(&format!(".{kind}-{number}"))
    }

    /// A new name `PATH.KIND-NUMBER` for a file. Removes surplus old files of this kind. Names contain numbers and not
    /// dates, because the clock may be wrong.
    pub(super) fn aside(&self, storage: &impl Storage, kind: &str) -> io::Result<PathBuf> {
        let found = self.numbers(storage, kind)?;
        let surplus = (found.len() + 1).saturating_sub(ASIDE_MAX);
        for number in found.iter().take(surplus) {
            // A failed removal must not prevent the new file.
            let path = self.numbered(kind, *number);
            let _ = storage.remove(&path);
            let _ = storage.remove(&previous(&path));
        }
        let last = found.last().copied().unwrap_or(0);
        let number = self.next_number(storage, last, |number| vec![self.numbered(kind, number)])?;
        Ok(self.numbered(kind, number))
    }

    /// Removes unfinished files that a crash left behind: new generations, and files that were being renamed.
    pub(super) fn remove_unfinished(&self, storage: &impl Storage) -> io::Result<()> {
        for generation in self.numbers(storage, "new")? {
            storage.remove(&self.fresh(generation))?;
        }
        for ending in self
            .endings(storage)?
            .iter()
            .filter(|ending| is_unfinished(ending))
        {
            storage.remove(&self.with(&format!(".{ending}")))?;
        }
        Ok(())
    }
}

/// Whether rosrescue gives a file the name `PATH.ENDING` until it is complete. Any other `PATH.….new` belongs to another
/// program.
fn is_unfinished(ending: &str) -> bool {
    let Some(complete) = ending.strip_suffix(".new") else {
        return false;
    };
    match complete.split_once('-') {
        None => ["previous", "report"].contains(&complete),
        Some(("log", number)) => number.strip_suffix(".gz").and_then(number_in).is_some(),
        Some((kind, number)) => [BROKEN, "rescue"].contains(&kind) && number_in(number).is_some(),
    }
}

/// The number that `digits` are as rosrescue writes it.
fn number_in(digits: &str) -> Option<u64> {
    let number = digits.parse::<u64>().ok()?;
    (number <= NUMBER_MAX && number.to_string() == digits).then_some(number)
}

fn is_ours(storage: &impl Storage, path: &Path) -> bool {
    storage.length_at(path).is_ok()
}

/// The name of the previous generation: the file that the one at `path` has replaced.
pub(super) fn previous(path: &Path) -> PathBuf {
    beside(path, ".previous")
}

/// The path of the file beside `path` whose name also has this `suffix`.
pub fn beside(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}
