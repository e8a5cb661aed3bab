//! What the kernel proves about nodes on this computer, without a question to any node.
//!
//! A node's listening socket is remembered when the node registers, together with the process that owns it. The socket's
//! inode identifies the socket, and process id and start time identify the process. As long as the socket listens, the
//! node is there. The node has ended if its socket is gone and its process too.
//!
//! The owner of the socket may be a program that forwards a port to a node in a container. So an ended process proves
//! something only if the node itself has confirmed the process id. And a socket with several names proves nothing about
//! any of them.

use std::{
    collections::{BTreeSet, HashMap, HashSet},
    time::Instant,
};

use super::mutant::WrongRule;

/// A process of this computer. The kernel reuses process ids, so the start time is part of the identity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Process {
    pub pid: u32,
    /// When it was started, in clock ticks since boot.
    pub started: u64,
}

/// The process that owns a listening socket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Owner {
    pub process: Process,
    /// The process id that the process itself sees, which differs in a container. A node answers `getPid` with it.
    pub own_pid: i32,
}

/// A registered node name on this computer.
#[derive(Clone, Copy, Debug)]
pub struct LocalName<'a> {
    pub node: &'a str,
    /// The node's address up to the port.
    pub port: &'a str,
    /// The number of the name's latest registration, which grows with each registration of any node.
    pub registered: u64,
    /// The process id that the node has answered to `getPid` since its latest registration.
    pub answered_pid: Option<i32>,
}

/// What the kernel shows about a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Evidence {
    /// The socket with which the node registered listens.
    Listens,
    /// The node's process has ended, and its socket is gone.
    Ended(Death),
    /// Another socket listens at the node's port, and nothing proves that the node has ended.
    Replaced,
    /// The kernel proves nothing.
    Unknown,
}

/// A proved end of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Death {
    pub process: Process,
    /// When the end was noticed.
    pub since: Instant,
    /// The number of the node's last registration. A node that registers again is another process.
    pub registered: u64,
    /// Whether another socket listens at the node's port now.
    pub taken: bool,
}

impl Death {
    /// Whether the name itself can be unregistered. `others` says whether other names are registered at its port. If
    /// not, the process that listens there may have the name, after a registration that rosrescue has not seen.
    pub fn is_certain(&self, others: bool) -> bool {
        !self.taken || others
    }
}

/// The process behind a name, as the kernel showed it when the name registered.
#[derive(Clone, Debug)]
struct Registrant {
    port: String,
    /// The sockets that listened at the port when the name registered. Only one proves anything.
    sockets: Vec<u64>,
    registered: u64,
    /// Whether other names have registered with the same socket.
    shared: bool,
    /// The process id that the node has answered while this socket listened.
    answered_pid: Option<i32>,
    ended: Option<Instant>,
}

/// The process behind each registered name on this computer.
#[derive(Debug, Default)]
pub struct Registrants {
    of: HashMap<String, Registrant>,
    /// The owners of the sockets of all names. `None` if the kernel hides the owner.
    owners: HashMap<u64, Option<Owner>>,
}

