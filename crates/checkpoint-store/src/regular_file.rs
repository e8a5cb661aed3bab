//! Opens regular files safely in folders that other users may write to. No function waits for the other end of a pipe.
//! A file for writing is never opened through a symbolic link, and never has a second hard link.
//!
//! Another user can plant a file in such a folder. A file counts as *ours* if no other user than this process's, root
//! or the folder's owner can have made it. The owner of a folder can replace every file in it anyway, and `sudo
//! rosrescue log` must be able to read a robot's files.

use std::{
    fs::{self, File, Metadata, OpenOptions},
    io::{self, Read},
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

/// Largest file of options, a password or the like, in bytes.
const SMALL: u64 = 1 << 20;

/// Reads a small text from a file that the operator has named, which may also be a pipe.
///
/// # Errors
///
/// If the file cannot be read, is not UTF-8, or has more than 1 MiB.
pub fn read_small(path: &Path) -> io::Result<String> {
    let mut text = String::new();
    let mut file = File::open(path)?.take(SMALL + 1);
    file.read_to_string(&mut text)?;
    match text.len() as u64 > SMALL {
        true => Err(io::Error::other("it has more than 1 MiB")),
        false => Ok(text),
    }
}

/// Opens a file of ours at `path` for reading, such as a file beside the checkpoint.
///
/// # Errors
///
/// If the file cannot be opened, is a symbolic link or another irregular file, or belongs to another user.
pub fn open_ours(path: &Path) -> io::Result<File> {
    let flags = OFlags::NONBLOCK | OFlags::NOFOLLOW;
    let file = with(OpenOptions::new().read(true), flags)
        .open(path)
        .map_err(name_link)?;
    check_ours(path, &file.metadata()?).map(|()| file)
}

/// The length of the file of ours at `path`, in bytes.
///
/// # Errors
///
/// The errors of [`open_ours`].
pub fn length_of_ours(path: &Path) -> io::Result<u64> {
    let metadata = fs::symlink_metadata(path)?;
    check_ours(path, &metadata).map(|()| metadata.len())
}

/// Opens the file of ours at `path` for reading and writing, or creates it with access for its owner only.
/// Keeps existing content.
///
/// # Errors
///
/// The errors of [`open_ours`], or if the file has several hard links.
pub fn open_or_create(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.mode(0o600).read(true).write(true).create(true);
    let flags = OFlags::NONBLOCK | OFlags::NOFOLLOW;
    let file = with(&mut options, flags).open(path).map_err(name_link)?;
    check_ours(path, &file.metadata()?)?;
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

/// Checks the file at `path` with this `metadata`.
fn check_ours(path: &Path, metadata: &Metadata) -> io::Result<()> {
    if metadata.is_symlink() {
        return Err(io::Error::other(LINK));
    }
    if !metadata.is_file() {
        return Err(irregular());
    }
    let folder = match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    let own = rustix::process::geteuid().as_raw();
    let owner = metadata.uid();
    if owner == own || owner == 0 || owner == fs::metadata(folder)?.uid() {
        return Ok(());
    }
    Err(io::Error::other(format!(
        "it belongs to another user (number {owner})"
    )))
}

/// Names the reason if a symbolic link could not be opened.
fn name_link(error: io::Error) -> io::Error {
    match error.raw_os_error() == Some(rustix::io::Errno::LOOP.raw_os_error()) {
        true => io::Error::other(LINK),
        false => error,
    }
}

const LINK: &str = "it is a symbolic link";

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
        for name in ["link", "fifo"] {
            assert!(open_ours(&path(name)).is_err(), "{name}");
            assert!(length_of_ours(&path(name)).is_err(), "{name}");
        }
        let error = open_ours(&path("link")).unwrap_err();
        assert_eq!(error.to_string(), LINK);
        assert_eq!(length_of_ours(&path("target")).unwrap(), 4);
        assert!(open(&path("link")).is_ok());
        // One of the two names is removed. The content remains under the other.
        create(&path("second")).unwrap().write_all(b"new").unwrap();
        assert_eq!(fs::read_to_string(path("target")).unwrap(), "kept");
        assert_eq!(fs::read_to_string(path("second")).unwrap(), "new");
    }

    #[test]
    fn a_file_of_another_user_is_not_ours_unless_the_folder_is_his() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        fs::write(&path, "planted").unwrap();
        let other = Some(12_345);
        if std::os::unix::fs::chown(&path, other, None).is_err() {
            // Only root can give a file away.
            return;
        }
        let error = open_ours(&path).unwrap_err();
        assert_eq!(
            error.to_string(),
            "it belongs to another user (number 12345)"
        );
        assert!(open_or_create(&path).is_err());
        assert!(length_of_ours(&path).is_err());
        assert!(open(&path).is_ok());
        std::os::unix::fs::chown(folder.path(), other, None).unwrap();
        assert!(open_ours(&path).is_ok());
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
