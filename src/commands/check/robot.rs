//! What a running rosrescue says about the robot's nodes.

use super::{Finding, Severity};
use crate::{
    commands::counted,
    status::summary::{Status, shortened},
};

/// The nodes that are in trouble.
pub(super) fn findings(status: &Status) -> Vec<Finding> {
    let nodes = &status.nodes;
    let finding = |what, todo: String| Finding {
        severity: Severity::Problem,
        subject: "nodes",
        what,
        todo,
    };
    let mut all = Vec::new();
    if !nodes.dead_nodes.is_empty() {
        let (count, names) = (nodes.dead_nodes.len(), nodes.with_times(&nodes.dead_nodes));
        let what = format!(
            "{} died without unregistering: {names}",
            counted(count, "node")
        );
        let todo = "restart these nodes, or unregister them: `rosnode cleanup`";
        all.push(finding(what, todo.to_owned()));
    }
    if !nodes.unregistered_nodes.is_empty() {
        let names = nodes.unregistered_nodes.iter().map(ToString::to_string);
        let names: Vec<_> = names.collect();
        let what = format!(
            "{} died, now unregistered: {}",
            counted(names.len(), "node"),
            shortened(&names)
        );
        all.push(finding(what, "restart these nodes".to_owned()));
    }
    for node in &nodes.misaddressed_nodes {
        let (name, api, from) = (&node.node, &node.api, node.from);
        let what = format!(
            "{name} has registered from {from} as {api}, so no other computer can reach it"
        );
        let todo = format!("on {from}: `export ROS_IP={from}`, and restart the node");
        all.push(finding(what, todo));
    }
    all
}
