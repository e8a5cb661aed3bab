//! The nodes of this computer, as the kernel shows them: who listens at their ports, and whose process has ended.

mod moves;
mod unregister_dead;

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, HashSet},
    net::{IpAddr, SocketAddr},
    sync::{Mutex, MutexGuard, PoisonError},
    time::Instant,
};

use rescue_core::{
    health::{
        AddressChanges, Evidence, Feuds, LocalName, Moving, NodeAddresses, Reach, Reap,
        Registrants, port_of,
    },
    replay::Token,
};
use tokio::sync::Notify;

pub(super) use self::unregister_dead::unregister_dead;
use super::{liveness, origin::log_misaddressed};
use crate::{
    clock,
    ledger::Ledger,
    process::listeners,
    resolver,
    status::{stats::Stats, summary::Misaddressed},
    upstream::sockets,
};

/// The listening sockets of this computer, by address.
pub(super) type Listening = HashMap<SocketAddr, Vec<u64>>;

/// What the kernel shows about the nodes of this computer.
#[derive(Debug)]
pub(crate) struct LocalNodes {
    reap: Reap,
    stats: &'static Stats,
    facts: Mutex<KernelFacts>,
    feuds: Mutex<Feuds>,
    /// Wakes the task that reads the socket table, because a node has registered.
    pub(super) registered: Notify,
    /// Moved names whose evidence has not been read yet, because no call waits for it.
    unreported: Mutex<Vec<Moving>>,
    /// Wakes the task that reports [`Self::unreported`].
    pub(super) moved: Notify,
}

#[derive(Debug, Default)]
struct KernelFacts {
    /// For each port of a node, the addresses to which it led when it was last looked up, and when that was.
    at: HashMap<String, (Vec<IpAddr>, Instant)>,
    /// For each port that leads to this computer, the addresses at which a node may listen.
    here: HashMap<String, Vec<SocketAddr>>,
    /// Nodes of other computers that are registered under an address of this one, and that nobody can reach there.
    misaddressed: BTreeMap<String, Misaddressed>,
    registrants: Registrants,
    evidence: HashMap<String, Evidence>,
    /// Dead nodes that were reported or unregistered, each with the number of its last registration.
    handled: HashMap<String, u64>,
    addresses: NodeAddresses,
}

/// A registered name.
pub(super) struct Named {
    pub(super) node: String,
    api: String,
    /// The address up to the port.
    pub(super) port: String,
    registered: u64,
    /// Whether the node has ever answered at this address.
    pub(super) has_answered: bool,
    /// The process id that the node has answered since its last registration.
    answered_pid: Option<i32>,
    /// The computer from which the node has registered; `None` for this one.
    pub(super) from: Option<IpAddr>,
    /// See [`Master::is_listed`](ros1_master::master::Master::is_listed).
    pub(super) is_listed: bool,
}

/// All registered names, without rosrescue's own.
pub(super) fn names(ledger: &Ledger) -> Vec<Named> {
    // Calls wait for the ledger's lock, so only what the copy lacks is looked up under it.
    let (mirror, known) = ledger.with_activity(|mirror, activity| {
        let known = mirror.nodes().map(|(node, api)| {
            let registered = activity.last_calls(node).registered;
            (registered, activity.pid_of(node, api))
        });
        let known: Vec<_> = known.collect();
        (mirror.clone(), known)
    });
    let names = mirror.nodes().zip(known);
    let names = names.filter(|((node, _), _)| !Token::is_ours(node));
    let named = names.map(|((node, api), (registered, pid))| Named {
        node: node.to_owned(),
        api: api.to_owned(),
        port: port_of(api).to_owned(),
        registered,
        has_answered: pid.is_some(),
        from: mirror.registered_from(node),
        is_listed: mirror.is_listed(node),
        answered_pid: match pid {
            Some((pid, false)) => Some(pid),
            // An answer from before the last registration may be another process's.
            Some((_, true)) | None => None,
        },
    });
    named.collect()
}

impl LocalNodes {
    pub(crate) fn new(reap: Reap, stats: &'static Stats) -> Self {
        Self {
            reap,
            stats,
            facts: Mutex::default(),
            feuds: Mutex::default(),
            registered: Notify::new(),
            unreported: Mutex::default(),
            moved: Notify::new(),
        }
    }

    /// Whether a regular health check unregisters dead nodes.
    pub(super) fn is_regular_check_enabled(&self) -> bool {
        self.reap == Reap::All
    }

