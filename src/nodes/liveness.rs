//! Finds out which nodes are alive, for reports only. A node on this computer is alive while a process listens at its
//! port, which the kernel's socket table shows. Other nodes are asked every 30 s.

use std::{
    collections::{BTreeMap, BTreeSet, HashSet},
    net::SocketAddr,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use tokio::{
    sync::Semaphore,
    time::{MissedTickBehavior, interval, timeout},
};

use super::{
    Nodes,
    client::{self, Reaction},
};
use crate::{
    gate::State,
    health::{self, Health, port_of},
    limit::rarely,
    master,
    replay::Token,
    resolver,
    ros_env::MasterUri,
    upstream::sockets,
};

/// Pause between two reads of the socket table.
const LOOK_AGAIN: Duration = Duration::from_secs(2);
/// Number of nodes asked at the same time.
const AT_ONCE: usize = 8;

/// What is known about which nodes are alive.
#[derive(Debug)]
pub(super) struct LivenessEvidence {
    known: Mutex<Known>,
    permits: Semaphore,
}

#[derive(Debug, Default)]
struct Known {
    liveness: health::Liveness,
    /// For each port of a node on this computer, the addresses at which the node may listen.
    here: BTreeMap<String, Vec<SocketAddr>>,
}

/// Whether a registered node is alive, as far as known.
#[derive(Clone, Debug)]
pub(crate) struct Life {
    pub(crate) health: Health,
    /// When rosrescue last found out whether the node is alive. `None` if it never has.
    pub(crate) checked: Option<Instant>,
}

impl Default for LivenessEvidence {
    fn default() -> Self {
        Self {
            known: Mutex::default(),
            permits: Semaphore::new(AT_ONCE),
        }
    }
}

impl LivenessEvidence {
    fn lock(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Nodes {
    /// Whether each registered node is alive, by name.
    pub(crate) fn lives(&self) -> BTreeMap<String, Life> {
        let now = Instant::now();
        // The clone releases this lock before the ledger's lock is taken.
        let unreachable = self.lock().clone();
        let nodes: Vec<_> = self.ledger.with_mirror(|mirror| {
            let nodes = mirror.nodes().filter(|(name, _)| !Token::is_ours(name));
            nodes
                .map(|(name, api)| (name.to_owned(), port_of(api).to_owned()))
                .collect()
        });
        let known = self.liveness.lock();
        let lives = nodes.into_iter().map(|(name, port)| {
            let seen = known.liveness.seen(&port);
            let life = Life {
                health: Health::of(seen, unreachable.contains(&port), now),
                checked: seen.map(|seen| seen.at),
            };
            (name, life)
        });
        lives.collect()
    }
}

/// Watches the nodes as long as it is polled.
pub(crate) async fn watch(nodes: Arc<Nodes>) {
    let mut looks = interval(LOOK_AGAIN);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        looks.tick().await;
        let registered: BTreeSet<String> = nodes.ledger.with_mirror(|mirror| {
            let nodes = mirror.nodes().filter(|(name, _)| !Token::is_ours(name));
            nodes.map(|(_, api)| port_of(api).to_owned()).collect()
        });
        // This blocks for less than a millisecond: the kernel generates some kilobytes.
        let listening = match registered.is_empty() {
            true => HashSet::new(),
            false => sockets::listening(),
        };
        let due = {
            let mut known = nodes.liveness.lock();
            let Known { liveness, here } = &mut *known;
            here.retain(|port, _| registered.contains(port));
            let listens = |port: &str| here.get(port).map(|at| is_among(at, &listening));
            liveness.round(&registered, listens, Instant::now())
        };
        let listening = Arc::new(listening);
        for port in due {
            crate::task::spawn(ask(nodes.clone(), port, listening.clone()));
        }
    }
}

/// Whether a process listens at any of `addresses`.
fn is_among(addresses: &[SocketAddr], listening: &HashSet<SocketAddr>) -> bool {
    addresses.iter().any(|address| {
        let port = address.port();
        let any = [([0; 4], port).into(), ([0; 16], port).into()];
        listening.contains(address) || any.iter().any(|any| listening.contains(any))
    })
}

/// Asks the node at `port`, unless a process on this computer listens there.
async fn ask(nodes: Arc<Nodes>, port: String, listening: Arc<HashSet<SocketAddr>>) {
    // The semaphore is never closed.
    let permit = nodes.liveness.permits.acquire().await;
    let here = addresses_here(&port, nodes.timeout).await;
    let sign = match &here {
        None => None,
        Some(here) if is_among(here, &listening) => Some(Reaction::Alive),
        Some(_) => match nodes.visits.admit(&port, nodes.timeout).await {
            Some(_admitted) => Some(client::ask(&port, &master::get_pid(), nodes.timeout).await),
            None => None,
        },
    };
    drop(permit);
    let has_died = {
        let mut known = nodes.liveness.lock();
        if let Some(here) = here.filter(|here| !here.is_empty()) {
            known.here.insert(port.clone(), here);
        }
        known.liveness.answered(&port, sign, Instant::now())
    };
    // Nothing is logged while the mirror stands in: the health check afterwards reports dead nodes.
    if has_died && matches!(nodes.gate.state(), State::Open { .. }) {
        let names: Vec<_> = nodes.ledger.with_mirror(|mirror| {
            let nodes = mirror.nodes().filter(|(_, api)| port_of(api) == port);
            nodes.map(|(name, _)| name.to_owned()).collect()
        });
        rarely!(
            info,
            ?names,
            "a registered node is dead: its port refuses connections. It stays registered until it restarts, is unregistered, or fails a health check (--reap-dead-nodes)"
        );
    }
}

/// The addresses of `api` that belong to this computer. `None` if it has no address within `limit`.
async fn addresses_here(api: &str, limit: Duration) -> Option<Vec<SocketAddr>> {
    let MasterUri { host, port } = MasterUri::parse(api).ok()?;
    let found = timeout(limit, resolver::addresses(&host, port)).await;
    let mut found = found.ok()?.ok()?;
    for address in &mut found {
        address.set_ip(address.ip().to_canonical());
    }
    found.retain(|address| resolver::is_own(address.ip()));
    Some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_table_of_sockets_tells_who_listens_on_this_computer() {
        let limit = Duration::from_secs(60);
        for host in ["127.0.0.1", "0.0.0.0"] {
            let listener = std::net::TcpListener::bind((host, 0)).unwrap();
            let port = listener.local_addr().unwrap().port();
            let api = format!("http://127.0.0.1:{port}");
            let here = addresses_here(&api, limit).await.unwrap();
            assert!(is_among(&here, &sockets::listening()), "{host}");
            drop(listener);
            crate::process::listeners::wait_closed(port);
            assert!(!is_among(&here, &sockets::listening()), "{host}");
        }
        // These networks and names are reserved for documentation.
        assert_eq!(
            addresses_here("http://192.0.2.1:80", limit).await,
            Some(Vec::new())
        );
        assert_eq!(
            addresses_here("http://nobody.invalid:80", limit).await,
            None
        );
    }
}
