//! Finds out which nodes are alive, for reports only. A node on this computer is alive while a process listens at its
//! port, which the kernel's socket table shows. Other nodes are asked every 30 s.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    net::SocketAddr,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use rescue_core::health::{self, Evidence, Health};
use ros1_master::master;
use tokio::{
    sync::Semaphore,
    time::{MissedTickBehavior, interval},
};

use super::{
    Nodes,
    client::{self, Reaction},
    local::{self, Listening},
    origin,
};
use crate::{
    clock,
    gate::State,
    limit::rarely,
    resolver,
    status::{condition::NodesTrouble, summary::IllNode},
    upstream::sockets,
};

/// Pause between two reads of the socket table.
const LOOK_AGAIN: Duration = Duration::from_secs(1);
/// Pause before it is noted again since when each node's health has been the same. It costs as much as a look.
const NOTE_AGAIN: Duration = Duration::from_secs(5);
/// Shortest pause before the table is read again because nodes register.
const SETTLE: Duration = Duration::from_millis(100);
/// The same pause, as a multiple of the time that the last look took. A look at 10,000 nodes takes longer than [`SETTLE`].
const SETTLE_LOOKS: u32 = 10;
/// Number of nodes asked at the same time. A node that does not answer takes a place for `--node-timeout`, and the others
/// must have their turn before what is known of them is too old.
const AT_ONCE: usize = 32;

/// What is known about which nodes are alive.
#[derive(Debug)]
pub(super) struct LivenessEvidence {
    known: Mutex<HealthByNode>,
    permits: Semaphore,
}

#[derive(Debug, Default)]
struct HealthByNode {
    liveness: health::Liveness,
    /// Health of each node at the last look, and since when.
    since: BTreeMap<String, (Health, Instant)>,
}

/// Whether a registered node is alive, as far as known.
#[derive(Clone, Debug)]
pub(crate) struct Life {
    pub(crate) health: Health,
    /// When rosrescue last found out whether the node is alive. `None` if it never has.
    pub(crate) checked: Option<Instant>,
    /// Since when the node's health has been the same.
    pub(crate) since: Instant,
    /// The process on this computer whose end would prove the node dead.
    pub(crate) process: Option<u32>,
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
    fn lock(&self) -> MutexGuard<'_, HealthByNode> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Nodes {
    /// Whether each registered node is alive, by name.
    pub(crate) fn lives(&self) -> BTreeMap<String, Life> {
        let now = Instant::now();
        // The clone releases this lock before the ledger's lock is taken.
        let unreachable = self.lock().clone();
        let names = local::names(&self.ledger);
        let known = self.liveness.lock();
        let lives = names.into_iter().filter_map(|named| {
            let (name, port) = (named.node, named.port);
            let seen = known.liveness.last_seen(&port);
            let evidence = self.local.evidence(&name);
            let reach = self.local.reach(&port, named.from);
            let health = Health::from_last_seen(seen, unreachable.contains(&port), now);
            let health = health
                .as_proved(reach, named.has_answered)
                .corrected_by(evidence);
            let noted = known.since.get(&name).filter(|(noted, _)| *noted == health);
            let life = Life {
                process: self.local.process(&name, &port),
                health,
                checked: seen.map(|seen| seen.at),
                since: match (evidence, noted) {
                    (Evidence::Ended(death), _) => death.since,
                    (_, Some((_, since))) => *since,
                    (_, None) => now,
                },
            };
            // What a node has left behind that stopped cleanly is no dead node.
            (named.is_listed || health == Health::Alive).then_some((name, life))
        });
        lives.collect()
    }

    /// What is wrong with nodes. `lives` says whether each registered node is alive.
    pub(crate) fn trouble(&self, lives: &BTreeMap<String, Life>) -> NodesTrouble {
        let ill = |node: &str, since| IllNode {
            node: node.to_owned(),
            since: clock::wall_time_of(since).round(),
        };
        let with = |health| {
            let nodes = lives.iter().filter(|(_, life)| life.health == health);
            nodes.map(|(node, life)| ill(node, life.since)).collect()
        };
        let unregistered = self.removed.lately(Instant::now()).into_iter();
        let unregistered = unregistered.filter(|(node, _)| !lives.contains_key(node));
        NodesTrouble {
            dead: with(Health::Dead),
            unregistered: unregistered.map(|(node, at)| ill(&node, at)).collect(),
            unreachable: with(Health::Unreachable),
            feuds: self.local.feuds(),
            lost_addresses: self.lost_addresses(),
            misaddressed: self.local.misaddressed(),
        }
    }

    /// Remembers since when each node's health has been the same.
    fn note_lives(&self) {
        let lives = self.lives().into_iter();
        let since = lives.map(|(name, life)| (name, (life.health, life.since)));
        self.liveness.lock().since = since.collect();
    }
}

