//! Listening sockets that this process has inherited by systemd's LISTEN_FDS protocol (`sd_listen_fds(3)`), from
//! systemd or from the guardian.
//!
//! In the protocol, LISTEN_PID is the process that the sockets are meant for. A guardian cannot know its worker's
//! process id before the fork, so it sets `ROSRESCUE_GUARDIAN` to its own instead. Its last socket is not a listener
//! but one end of a pair, the *link*. Through it the worker reports that it handles signals, and later that it answers
//! calls, and notices the end of the guardian.

use std::{
    io::{self, Write},
    net::{SocketAddr, TcpListener},
    os::{
        fd::{OwnedFd, RawFd},
        unix::{net::UnixStream, process::parent_id},
    },
    process::Command,
};

use listenfd::ListenFd;
use socket2::SockRef;
use thiserror::Error;

use crate::ros_env::Lookup;

/// Descriptor number of the first socket.
pub(super) const FIRST: RawFd = 3;
/// Environment variable with the number of sockets.
pub(super) const LISTEN_FDS: &str = "LISTEN_FDS";
/// Environment variable with the id of the process that the sockets are meant for.
pub(super) const LISTEN_PID: &str = "LISTEN_PID";
pub(super) const LISTEN_FDNAMES: &str = "LISTEN_FDNAMES";
/// Environment variable with the process id of the worker's guardian.
pub(super) const GUARDIAN: &str = "ROSRESCUE_GUARDIAN";
/// Environment variable with the number of workers that have died before this one.
pub(super) const RESTARTS: &str = "ROSRESCUE_WORKER_RESTARTS";
/// Environment variable that is set if an earlier worker of this guardian has answered calls.
pub(super) const CONTINUES: &str = "ROSRESCUE_CONTINUES";
/// Memory settings of the worker, unless the user has set others: a single heap, with large blocks outside of it. Then
/// the memory of a large call goes back to the system. By default glibc uses a heap for each thread and keeps most of
/// it.
pub const TUNABLES: (&str, &str) = (
    "GLIBC_TUNABLES",
    "glibc.malloc.arena_max=1:glibc.malloc.mmap_threshold=131072:glibc.malloc.trim_threshold=131072",
);

/// A worker sends this once it handles signals. Before that, a signal would kill it.
pub(super) const HANDLES_SIGNALS: u8 = b'h';
/// A worker sends this once it answers calls.
pub const SERVES: u8 = b's';

/// Why inherited sockets cannot be served. The exit status is 1.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum HandoverError {
    #[error(
        "socket {number} that was passed to rosrescue is not a listening TCP socket: {source}; a socket unit needs ListenStream= with a port, and Accept=no"
    )]
    NotAListener { number: RawFd, source: io::Error },
    /// The link to the guardian is missing.
    #[error("the guardian's link cannot be used: {0}")]
    Link(io::Error),
}

/// The sockets to serve.
#[derive(Debug)]
pub struct Sockets {
    /// The listening sockets, in non-blocking mode.
    pub listeners: Vec<TcpListener>,
    /// What keeps the sockets open when this process ends.
    pub guard: Guard,
}

/// The supervisor that keeps the sockets and restarts rosrescue when it dies.
#[derive(Debug)]
pub enum Guard {
    /// There is no known supervisor.
    Nobody,
    /// systemd, or another supervisor that uses its protocol.
    Systemd,
    Guardian {
        pid: u32,
        /// Closes when the guardian ends.
        link: UnixStream,
    },
}

impl Sockets {
    /// The sockets that this process has inherited, or `None`. Must be called once, before anything else.
    ///
    /// # Errors
    ///
    /// If the sockets cannot be served.
    pub fn inherited() -> Result<Option<Self>, HandoverError> {
        let env = |name: &str| std::env::var(name).ok();
        let Some(giver) = giver(&env, std::process::id(), parent_id()) else {
            return Ok(None);
        };
        // This removes the variables from the environment.
        let mut given = ListenFd::from_env();
        let guard = match giver {
            Giver::Systemd => Guard::Systemd,
            Giver::Guardian(pid) => {
                let link = given.take_unix_listener(given.len().saturating_sub(1));
                let link = link.map_err(HandoverError::Link)?;
                let link =
                    link.ok_or_else(|| HandoverError::Link(io::ErrorKind::NotFound.into()))?;
                Guard::Guardian {
                    pid,
                    link: OwnedFd::from(link).into(),
                }
            }
        };
        let mut listeners = Vec::new();
        for (index, number) in (0..given.len()).zip(FIRST..) {
            let listener = given.take_tcp_listener(index).and_then(|listener| {
                let Some(listener) = listener else {
                    return Ok(None);
                };
                if !SockRef::from(&listener).is_listener()? {
                    return Err(io::Error::other("it is not listening"));
                }
                listener.set_nonblocking(true)?;
                Ok(Some(listener))
            });
            let listener =
                listener.map_err(|source| HandoverError::NotAListener { number, source });
            listeners.extend(listener?);
        }
        Ok(Some(Self { listeners, guard }))
    }