impl Registrants {
    /// Brings the names up to date. `sockets` gives the inodes of the sockets that listen at a port of this computer,
    /// and `None` for a port of another computer. It must be read after `names`.
    pub fn update<'a>(
        &mut self,
        names: &[LocalName<'a>],
        sockets: impl Fn(&'a str) -> Option<&'a [u64]>,
    ) {
        let registered: HashSet<_> = names.iter().map(|name| name.node).collect();
        self.of.retain(|node, _| registered.contains(node.as_str()));
        for name in names {
            let Some(sockets) = sockets(name.port) else {
                self.of.remove(name.node);
                continue;
            };
            let known = self.of.get_mut(name.node);
            match known.filter(|known| known.port == name.port) {
                Some(known) if known.is_among(sockets) => {
                    known.registered = name.registered;
                    known.answered_pid = name.answered_pid.or(known.answered_pid);
                }
                // The name has not registered since, so another socket is not the node's. What that one answers does
                // not count: its process id may be that of a process that has ended.
                Some(known) if known.registered == name.registered => {}
                _ => self.bind(name, sockets),
            }
        }
        let used: BTreeSet<_> = self.of.values().flat_map(|of| of.sockets.clone()).collect();
        self.owners.retain(|socket, _| used.contains(socket));
    }

    /// Remembers the sockets at a port as those with which the node has registered.
    fn bind(&mut self, name: &LocalName<'_>, sockets: &[u64]) {
        self.of.remove(name.node);
        let mut shared = false;
        for other in self.of.values_mut().filter(|of| of.is_among(sockets)) {
            (other.shared, shared) = (true, true);
        }
        let registrant = Registrant {
            port: name.port.to_owned(),
            sockets: sockets.to_vec(),
            registered: name.registered,
            shared,
            answered_pid: name.answered_pid,
            ended: None,
        };
        self.of.insert(name.node.to_owned(), registrant);
    }

    /// The sockets whose owners have not been looked for yet.
    pub fn unowned(&self) -> BTreeSet<u64> {
        let sockets = self.of.values().filter_map(Registrant::socket);
        sockets
            .filter(|socket| !self.owners.contains_key(socket))
            .collect()
    }

    /// Notes the owner of a socket. `None` if the kernel hides it.
    pub fn set_owner(&mut self, socket: u64, owner: Option<Owner>) {
        self.owners.insert(socket, owner);
    }

    /// The process whose end would prove that of `node` at `port`. `None` if its end would prove nothing.
    pub fn process(&self, node: &str, port: &str) -> Option<Process> {
        let known = self.of.get(node).filter(|known| known.port == port);
        let known = known.filter(|known| !known.shared)?;
        let owner = (*self.owners.get(&known.socket()?)?)?;
        (known.answered_pid == Some(owner.own_pid)).then_some(owner.process)
    }

    /// What the kernel shows about the node `node` at `port`, where `sockets` listen. `has_ended` says whether a process
    /// has ended; it is asked only if the node's socket is gone.
    pub fn evidence(
        &mut self,
        node: &str,
        port: &str,
        sockets: &[u64],
        has_ended: impl Fn(Process) -> bool,
        now: Instant,
    ) -> Evidence {
        let known = self.of.get_mut(node).filter(|known| known.port == port);
        let Some(known) = known else {
            return Evidence::Unknown;
        };
        let taken = !sockets.is_empty();
        let unproved = match taken {
            true => Evidence::Replaced,
            false => Evidence::Unknown,
        };
        let shared = known.shared && !WrongRule::SharedSocketProves.lives();
        if known.is_among(sockets) {
            return match known.socket() {
                Some(_) if !shared => Evidence::Listens,
                _ => Evidence::Unknown,
            };
        }
        let owner = known.socket().and_then(|socket| *self.owners.get(&socket)?);
        let confirmed = owner.filter(|owner| {
            let answered =
                known.answered_pid == Some(owner.own_pid) || WrongRule::TrustsForwarders.lives();
            answered && !shared
        });
        match confirmed {
            Some(owner) if has_ended(owner.process) || WrongRule::ClosedPortIsDeath.lives() => {
                Evidence::Ended(Death {
                    process: owner.process,
                    since: *known.ended.get_or_insert(now),
                    registered: known.registered,
                    taken,
                })
            }
            _ => unproved,
        }
    }
}

impl Registrant {
    /// The socket of the node, if it is certain.
    fn socket(&self) -> Option<u64> {
        match self.sockets.as_slice() {
            [socket] => Some(*socket),
            _ => None,
        }
    }

    /// Whether one of the node's possible sockets is among `sockets`.
    fn is_among(&self, sockets: &[u64]) -> bool {
        self.sockets.iter().any(|socket| sockets.contains(socket))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PORT: &str = "http://h:1";

    fn name(node: &str, registered: u64, answered_pid: Option<i32>) -> LocalName<'_> {
        LocalName {
            node,
            port: PORT,
            registered,
            answered_pid,
        }
    }

    fn owner(pid: u32, own_pid: i32) -> Option<Owner> {
        let process = Process {
            pid,
            started: 100 + u64::from(pid),
        };
        Some(Owner { process, own_pid })
    }

    /// The evidence about `/a` while `sockets` listen and the processes `ended` have ended.
    fn of_a(known: &mut Registrants, sockets: &[u64], ended: &[u32]) -> Evidence {
        let has_ended = |process: Process| ended.contains(&process.pid);
        known.evidence("/a", PORT, sockets, has_ended, Instant::now())
    }

