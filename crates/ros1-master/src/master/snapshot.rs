//! The whole state of a master as plain data, as it is stored in a checkpoint.

use std::net::IpAddr;

use super::OrderedMap;
use crate::xmlrpc::Struct;

/// The whole state of a master. Every map and list keeps the master's order, because replies show it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Snapshot {
    /// References to nodes by caller id, including nodes that have nothing but services that other nodes have taken
    /// over.
    pub nodes: OrderedMap<SnapshotNode>,
    /// Types by topic. A type remains when the topic has no nodes left.
    pub topic_types: OrderedMap<String>,
    /// Caller ids of the publishers of each topic.
    pub publishers: OrderedMap<Vec<String>>,
    /// Caller ids of the subscribers of each topic.
    pub subscribers: OrderedMap<Vec<String>>,
    /// Providers by service.
    pub services: OrderedMap<ServiceEntry>,
    /// Whether any service was ever registered. If there are none now, this shows only in a message of
    /// `unregisterService`.
    pub had_services: bool,
    /// Caller ids of the subscribers of each parameter key. As in the master, keys end in `/`.
    pub param_subscribers: OrderedMap<Vec<String>>,
    pub params: Struct,
}

impl Snapshot {
    /// Removes nodes, topics, services and parameters whose names start with `prefix`.
    pub fn remove_named(&mut self, prefix: &str) {
        let stays = |name: &str| !name.starts_with(prefix);
        self.nodes.retain(|name, _| stays(name));
        self.topic_types.retain(|topic, _| stays(topic));
        for registrations in [
            &mut self.publishers,
            &mut self.subscribers,
            &mut self.param_subscribers,
        ] {
            registrations.retain(|key, nodes| {
                nodes.retain(|node| stays(node));
                stays(key) && !nodes.is_empty()
            });
        }
        self.services
            .retain(|name, entry| stays(name) && stays(&entry.node));
        self.params.retain(|key, _| stays(&format!("/{key}")));
    }
}

/// A master's reference to a node.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SnapshotNode {
    /// Address of the node's own XML-RPC server.
    pub api: String,
    /// Services that this node registered and another node has taken over since. The master keeps them forever, so
    /// `lookupNode` still finds the node.
    pub taken_over_services: Vec<String>,
    /// See [`Master::registered_from`](super::Master::registered_from).
    pub from: Option<IpAddr>,
}

/// The provider of a service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceEntry {
    /// Caller id of the provider.
    pub node: String,
    /// Address of the service itself, `rosrpc://HOST:PORT`.
    pub api: String,
}
