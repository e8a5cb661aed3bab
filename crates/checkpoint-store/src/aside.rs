//! Keeps files under other names: damaged ones, those found at the path, and ended sessions.

use std::io;
use std::path::{Path, PathBuf};

use super::generation::{append_all, failed};
use super::names::previous;
use super::storage::FileId;
use super::{BROKEN, Loaded, Names, Storage, Store, StoreError};

impl<S: Storage> Store<S> {
    /// Renames the present file to `PATH.REASON-NUMBER`, so that it does not affect the next one. Its previous
    /// generation is removed, or renamed too if the file lacks anything. Nothing can be recorded before the next [`begin`](Self::begin). Returns the
    /// file's new path, if there was a file.
    ///
    /// # Errors
    ///
    /// If they cannot be renamed: they may still be at their old names.
    pub fn set_aside(&mut self, reason: &str) -> Result<Option<PathBuf>, StoreError> {
        self.active = None;
        self.overtake();
        self.unprotected = Some("its file has been set aside".to_owned());
        // Then it has all that the previous generation has.
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
            // The previous generation first: if it stayed alone it could be restored.
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
}

impl<S: Storage> Store<S> {
    /// Moves the file at `fresh` to the path. A file that is there is kept under another name, unless it is
    /// known: it is already kept as the `previous` generation, or is ours and useless.
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
}

/// Keeps a damaged file, and notes under which name.
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

/// Whether the file was there.
fn if_there(done: io::Result<()>) -> io::Result<bool> {
    match done {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}
