//! The disk operations of the store, and their implementation for a real disk.

use std::fs::{self, File, Metadata, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{CWD, RenameFlags};
use rustix::io::Errno;

use super::lock::{self, DiskLock};
use super::names::beside;
use crate::regular_file;

/// Identifies a file independently of its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileId {
    pub device: u64,
    pub inode: u64,
}

impl FileId {
    pub(super) fn from_metadata(metadata: &Metadata) -> Self {
        Self {
            device: metadata.dev(),
            inode: metadata.ino(),
        }
    }

    /// The id of the file at `path`, if there is one. A broken link counts as a file.
    pub(super) fn at(path: &Path) -> io::Result<Option<Self>> {
        match fs::metadata(path).or_else(|_| fs::symlink_metadata(path)) {
            Ok(metadata) => Ok(Some(Self::from_metadata(&metadata))),
            Err(error) if is_absence(&error) => Ok(None),
            Err(error) => Err(error),
        }
    }
}

fn is_absence(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::NotFound | io::ErrorKind::NotADirectory
    )
}

/// The properties of a file that show whether another process has written to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileStatus {
    pub id: FileId,
    pub length: u64,
    /// Time of the last write, in nanoseconds. It is only compared with other values of this field.
    pub modified: i128,
}

/// The disk operations that a checkpoint needs. `append` makes one `write(2)`. Names are complete paths in one folder.
/// Contents are durable after `sync`, names after `sync_dir`.
pub trait Storage: Clone + Send + Sync + 'static {
    type File: Send + Sync + 'static;
    type Lock: Send + 'static;

    /// Creates the folder of `path` if needed, and returns the file's real path.
    fn locate(&self, path: &Path) -> io::Result<PathBuf>;
    /// Takes the lock of `checkpoint`, and writes this process's id to the lock file at `path`. If another process has
    /// the lock, returns the id of that process as an inner error, if known.
    fn lock(&self, checkpoint: &Path, path: &Path) -> io::Result<Result<Self::Lock, Option<u32>>>;
    /// Makes a new lock file at `path` and locks it, unless the locked file is still there. Creates the folder if
    /// needed. If another process has the lock, returns the id of that process as an inner error, if known.
    fn renew_lock(&self, lock: &mut Self::Lock, path: &Path)
    -> io::Result<Result<(), Option<u32>>>;
    /// The id of the lock file.
    fn lock_id(&self, lock: &Self::Lock) -> io::Result<FileId>;
    /// Reads the whole content of the file at `path`. A file of more than `limit` bytes is an error, as is one that is
    /// not a regular file of [ours](crate::regular_file).
    fn read(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>>;
    /// Does the same for a regular file that the operator has named, with any owner.
    fn read_named(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        self.read(path, limit)
    }
    /// Creates an empty file, readable and writable for its owner only. Replaces an existing one.
    fn create(&self, path: &Path) -> io::Result<Self::File>;
    /// Writes at the end of the file, and returns how many bytes were written.
    fn append(&self, file: &Self::File, bytes: &[u8]) -> io::Result<usize>;
    /// Waits until the content is durable.
    fn sync(&self, file: &Self::File) -> io::Result<()>;
    /// Renames `from` to `to`. Replaces an existing file atomically.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Makes a hard link `to` to the file `from`, and returns `true`. If the file system has no hard links, makes a
    /// copy and returns `false`. Replaces an existing file atomically.
    fn link(&self, from: &Path, to: &Path) -> io::Result<bool>;
    /// Renames `from` to `path`, and the file that was at `path` to `aside`, an unused name.
    fn replace(&self, from: &Path, path: &Path, aside: &Path) -> io::Result<()>;
    fn status(&self, file: &Self::File) -> io::Result<FileStatus>;
    /// The length of the file at `path`, in bytes. A file that is not a regular file of [ours](crate::regular_file) is
    /// an error.
    fn length_at(&self, path: &Path) -> io::Result<u64>;
    /// The id of the file at `path`, if there is one.
    fn id_at(&self, path: &Path) -> io::Result<Option<FileId>>;
    /// The CRC-32C of the first `length` bytes of the file at `path`.
    fn checksum(&self, path: &Path, length: u64) -> io::Result<u32>;
    fn remove(&self, path: &Path) -> io::Result<()>;
    /// Waits until the names in `folder` are durable.
    fn sync_dir(&self, folder: &Path) -> io::Result<()>;
    /// The names of all files in `folder`. Bytes that are not UTF-8 are replaced.
    fn list(&self, folder: &Path) -> io::Result<Vec<String>>;
}

#[derive(Clone, Copy, Debug, Default)]
pub struct Disk;

/// Maximum number of symbolic links that Linux follows for one path.
const SYMLINKS_MAX: usize = 40;

impl Disk {
    fn private() -> OpenOptions {
        let mut options = OpenOptions::new();
        options.mode(0o600);
        options
    }
}

