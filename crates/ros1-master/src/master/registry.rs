//! Publishers, subscribers and services, as in `rosmaster/registrations.py`.

use std::net::IpAddr;

use indexmap::IndexSet;

use super::{ordered_map::OrderedMap, snapshot::ServiceEntry};

/// Caller ids by topic or parameter key, in the order in which they registered.
pub type Registrations = OrderedMap<Vec<String>>;

/// The kinds of registration that several nodes can share under one key.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum SharedRegistration {
    Publishers,
    Subscribers,
    ParamSubscribers,
}

/// The part of a node's address up to the port. Nodes whose addresses differ only behind the port are one program, or
/// programs of which at most one is alive.
pub fn port_of(api: &str) -> &str {
    let api = api.trim();
    let host = api.find("//").map_or(0, |at| at + 2);
    let end = api.match_indices('/').find(|(at, _)| *at >= host);
    end.map_or(api, |(end, _)| api.split_at(end).0)
}

/// A reference to a node. rosmaster drops it when the node has no registration left.
#[derive(Clone, Default)]
pub struct Node {
    /// The address of the node's slave API.
    pub api: String,
    /// See [`Master::registered_from`](super::Master::registered_from). Ignored when two nodes are compared.
    pub from: Option<IpAddr>,
    /// The topics that the node publishes.
    pub publications: IndexSet<String>,
    /// The topics to which the node subscribes.
    pub subscriptions: IndexSet<String>,
    /// The keys of the parameters to which the node subscribes.
    pub param_subscriptions: IndexSet<String>,
    /// Services that this node has registered, including those that another node has taken over since.
    pub services: IndexSet<String>,
}

impl PartialEq for Node {
    fn eq(&self, other: &Self) -> bool {
        self.api == other.api
            && self.publications == other.publications
            && self.subscriptions == other.subscriptions
            && self.param_subscriptions == other.param_subscriptions
            && self.services == other.services
    }
}

impl Eq for Node {}

impl Node {
    pub(crate) fn is_empty(&self) -> bool {
        self.publications.is_empty()
            && self.subscriptions.is_empty()
            && self.param_subscriptions.is_empty()
            && self.services.is_empty()
    }

    fn has(&self, kind: SharedRegistration, key: &str) -> bool {
        match kind {
            SharedRegistration::Publishers => self.publications.contains(key),
            SharedRegistration::Subscribers => self.subscriptions.contains(key),
            SharedRegistration::ParamSubscribers => self.param_subscriptions.contains(key),
        }
    }

    pub(crate) fn keys(&mut self, kind: SharedRegistration) -> &mut IndexSet<String> {
        match kind {
            SharedRegistration::Publishers => &mut self.publications,
            SharedRegistration::Subscribers => &mut self.subscriptions,
            SharedRegistration::ParamSubscribers => &mut self.param_subscriptions,
        }
    }
}

/// rosmaster's `RegistrationManager`. A clone shares its memory; see [`OrderedMap`].
#[derive(Clone, Default)]
pub struct Registry {
    /// References to nodes by caller id. No reply shows their order.
    pub nodes: OrderedMap<Node>,
    /// The caller ids of the nodes at each port, so that no question about a port searches all nodes.
    pub(super) at_port: Registrations,
    /// The publishers of each topic.
    pub publishers: Registrations,
    /// The subscribers of each topic.
    pub subscribers: Registrations,
    /// The subscribers of each parameter key.
    pub param_subscribers: Registrations,
    /// The provider of each service.
    pub services: OrderedMap<ServiceEntry>,
    /// Whether any service was ever registered. This shows only in a message of `unregisterService`.
    pub had_services: bool,
}

impl Registry {
    /// The caller ids and addresses of the nodes at `port`; see [`port_of`].
    pub(crate) fn nodes_at(&self, port: &str) -> impl Iterator<Item = (&str, &str)> {
        let callers = self.at_port.get(port).into_iter().flatten();
        callers.filter_map(|caller_id| {
            let node = self.nodes.get(caller_id)?;
            Some((caller_id.as_str(), node.api.as_str()))
        })
    }

    pub(crate) fn shared(&self, kind: SharedRegistration) -> &Registrations {
        match kind {
            SharedRegistration::Publishers => &self.publishers,
            SharedRegistration::Subscribers => &self.subscribers,
            SharedRegistration::ParamSubscribers => &self.param_subscribers,
        }
    }

    fn shared_mut(&mut self, kind: SharedRegistration) -> &mut Registrations {
        match kind {
            SharedRegistration::Publishers => &mut self.publishers,
            SharedRegistration::Subscribers => &mut self.subscribers,
            SharedRegistration::ParamSubscribers => &mut self.param_subscribers,
        }
    }

    /// The addresses of the nodes registered under `key`, in order.
    pub(crate) fn apis(&self, kind: SharedRegistration, key: &str) -> Vec<String> {
        let callers = self.shared(kind).get(key).map_or(&[][..], Vec::as_slice);
        callers
            .iter()
            .filter_map(|caller_id| Some(self.nodes.get(caller_id)?.api.clone()))
            .collect()
    }

    /// Registers a node under a key. If a node of the same name was registered at another address, removes that node's
    /// registrations and returns its address.
    pub(crate) fn register(
        &mut self,
        kind: SharedRegistration,
        key: &str,
        caller_id: &str,
        caller_api: &str,
    ) -> Option<String> {
        let bumped = self.add_node(caller_id, caller_api);
        let node = self.nodes.get_mut(caller_id);
        if node.is_some_and(|node| node.keys(kind).insert(key.to_owned())) {
            push_caller(self.shared_mut(kind), key, caller_id);
        }
        bumped
    }

