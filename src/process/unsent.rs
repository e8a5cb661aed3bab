//! Kills a rosmaster so that nothing comes from it any more.
//!
//! The kernel goes on sending what a dead process has written. If a cut cable holds it up, it arrives up to as long after
//! the cable is mended as the cable was cut: after what the next master has told the node meanwhile.

use std::{fs, io, time::Duration};

use rustix::process::{PidfdFlags, PidfdGetfdFlags, Signal, pidfd_getfd, pidfd_open};
use socket2::SockRef;

use super::{raw_pid, signal_process};
use crate::upstream::is_local;

/// A connection ends when it would have to send again after this time. The kernel's unit, and 0 means no limit.
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
/// would do the same, but roscpp prints an error for each.
fn send_no_more(pid: u32) -> io::Result<()> {
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
        let ends = [socket.peer_addr(), socket.local_addr()];
        if let [Some(peer), Some(own)] = ends.map(|end| end.ok()?.as_socket())
            && !is_local(peer, own)
        {
            socket.set_tcp_user_timeout(Some(AT_ONCE))?;
        }
    }
    Ok(())
}
