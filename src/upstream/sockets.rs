//! Finds out from the kernel's table of TCP sockets whether the master may still be running a call of a closed
//! connection.
//!
//! A rosmaster runs each connection in a thread of its own, and closes its end only after it has run what has arrived.
//! rosrescue, or the death of an earlier rosrescue, may have closed a connection whose call still runs. Then the
//! master's end is in the state CLOSE_WAIT, even if the master has not accepted the connection. Only a master on this
//! computer has its end in this table. rosrescue's end, which belongs to no process any more, is in FIN_WAIT1 or
//! FIN_WAIT2.
//!
//! Linux drops rosrescue's end a minute after the master's side has acknowledged the close. So a call in a master on
//! another computer is waited for no longer than a minute; see `docs/decisions/0003-no-call-in-flight.md`.

mod diag;

use std::{
    collections::HashMap,
    fs::{self, File},
    io::{BufRead, BufReader},
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr},
};

/// States of a socket, as the kernel numbers them.
const FIN_WAIT1: u8 = 0x04;
const FIN_WAIT2: u8 = 0x05;
const CLOSE_WAIT: u8 = 0x08;
const CLOSING: u8 = 0x0b;
const LISTEN: u8 = 0x0a;
const ESTABLISHED: u8 = 0x01;

/// Whether the master at `master` may still be running a call of a connection that this side has closed.
pub(crate) fn may_run_a_call(master: SocketAddr) -> bool {
    ["tcp", "tcp6"].into_iter().any(|table| {
        // Without the table nothing is known, and no call is assumed to run.
        let table = fs::read_to_string(format!("/proc/self/net/{table}")).unwrap_or_default();
        is_in_table(&table, master)
    })
}

/// The addresses at which processes in this network namespace listen, with the inodes of their sockets. IPv4 addresses
/// are not in their IPv6 form. Blocks for some hundred microseconds.
pub(crate) fn listening() -> HashMap<SocketAddr, Vec<u64>> {
    let mut all = HashMap::<_, Vec<u64>>::new();
    // The table in /proc takes 25 ms, because the kernel looks through the connections as well.
    for (address, inode) in diag::listening().unwrap_or_else(|_| listening_in_table()) {
        all.entry(address).or_default().push(inode);
    }
    all
}

/// Like [`listening`], from the table in /proc.
fn listening_in_table() -> Vec<(SocketAddr, u64)> {
    let tables = ["/proc/self/net/tcp", "/proc/self/net/tcp6"].map(File::open);
    let sockets = tables.into_iter().flatten().flat_map(|table| {
        // The kernel lists listening sockets first. Tens of thousands of others may follow.
        let lines = BufReader::new(table).lines().skip(1);
        lines.map_while(|line| listens_at(&line.ok()?))
    });
    sockets.collect()
}

/// The inodes of the sockets of `listening` that accept connections to `address`. A socket with a specific address takes
/// precedence over one for any address.
pub(crate) fn accepting(
    listening: &HashMap<SocketAddr, Vec<u64>>,
    address: SocketAddr,
) -> Vec<u64> {
    if let Some(sockets) = listening.get(&address) {
        return sockets.clone();
    }
    let port = address.port();
    let any = [([0; 4], port).into(), ([0; 16], port).into()];
    any.iter()
        .filter_map(|any| listening.get(any))
        .flatten()
        .copied()
        .collect()
}

/// One end of a connection in this network namespace.
#[derive(Clone, Debug)]
pub(crate) struct Established {
    pub(crate) local: SocketAddr,
    pub(crate) remote: SocketAddr,
    pub(crate) user: u32,
    /// Inode that identifies the socket.
    pub(crate) inode: u64,
}

/// All ends of connections. IPv4 addresses are not in their IPv6 form. Blocks while the kernel generates the table.
pub(crate) fn established() -> Vec<Established> {
    let tables = ["/proc/self/net/tcp", "/proc/self/net/tcp6"].map(File::open);
    let sockets = tables.into_iter().flatten().flat_map(|table| {
        let lines = BufReader::new(table).lines().skip(1);
        lines.map_while(Result::ok).filter_map(|line| end_in(&line))
    });
    sockets.collect()
}

/// Parses one line of the table as the end of a connection.
fn end_in(line: &str) -> Option<Established> {
    let mut columns = line.split_whitespace().skip(1);
    let (local, remote, state) = (columns.next()?, columns.next()?, columns.next()?);
    if u8::from_str_radix(state, 16).ok()? != ESTABLISHED {
        return None;
    }
    Some(Established {
        local: address(local)?,
        remote: address(remote)?,
        user: columns.nth(3)?.parse().ok()?,
        inode: columns.nth(1)?.parse().ok()?,
    })
}

