//! The TCP sockets of this network namespace: who listens, who is connected, and whether the master may still be running
//! a call of a closed connection.
//!
//! A rosmaster runs each connection in a thread of its own, and closes its end only after it has run what has arrived.
//! rosrescue, or the death of an earlier rosrescue, may have closed a connection whose call still runs. Then the
//! master's end is in the state CLOSE_WAIT, even if the master has not accepted the connection. Only a master on this
//! computer has its end among these sockets. rosrescue's end, which belongs to no process any more, is in FIN_WAIT1 or
//! FIN_WAIT2.
//!
//! Linux drops rosrescue's end a minute after the master's side has acknowledged the close. So a call in a master on
//! another computer is waited for no longer than a minute; see `docs/decisions/0003-no-call-in-flight.md`.

mod diag;

use std::{
    collections::HashMap,
    fs::File,
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

/// One end of a TCP connection, or a listening socket, in this network namespace. IPv4 addresses are not in their IPv6
/// form.
#[derive(Clone, Debug)]
pub(crate) struct Socket {
    pub(crate) local: SocketAddr,
    pub(crate) remote: SocketAddr,
    /// The state, as the kernel numbers it.
    pub(crate) state: u8,
    pub(crate) user: u32,
    /// 0 if no process has the socket any more.
    pub(crate) inode: u64,
}

/// Whether the master at `master` may still be running a call of a connection that this side has closed.
pub(crate) fn may_run_a_call(master: SocketAddr) -> bool {
    // If nothing can be known, no call is assumed to run.
    let closing = in_states(&[FIN_WAIT1, FIN_WAIT2, CLOSE_WAIT, CLOSING]);
    closing.iter().any(|socket| socket.may_run_a_call(master))
}

/// The addresses at which processes in this network namespace listen, with the inodes of their sockets. Blocks for some
/// hundred microseconds.
pub(crate) fn listening() -> HashMap<SocketAddr, Vec<u64>> {
    let mut all = HashMap::<_, Vec<u64>>::new();
    for socket in in_states(&[LISTEN]) {
        all.entry(socket.local).or_default().push(socket.inode);
    }
    all
}

/// All ends of connections.
pub(crate) fn established() -> Vec<Socket> {
    in_states(&[ESTABLISHED])
}

fn in_states(states: &[u8]) -> Vec<Socket> {
    diag::in_states(states).unwrap_or_else(|_| in_table(states))
}

/// Like [`in_states`], from the table in /proc, for which the kernel needs milliseconds per thousand sockets in any
/// state.
fn in_table(states: &[u8]) -> Vec<Socket> {
    let tables = ["/proc/self/net/tcp", "/proc/self/net/tcp6"].map(File::open);
    let sockets = tables.into_iter().flatten().flat_map(|table| {
        let lines = BufReader::new(table).lines().skip(1);
        let sockets = lines
            .map_while(Result::ok)
            .filter_map(|line| Socket::parse(&line));
        // The kernel lists listening sockets first.
        sockets.take_while(|socket| states != [LISTEN] || socket.state == LISTEN)
    });
    sockets
        .filter(|socket| states.contains(&socket.state))
        .collect()
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

impl Socket {
    /// Parses a line of the table in /proc.
    fn parse(line: &str) -> Option<Self> {
        let mut columns = line.split_whitespace().skip(1);
        Some(Self {
            local: address(columns.next()?)?,
            remote: address(columns.next()?)?,
            state: u8::from_str_radix(columns.next()?, 16).ok()?,
            user: columns.nth(3)?.parse().ok()?,
            inode: columns.nth(1)?.parse().ok()?,
        })
    }

    fn may_run_a_call(&self, master: SocketAddr) -> bool {
        let master = SocketAddr::new(master.ip().to_canonical(), master.port());
        match self.state {
            CLOSE_WAIT => self.local == master,
            FIN_WAIT1 | FIN_WAIT2 | CLOSING => self.remote == master,
            _ => false,
        }
    }
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
    fn both_ways_list_the_same_sockets() {
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
        let mut clients: Vec<_> = own
            .iter()
            .map(|it| TcpStream::connect(it).unwrap())
            .collect();
        let reached = clients.iter().map(|it| it.peer_addr().unwrap());
        let ends: Vec<_> = own.iter().copied().chain(reached).collect();
        let only_own = |all: Vec<Socket>| {
            let mut all: Vec<_> = all
                .into_iter()
                .map(|it| (it.local, it.remote, it.state, it.user, it.inode))
                // Another program may have one of these ports at another address.
                .filter(|(local, remote, ..)| ends.contains(local) || ends.contains(remote))
                .collect();
            all.sort_unstable();
            // The kernel shows a socket twice if others are opened while a program reads the table in `/proc`.
            all.dedup();
            all
        };
        let both = |states: &[u8], count: usize| {
            let table = only_own(in_table(states));
            assert_eq!(table.len(), count, "{states:?}: {table:?}");
            assert_eq!(only_own(diag::in_states(states).unwrap()), table);
        };
        both(&[LISTEN], own.len());
        both(&[ESTABLISHED], 2 * own.len());
        clients.clear();
        let closing = [FIN_WAIT1, FIN_WAIT2, CLOSE_WAIT, CLOSING];
        eventually("the ends are closed, and the other ends know", || {
            only_own(in_table(&[FIN_WAIT2, CLOSE_WAIT])).len() == 2 * own.len()
        });
        both(&closing, 2 * own.len());
        both(&[LISTEN, CLOSE_WAIT], 2 * own.len());
    }

    #[test]
    fn addresses_of_both_families_are_read() {
        let rest = "00000000:00000000 00:00000000 00000000 7 0 9 1 0 100 0 0 10 0";
        let may_run = |line: &str, master: &str| {
            let socket = Socket::parse(&format!("{line} {rest}")).unwrap();
            assert_eq!((socket.user, socket.inode), (7, 9));
            socket.may_run_a_call(master.parse().unwrap())
        };
        let v4 = "0: 0100007F:2C2F 0100007F:A001 08";
        let v6 =
            "1: 0000000000000000FFFF00000200000A:A002 0000000000000000FFFF00000100000A:2C2F 05";
        if cfg!(target_endian = "little") {
            assert!(may_run(v4, "127.0.0.1:11311"));
            assert!(may_run(v6, "10.0.0.1:11311"));
            assert!(may_run(v6, "[::ffff:10.0.0.1]:11311"));
            assert!(!may_run(v6, "10.0.0.2:11311"));
            assert!(!may_run(v4, "127.0.0.1:40961"));
        }
    }
}
