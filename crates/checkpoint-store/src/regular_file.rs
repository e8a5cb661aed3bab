//! Opens regular files safely in folders that other users may write to. No function waits for the other end of a pipe.
//! A file for writing is never opened through a symbolic link, and never has a second hard link.

use std::{
    fs::{self, File, OpenOptions},
    io,
    os::unix::fs::{MetadataExt, OpenOptionsExt},
    path::Path,
};

use rustix::fs::OFlags;

/// Opens the regular file at `path` for reading. Follows symbolic links.
///
/// # Errors
///
/// If the file cannot be opened, or is not a regular file.
pub fn open(path: &Path) -> io::Result<File> {
    let file = with(OpenOptions::new().read(true), OFlags::NONBLOCK).open(path)?;
    check(&file).map(|_| file)
}

/// Opens the file at `path` for reading and writing, or creates it with access for its owner only.
/// Keeps existing content.
///
/// # Errors
///
/// If the file cannot be opened, is a symbolic link, is not a regular file, or has several hard
/// links.
pub fn open_or_create(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.mode(0o600).read(true).write(true).create(true);
    let flags = OFlags::NONBLOCK | OFlags::NOFOLLOW;
    let file = match with(&mut options, flags).open(path) {
        Err(error) if error.raw_os_error() == Some(rustix::io::Errno::LOOP.raw_os_error()) => {
            return Err(io::Error::other("it is a symbolic link"));
        }
        opened => opened?,
    };
    match check(&file)? {
        0 | 1 => Ok(file),
        _ => Err(io::Error::other("the file has another hard link")),
    }
}

/// Creates an empty file at `path` for reading and appending, with access for its owner only.
/// Replaces a regular file that is there.
///
/// # Errors
///
/// If the file cannot be created, or another kind of file is there.
pub fn create(path: &Path) -> io::Result<File> {
    match fs::symlink_metadata(path) {
        Ok(present) if present.is_file() => fs::remove_file(path)?,
        Ok(_) => return Err(irregular()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => return Err(error),
    }
    // O_EXCL: fails if another process has created something there meanwhile.
    let mut options = OpenOptions::new();
    options.read(true).append(true).create_new(true);
    options.mode(0o600).open(path)
}

fn with(options: &mut OpenOptions, flags: OFlags) -> &mut OpenOptions {
    options.custom_flags(flags.bits().cast_signed())
}

/// Number of hard links of a regular file.
fn check(file: &File) -> io::Result<u64> {
    let metadata = file.metadata()?;
    match metadata.is_file() {
        true => Ok(metadata.nlink()),
        false => Err(irregular()),
    }
}

fn irregular() -> io::Error {
    io::Error::other("it is not a regular file")
}

#[cfg(test)]
mod tests {
    use std::{io::Write, os::unix::fs::symlink};

    use rustix::fs::{CWD, FileType, Mode, mknodat};

    use super::*;

    #[test]
    fn what_was_planted_is_refused_at_once_and_stays_as_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        fs::write(path("target"), "kept").unwrap();
        symlink(path("target"), path("link")).unwrap();
        fs::hard_link(path("target"), path("second")).unwrap();
        let fifo = path("fifo");
        mknodat(CWD, &fifo, FileType::Fifo, Mode::from_raw_mode(0o600), 0).unwrap();
        for name in ["link", "fifo"] {
            assert!(create(&path(name)).is_err(), "{name}");
        }
        for name in ["link", "fifo", "second"] {
            assert!(open_or_create(&path(name)).is_err(), "{name}");
        }
        assert!(open(&fifo).is_err());
        assert!(open(&path("link")).is_ok());
        // One of the two names is removed. The content remains under the other.
        create(&path("second")).unwrap().write_all(b"new").unwrap();
        assert_eq!(fs::read_to_string(path("target")).unwrap(), "kept");
        assert_eq!(fs::read_to_string(path("second")).unwrap(), "new");
    }

    #[test]
    fn a_file_of_ours_is_replaced_or_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        create(&path).unwrap().write_all(b"old").unwrap();
        open_or_create(&path).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        create(&path).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "");
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o777, 0o600);
    }
}
