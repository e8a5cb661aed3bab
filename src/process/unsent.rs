//! Ends what a rosmaster has begun to send, when it is killed or gives up a node.
//!
//! The kernel goes on sending what a process has written before it died or closed the connection. If a cut cable holds it
//! up, it arrives up to as long after the cable is mended as the cable was cut: after what the node has been told
//! meanwhile.

use std::{
    collections::HashSet, convert::Infallible, fs, io, os::fd::OwnedFd, path::PathBuf,
    time::Duration,
};

use rustix::process::{PidfdFlags, PidfdGetfdFlags, Signal, pidfd_getfd, pidfd_open};
use socket2::SockRef;

use super::{raw_pid, signal_process};
use crate::{task, upstream::is_local};

/// The shortest limit that the kernel knows: a connection ends instead of sending something again. 0 means no limit.
const AT_ONCE: Duration = Duration::from_millis(1);

/// Shortest pause between two looks at a process's connections.
const PAUSE: Duration = Duration::from_millis(100);

/// Kills the process `pid`. What other computers have not received of it by then is not sent again.
///
/// That needs Linux 5.6, and if Yama restricts `ptrace`, the process must be a descendant of this one. Otherwise
/// the process is only killed.
pub(crate) fn kill(pid: u32) {
    // A process that is stopped writes nothing more.
    signal_process(pid, Signal::STOP);
    // A reset would do the same, but nodes would see an error on idle connections.
    if let Err(error) = limit_all(pid, AT_ONCE, &mut HashSet::new()) {
        tracing::debug!(pid, %error, "what the killed process has written may still be sent");
    }
    signal_process(pid, Signal::KILL);
}

/// Has the kernel send nothing again that the process `pid` has written to other computers more than `limit` ago, also
/// after the process has closed the connection. `limit` is the process's own socket timeout.
///
/// Needs what [`kill`] needs. Otherwise it does nothing.
pub(crate) async fn keep_limited(pid: u32, limit: Duration) -> Infallible {
    let mut limited = HashSet::new();
    loop {
        // Each connection is open for at least `limit` before it is given up.
        tokio::time::sleep((limit / 4).max(PAUSE)).await;
        let look = move || {
            let result = limit_all(pid, limit, &mut limited);
            (limited, result)
        };
        let Ok((now, result)) = task::spawn_blocking(look).await else {
            break;
        };
        limited = now;
        let kind = result.as_ref().map_err(io::Error::kind).err();
        if let Some(io::ErrorKind::PermissionDenied | io::ErrorKind::Unsupported) = kind {
            tracing::debug!(pid, ?result, "what rosmaster has written may arrive late");
            break;
        }
    }
    std::future::pending().await
}

/// Makes the kernel give up the process's connections to other computers if they have lacked something that was sent for
/// `time`. `limited` are the process's sockets for which that has been done.
fn limit_all(pid: u32, time: Duration, limited: &mut HashSet<PathBuf>) -> io::Result<()> {
    let id = raw_pid(pid).ok_or(io::ErrorKind::InvalidInput)?;
    let process = pidfd_open(id, PidfdFlags::empty())?;
    // A file that has just been closed does not keep the others from being treated.
    let mut result = Ok(());
    let before = std::mem::take(limited);
    for entry in fs::read_dir(format!("/proc/{pid}/fd"))?.flatten() {
        let name = entry.file_name();
        let number = name.to_str().and_then(|name| name.parse().ok());
        // As in `socket:[4711]`, with the socket's number.
        let file = fs::read_link(entry.path()).unwrap_or_default();
        let is_socket = file.to_string_lossy().starts_with("socket:");
        let Some(number) = number.filter(|_| is_socket) else {
            continue;
        };
        if before.contains(&file) {
            limited.insert(file);
            continue;
        }
        let socket = pidfd_getfd(&process, number, PidfdGetfdFlags::empty());
        match socket.map_err(Into::into).and_then(|of| limit(&of, time)) {
            Ok(true) => {
                limited.insert(file);
            }
            Ok(false) => {}
            Err(error) => result = Err(error),
        }
    }
    result
}

/// Limits a connection to another computer. Does nothing to any other socket. Returns whether this is a connection.
fn limit(socket: &OwnedFd, time: Duration) -> io::Result<bool> {
    let socket = SockRef::from(socket);
    let ends = [socket.peer_addr(), socket.local_addr()];
    match ends.map(|end| end.ok()?.as_socket()) {
        [Some(peer), Some(own)] => {
            if !is_local(peer, own) {
                socket.set_tcp_user_timeout(Some(time))?;
            }
            Ok(true)
        }
        _ => Ok(false),
    }
}
