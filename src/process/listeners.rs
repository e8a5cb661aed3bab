//! Which processes listen at a port, as far as the system lets us see.

use std::{collections::HashSet, fs, path::PathBuf};

/// State of a listening socket in the kernel's tables.
const LISTENING: &str = "0A";

/// The processes that listen at `port`, in our network namespace. Those of other users are seen by root only.
pub(crate) fn at(port: u16) -> Vec<u32> {
    let sockets = sockets(port);
    if sockets.is_empty() {
        return Vec::new();
    }
    super::all()
        .filter(|pid| holds_one(*pid, &sockets))
        .collect()
}

/// Whether the process `pid` listens at `port`.
pub(crate) fn listens(pid: u32, port: u16) -> bool {
    holds_one(pid, &sockets(port))
}

/// The ports at which the process `pid` listens.
pub(crate) fn ports(pid: u32) -> Vec<u16> {
    let open: HashSet<_> = open_files(pid).collect();
    let mut ports: Vec<_> = listening()
        .into_iter()
        .filter(|(_, socket)| open.contains(socket))
        .map(|(port, _)| port)
        .collect();
    ports.sort_unstable();
    ports.dedup();
    ports
}

/// The listening sockets at `port`, as links in `/proc/PID/fd` name them.
fn sockets(port: u16) -> HashSet<PathBuf> {
    let listening = listening().into_iter();
    listening
        .filter_map(|(at, socket)| (at == port).then_some(socket))
        .collect()
}

fn listening() -> Vec<(u16, PathBuf)> {
    let tables = ["/proc/self/net/tcp", "/proc/self/net/tcp6"].map(fs::read_to_string);
    let tables = tables.map(Result::unwrap_or_default).join("\n");
    tables.lines().filter_map(socket).collect()
}

/// Port and socket of a table's line, if it listens.
fn socket(line: &str) -> Option<(u16, PathBuf)> {
    let columns: Vec<_> = line.split_whitespace().collect();
    if *columns.get(3)? != LISTENING {
        return None;
    }
    let (_, port) = columns.get(1)?.rsplit_once(':')?;
    let inode = columns.get(9)?;
    Some((
        u16::from_str_radix(port, 16).ok()?,
        format!("socket:[{inode}]").into(),
    ))
}

fn open_files(pid: u32) -> impl Iterator<Item = PathBuf> {
    let open = fs::read_dir(format!("/proc/{pid}/fd"));
    let open = open.into_iter().flatten().flatten();
    open.filter_map(|entry| fs::read_link(entry.path()).ok())
}

fn holds_one(pid: u32, sockets: &HashSet<PathBuf>) -> bool {
    open_files(pid).any(|file| sockets.contains(&file))
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn who_listens_is_known() {
        for address in ["127.0.0.1:0", "[::1]:0"] {
            let listener = TcpListener::bind(address).unwrap();
            let port = listener.local_addr().unwrap().port();
            let own = std::process::id();
            assert!(listens(own, port));
            assert!(at(port).contains(&own));
            assert!(ports(own).contains(&port));
            assert!(!listens(1, port) || own == 1);
            drop(listener);
            assert!(!listens(own, port));
        }
    }
}