    fn lock(&self) -> MutexGuard<'_, KernelFacts> {
        self.facts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes the addresses to which `port` leads.
    pub(super) fn set_addresses(&self, port: &str, addresses: Vec<SocketAddr>) {
        let here = liveness::local_addresses(&addresses);
        let at = addresses.iter().map(SocketAddr::ip).collect();
        let mut known = self.lock();
        known.at.insert(port.to_owned(), (at, Instant::now()));
        known.addresses.set(port, here.iter().map(SocketAddr::ip));
        match here.is_empty() {
            true => known.here.remove(port),
            false => known.here.insert(port.to_owned(), here),
        };
    }

    /// What the address with this `port` proves about a node that has registered from the computer `from`; `None` for
    /// this one.
    pub(super) fn reach(&self, port: &str, from: Option<IpAddr>) -> Reach {
        let known = self.lock();
        match from {
            None if known.addresses.is_lost(port) => Reach::Elsewhere { loopback: false },
            None => Reach::Certain,
            Some(_) => known.reach(port, from),
        }
    }

    /// Nodes of other computers that are registered under an address that means each computer itself.
    pub(crate) fn misaddressed(&self) -> Vec<Misaddressed> {
        self.lock().misaddressed.values().cloned().collect()
    }

    /// Updates what is known of all nodes. `names` are those of `since`, and `listening` is the socket table of a later
    /// moment. Returns whether a process listens at each port of this computer. Without `proves`, as on a computer that
    /// does not see all registrations, the table proves nothing about single names.
    pub(super) fn update(
        &self,
        names: &[Named],
        since: Instant,
        listening: &Listening,
        proves: bool,
    ) -> HashMap<String, bool> {
        let now = Instant::now();
        let known = &mut *self.lock();
        if !proves {
            known.registrants = Registrants::default();
        }
        let registered: HashSet<_> = names.iter().map(|name| name.port.as_str()).collect();
        // A node that has registered meanwhile may need what was looked up for it.
        known
            .at
            .retain(|port, (_, when)| registered.contains(port.as_str()) || *when >= since);
        let at = &known.at;
        known.here.retain(|port, _| at.contains_key(port));
        known.addresses.retain(|port| at.contains_key(port));
        let here = known.here.iter();
        let sockets: HashMap<_, _> = here
            .map(|(port, addresses)| (port.as_str(), accepting(listening, addresses)))
            .collect();
        // The sockets at the address of a node that is elsewhere are not the node's.
        let (local, foreign): (Vec<&Named>, Vec<_>) = names
            .iter()
            .partition(|name| known.reach(&name.port, name.from).answer_counts());
        let at = |port| sockets.get(port).map(Vec::as_slice);
        let misaddressed = foreign
            .iter()
            .filter_map(|name| known.misaddressed(name, at(name.port.as_str())));
        let misaddressed: BTreeMap<_, _> = misaddressed.map(|it| (it.node.clone(), it)).collect();
        let new = misaddressed.values();
        let new = new.filter(|it| known.misaddressed.get(&it.node) != Some(it));
        log_misaddressed(&new.cloned().collect::<Vec<_>>());
        known.misaddressed = misaddressed;
        let names = local;
        let local: Vec<_> = names.iter().map(|name| name.local()).collect();
        if proves {
            known.registrants.update(&local, at);
        }
        known.evidence.clear();
        for name in names {
            let evidence = match at(name.port.as_str()) {
                Some(sockets) => known.registrants.evidence(
                    &name.node,
                    &name.port,
                    sockets,
                    listeners::has_ended,
                    now,
                ),
                None => Evidence::Unknown,
            };
            if evidence != Evidence::Unknown {
                known.evidence.insert(name.node.clone(), evidence);
            }
        }
        let known_handled = &mut known.handled;
        known_handled.retain(|node, _| known.evidence.contains_key(node));
        let listens = sockets.into_iter();
        listens
            .map(|(port, sockets)| (port.to_owned(), !sockets.is_empty()))
            .collect()
    }

    /// The ports of nodes that are registered at a lost address.
    pub(super) fn ports_at_lost_addresses(&self) -> Vec<String> {
        let known = self.lock();
        let lost = known.addresses.lost_ports();
        lost.map(|(port, ..)| port.to_owned()).collect()
    }

    /// The addresses that this computer has lost and that nodes are registered at, each with their ports and the time.
    pub(crate) fn lost_addresses(&self) -> BTreeMap<IpAddr, (Instant, BTreeSet<String>)> {
        let mut lost = BTreeMap::new();
        for (port, address, since) in self.lock().addresses.lost_ports() {
            let (at, ports) = lost
                .entry(address)
                .or_insert_with(|| (since, BTreeSet::new()));
            *at = since.min(*at);
            ports.insert(port.to_owned());
        }
        lost
    }

