//! What is wrong with nodes, in words.

use std::{
    collections::{BTreeMap, BTreeSet},
    net::IpAddr,
};

use rescue_core::health::Feud;

use super::ConditionName;
use crate::{
    clock,
    status::summary::{IllNode, LostAddress, Misaddressed, shortened},
};

/// What is wrong with nodes.
#[derive(Debug, Default)]
pub(crate) struct NodesTrouble {
    /// Nodes that have died and are still registered.
    pub(crate) dead: Vec<IllNode>,
    /// Nodes that have died, that rosrescue has unregistered lately, and that have not come back.
    pub(crate) unregistered: Vec<IllNode>,
    /// Nodes that do not answer.
    pub(crate) unreachable: Vec<IllNode>,
    /// Names that two programs take from each other.
    pub(crate) feuds: Vec<Feud>,
    /// Addresses that this computer has lost, and at which nodes are registered.
    pub(crate) lost_addresses: Vec<LostAddress>,
    /// Nodes that no computer but their own can reach.
    pub(crate) misaddressed: Vec<Misaddressed>,
}

impl NodesTrouble {
    /// The worst condition of the nodes, and since when; `None` if nothing is wrong.
    pub(super) fn condition(&self) -> Option<(ConditionName, f64)> {
        let dead = self.dead.iter().chain(&self.unregistered);
        let since = |nodes: &mut dyn Iterator<Item = f64>| nodes.min_by(f64::total_cmp);
        let dead = since(&mut dead.map(|node| node.since));
        let unreachable = since(&mut self.unexplained().map(|node| node.since));
        let lost = self.lost_addresses.iter().map(|lost| lost.since);
        let misaddressed = self.misaddressed.iter().map(|node| node.since);
        let wrong = since(&mut lost.chain(misaddressed));
        dead.map(|since| (ConditionName::NodesDead, since))
            .or_else(|| unreachable.map(|since| (ConditionName::NodesUnreachable, since)))
            .or_else(|| wrong.map(|since| (ConditionName::WrongAddresses, since)))
    }

    /// Nodes that do not answer although this computer has their addresses.
    fn unexplained(&self) -> impl Iterator<Item = &IllNode> {
        let is_explained = |ill: &IllNode| {
            let mut lost = self.lost_addresses.iter();
            lost.any(|lost| lost.nodes.contains(&ill.node))
        };
        self.unreachable.iter().filter(move |it| !is_explained(it))
    }

    /// What nodes notice and what to do about each trouble, the worst first.
    pub(super) fn sentences(&self) -> Vec<(String, String)> {
        let mut all = Vec::new();
        if !self.dead.is_empty() {
            all.push((
                format!(
                    "{} died without unregistering: {}.",
                    count(&self.dead),
                    listed(&self.dead)
                ),
                "restart these nodes, or unregister them with `rosnode cleanup`.".to_owned(),
            ));
        }
        if !self.unregistered.is_empty() {
            let nodes = &self.unregistered;
            all.push((
                format!(
                    "{} died, now unregistered: {}.",
                    count(nodes),
                    listed(nodes)
                ),
                "restart these nodes, if the robot needs them.".to_owned(),
            ));
        }
        let unexplained: Vec<_> = self.unexplained().cloned().collect();
        if !unexplained.is_empty() {
            let nodes = &unexplained;
            let verb = if nodes.len() == 1 { "does" } else { "do" };
            all.push((
                format!("{} {verb} not answer: {}.", count(nodes), listed(nodes)),
                "see whether these nodes hang, and whether their computers are on and connected."
                    .to_owned(),
            ));
        }
        for LostAddress { address, nodes, .. } in &self.lost_addresses {
            all.push((
                format!("This computer has lost the address {address}, so no node can connect to {}.", shortened(nodes)),
                format!(
                    "give this computer the address {address} back, or restart these nodes with its present address in ROS_IP."
                ),
            ));
        }
        for (from, nodes) in by_computer(&self.misaddressed) {
            let addresses: Vec<_> = nodes
                .iter()
                .map(|it| format!("{} as {}", it.node, it.api))
                .collect();
            // roscpp does not understand an IPv6 address in a URI.
            let setting = match from.is_ipv6() {
                true => format!("ROS_HOSTNAME=NAME` on {from}, with a name that leads to it"),
                false => format!("ROS_IP={from}` on {from}"),
            };
            all.push((
                format!(
                    "No other computer can reach nodes of {from}, and they cannot be checked from here: they have registered under an address that means each computer itself ({}).",
                    shortened(&addresses)
                ),
                format!("run `export {setting}, and restart these nodes there."),
            ));
        }
        if !self.feuds.is_empty() {
            let names: Vec<_> = self.feuds.iter().map(ToString::to_string).collect();
            all.push((
                format!(
                    "Programs take a node name from each other, and shut each other down: {}.",
                    shortened(&names)
                ),
                "stop one of the two programs, or give it another name (__name:=).".to_owned(),
            ));
        }
        all
    }
}

/// The number of nodes in words.
fn count(nodes: &[IllNode]) -> String {
    match nodes.len() {
        1 => "1 node".to_owned(),
        count => format!("{count} nodes"),
    }
}

/// The names of nodes, each with the time since when it has been ill. A time that is the same for all stands once.
fn listed(nodes: &[IllNode]) -> String {
    let times: BTreeSet<_> = nodes.iter().map(|it| clock::wall_text(it.since)).collect();
    match times.first().filter(|_| times.len() == 1) {
        Some(time) => {
            let names: Vec<_> = nodes.iter().map(|it| it.node.clone()).collect();
            format!("{} since {time}", shortened(&names))
        }
        None => shortened(&nodes.iter().map(ToString::to_string).collect::<Vec<_>>()),
    }
}

/// Groups nodes by the computer from which they have registered.
fn by_computer(nodes: &[Misaddressed]) -> BTreeMap<IpAddr, Vec<&Misaddressed>> {
    let mut computers = BTreeMap::<_, Vec<_>>::new();
    for node in nodes {
        computers.entry(node.from).or_default().push(node);
    }
    computers
}
