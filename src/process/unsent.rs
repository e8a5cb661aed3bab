//! Kills a rosmaster so that nothing comes from it any more.
//!
//! The kernel goes on sending what a dead process has written. If a cut cable holds it up, it arrives up to as long after
//! the cable is mended as the cable was cut: after what the next master has told the node meanwhile.

use std::{fs, io, time::Duration};

use rustix::process::{PidfdFlags, PidfdGetfdFlags, Signal, pidfd_getfd, pidfd_open};
use socket2::SockRef;

use super::{raw_pid, signal_process};

/// Kills the process `pid`. What it has written to other computers and they have not received is discarded.
///
/// Discarding needs Linux 5.6, and if Yama restricts `ptrace`, the process must be a descendant of this one. Otherwise
/// the process is only killed.
pub(crate) fn kill(pid: u32) {
    // A process that is stopped writes nothing more.
    signal_process(pid, Signal::STOP);
    if let Err(error) = discard(pid) {
        tracing::debug!(pid, %error, "what the killed process has not sent yet cannot be discarded");
    }
    signal_process(pid, Signal::KILL);
}

/// Makes the kernel reset the process's connections to other computers when they are closed, instead of sending the
/// rest.
fn discard(pid: u32) -> io::Result<()> {
    let id = raw_pid(pid).ok_or(io::ErrorKind::InvalidInput)?;
    let process = pidfd_open(id, PidfdFlags::empty())?;
    for entry in fs::read_dir(format!("/proc/{pid}/fd"))? {
        let entry = entry?;
        let name = entry.file_name();
        let number = name.to_str().and_then(|name| name.parse().ok());
        let file = fs::read_link(entry.path())?;
        let Some(number) = number.filter(|_| file.to_string_lossy().starts_with("socket:")) else {
            continue;
        };
        let socket = pidfd_getfd(&process, number, PidfdGetfdFlags::empty())?;
        let socket = SockRef::from(&socket);
        if is_to_another_computer(&socket) {
            socket.set_linger(Some(Duration::ZERO))?;
        }
    }
    Ok(())
}

fn is_to_another_computer(socket: &SockRef<'_>) -> bool {
    let peer = socket.peer_addr().ok().and_then(|peer| peer.as_socket());
    let own = socket.local_addr().ok().and_then(|own| own.as_socket());
    peer.is_some_and(|peer| {
        !peer.ip().to_canonical().is_loopback() && own.is_some_and(|own| own.ip() != peer.ip())
    })
}
