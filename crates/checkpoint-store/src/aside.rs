//! The checkpoint's path and lock, and the files that are kept under other names: damaged files, foreign files at the
//! path, and files of ended sessions.

use std::io;
use std::path::{Path, PathBuf};

use super::generation::{append_all, failed};
use super::names::previous;
use super::storage::FileId;
use super::{BROKEN, Loaded, Names, OpenError, Storage, StoreError, open_failed};

/// The file at the checkpoint's path, as this store has read or written it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Present {
    pub(super) id: FileId,
    /// False if the file may lack records of the previous generation, which it must not replace in that case.
    pub(super) usable: bool,
}

/// The checkpoint's path, its lock, and the file that is there.
pub(super) struct LockedPath<S: Storage> {
    pub(super) storage: S,
    pub(super) names: Names,
    /// The file at the path, as this store has read or written it. Any other file there is kept under another name
    /// before it is replaced.
    pub(super) present: Option<Present>,
    /// Part of the name under which the next foreign file is kept.
    pub(super) aside_kind: &'static str,
    /// The name under which the last foreign file was kept.
    pub(super) kept: Option<PathBuf>,
    lock: S::Lock,
    pub(super) lock_id: FileId,
}

impl<S: Storage> LockedPath<S> {
    /// Locks `path` without reading the file there.
    pub(super) fn lock(storage: S, path: &Path) -> Result<Self, OpenError> {
        let path = storage
            .locate(path)
            .map_err(open_failed("create the folder of", path))?;
        let names = Names { path };
        let lock_path = names.lock();
        let lock = storage
            .lock(&names.path, &lock_path)
            .map_err(open_failed("lock", &lock_path))?
            .map_err(|holder| OpenError::Locked {
                path: names.path.clone(),
                holder,
            })?;
        let lock_id = storage
            .lock_id(&lock)
            .map_err(open_failed("lock", &lock_path))?;
        Ok(Self {
            storage,
            names,
            present: None,
            aside_kind: BROKEN,
            kept: None,
            lock,
            lock_id,
        })
    }

    /// Renames the present file; see [`Store::set_aside`](super::Store::set_aside).
    pub(super) fn set_aside(&mut self, reason: &str) -> Result<Option<PathBuf>, StoreError> {
        // A usable file contains everything that the previous generation contains.
        let whole = self.present.take().is_some_and(|present| present.usable);
        let kind: String = reason
            .chars()
            .map(|letter| {
                if letter.is_ascii_alphanumeric() {
                    letter
                } else {
                    '-'
                }
            })
            .collect();
        let (storage, path) = (&self.storage, &self.names.path);
        let moved = self.names.aside(storage, &kind).and_then(|aside| {
            // The previous generation is moved first. If it stayed, a later start could restore it.
            let before = self.names.previous();
            match whole {
                true => if_there(storage.remove(&before))?,
                false => if_there(storage.rename(&before, &previous(&aside)))?,
            };
            let moved = if_there(storage.rename(path, &aside))?;
            storage.sync_dir(self.names.folder())?;
            Ok(moved.then_some(aside))
        });
        moved.map_err(failed("set aside", path))
    }

    /// Moves the file at `fresh` to the checkpoint's path. If a file is already at that path, renames it first. Does
    /// not rename it if it is the `previous` generation, which is kept already, or an unusable file of this store.
    pub(super) fn take_path(&mut self, fresh: &Path, previous: Option<FileId>) -> io::Result<()> {
        let (storage, path) = (&self.storage, &self.names.path);
        let there = storage.id_at(path)?;
        let useless = self.present.filter(|present| !present.usable);
        let useless = useless.map(|present| present.id);
        if there.is_none() || there == previous || there == useless {
            return storage.rename(fresh, path);
        }
        let aside = self.names.aside(storage, self.aside_kind)?;
        storage.replace(fresh, path, &aside)?;
        self.aside_kind = BROKEN;
        self.kept = Some(aside);
        Ok(())
    }

    /// Makes sure that the lock at the path is held, before anything is written there.
    pub(super) fn hold_lock(&mut self) -> Result<(), StoreError> {
        let path = self.names.lock();
        let renewed = self.storage.renew_lock(&mut self.lock, &path);
        let renewed = renewed.and_then(|renewed| {
            self.lock_id = self.storage.lock_id(&self.lock)?;
            Ok(renewed)
        });
        match renewed {
            Ok(Ok(())) => Ok(()),
            Ok(Err(holder)) => Err(StoreError::Taken {
                path: self.names.path.clone(),
                holder,
            }),
            Err(error) => Err(failed("lock", &path)(error)),
        }
    }
}

/// Keeps a copy of a damaged file and of an incomplete append, and adds the names of the copies to the texts in
/// `loaded`.
pub(super) fn keep_aside(
    storage: &impl Storage,
    names: &Names,
    loaded: &mut Loaded,
    torn: Option<Vec<u8>>,
) -> io::Result<()> {
    if let (Some(bytes), Some(sentence)) = (torn, &mut loaded.torn) {
        let aside = names.aside(storage, "torn")?;
        let file = storage.create(&aside)?;
        append_all(storage, &file, &bytes)?;
        sentence.push_str(&format!("; they are kept as `{}`", aside.display()));
    }
    if !loaded.damage.is_empty() {
        let aside = names.aside(storage, BROKEN)?;
        storage.link(&names.path, &aside)?;
        loaded
            .damage
            .push(format!("the damaged file is kept as `{}`", aside.display()));
    }
    Ok(())
}

pub(super) fn set_aside_previous(
    storage: &impl Storage,
    names: &Names,
    kind: &str,
) -> io::Result<()> {
    let previous = names.previous();
    let aside = names.aside(storage, kind)?;
    if_there(storage.rename(&previous, &aside)).map(|_| ())
}

/// Turns a "not found" error into `false`.
fn if_there(done: io::Result<()>) -> io::Result<bool> {
    match done {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}
