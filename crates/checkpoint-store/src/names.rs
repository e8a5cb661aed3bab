//! The names of the files beside a checkpoint.

use std::io;
use std::path::{Path, PathBuf};

use super::{Storage, StoreError};

/// Number of files of one kind to keep. Older ones are removed, so that daily starts do not fill the disk.
const ASIDE_MAX: usize = 10;

/// The paths of a checkpoint and of the files beside it, such as the lock file. All are in one folder.
#[derive(Clone, Debug)]
pub(super) struct Names {
    pub(super) path: PathBuf,
}

impl Names {
    fn with(&self, suffix: &str) -> PathBuf {
        with(&self.path, suffix)
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
            Some((closed.unwrap_or(number).parse().ok()?, closed.is_some()))
        };
        let mut parts: Vec<_> = self.endings(storage)?.iter().filter_map(part).collect();
        parts.sort_unstable();
        Ok(parts)
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

    /// The numbers of the files named `PATH.KIND-NUMBER`, lowest first.
    pub(super) fn numbers(&self, storage: &impl Storage, kind: &str) -> io::Result<Vec<u64>> {
        let number = |ending: &String| {
            ending
                .strip_prefix(kind)?
                .strip_prefix('-')?
                .parse::<u64>()
                .ok()
        };
        let mut numbers: Vec<u64> = self.endings(storage)?.iter().filter_map(number).collect();
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
        let number = found.last().copied().unwrap_or(0).saturating_add(1);
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
            .filter(|ending| ending.ends_with(".new"))
        {
            storage.remove(&self.with(&format!(".{ending}")))?;
        }
        Ok(())
    }
}

/// The name of the previous generation: the file that the one at `path` has replaced.
pub(super) fn previous(path: &Path) -> PathBuf {
    with(path, ".previous")
}

pub(super) fn with(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}
