//! The names of the files beside a checkpoint: one place makes them all.

use std::io;
use std::path::{Path, PathBuf};

use super::Storage;

/// Files of one kind that are kept; older ones are removed, so that a robot that is switched on
/// every morning does not fill its disk.
const ASIDE_MAX: usize = 10;

/// A checkpoint's path and those of its companions, all in one folder.
#[derive(Clone, Debug)]
pub(super) struct Names {
    pub(super) path: PathBuf,
}

impl Names {
    fn with(&self, suffix: &str) -> PathBuf {
        let mut name = self.path.as_os_str().to_owned();
        name.push(suffix);
        PathBuf::from(name)
    }

    pub(super) fn lock(&self) -> PathBuf {
        self.with(".lock")
    }

    pub(super) fn previous(&self) -> PathBuf {
        self.with(".previous")
    }

    pub(super) fn fresh(&self, generation: u64) -> PathBuf {
        self.with(&format!(".new-{generation}"))
    }

    pub(super) fn folder(&self) -> &Path {
        self.path.parent().unwrap_or_else(|| Path::new("/"))
    }

    /// The numbers and names of the files called `PATH.KIND-NUMBER`, lowest first.
    fn numbered(&self, storage: &impl Storage, kind: &str) -> io::Result<Vec<(u64, PathBuf)>> {
        let stem = self
            .path
            .file_name()
            .and_then(|name| name.to_str())
            .unwrap_or_default();
        let start = format!("{stem}.{kind}-");
        let mut found: Vec<_> = storage
            .list(self.folder())?
            .into_iter()
            .filter_map(|name| {
                let number = name.strip_prefix(&start)?.parse().ok()?;
                Some((number, self.folder().join(name)))
            })
            .collect();
        found.sort_unstable();
        Ok(found)
    }

    /// A name for a file of this kind that none has yet. Numbered: the clock may be anywhere.
    /// Makes room for it.
    pub(super) fn aside(&self, storage: &impl Storage, kind: &str) -> io::Result<PathBuf> {
        let found = self.numbered(storage, kind)?;
        let number = found
            .last()
            .map_or(0, |(number, _)| *number)
            .saturating_add(1);
        let surplus = (found.len() + 1).saturating_sub(ASIDE_MAX);
        for (_, old) in found.iter().take(surplus) {
            storage.remove(old)?;
        }
        Ok(self.with(&format!(".{kind}-{number}")))
    }

    /// Removes new generations that a crash left unfinished.
    pub(super) fn remove_unfinished(&self, storage: &impl Storage) -> io::Result<()> {
        for (_, path) in self.numbered(storage, "new")? {
            storage.remove(&path)?;
        }
        Ok(())
    }
}