    /// Finds which nodes' addresses this computer has lost or got back.
    pub(super) fn update_addresses(&self, is_own: impl Fn(IpAddr) -> bool) -> AddressChanges {
        self.lock().addresses.update(is_own, Instant::now())
    }

    /// Finds the owners of the nodes' sockets that have not been looked for yet. Blocks for some milliseconds if there
    /// are any.
    pub(super) fn find_owners(&self) {
        let unowned = self.lock().registrants.unowned();
        if unowned.is_empty() {
            return;
        }
        for (socket, owner) in listeners::owners(&unowned) {
            self.lock().registrants.set_owner(socket, owner);
        }
    }

    /// What the last look has shown about `node`.
    pub(super) fn evidence(&self, node: &str) -> Evidence {
        let known = self.lock();
        let evidence = known.evidence.get(node);
        evidence.copied().unwrap_or(Evidence::Unknown)
    }

    /// The process whose end would prove that of `node` at `port`.
    pub(super) fn process(&self, node: &str, port: &str) -> Option<u32> {
        let process = self.lock().registrants.process(node, port);
        process.map(|process| process.pid)
    }

    /// What the kernel shows now about the node at the old address.
    fn evidence_now(&self, moving: &Moving) -> Evidence {
        let (node, port) = (moving.node.as_str(), port_of(&moving.from));
        let known = &mut *self.lock();
        let Some(addresses) = known.here.get(port) else {
            return Evidence::Unknown;
        };
        let sockets = accepting(&sockets::listening(), addresses);
        let reach = known.reach(port, moving.computer);
        if let Some(evidence) = Moving::evidence_elsewhere(reach, !sockets.is_empty()) {
            return evidence;
        }
        let ended = listeners::has_ended;
        known
            .registrants
            .evidence(node, port, &sockets, ended, Instant::now())
    }
}

impl KernelFacts {
    fn reach(&self, port: &str, from: Option<IpAddr>) -> Reach {
        let at = self.at.get(port).map_or(&[][..], |(at, _)| at);
        Reach::classify(from, at, resolver::is_own)
    }

    /// The facts about `name`, if nobody can reach the node at its address. `sockets` listen there. A container's port
    /// may be forwarded from an address of this computer.
    fn misaddressed(&self, name: &Named, sockets: Option<&[u64]>) -> Option<Misaddressed> {
        let from = name.from?;
        let is_forwarded = sockets.is_some_and(|sockets| !sockets.is_empty());
        let reaches_nobody = match self.reach(&name.port, name.from) {
            Reach::Elsewhere { loopback } => loopback || !is_forwarded,
            Reach::Certain | Reach::Doubtful => false,
        };
        let new = Misaddressed {
            node: name.node.clone(),
            api: name.api.clone(),
            from,
            since: clock::wall_time().round(),
        };
        let known = self.misaddressed.get(&name.node);
        let known = known.filter(|known| (&known.api, known.from) == (&new.api, from));
        reaches_nobody.then(|| known.cloned().unwrap_or(new))
    }
}

impl Named {
    fn local(&self) -> LocalName<'_> {
        LocalName {
            node: &self.node,
            port: &self.port,
            registered: self.registered,
            answered_pid: self.answered_pid,
        }
    }
}

/// The sockets that accept connections to one of `addresses`.
fn accepting(listening: &Listening, addresses: &[SocketAddr]) -> Vec<u64> {
    let sockets = addresses.iter();
    let sockets: BTreeSet<_> = sockets
        .flat_map(|address| sockets::accepting(listening, *address))
        .collect();
    sockets.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_looked_up_for_a_node_that_registers_during_a_look_is_kept() {
        let stats = Box::leak(Box::default());
        let local = LocalNodes::new(Reap::Local, stats);
        let from = "10.0.0.9".parse().ok();
        let reach = || local.reach("http://localhost:1", from);
        let look = |since| local.update(&[], since, &HashMap::new(), true);
        let before = Instant::now();
        local.set_addresses("http://localhost:1", vec![([127, 0, 0, 1], 1).into()]);
        look(before);
        assert_eq!(reach(), Reach::Elsewhere { loopback: true });
        look(Instant::now() + std::time::Duration::from_secs(1));
        assert_eq!(reach(), Reach::Doubtful);
    }
}
