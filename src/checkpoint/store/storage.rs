//! What the store asks of a disk, and the real one.

use std::fs::{self, File, Metadata, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{CWD, RenameFlags};
use rustix::io::Errno;

use super::lock::{self, DiskLock};

/// Which file it is, whatever its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileId {
    /// The file system.
    pub device: u64,
    pub inode: u64,
}

impl FileId {
    pub(super) fn of(metadata: &Metadata) -> Self {
        Self {
            device: metadata.dev(),
            inode: metadata.ino(),
        }
    }

    /// Of what `path` names, if anything; a link that leads nowhere is something.
    pub(super) fn at(path: &Path) -> io::Result<Option<Self>> {
        match fs::metadata(path).or_else(|_| fs::symlink_metadata(path)) {
            Ok(metadata) => Ok(Some(Self::of(&metadata))),
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

/// What shows whether somebody else has written to a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileStatus {
    pub id: FileId,
    pub length: u64,
    /// When it was written last, in nanoseconds; only ever compared with itself.
    pub modified: i128,
}

/// The operations that a checkpoint needs. `append` makes one `write(2)`; names are whole paths in
/// one folder; nothing is durable before `sync` (contents) and `sync_dir` (names).
pub trait Storage: Clone + Send + Sync + 'static {
    /// A file open for appending.
    type File: Send + Sync + 'static;
    /// Holds the lock until dropped.
    type Lock: Send + 'static;

    /// Makes the folder of `path` if need be and says where the file really is.
    fn locate(&self, path: &Path) -> io::Result<PathBuf>;
    /// Takes the lock of `checkpoint`, with the lock file `path` in which our process id is left, or
    /// says who has it.
    fn lock(&self, checkpoint: &Path, path: &Path) -> io::Result<Result<Self::Lock, Option<u32>>>;
    /// Makes the lock file `path` anew if the one there is not ours any more, and its folder too, or
    /// says who has it.
    fn renew_lock(&self, lock: &mut Self::Lock, path: &Path)
    -> io::Result<Result<(), Option<u32>>>;
    /// Which file the lock file is.
    fn lock_id(&self, lock: &Self::Lock) -> io::Result<FileId>;
    /// The whole content, at most `limit` bytes and one.
    fn read(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>>;
    /// A new empty file, readable and writable for its owner only, in place of any before.
    fn create(&self, path: &Path) -> io::Result<Self::File>;
    /// Writes at the end of the file; says how many bytes were taken.
    fn append(&self, file: &Self::File, bytes: &[u8]) -> io::Result<usize>;
    /// Returns when the content is on the medium.
    fn sync(&self, file: &Self::File) -> io::Result<()>;
    /// Gives the file at `from` the name `to`, atomically in place of any other.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Gives the file at `from` the second name `to`, atomically in place of any other, and says
    /// `true`; where the file system has no second names, makes a copy and says `false`.
    fn link(&self, from: &Path, to: &Path) -> io::Result<bool>;
    /// Gives the file at `from` the name `path`, and what has that name now the name `aside`, which
    /// nothing has.
    fn replace(&self, from: &Path, path: &Path, aside: &Path) -> io::Result<()>;
    /// How an open file is now.
    fn status(&self, file: &Self::File) -> io::Result<FileStatus>;
    /// Which file `path` names, if any.
    fn id_at(&self, path: &Path) -> io::Result<Option<FileId>>;
    /// The CRC-32C of the first `length` bytes at `path`.
    fn checksum(&self, path: &Path, length: u64) -> io::Result<u32>;
    fn remove(&self, path: &Path) -> io::Result<()>;
    /// Returns when the names in `folder` are on the medium.
    fn sync_dir(&self, folder: &Path) -> io::Result<()>;
    /// The names in `folder`, as far as they are text.
    fn list(&self, folder: &Path) -> io::Result<Vec<String>>;
}

/// The file system of this machine.
#[derive(Clone, Copy, Debug, Default)]
pub struct Disk;

/// Linux follows at most 40 symbolic links.
const SYMLINKS_MAX: usize = 40;

impl Disk {
    fn private() -> OpenOptions {
        let mut options = OpenOptions::new();
        options.mode(0o600);
        options
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
                // A relative target counts from the link's folder; an absolute one replaces it.
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
        let metadata = fs::metadata(path)?;
        // A pipe would block in `open`.
        if !metadata.is_file() {
            return Err(io::Error::other("it is not a regular file"));
        }
        if metadata.len() > limit {
            return Err(io::Error::other("it is larger than any checkpoint"));
        }
        let mut bytes = Vec::new();
        File::open(path)?
            .take(limit.saturating_add(1))
            .read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    fn create(&self, path: &Path) -> io::Result<File> {
        // Never write into an inode that has another name.
        remove_if_there(path)?;
        let file = Self::private().append(true).create_new(true).open(path)?;
        // The umask can only have taken bits away.
        file.set_permissions(fs::Permissions::from_mode(0o600))?;
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
        let mut name = to.as_os_str().to_owned();
        name.push(".new");
        let aside = PathBuf::from(name);
        remove_if_there(&aside)?;
        let linked = fs::hard_link(from, &aside).is_ok();
        if !linked {
            let mut original = File::open(from)?;
            let copy = self.create(&aside)?;
            io::copy(&mut original, &mut &copy)?;
            copy.sync_data()?;
        }
        fs::rename(&aside, to)?;
        // Renaming a name over another one of the same file does nothing at all.
        remove_if_there(&aside)?;
        Ok(linked)
    }

    fn replace(&self, from: &Path, path: &Path, aside: &Path) -> io::Result<()> {
        // By way of the name that stays, so that a crash leaves ours under it and nothing lost.
        fs::rename(from, aside)?;
        let exchanged = rustix::fs::renameat_with(CWD, aside, CWD, path, RenameFlags::EXCHANGE);
        let Err(error) = exchanged else {
            return Ok(());
        };
        fs::rename(aside, from)?;
        match error {
            // Not on this file system, or not with this kernel.
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
            id: FileId::of(&metadata),
            length: metadata.len(),
            modified: i128::from(metadata.mtime()) * 1_000_000_000
                + i128::from(metadata.mtime_nsec()),
        })
    }

    fn id_at(&self, path: &Path) -> io::Result<Option<FileId>> {
        FileId::at(path)
    }

    fn checksum(&self, path: &Path, length: u64) -> io::Result<u32> {
        let mut rest = File::open(path)?.take(length);
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
