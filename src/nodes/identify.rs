//! Asks newly registered nodes for their process ids. A different process id at the same port will
//! later mean a different node.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use rescue_core::health::port_of;
use ros1_master::master;

use super::{Nodes, client};

/// Delay between a node's last registration and the question, because starting nodes are busy.
pub(super) const IDENTIFY_AFTER: Duration = Duration::from_secs(2);

/// Names without a known process id, by port. One question serves all names at a port.
#[derive(Debug, Default)]
pub(super) struct New(Mutex<BTreeMap<String, Vec<Name>>>);

#[derive(Debug)]
struct Name {
    node: String,
    api: String,
    /// Number of the name's last registration.
    registered: u64,
}

impl New {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Vec<Name>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether names at `port` still wait to be identified. If none do, the next name there needs a new task.
    fn go_on(&self, port: &str) -> bool {
        let mut new = self.lock();
        let waiting = new.get(port).is_some_and(|names| !names.is_empty());
        if !waiting {
            new.remove(port);
        }
        waiting
    }
}

/// Asks the nodes whose last registration was at least [`IDENTIFY_AFTER`] ago.
pub(super) fn new_nodes(nodes: &Arc<Nodes>) {
    let Some(before) = Instant::now().checked_sub(IDENTIFY_AFTER) else {
        return;
    };
    let due = nodes.ledger.with_activity(|mirror, activity| {
        let due = activity.take_unidentified(before).into_iter();
        let due = due.filter_map(|node| {
            let api = mirror.api_of(&node)?.to_owned();
            let registered = activity.last_calls(&node).registered;
            Some(Name {
                node,
                api,
                registered,
            })
        });
        due.collect::<Vec<_>>()
    });
    let mut new = nodes.new.lock();
    for name in due {
        let port = port_of(&name.api).to_owned();
        let names = new.entry(port.clone()).or_insert_with(|| {
            crate::task::spawn(identify(nodes.clone(), port));
            Vec::new()
        });
        names.push(name);
    }
}

async fn identify(nodes: Arc<Nodes>, port: String) {
    while nodes.new.go_on(&port) {
        let admitted = nodes.visits.admit(&port, nodes.timeout).await;
        // This includes names that were added meanwhile.
        let names = nodes.new.lock().get_mut(&port).map(std::mem::take);
        let mut names = names.unwrap_or_default();
        let reaches = nodes.reaches(&port).await;
        names.retain(|name| reaches.get(&name.node).is_some_and(|of| of.answer_counts()));
        // The health check asks unreachable nodes again.
        let asks = admitted.is_some() && !names.is_empty() && !nodes.is_unreachable(&port);
        let answer = match asks {
            true => {
                client::call_for_value(&port, &master::get_pid(), nodes.timeout)
                    .await
                    .1
            }
            false => None,
        };
        let Some(pid) = answer.and_then(|pid| pid.as_int()) else {
            continue;
        };
        nodes.ledger.with_activity(|_, activity| {
            for name in names {
                activity.remember_pid(&name.node, &name.api, name.registered, pid);
            }
        });
    }
}