    /// `/a`, which listens with socket 7 of process 1 and has answered `answered_pid`.
    fn registered(answered_pid: Option<i32>, owner: Option<Owner>) -> Registrants {
        let mut known = Registrants::default();
        known.update(&[name("/a", 1, answered_pid)], |_| Some(&[7]));
        assert_eq!(known.unowned(), BTreeSet::from([7]));
        known.set_owner(7, owner);
        assert!(known.unowned().is_empty());
        known
    }

    #[test]
    fn a_node_has_ended_when_its_socket_and_its_process_are_gone() {
        let mut known = registered(Some(1), owner(1, 1));
        assert_eq!(
            known.process("/a", PORT).map(|process| process.pid),
            Some(1)
        );
        assert_eq!(of_a(&mut known, &[7], &[]), Evidence::Listens);
        // A forked child, or a zombie, holds the socket.
        assert_eq!(of_a(&mut known, &[7], &[1]), Evidence::Listens);
        // roslisp closes its port first and unregisters later.
        assert_eq!(of_a(&mut known, &[], &[]), Evidence::Unknown);
        assert_eq!(of_a(&mut known, &[8], &[]), Evidence::Replaced);
        for (sockets, taken) in [(&[][..], false), (&[8][..], true)] {
            let Evidence::Ended(death) = of_a(&mut known, sockets, &[1]) else {
                panic!("{sockets:?}");
            };
            assert_eq!((death.process.pid, death.registered), (1, 1));
            assert_eq!(death.taken, taken);
            assert_eq!(death.is_certain(false), !taken);
            assert!(death.is_certain(true));
        }
    }

    #[test]
    fn a_process_that_the_node_has_not_confirmed_proves_nothing() {
        // A container's port is forwarded by process 1, and the node calls itself process 12.
        for answered_pid in [None, Some(12)] {
            let mut known = registered(answered_pid, owner(1, 1));
            assert_eq!(known.process("/a", PORT), None);
            assert_eq!(of_a(&mut known, &[], &[1]), Evidence::Unknown);
            assert_eq!(of_a(&mut known, &[8], &[1]), Evidence::Replaced);
        }
        // A container with the host's network: the node sees another process id than the host.
        let mut known = registered(Some(12), owner(1, 12));
        assert!(matches!(of_a(&mut known, &[], &[1]), Evidence::Ended(_)));
        // The kernel hides the processes of other users.
        let mut known = registered(Some(1), None);
        assert_eq!(of_a(&mut known, &[], &[1]), Evidence::Unknown);
        assert_eq!(of_a(&mut known, &[8], &[]), Evidence::Replaced);
    }

    #[test]
    fn a_socket_with_several_names_proves_nothing() {
        let mut known = registered(Some(1), owner(1, 1));
        let both = [name("/a", 1, Some(1)), name("/b", 2, Some(1))];
        known.update(&both, |_| Some(&[7]));
        for sockets in [&[7][..], &[]] {
            assert_eq!(of_a(&mut known, sockets, &[1]), Evidence::Unknown);
        }
        assert_eq!(of_a(&mut known, &[8], &[1]), Evidence::Replaced);
        // One of several sockets at a port may be anybody's.
        let mut known = Registrants::default();
        known.update(&[name("/a", 1, Some(1))], |_| Some(&[7, 8]));
        assert_eq!(of_a(&mut known, &[8], &[1]), Evidence::Unknown);
        // Nobody listened when the name registered, so a later socket is not the node's.
        let mut known = Registrants::default();
        for sockets in [&[][..], &[9]] {
            known.update(&[name("/a", 1, None)], |_| Some(sockets));
        }
        assert_eq!(of_a(&mut known, &[9], &[]), Evidence::Replaced);
    }

    #[test]
    fn a_name_that_registers_again_is_another_process() {
        let mut known = registered(Some(1), owner(1, 1));
        // Another program has the port. The name has not registered since.
        known.update(&[name("/a", 1, Some(1))], |_| Some(&[8]));
        assert!(matches!(of_a(&mut known, &[8], &[1]), Evidence::Ended(_)));
        // The node was started again at the same port.
        known.update(&[name("/a", 5, None)], |_| Some(&[8]));
        assert_eq!(of_a(&mut known, &[8], &[1]), Evidence::Listens);
        assert_eq!(known.unowned(), BTreeSet::from([8]));
        // The name is on another computer now.
        known.update(&[name("/a", 6, None)], |_| None);
        assert_eq!(of_a(&mut known, &[], &[1]), Evidence::Unknown);
    }
}