/// Address and inode in one line of the table, if the socket listens.
fn listens_at(line: &str) -> Option<(SocketAddr, u64)> {
    let mut columns = line.split_whitespace().skip(1);
    let (local, state) = (columns.next()?, columns.nth(1)?);
    if u8::from_str_radix(state, 16).ok()? != LISTEN {
        return None;
    }
    let inode = columns.nth(5)?.parse().ok()?;
    Some((address(local)?, inode))
}

fn is_in_table(table: &str, master: SocketAddr) -> bool {
    let master = SocketAddr::new(master.ip().to_canonical(), master.port());
    let mut sockets = table.lines().skip(1).filter_map(|line| {
        let mut columns = line.split_whitespace().skip(1);
        let (local, remote) = (columns.next()?, columns.next()?);
        let state = u8::from_str_radix(columns.next()?, 16).ok()?;
        Some((local, remote, state))
    });
    // Most sockets are in none of these states.
    sockets.any(|(local, remote, state)| match state {
        CLOSE_WAIT => address(local) == Some(master),
        FIN_WAIT1 | FIN_WAIT2 | CLOSING => address(remote) == Some(master),
        _ => false,
    })
}

/// Parses an address of the table: 32-bit words in this computer's byte order, and the port.
fn address(text: &str) -> Option<SocketAddr> {
    let (ip, port) = text.split_once(':')?;
    let words: Vec<_> = (0..ip.len() / 8)
        .map(|index| u32::from_str_radix(ip.get(8 * index..8 * index + 8)?, 16).ok())
        .map(|word| Some(word?.to_ne_bytes()))
        .collect::<Option<_>>()?;
    let ip = match words.as_slice() {
        [v4] => IpAddr::V4(Ipv4Addr::from(*v4)),
        [a, b, c, d] => {
            let bytes: [u8; 16] = [*a, *b, *c, *d].concat().try_into().ok()?;
            IpAddr::V6(Ipv6Addr::from(bytes)).to_canonical()
        }
        _ => return None,
    };
    Some(SocketAddr::new(ip, u16::from_str_radix(port, 16).ok()?))
}

#[cfg(test)]
mod tests {
    use std::{
        io::Write,
        net::{TcpListener, TcpStream},
        time::{Duration, Instant},
    };

    use super::*;

    fn eventually(what: &str, is_it: impl Fn() -> bool) {
        let deadline = Instant::now() + Duration::from_secs(60);
        while !is_it() {
            assert!(Instant::now() < deadline, "never: {what}");
            std::thread::yield_now();
        }
    }

    #[test]
    fn a_call_may_run_until_the_master_closes_its_end() {
        for address in ["127.0.0.1:0", "[::1]:0"] {
            let Ok(listener) = TcpListener::bind(address) else {
                // This computer has no IPv6.
                continue;
            };
            let master = listener.local_addr().unwrap();
            assert!(!may_run_a_call(master));
            let mut client = TcpStream::connect(master).unwrap();
            client.write_all(b"a call").unwrap();
            assert!(!may_run_a_call(master), "its sender waits for the answer");
            drop(client);
            eventually("it is on its way", || may_run_a_call(master));
            let (server, _) = listener.accept().unwrap();
            assert!(may_run_a_call(master), "it has been accepted");
            drop(server);
            eventually("it has been run", || !may_run_a_call(master));
        }
    }

    #[test]
    fn both_ways_list_the_same_listening_sockets() {
        let listeners = ["127.0.0.1:0", "0.0.0.0:0", "[::1]:0", "[::]:0"];
        let listeners: Vec<_> = listeners
            .map(TcpListener::bind)
            .into_iter()
            .flatten()
            .collect();
        let own: Vec<_> = listeners
            .iter()
            .map(|it| it.local_addr().unwrap())
            .collect();
        let only_own = |mut all: Vec<(SocketAddr, u64)>| {
            all.retain(|(address, _)| own.contains(address));
            all.sort_unstable();
            all
        };
        let table = only_own(listening_in_table());
        assert_eq!(table.len(), own.len());
        assert_eq!(only_own(diag::listening().unwrap()), table);
    }

    #[test]
    fn addresses_of_both_families_are_read() {
        let table = "  sl  local_address rem_address   st\n\
             0: 0100007F:2C2F 0100007F:A001 08 00000000:00000000\n\
             1: 0000000000000000FFFF00000200000A:A002 0000000000000000FFFF00000100000A:2C2F 05 0\n";
        if cfg!(target_endian = "little") {
            assert!(is_in_table(table, "127.0.0.1:11311".parse().unwrap()));
            assert!(is_in_table(table, "10.0.0.1:11311".parse().unwrap()));
            assert!(!is_in_table(table, "10.0.0.2:11311".parse().unwrap()));
            assert!(!is_in_table(table, "127.0.0.1:40961".parse().unwrap()));
        }
    }
}
