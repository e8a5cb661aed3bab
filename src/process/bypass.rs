//! Finds clients that bypass rosrescue and talk directly to the master of `proxy`. It finds them in the kernel's table
//! of TCP sockets, and only reports them.

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    fmt, fs,
    net::{IpAddr, SocketAddr},
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::time::{MissedTickBehavior, interval};

use super::{Stat, listeners};
use crate::{
    limit::rarely,
    resolver,
    ros_env::MasterUri,
    status::Board,
    upstream::{
        Upstream,
        sockets::{self, Socket},
    },
};

/// Pause between two reads of the table.
const LOOK_AGAIN: Duration = Duration::from_secs(5);
/// How long a client is reported after its last connection. XML-RPC clients connect again for each call, or from time
/// to time.
const REMEMBERED: Duration = Duration::from_secs(600);

/// A client that talks directly to the master.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum Who {
    Process {
        name: String,
        pid: u32,
        /// Start time. Together with the id it identifies the process.
        started: u64,
    },
    /// A process of the user with this id, which rosrescue has no permission to inspect.
    User(u32),
    /// Another computer.
    Host(IpAddr),
}

impl Who {
    fn of_process(pid: u32) -> Option<Self> {
        Some(Self::Process {
            name: program_of(pid),
            pid,
            started: Stat::read(pid)?.started,
        })
    }

    /// Whether the client is still reported if its last connection was seen `since` ago.
    fn counts(&self, since: Duration) -> bool {
        match self {
            Self::Process { pid, started, .. } => {
                Stat::read(*pid).is_some_and(|stat| stat.started == *started && stat.is_alive())
            }
            Self::User(_) | Self::Host(_) => since < REMEMBERED,
        }
    }
}

impl fmt::Display for Who {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Process { name, pid, .. } => write!(f, "{name} (process {pid})"),
            Self::User(id) => write!(f, "a process of user {id}"),
            Self::Host(address) => write!(f, "computer {address}"),
        }
    }
}

/// The program that the process `pid` runs; for a Python program, its script.
fn program_of(pid: u32) -> String {
    let name = super::name_of(pid);
    if !name.starts_with("python") {
        return name;
    }
    let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    let line = String::from_utf8_lossy(&line);
    let mut words = line.split('\0').skip(1);
    let script = words.find(|word| !word.is_empty() && !word.starts_with('-'));
    let script = script.and_then(|script| Path::new(script).file_name());
    script.map_or(name, |script| script.to_string_lossy().into_owned())
}

/// The addresses of the master.
#[derive(Clone, Debug)]
pub(crate) struct MasterAddresses {
    port: u16,
    addresses: Vec<IpAddr>,
    /// Whether the master is on this computer.
    is_here: bool,
}

impl MasterAddresses {
    /// Resolves the master's address. `None` if its host has no address.
    pub(crate) async fn resolve(master: &MasterUri) -> Option<Self> {
        let found = resolver::addresses(&master.host, master.port).await.ok()?;
        let addresses: Vec<_> = found.iter().map(|at| at.ip().to_canonical()).collect();
        Some(Self {
            port: master.port,
            is_here: addresses.iter().any(|address| resolver::is_own(*address)),
            addresses,
        })
    }

    fn is_at(&self, address: SocketAddr) -> bool {
        let ip = address.ip();
        let is_master = || self.addresses.contains(&ip) || self.is_here && resolver::is_own(ip);
        address.port() == self.port && is_master()
    }

    /// Whether the master accepts connections from other computers, so that they can bypass
    /// rosrescue. False if it is not on this computer.
    pub(crate) fn is_open(&self) -> bool {
        let open = |at: &SocketAddr| at.port() == self.port && !at.ip().is_loopback();
        self.is_here && sockets::listening().keys().any(open)
    }
}

/// Which clients call the master directly, past this rosrescue.
#[derive(Debug, Default)]
pub(crate) struct Bypass {
    /// When each client's last connection was seen.
    seen: BTreeMap<Who, Instant>,
    /// The owners of the sockets at the last look.
    sockets: HashMap<u64, Who>,
}

impl Bypass {
    /// Reads the socket table of this computer once, and returns the new clients. Blocks for milliseconds if it has to
    /// search for the owner of a new socket.
    pub(crate) fn find_new_clients(&mut self, master: &MasterAddresses) -> Vec<Who> {
        let own = listeners::open_sockets(std::process::id());
        let table = sockets::established();
        let (clients, hosts) = split(table, master, &own, resolver::is_own);
        self.sockets.retain(|inode, _| clients.contains_key(inode));
        let mut unknown = clients.clone();
        unknown.retain(|inode, _| !self.sockets.contains_key(inode));
        if !unknown.is_empty() {
            self.find_owners(&mut unknown);
        }
        let now = Instant::now();
        let hosts = hosts.into_iter().map(Who::Host);
        let mut new = Vec::new();
        for who in self.sockets.values().cloned().chain(hosts) {
            if self.seen.insert(who.clone(), now).is_none() {
                new.push(who);
            }
        }
        self.seen
            .retain(|who, at| who.counts(now.duration_since(*at)));
        new
    }

