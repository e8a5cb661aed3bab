//! Keeps files under other names: damaged files, foreign files at the checkpoint's path, and files of ended sessions.

use std::io;
use std::path::{Path, PathBuf};

use super::generation::{append_all, failed};
use super::names::previous;
use super::storage::FileId;
use super::{BROKEN, Loaded, Names, Storage, Store, StoreError};

impl<S: Storage> Store<S> {
    /// Renames the present file to `PATH.REASON-NUMBER`, so that it does not affect the next session. Removes the
    /// previous generation, or renames it too if the present file may lack records. Afterwards nothing can be recorded
    /// before the next [`begin`](Self::begin). Returns the new path, if there was a file.
    ///
    /// # Errors
    ///
    /// If the files cannot be renamed. They may then still have their old names.
    pub fn set_aside(&mut self, reason: &str) -> Result<Option<PathBuf>, StoreError> {
        self.active = None;
        self.overtake();
        self.unprotected = Some("its file has been set aside".to_owned());
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
}

impl<S: Storage> Store<S> {
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