fn read_all(file: &File, limit: u64) -> io::Result<Vec<u8>> {
    let too_large = || io::Error::other("it is larger than such a file can be");
    if file.metadata()?.len() > limit {
        return Err(too_large());
    }
    let mut bytes = Vec::new();
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    match bytes.len() as u64 > limit {
        // It has grown meanwhile.
        true => Err(too_large()),
        false => Ok(bytes),
    }
}

fn remove_if_there(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

impl Storage for Disk {
    type File = File;
    type Lock = DiskLock;

    fn locate(&self, path: &Path) -> io::Result<PathBuf> {
        let mut path = std::path::absolute(path)?;
        for _ in 0..SYMLINKS_MAX {
            match fs::read_link(&path) {
                // A relative target starts at the link's folder. An absolute one replaces the path.
                Ok(target) => {
                    path.pop();
                    path.push(target);
                }
                Err(_) => {
                    if let Some(folder) = path.parent() {
                        fs::create_dir_all(folder)?;
                    }
                    return Ok(path);
                }
            }
        }
        Err(Errno::LOOP.into())
    }

    fn lock(&self, checkpoint: &Path, path: &Path) -> io::Result<Result<DiskLock, Option<u32>>> {
        DiskLock::take(checkpoint, path)
    }

    fn renew_lock(&self, lock: &mut DiskLock, path: &Path) -> io::Result<Result<(), Option<u32>>> {
        lock.renew(path)
    }

    fn lock_id(&self, lock: &DiskLock) -> io::Result<FileId> {
        lock.id()
    }

    fn read(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        read_all(&regular_file::open_ours(path)?, limit)
    }

    fn read_named(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        read_all(&regular_file::open(path)?, limit)
    }

    fn create(&self, path: &Path) -> io::Result<File> {
        // An existing file is removed and not emptied, because it may have a second name, under which its content must
        // stay.
        remove_if_there(path)?;
        let file = Self::private().append(true).create_new(true).open(path)?;
        lock::claim(&file);
        Ok(file)
    }

    fn append(&self, mut file: &File, bytes: &[u8]) -> io::Result<usize> {
        loop {
            match file.write(bytes) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                other => return other,
            }
        }
    }

    fn sync(&self, file: &File) -> io::Result<()> {
        file.sync_data()
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<bool> {
        let aside = beside(to, ".new");
        remove_if_there(&aside)?;
        let linked = fs::hard_link(from, &aside).is_ok();
        if !linked {
            let mut original = regular_file::open(from)?;
            let copy = self.create(&aside)?;
            io::copy(&mut original, &mut &copy)?;
            copy.sync_data()?;
        }
        fs::rename(&aside, to)?;
        // If `aside` and `to` are names of the same file, the rename does nothing and `aside` remains.
        remove_if_there(&aside)?;
        Ok(linked)
    }

    fn replace(&self, from: &Path, path: &Path, aside: &Path) -> io::Result<()> {
        // The new file goes through `aside`. If a crash happens in between, the file is at `aside`, and nothing is
        // lost.
        fs::rename(from, aside)?;
        let exchanged = rustix::fs::renameat_with(CWD, aside, CWD, path, RenameFlags::EXCHANGE);
        let Err(error) = exchanged else {
            return Ok(());
        };
        fs::rename(aside, from)?;
        match error {
            // The file system or the kernel does not support the exchange.
            Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP => {
                fs::hard_link(path, aside).or_else(|_| fs::rename(path, aside))?;
                fs::rename(from, path)
            }
            error => Err(error.into()),
        }
    }

    fn status(&self, file: &File) -> io::Result<FileStatus> {
        let metadata = file.metadata()?;
        Ok(FileStatus {
            id: FileId::from_metadata(&metadata),
            length: metadata.len(),
            modified: i128::from(metadata.mtime()) * 1_000_000_000
                + i128::from(metadata.mtime_nsec()),
        })
    }

    fn length_at(&self, path: &Path) -> io::Result<u64> {
        regular_file::length_of_ours(path)
    }

    fn id_at(&self, path: &Path) -> io::Result<Option<FileId>> {
        FileId::at(path)
    }

    fn checksum(&self, path: &Path, length: u64) -> io::Result<u32> {
        let mut rest = regular_file::open(path)?.take(length);
        let mut buffer = vec![0; 64 * 1024];
        let mut crc = 0;
        loop {
            match rest.read(&mut buffer)? {
                0 => return Ok(crc),
                count => {
                    let bytes = buffer.get(..count).unwrap_or_default();
                    crc = crc32c::crc32c_append(crc, bytes);
                }
            }
        }
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    fn sync_dir(&self, folder: &Path) -> io::Result<()> {
        File::open(folder)?.sync_all()
    }

    fn list(&self, folder: &Path) -> io::Result<Vec<String>> {
        fs::read_dir(folder)?
            .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
            .collect()
    }
}