    /// Finds the owners of the sockets with these inodes and users.
    fn find_owners(&mut self, unknown: &mut HashMap<u64, u32>) {
        for pid in super::all_pids() {
            let open = listeners::open_sockets(pid);
            let mine: Vec<_> = unknown
                .keys()
                .copied()
                .filter(|it| open.contains(it))
                .collect();
            let who = match super::is_rosrescue(pid) {
                true => None,
                false if mine.is_empty() => None,
                false => Who::of_process(pid),
            };
            for inode in mine {
                unknown.remove(&inode);
                self.sockets.extend(who.clone().map(|who| (inode, who)));
            }
        }
        if unknown.is_empty() {
            return;
        }
        // A socket that was closed meanwhile no longer has an owner.
        let still: HashSet<_> = sockets::established().iter().map(|it| it.inode).collect();
        let hidden = unknown
            .drain()
            .filter(|(inode, _)| *inode != 0 && still.contains(inode));
        self.sockets
            .extend(hidden.map(|(inode, user)| (inode, Who::User(user))));
    }

    pub(crate) fn names(&self) -> Vec<String> {
        self.seen.keys().map(ToString::to_string).collect()
    }
}

/// The clients of `master`: inode and user of each socket on this computer, except those in `own`, and the
/// addresses of other computers.
fn split(
    table: Vec<Socket>,
    master: &MasterAddresses,
    own: &HashSet<u64>,
    is_own: impl Fn(IpAddr) -> bool,
) -> (HashMap<u64, u32>, HashSet<IpAddr>) {
    let (mut clients, mut hosts) = (HashMap::new(), HashSet::new());
    for Socket {
        local,
        remote,
        user,
        inode,
        ..
    } in table
    {
        if remote.port() == master.port && master.is_at(remote) {
            if !own.contains(&inode) {
                clients.insert(inode, user);
            }
        } else if local.port() == master.port && master.is_at(local) && !is_own(remote.ip()) {
            hosts.insert(remote.ip());
        }
    }
    (clients, hosts)
}

/// Watches the master of `proxy` as long as it is polled. `uri` is the address that nodes should
/// use.
pub(crate) async fn watch(upstream: Arc<Upstream>, board: Arc<Board>, uri: String) {
    let mut looks = interval(LOOK_AGAIN);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut bypass = Bypass::default();
    loop {
        looks.tick().await;
        let Some(place) = MasterAddresses::resolve(&upstream.address()).await else {
            continue;
        };
        let looked = crate::task::spawn_blocking(move || {
            let new = bypass.find_new_clients(&place);
            (place.is_open(), new, bypass)
        });
        let Ok((is_open, new, now)) = looked.await else {
            return;
        };
        bypass = now;
        for who in new {
            rarely!(
                warn, %who,
                "a client bypasses rosrescue: it talks to the master directly, so its changes are not recorded. Restart it with ROS_MASTER_URI={uri}"
            );
        }
        board.update(|facts| {
            facts.bypassing = bypass.names();
            facts.master_is_open = is_open;
        });
    }
}

#[cfg(test)]
mod tests {
    use std::net::{TcpListener, TcpStream};

    use super::*;

    #[test]
    fn clients_of_the_master_are_distinguished_from_other_connections() {
        let place = MasterAddresses {
            port: 11_312,
            addresses: vec!["127.0.0.1".parse().unwrap()],
            is_here: true,
        };
        let line = |local: &str, remote: &str, inode| Socket {
            local: local.parse().unwrap(),
            remote: remote.parse().unwrap(),
            state: 1,
            user: 7,
            inode,
        };
        let table = vec![
            line("127.0.0.1:40000", "127.0.0.1:11312", 1),
            line("127.0.0.1:11312", "127.0.0.1:40000", 2),
            line("127.0.0.1:40001", "127.0.0.1:11312", 3),
            line("127.0.0.1:40002", "192.0.2.1:11312", 4),
            line("127.0.0.1:11312", "192.0.2.9:5", 5),
            line("127.0.0.1:40003", "127.0.0.1:11311", 6),
        ];
        let is_own = |ip: IpAddr| ip.is_loopback();
        let (clients, hosts) = split(table, &place, &HashSet::from([3]), is_own);
        assert_eq!(clients, HashMap::from([(1, 7)]));
        assert_eq!(hosts, HashSet::from(["192.0.2.9".parse().unwrap()]));
    }

    #[tokio::test]
    async fn own_connections_do_not_count_and_an_open_port_is_noticed() {
        for (address, is_open) in [("127.0.0.1:0", false), ("0.0.0.0:0", true)] {
            let listener = TcpListener::bind(address).unwrap();
            let port = listener.local_addr().unwrap().port();
            let host = "127.0.0.1".to_owned();
            let place = MasterAddresses::resolve(&MasterUri { host, port })
                .await
                .unwrap();
            let _client = TcpStream::connect(("127.0.0.1", port)).unwrap();
            let mut bypass = Bypass::default();
            assert_eq!(bypass.find_new_clients(&place), []);
            assert_eq!(place.is_open(), is_open, "{address}");
        }
    }
}
