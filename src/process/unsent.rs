//! Kills a rosmaster so that nothing comes from it any more.
//!
//! The kernel goes on sending what a dead process has written. If a cut cable holds it up, it arrives up to as long after
//! the cable is mended as the cable was cut: after what the next master has told the node meanwhile.

use std::{fs, io, os::fd::OwnedFd, time::Duration};

use rustix::process::{PidfdFlags, PidfdGetfdFlags, Signal, pidfd_getfd, pidfd_open};
use socket2::SockRef;

use super::{raw_pid, signal_process};
use crate::upstream::is_local;

/// The shortest limit that the kernel knows: a connection ends instead of sending something again. 0 means no limit.
const AT_ONCE: Duration = Duration::from_millis(1);

/// Kills the process `pid`. What other computers have not received of it by then is not sent again.
///
/// That needs Linux 5.6, and if Yama restricts `ptrace`, the process must be a descendant of this one. Otherwise
/// the process is only killed.
pub(crate) fn kill(pid: u32) {
    // A process that is stopped writes nothing more.
    signal_process(pid, Signal::STOP);
    if let Err(error) = send_no_more(pid) {
        tracing::debug!(pid, %error, "what the killed process has written may still be sent");
    }
    signal_process(pid, Signal::KILL);
}

/// Makes the kernel give up the process's connections to other computers if they lack something that was sent. A reset
/// would do the same, but nodes would see an error on idle connections.
fn send_no_more(pid: u32) -> io::Result<()> {
    let id = raw_pid(pid).ok_or(io::ErrorKind::InvalidInput)?;
    let process = pidfd_open(id, PidfdFlags::empty())?;
    // A file that has just been closed does not keep the others from being treated.
    let mut result = Ok(());
    for entry in fs::read_dir(format!("/proc/{pid}/fd"))?.flatten() {
        let name = entry.file_name();
        let number = name.to_str().and_then(|name| name.parse().ok());
        let is_socket = fs::read_link(entry.path())
            .is_ok_and(|file| file.to_string_lossy().starts_with("socket:"));
        let Some(number) = number.filter(|_| is_socket) else {
            continue;
        };
        let socket = pidfd_getfd(&process, number, PidfdGetfdFlags::empty());
        let limited = socket.map_err(Into::into).and_then(limit);
        result = limited.and(result);
    }
    result
}

/// Limits a connection to another computer. Does nothing to any other socket.
fn limit(socket: OwnedFd) -> io::Result<()> {
    let socket = SockRef::from(&socket);
    let ends = [socket.peer_addr(), socket.local_addr()];
    match ends.map(|end| end.ok()?.as_socket()) {
        [Some(peer), Some(own)] if !is_local(peer, own) => {
            socket.set_tcp_user_timeout(Some(AT_ONCE))
        }
        _ => Ok(()),
    }
}