    /// Wraps sockets that this process has bound itself.
    pub fn from_listeners(listeners: Vec<TcpListener>) -> Self {
        Self {
            listeners,
            guard: Guard::Nobody,
        }
    }

    /// The addresses of the listening sockets.
    pub fn addresses(&self) -> Vec<SocketAddr> {
        let addresses = self.listeners.iter().map(TcpListener::local_addr);
        addresses.filter_map(Result::ok).collect()
    }
}

impl Guard {
    /// Reports that this process handles signals now.
    pub fn handles_signals(&self) {
        if let Self::Guardian { link, .. } = self {
            let mut link = link;
            // A guardian that has ended sends no signals.
            let _ = link.write_all(&[HANDLES_SIGNALS]);
        }
    }
}

/// The process that passed the sockets.
#[derive(Debug, PartialEq, Eq)]
enum Giver {
    Systemd,
    Guardian(u32),
}

/// Finds out from the environment `env` which process passed the sockets. `own` is this process and `parent` its
/// parent. `None` if the sockets are not meant for this process.
fn giver(env: Lookup<'_>, own: u32, parent: u32) -> Option<Giver> {
    let number = |name: &str| env(name)?.parse::<u32>().ok();
    number(LISTEN_FDS).filter(|count| *count > 0)?;
    match env(LISTEN_PID) {
        Some(_) => (number(LISTEN_PID) == Some(own)).then_some(Giver::Systemd),
        None => (number(GUARDIAN) == Some(parent)).then_some(Giver::Guardian(parent)),
    }
}

/// Number of workers of this guardian that have died before this one.
pub fn restarts() -> u64 {
    let restarts = std::env::var(RESTARTS).ok();
    restarts.and_then(|count| count.parse().ok()).unwrap_or(0)
}

/// Whether an earlier worker of this guardian has answered calls. Then this worker continues that one's session.
pub fn continues() -> bool {
    std::env::var_os(CONTINUES).is_some()
}

/// Hides from a child process the variables that the guardian and systemd have set for rosrescue.
pub fn keep_from(command: &mut Command) {
    for name in [
        LISTEN_FDS,
        LISTEN_PID,
        LISTEN_FDNAMES,
        GUARDIAN,
        RESTARTS,
        CONTINUES,
        "NOTIFY_SOCKET",
        "WATCHDOG_PID",
        "WATCHDOG_USEC",
    ] {
        command.env_remove(name);
    }
    let (name, value) = TUNABLES;
    if std::env::var_os(name).is_some_and(|of| of == value) {
        command.env_remove(name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn giver_of(variables: &[(&str, &str)]) -> Option<Giver> {
        let env = |name: &str| {
            let found = variables.iter().find(|(of, _)| *of == name)?;
            Some(found.1.to_owned())
        };
        giver(&env, 20, 10)
    }

    #[test]
    fn sockets_are_used_only_by_the_process_that_they_are_for() {
        assert_eq!(giver_of(&[]), None);
        let fds = (LISTEN_FDS, "2");
        assert_eq!(giver_of(&[fds]), None);
        assert_eq!(giver_of(&[fds, (LISTEN_PID, "20")]), Some(Giver::Systemd));
        assert_eq!(giver_of(&[fds, (LISTEN_PID, "21")]), None);
        assert_eq!(giver_of(&[(LISTEN_FDS, "0"), (LISTEN_PID, "20")]), None);
        let ours = (GUARDIAN, "10");
        assert_eq!(giver_of(&[fds, ours]), Some(Giver::Guardian(10)));
        assert_eq!(giver_of(&[fds, (GUARDIAN, "11")]), None);
        assert_eq!(giver_of(&[ours]), None);
        assert_eq!(giver_of(&[fds, ours, (LISTEN_PID, "21")]), None);
    }
}
