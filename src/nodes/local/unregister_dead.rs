//! Unregisters nodes of this computer that the kernel proves dead.

use std::sync::Arc;

use rescue_core::health::{Death, Evidence, Reap};

use super::{
    super::{
        Nodes,
        health_check::{self, Removal},
    },
    Named,
};
use crate::{clock, ledger::activity::LastCalls, limit::rarely};

/// Reports or unregisters the nodes of `names` that are proved dead. Does nothing while the mirror answers in the
/// master's place: the health check afterwards deals with dead nodes.
pub(crate) fn unregister_dead(nodes: &Arc<Nodes>, names: &[Named]) {
    if !nodes.gate.is_open() {
        return;
    }
    for name in names {
        let Evidence::Ended(death) = nodes.local.evidence(&name.node) else {
            continue;
        };
        let others: Vec<_> = names
            .iter()
            .filter(|other| other.port == name.port && other.node != name.node)
            .map(|other| other.node.as_str())
            .collect();
        if !death.is_certain(!others.is_empty()) {
            continue;
        }
        let mut known = nodes.local.lock();
        if known.handled.get(&name.node) == Some(&death.registered) {
            continue;
        }
        known.handled.insert(name.node.clone(), death.registered);
        drop(known);
        let node = &name.node;
        let how = how(&death, &others);
        if nodes.local.reap == Reap::Report && !name.is_listed {
            continue;
        }
        if nodes.local.reap == Reap::Report {
            rarely!(info, "would have unregistered {node}: {how} (--reap local)");
            continue;
        }
        crate::task::spawn(unregister(
            nodes.clone(),
            name.node.clone(),
            name.api.clone(),
            death,
            how,
        ));
    }
}

async fn unregister(nodes: Arc<Nodes>, node: String, api: String, death: Death, how: String) {
    let same = |calls: LastCalls| calls.registered == death.registered && nodes.gate.is_open();
    match health_check::remove(&nodes, &node, &api, same).await {
        Removal::Node => {
            nodes.stats.dead_nodes_reaped.count();
            rarely!(info, "unregistered {node}: {how}");
        }
        Removal::Remains => {}
        Removal::Nothing => {
            // The next look tries again, if the node is still registered.
            nodes.local.lock().handled.remove(&node);
        }
    }
}

/// How a node has ended, as in `its process 7 ended at 14:03:01, no process listens at its port`. `others` are the other names
/// at its port.
fn how(death: &Death, others: &[&str]) -> String {
    let at = clock::wall_text(clock::wall_time_of(death.since));
    let time = at.get(11..19).unwrap_or(&at);
    let process = death.process.pid;
    let port = match death.taken {
        false => "no process listens at its port".to_owned(),
        true => format!("{} uses its port now", others.join(", ")),
    };
    format!("its process {process} ended at {time}, {port}")
}
