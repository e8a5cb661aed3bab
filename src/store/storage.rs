//! What the store asks of a disk, and the real one.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::FlockOperation;

/// The operations that a checkpoint needs. `append` makes one `write(2)`; names are whole paths in
/// one folder; nothing is durable before `sync` (contents) and `sync_dir` (names).
pub trait Storage: Clone + Send + Sync + 'static {
    /// A file open for appending.
    type File: Send + Sync + 'static;
    /// Holds the lock until dropped.
    type Lock: Send + 'static;

    /// Makes the folder of `path` if need be and says where the file really is.
    fn locate(&self, path: &Path) -> io::Result<PathBuf>;
    /// Takes the lock at `path` and leaves our process id there, or says who has it.
    fn lock(&self, path: &Path) -> io::Result<Result<Self::Lock, Option<u32>>>;
    /// The whole content, at most `limit` bytes and one.
    fn read(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>>;
    /// A new empty file, readable and writable for its owner only, in place of any before.
    fn create(&self, path: &Path) -> io::Result<Self::File>;
    /// Writes at the end of the file; says how many bytes were taken.
    fn append(&self, file: &Self::File, bytes: &[u8]) -> io::Result<usize>;
    /// Returns when the content is on the medium. An error if the file has no name any more: what
    /// is written to it is lost then.
    fn sync(&self, file: &Self::File) -> io::Result<()>;
    /// Gives the file at `from` the name `to`, atomically in place of any other.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Gives the file at `from` the second name `to`, atomically in place of any other, and says
    /// `true`; where the file system has no second names, makes a copy and says `false`.
    fn link(&self, from: &Path, to: &Path) -> io::Result<bool>;
    /// Removes a name.
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
    type Lock = File;

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
        Err(rustix::io::Errno::LOOP.into())
    }

    fn lock(&self, path: &Path) -> io::Result<Result<File, Option<u32>>> {
        let mut options = Self::private();
        let mut file = options
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)?;
        match rustix::fs::flock(file.as_fd(), FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => {
                // For people and for the message of the next one; the lock holds without it.
                let _ = file
                    .set_len(0)
                    .and_then(|()| writeln!(file, "{}", std::process::id()));
                Ok(Ok(file))
            }
            Err(rustix::io::Errno::WOULDBLOCK) => {
                let mut holder = String::new();
                let _ = (&file).take(32).read_to_string(&mut holder);
                Ok(Err(holder.trim().parse().ok()))
            }
            Err(error) => Err(error.into()),
        }
    }

    fn read(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        // A pipe would block in `open`.
        if !fs::metadata(path)?.is_file() {
            return Err(io::Error::other("it is not a regular file"));
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
        file.sync_data()?;
        if file.metadata()?.nlink() == 0 {
            return Err(io::Error::new(
                io::ErrorKind::NotFound,
                "the file has been removed",
            ));
        }
        Ok(())
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
