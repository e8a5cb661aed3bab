//! The lock of a checkpoint on this computer's disk.
//!
//! A lock file alone is not enough. It can be deleted, or renamed together with its folder, and then the next rosrescue
//! would create a new one. So there are three locks. First, the lock file works for every process that sees the folder,
//! including processes in other containers. Second, a socket in the abstract namespace, named after the checkpoint,
//! cannot be removed while rosrescue lives. Third, the checkpoint itself is locked; see [`claim`].

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::os::fd::AsFd;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::fs::FlockOperation;

use super::names::beside;
use super::storage::FileId;
use crate::regular_file;

/// How long to wait for the locks of a killed process. If a process was starting a child process when it was killed,
/// its locks last until the child has closed the inherited descriptors. A rosrescue that starts in that time must not
/// be refused.
const LINGER: Duration = Duration::from_millis(500);

#[derive(Debug)]
pub struct DiskLock {
    file: File,
    /// The bound socket. `None` if the kernel does not support sockets in the abstract namespace.
    _name: Option<UnixDatagram>,
}

/// The lock was refused. The value is the process id of its holder, if known.
type Refused = Option<u32>;

impl DiskLock {
    /// Takes the lock of `checkpoint`, with its lock file at `path`.
    pub(super) fn take(checkpoint: &Path, path: &Path) -> io::Result<Result<Self, Refused>> {
        let start = Instant::now();
        loop {
            match Self::try_take(checkpoint, path)? {
                Err(_) if start.elapsed() < LINGER => std::thread::sleep(LINGER / 20),
                taken => return Ok(taken),
            }
        }
    }

    fn try_take(checkpoint: &Path, path: &Path) -> io::Result<Result<Self, Refused>> {
        let name = match bind(checkpoint) {
            Err(error) if error.kind() == io::ErrorKind::AddrInUse => {
                return Ok(Err(holder_in(path)));
            }
            other => other.ok(),
        };
        if is_claimed(checkpoint) {
            return Ok(Err(holder_in(path)));
        }
        Ok(lock_file(path)?.map(|file| Self { file, _name: name }))
    }

    /// Makes a new lock file at `path` and locks it, unless the locked file is still there. Creates the folder if
    /// needed.
    pub(super) fn renew(&mut self, path: &Path) -> io::Result<Result<(), Refused>> {
        if FileId::at(path)? == Some(self.id()?) {
            return Ok(Ok(()));
        }
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder)?;
        }
        Ok(lock_file(path)?.map(|file| self.file = file))
    }

    pub(super) fn id(&self) -> io::Result<FileId> {
        Ok(FileId::from_metadata(&self.file.metadata()?))
    }
}

/// Locks the checkpoint file while it is open, if the file system supports that.
pub(super) fn claim(file: &File) {
    let _ = rustix::fs::flock(file.as_fd(), FlockOperation::NonBlockingLockExclusive);
}

/// Whether another rosrescue has this checkpoint open.
fn is_claimed(checkpoint: &Path) -> bool {
    let Ok(file) = regular_file::open(checkpoint) else {
        return false;
    };
    let tried = rustix::fs::flock(file, FlockOperation::NonBlockingLockShared);
    tried == Err(rustix::io::Errno::WOULDBLOCK)
}

/// The rosrescue that uses a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LockHolder {
    /// The process id of this rosrescue, if known.
    pub pid: Option<u32>,
}

/// The rosrescue that uses this checkpoint. `None` if none does.
pub fn holder_of(checkpoint: &Path) -> Option<LockHolder> {
    let pid = || holder_in(&beside(checkpoint, ".lock"));
    is_claimed(checkpoint).then(|| LockHolder { pid: pid() })
}

fn lock_file(path: &Path) -> io::Result<Result<File, Refused>> {
    let mut file = regular_file::open_or_create(path)?;
    match rustix::fs::flock(file.as_fd(), FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => {
            // The content is for users and error messages. The lock holds without it.
            let _ = file
                .set_len(0)
                .and_then(|()| writeln!(file, "{}", std::process::id()));
            Ok(Ok(file))
        }
        Err(rustix::io::Errno::WOULDBLOCK) => Ok(Err(holder(file))),
        Err(error) => Err(error.into()),
    }
}

/// Reads the process id from the lock file at `path`.
fn holder_in(path: &Path) -> Refused {
    regular_file::open_ours(path).ok().and_then(holder)
}

/// Reads the process id from a lock file.
fn holder(file: File) -> Option<u32> {
    let mut text = String::new();
    file.take(32).read_to_string(&mut text).ok()?;
    text.trim().parse().ok()
}

/// Binds the socket named after the checkpoint. A datagram socket has no queue of connections that another process
/// could fill.
fn bind(checkpoint: &Path) -> io::Result<UnixDatagram> {
    let root = FileId::from_metadata(&fs::metadata("/")?);
    // In two containers, one path can stand for two files. Containers that share a network namespace share the names of
    // sockets too, so the name must depend on the container: on its mount namespace and its root folder.
    let mounts = fs::read_link("/proc/self/ns/mnt").unwrap_or_default();
    let folder = checkpoint.parent().unwrap_or_else(|| Path::new("/"));
    let path = fs::canonicalize(folder)?.join(checkpoint.file_name().unwrap_or_default());
    let tree = format!("{}:{}:{}:", mounts.display(), root.device, root.inode);
    let hash = fnv1a(&[tree.as_bytes(), path.as_os_str().as_bytes()].concat());
    let name = format!("rosrescue-checkpoint-{hash:016x}");
    UnixDatagram::bind_addr(&SocketAddr::from_abstract_name(name)?)
}

/// Computes a 64-bit FNV-1a hash, because a path can be longer than a socket's name. Must not change, because all
/// versions of rosrescue must compute the same name.
fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3)
    })
}