    /// Registers a service of a node, and returns the same as [`Registry::register`]. The previous provider loses the
    /// service, but stays in [`Self::nodes`].
    pub(crate) fn register_service(
        &mut self,
        service: &str,
        caller_id: &str,
        caller_api: &str,
        service_api: &str,
    ) -> Option<String> {
        let bumped = self.add_node(caller_id, caller_api);
        if let Some(node) = self.nodes.get_mut(caller_id) {
            node.services.insert(service.to_owned());
        }
        let entry = ServiceEntry {
            node: caller_id.to_owned(),
            api: service_api.to_owned(),
        };
        self.services.insert(service.to_owned(), entry);
        self.had_services = true;
        bumped
    }

    /// Creates the reference to a node if needed. If the name is registered at another address, that is an old node:
    /// removes its registrations and returns its address.
    fn add_node(&mut self, caller_id: &str, caller_api: &str) -> Option<String> {
        let fresh = || Node {
            api: caller_api.to_owned(),
            ..Node::default()
        };
        let old = match self.nodes.get(caller_id) {
            Some(node) if node.api == caller_api => return None,
            Some(_) => {
                let old = std::mem::replace(self.nodes.get_mut(caller_id)?, fresh());
                self.drop_registrations(caller_id, &old);
                drop_caller(&mut self.at_port, port_of(&old.api), caller_id);
                Some(old.api)
            }
            None => {
                self.nodes.insert(caller_id.to_owned(), fresh());
                None
            }
        };
        push_caller(&mut self.at_port, port_of(caller_api), caller_id);
        old
    }

    fn drop_registrations(&mut self, caller_id: &str, node: &Node) {
        for topic in &node.publications {
            drop_caller(&mut self.publishers, topic, caller_id);
        }
        for topic in &node.subscriptions {
            drop_caller(&mut self.subscribers, topic, caller_id);
        }
        for key in &node.param_subscriptions {
            drop_caller(&mut self.param_subscribers, key, caller_id);
        }
        for service in &node.services {
            if self
                .services
                .get(service)
                .is_some_and(|entry| entry.node == caller_id)
            {
                self.services.remove(service);
            }
        }
    }

    /// Unregisters a node from a key. Returns the message, and whether there was anything to unregister.
    pub(crate) fn unregister(
        &mut self,
        kind: SharedRegistration,
        key: &str,
        caller_id: &str,
        caller_api: &str,
    ) -> (String, bool) {
        let Some(node) = self.nodes.get(caller_id) else {
            return (not_registered(caller_id), false);
        };
        let is_known = node.api == caller_api && node.has(kind, key);
        let node = self.nodes.get_mut(caller_id).filter(|_| is_known);
        if !node.is_some_and(|node| node.keys(kind).swap_remove(key)) {
            let text = format!("[{caller_id}] is not a known provider of [{key}]");
            return (text, false);
        }
        drop_caller(self.shared_mut(kind), key, caller_id);
        self.forget_if_empty(caller_id);
        (unregistered(caller_id, key), true)
    }

    /// Unregisters a service of a node. Returns the message, and whether there was anything to unregister.
    pub(crate) fn unregister_service(
        &mut self,
        service: &str,
        caller_id: &str,
        service_api: &str,
    ) -> (String, bool) {
        if !self.nodes.contains_key(caller_id) {
            return (not_registered(caller_id), false);
        }
        if !self.had_services {
            let text = format!("[{caller_id}] is not a provider of [{service}]");
            return (text, false);
        }
        let current = self.services.get(service);
        if current.is_none_or(|entry| entry.node != caller_id || entry.api != service_api) {
            let text = format!(
                "[{service_api}] is no longer the current service api handle for [{service}]"
            );
            return (text, false);
        }
        if let Some(node) = self.nodes.get_mut(caller_id) {
            node.services.swap_remove(service);
        }
        self.services.remove(service);
        self.forget_if_empty(caller_id);
        (unregistered(caller_id, service), true)
    }

    fn forget_if_empty(&mut self, caller_id: &str) {
        if let Some(node) = self.nodes.get(caller_id).filter(|node| node.is_empty()) {
            drop_caller(&mut self.at_port, port_of(&node.api), caller_id);
            self.nodes.remove(caller_id);
        }
    }
}

/// The caller ids of `nodes` by port.
pub(super) fn by_port(nodes: &OrderedMap<Node>) -> Registrations {
    let mut at_port = Registrations::default();
    for (caller_id, node) in nodes {
        push_caller(&mut at_port, port_of(&node.api), caller_id);
    }
    at_port
}

fn push_caller(registrations: &mut Registrations, key: &str, caller_id: &str) {
    match registrations.get_mut(key) {
        Some(callers) => callers.push(caller_id.to_owned()),
        None => registrations.insert(key.to_owned(), vec![caller_id.to_owned()]),
    }
}

fn drop_caller(registrations: &mut Registrations, key: &str, caller_id: &str) {
    if let Some(callers) = registrations.get_mut(key) {
        if let Some(index) = callers.iter().position(|caller| caller == caller_id) {
            callers.remove(index);
        }
        if callers.is_empty() {
            registrations.remove(key);
        }
    }
}

fn not_registered(caller_id: &str) -> String {
    format!("[{caller_id}] is not a registered node")
}

fn unregistered(caller_id: &str, key: &str) -> String {
    format!("Unregistered [{caller_id}] as provider of [{key}]")
}
