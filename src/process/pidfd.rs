//! Descriptors by which the kernel tells of the end of a process or of a thread.

use std::io;

use rustix::process::{Pid, PidfdFlags, pidfd_open};
use tokio::net::unix::pipe::Receiver;

/// A descriptor that becomes readable when the process `id` ends, or what else `flags` ask for. It is
/// never read: only whether it could be is of interest, which tokio tells safely of pipes alone.
///
/// # Errors
///
/// What the system says: nobody has this id, or the kernel cannot watch it.
pub(crate) fn open(id: i32, flags: PidfdFlags) -> io::Result<Receiver> {
    let id = Pid::from_raw(id).ok_or(io::ErrorKind::InvalidInput)?;
    Receiver::from_owned_fd_unchecked(pidfd_open(id, flags)?)
}
