//! File descriptors that report the end of a process or a thread.

use std::io;

use rustix::process::{Pid, PidfdFlags, pidfd_open};
use tokio::net::unix::pipe::Receiver;

/// Opens a descriptor that becomes readable when the process `id` ends, or as `flags` specify. It is only polled and
/// never read. tokio's pipe type allows that without unsafe code.
///
/// # Errors
///
/// If no process has this id, or if the kernel cannot watch it.
pub(crate) fn open(id: i32, flags: PidfdFlags) -> io::Result<Receiver> {
    let id = Pid::from_raw(id).ok_or(io::ErrorKind::InvalidInput)?;
    Receiver::from_owned_fd_unchecked(pidfd_open(id, flags)?)
}