/// Watches the nodes as long as it is polled. Reads the socket table every second, and when a node has registered or
/// moved.
pub(crate) async fn watch(nodes: Arc<Nodes>) {
    let mut looks = interval(LOOK_AGAIN);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut next = Instant::now();
    let mut noted = None;
    loop {
        let find_owners = tokio::select! {
            () = nodes.local.moved.notified() => {
                nodes.local.report_moves();
                continue;
            }
            _ = looks.tick() => true,
            () = async {
                tokio::time::sleep_until(next.into()).await;
                nodes.local.registered.notified().await;
            } => false,
        };
        let start = Instant::now();
        let note = noted.is_none_or(|noted| noted + NOTE_AGAIN <= start);
        if note {
            noted = Some(start);
        }
        let looking = nodes.clone();
        let look = crate::task::spawn_blocking(move || {
            if find_owners {
                looking.local.find_owners();
            }
            check_nodes(&looking);
            if note {
                looking.note_lives();
            }
        });
        // If it panics, the next look may succeed.
        drop(look.await);
        next = start + SETTLE.max(start.elapsed() * SETTLE_LOOKS);
    }
}

/// Checks all nodes once. Blocks for 0.1 s with 10,000 nodes.
fn check_nodes(nodes: &Arc<Nodes>) {
    let since = Instant::now();
    let names = local::names(&nodes.ledger);
    nodes.local.report_moves();
    let registered: BTreeSet<_> = names.iter().map(|name| name.port.clone()).collect();
    let listening = match registered.is_empty() {
        true => HashMap::new(),
        false => sockets::listening(),
    };
    let listens = nodes.local.update(
        &names,
        since,
        &listening,
        nodes.gate.state() != State::Elsewhere,
    );
    let due = nodes.liveness.lock().liveness.round(
        &registered,
        |port| listens.get(port).copied(),
        Instant::now(),
    );
    local::unregister_dead(nodes, &names);
    let listening = Arc::new(listening);
    for port in due {
        crate::task::spawn(probe_port(nodes.clone(), port, listening.clone()));
    }
}

/// Whether a process listens at any of `addresses`.
fn is_among(addresses: &[SocketAddr], listening: &Listening) -> bool {
    let sockets = |address: &SocketAddr| sockets::accepting(listening, *address);
    addresses.iter().any(|address| !sockets(address).is_empty())
}

/// Asks the node at `port`, unless a process on this computer listens there.
async fn probe_port(nodes: Arc<Nodes>, port: String, listening: Arc<Listening>) {
    // The semaphore is never closed.
    let permit = nodes.liveness.permits.acquire().await;
    let addresses = origin::addresses(&port, nodes.timeout).await;
    if let Some(addresses) = &addresses {
        nodes.local.set_addresses(&port, addresses.clone());
        nodes.local.registered.notify_one();
    }
    let mut reaches = nodes.reaches(&port).await;
    reaches.retain(|_, reach| reach.answer_counts());
    let sign = match &addresses {
        None => None,
        // What listens there is another program.
        Some(_) if reaches.is_empty() => None,
        Some(at) if is_among(&local_addresses(at), &listening) => Some(Reaction::Alive),
        Some(_) => match nodes.visits.admit(&port, nodes.timeout).await {
            Some(_admitted) => Some(client::call(&port, &master::get_pid(), nodes.timeout).await),
            None => None,
        },
    };
    drop(permit);
    let mut known = nodes.liveness.lock();
    let has_died = known.liveness.note_answer(&port, sign, Instant::now());
    drop(known);
    // Nothing is logged while the mirror stands in: the health check afterwards reports dead nodes.
    if has_died && matches!(nodes.gate.state(), State::Open { .. }) {
        let names: Vec<_> = nodes.ledger.with_activity(|mirror, activity| {
            let dead = mirror.nodes_at(&port).filter(|(name, api)| {
                let answered = activity.pid_of(name, api).is_some();
                let reach = reaches.get(*name);
                mirror.is_listed(name) && reach.is_some_and(|reach| reach.refusal_proves(answered))
            });
            dead.map(|(name, _)| name.to_owned()).collect()
        });
        // The log has named those that the kernel proves dead.
        let is_new = |name: &&String| !matches!(nodes.local.evidence(name), Evidence::Ended(_));
        let names: Vec<_> = names.iter().filter(is_new).collect();
        if names.is_empty() {
            return;
        }
        rarely!(
            info,
            ?names,
            "a registered node is dead: its port refuses connections. It stays registered until it restarts, is unregistered, or fails a health check (--reap all)"
        );
    }
}

/// Those of `addresses` that belong to this computer.
pub(super) fn local_addresses(addresses: &[SocketAddr]) -> Vec<SocketAddr> {
    let own = addresses.iter().filter(|at| resolver::is_own(at.ip()));
    own.copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn addresses_here(api: &str, limit: Duration) -> Option<Vec<SocketAddr>> {
        Some(local_addresses(&origin::addresses(api, limit).await?))
    }

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
