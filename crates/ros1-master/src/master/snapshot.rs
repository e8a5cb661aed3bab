//! A master's whole state as plain data, as in a checkpoint.

use indexmap::IndexMap;

use crate::xmlrpc::Struct;

/// A master's whole state. Every map and list has the master's order, because replies show it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Snapshot {
    /// Node references by caller id, including those without any registration left.
    pub nodes: IndexMap<String, SnapshotNode>,
    /// Types by topic. A type outlives its topic.
    pub topic_types: IndexMap<String, String>,
    /// Caller ids of the publishers of each topic.
    pub publishers: IndexMap<String, Vec<String>>,
    /// Caller ids of the subscribers of each topic.
    pub subscribers: IndexMap<String, Vec<String>>,
    /// The provider of each service.
    pub services: IndexMap<String, ServiceEntry>,
    /// Whether any service was ever registered. Without services this shows only in a message of
    /// `unregisterService`.
    pub had_services: bool,
    /// Caller ids of the subscribers of each parameter key. Keys end in `/`, as in the master.
    pub param_subscribers: IndexMap<String, Vec<String>>,
    pub params: Struct,
}

impl Snapshot {
    /// Removes nodes, topics, services and parameters whose names begin with `prefix`.
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

/// A node reference.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SnapshotNode {
    /// The node's own XML-RPC address.
    pub api: String,
    /// Services that this node registered and another node took over. The master never forgets them, so
    /// `lookupNode` still finds such a node.
    pub taken_over_services: Vec<String>,
}

/// A service's provider.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceEntry {
    /// Caller id of the provider.
    pub node: String,
    /// The service's own address, `rosrpc://HOST:PORT`.
    pub api: String,
}
