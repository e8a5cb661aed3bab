//! The state of the model, and its conversion from and to a [`Snapshot`].

use std::{fmt, net::IpAddr};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::notice::NoticeSink;
use super::params::Params;
use super::registry::{self, Node, Registry, SharedRegistration};
use super::snapshot::{Snapshot, SnapshotNode};
use super::updates::Update;
use super::write::Write;
use super::{Method, OrderedMap, Request, names};
use crate::xmlrpc::{Python, Reply, Struct, Value};

/// A complete master without IO: holds the state of a rosmaster and answers calls by [`Master::apply`].
///
/// A clone shares its memory with the original, so it costs less than a microsecond. The next change of either costs some
/// ten microseconds with 10,000 nodes.
///
/// Two masters are equal if all reads give the same answers in the same order, and if their references to
/// nodes and their parameter subscriptions are the same. Their identity (process id and address) is not
/// compared.
#[derive(Clone, Default)]
pub struct Master {
    pub(crate) registry: Registry,
    pub(crate) topic_types: OrderedMap<String>,
    pub(crate) params: Params,
    /// Whether a value is stored differently than in rosmaster, so that answers may differ. No ROS client sends a value
    /// that causes this.
    pub(crate) inexact: bool,
    /// The version of Python on which the modelled master runs.
    pub(crate) python: Python,
    /// Whether the modelled master is old, as in [`Self::set_old`]. `None` if unknown.
    pub(crate) old: Option<bool>,
    pub(crate) pid: i32,
    pub(crate) uri: String,
}

/// Sizes of a master's state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    /// Number of references to nodes.
    pub nodes: usize,
    /// Number of publishers, summed over all topics.
    pub publishers: usize,
    /// Number of subscribers, summed over all topics.
    pub subscribers: usize,
    pub services: usize,
    /// Number of parameters, not counting namespaces.
    pub params: usize,
    /// Number of parameter subscriptions, summed over all keys.
    pub param_subscribers: usize,
}

impl fmt::Display for Counts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counts = [
            (self.nodes, "node"),
            (self.publishers, "publisher"),
            (self.subscribers, "subscriber"),
            (self.services, "service"),
            (self.params, "parameter"),
            (self.param_subscribers, "parameter subscription"),
        ];
        for (index, (count, what)) in counts.into_iter().enumerate() {
            let comma = if index > 0 { ", " } else { "" };
            let plural = if count == 1 { "" } else { "s" };
            write!(f, "{comma}{count} {what}{plural}")?;
        }
        Ok(())
    }
}

/// Why no master can be in the state that a snapshot describes.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum InvalidSnapshot {
    /// A node has a registration but is not among the nodes.
    #[error(
        "`{key}` is registered by `{caller_id}`, which is not among the nodes: add the node with its api, or remove the registration"
    )]
    UnknownNode {
        /// Topic, service or parameter key.
        key: String,
        caller_id: String,
    },
    /// A list names a node twice.
    #[error("`{caller_id}` is listed twice for `{key}`: remove one of the two")]
    Twice {
        /// Topic or parameter key.
        key: String,
        caller_id: String,
    },
    /// A list names no node.
    #[error("`{key}` is listed without a node: remove it")]
    NoNodes {
        /// Topic or parameter key.
        key: String,
    },
    /// A node has no registration.
    #[error("the node `{caller_id}` has no registration: remove it")]
    EmptyNode { caller_id: String },
    /// A node has no address.
    #[error("the node `{caller_id}` has no api: add it, or remove the node and its registrations")]
    NoApi { caller_id: String },
    /// A published topic has no type.
    #[error("the published topic `{topic}` has no type: add one, `*` if it is not known")]
    NoType { topic: String },
    /// A service is listed as taken over from the node that provides it now.
    #[error(
        "the node `{caller_id}` provides the service `{service}`, but also lists it under taken_over_services: remove it from that list"
    )]
    NotTakenOver { service: String, caller_id: String },
}

impl Master {
    /// Publishers, subscribers, services and the references to nodes.
    pub fn registry(&self) -> &Registry {
        &self.registry
    }

    /// The type of each topic, in the order in which the master first saw the topics.
    pub fn topic_types(&self) -> &OrderedMap<String> {
        &self.topic_types
    }

    /// Sets the answers to `getPid` and `getUri`.
    pub fn set_identity(&mut self, pid: i32, uri: String) {
        self.pid = pid;
        self.uri = uri;
    }

    /// The answer to `getUri`.
    pub fn uri(&self) -> &str {
        &self.uri
    }

    /// Whether answers to reads may differ from rosmaster's. Ignored when two masters are compared.
    pub fn is_inexact(&self) -> bool {
        self.inexact || self.params.is_cut()
    }

    /// Sets whether a value is stored differently than in rosmaster, so that answers may differ.
    pub fn set_inexact(&mut self, inexact: bool) {
        self.inexact = inexact;
    }

    /// Sets the version of Python on which the modelled master runs. Faults and the order of dictionaries depend on it.
    pub fn set_python(&mut self, python: Python) {
        self.python = python;
    }

    /// The version set by [`Self::set_python`]. Ignored when two masters are compared.
    pub fn python(&self) -> Python {
        self.python
    }

    /// Sets whether the modelled master is old: rosmaster 1.14.3 or earlier, but not 1.12.15 to 1.12.17. An old master
    /// also notifies the node that sets a parameter, and three of its methods refuse a call with the value 0. `None` if
    /// unknown.
    pub fn set_old(&mut self, old: Option<bool>) {
        self.old = old;
    }

    /// The value set by [`Self::set_old`]. Ignored when two masters are compared.
    pub fn is_old(&self) -> Option<bool> {
        self.old
    }

    /// A call whose answer shows whether a master is old, as in [`Self::set_old`]. It changes nothing.
    pub fn ask_if_old() -> Request {
        Request::new(Method::LookupService, [names::CALLER_ID, ""])
    }

    /// Reads the answer to [`Self::ask_if_old`]. `None` if it is not an answer of rosmaster.
    pub fn shows_old(reply: &Reply) -> Option<bool> {
        match reply {
            Reply::Value(Value::Array(answer)) => match answer.as_slice() {
                [Value::Int(-1), _, Value::Int(0)] => Some(true),
                [Value::Int(-1), _, Value::String(_)] => Some(false),
                _ => None,
            },
            _ => None,
        }
    }

    /// Caller ids and addresses of the nodes.
    pub fn nodes(&self) -> impl Iterator<Item = (&str, &str)> {
        let nodes = self.registry.nodes.iter();
        nodes.map(|(caller_id, node)| (caller_id.as_str(), node.api.as_str()))
    }

    /// Caller ids and addresses of the nodes at `port`, the part of an address that [`port_of`](super::port_of) returns.
    pub fn nodes_at(&self, port: &str) -> impl Iterator<Item = (&str, &str)> {
        self.registry.nodes_at(port)
    }

    pub fn api_of(&self, caller_id: &str) -> Option<&str> {
        Some(self.registry.nodes.get(caller_id)?.api.as_str())
    }

    /// The address of the other computer from which a node has made its last registration. `None` for this computer, and
    /// if it is unknown. A master does not know it: see [`Self::note_origin`]. Ignored when two masters are compared.
    pub fn registered_from(&self, caller_id: &str) -> Option<IpAddr> {
        self.registry.nodes.get(caller_id)?.from
    }

    /// Notes that `call`, which has been applied, came from the computer `from`; `None` for this one.
    pub fn note_origin(&mut self, call: &Request, from: Option<IpAddr>) {
        for (caller_id, api) in Write::all(call).filter_map(|write| write.registrant()) {
            let node = self.registry.nodes.get(caller_id);
            let changes = node.is_some_and(|node| node.api == api && node.from != from);
            if let Some(node) = self.registry.nodes.get_mut(caller_id).filter(|_| changes) {
                node.from = from;
            }
        }
    }

    /// Takes from `known` the answers to `getPid` and `getUri`. For a state that was read from a master.
    pub fn keep_identity(&mut self, known: &Self) {
        self.set_identity(known.pid, known.uri.clone());
    }

    /// Takes from `known` where each node has registered from, if it has the same address in both. For a state that was
    /// read from a master.
    pub fn keep_origins(&mut self, known: &Self) {
        for (caller_id, known) in &known.registry.nodes {
            let Some(from) = known.from else { continue };
            let node = self.registry.nodes.get(caller_id);
            let lacks = node.is_some_and(|node| node.api == known.api && node.from.is_none());
            if let Some(node) = self.registry.nodes.get_mut(caller_id).filter(|_| lacks) {
                node.from = Some(from);
            }
        }
    }

    /// Addresses of the publishers of a topic, in order.
    pub fn publishers_of(&self, topic: &str) -> Vec<String> {
        self.registry.apis(SharedRegistration::Publishers, topic)
    }

    /// Addresses of the subscribers of a topic, in order.
    pub fn subscribers_of(&self, topic: &str) -> Vec<String> {
        self.registry.apis(SharedRegistration::Subscribers, topic)
    }

    /// The topics that have subscribers.
    pub fn subscribed_topics(&self) -> impl Iterator<Item = &str> {
        self.registry.subscribers.keys().map(String::as_str)
    }

    /// The type of a topic. It stays known after the last publisher has gone.
    pub fn type_of(&self, topic: &str) -> Option<&str> {
        self.topic_types.get(topic).map(String::as_str)
    }

    /// The topics that a node publishes.
    pub fn publications(&self, caller_id: &str) -> impl Iterator<Item = &str> {
        let node = self.registry.nodes.get(caller_id);
        node.into_iter()
            .flat_map(|node| &node.publications)
            .map(String::as_str)
    }

    /// The topics to which a node subscribes.
    pub fn subscriptions(&self, caller_id: &str) -> impl Iterator<Item = &str> {
        let node = self.registry.nodes.get(caller_id);
        node.into_iter()
            .flat_map(|node| &node.subscriptions)
            .map(String::as_str)
    }

    /// Whether the node publishes `topic`, if `publishes` is true. If it is false, whether the node subscribes to
    /// `topic`.
    pub fn has_topic(&self, caller_id: &str, publishes: bool, topic: &str) -> bool {
        let node = self.registry.nodes.get(caller_id);
        node.is_some_and(|node| match publishes {
            true => node.publications.contains(topic),
            false => node.subscriptions.contains(topic),
        })
    }

    /// The services that a node provides, with their addresses.
    pub fn services_of(&self, caller_id: &str) -> impl Iterator<Item = (&str, &str)> {
        let node = self.registry.nodes.get(caller_id);
        let services = node.into_iter().flat_map(|node| &node.services);
        services.filter_map(move |service| {
            let entry = self.registry.services.get(service)?;
            (entry.node == caller_id).then_some((service.as_str(), entry.api.as_str()))
        })
    }

    /// Whether a node shows in `getSystemState`. A node that has stopped cleanly may leave other things behind: rospy never
    /// ends the parameter subscription that each log line makes, and nobody can end a service that another node has taken
    /// over.
    pub fn is_listed(&self, caller_id: &str) -> bool {
        self.publications(caller_id).next().is_some()
            || self.subscriptions(caller_id).next().is_some()
            || self.services_of(caller_id).next().is_some()
    }

    /// The node that provides a service.
    pub fn provider_of(&self, service: &str) -> Option<&str> {
        let entry = self.registry.services.get(service)?;
        Some(entry.node.as_str())
    }

    /// Counts the state by walking through all of it.
    pub fn counts(&self) -> Counts {
        let sum = |kind| self.registry.shared(kind).values().map(Vec::len).sum();
        Counts {
            nodes: self.registry.nodes.len(),
            publishers: sum(SharedRegistration::Publishers),
            subscribers: sum(SharedRegistration::Subscribers),
            services: self.registry.services.len(),
            params: self.params.leaves(),
            param_subscribers: sum(SharedRegistration::ParamSubscribers),
        }
    }

    /// Whether there are no nodes, no topic types and no parameters.
    pub fn is_empty(&self) -> bool {
        self.registry.nodes.is_empty()
            && self.topic_types.is_empty()
            && self.params.tree().is_empty()
    }

    /// The calls that unregister everything a node has, as the node itself would when it stops.
    ///
    /// If another node has taken over a service of this node, the master keeps a reference to this node even after
    /// these calls. The calls of [`Self::forget_calls`] remove that reference as well.
    pub fn unregister_calls(&self, caller_id: &str) -> Vec<Request> {
        let Some(node) = self.registry.nodes.get(caller_id) else {
            return Vec::new();
        };
        let api = node.api.as_str();
        let mut calls = Vec::new();
        for (method, topics) in [
            (Method::UnregisterPublisher, &node.publications),
            (Method::UnregisterSubscriber, &node.subscriptions),
        ] {
            let names = topics
                .iter()
                .filter_map(|topic| names::name_for(topic, caller_id));
            calls.extend(names.map(|name| Request::new(method.clone(), [caller_id, &name, api])));
        }
        calls.extend(node.services.iter().filter_map(|service| {
            let entry = self.registry.services.get(service)?;
            let name = names::name_for(service, caller_id).filter(|_| entry.node == caller_id)?;
            let params = [caller_id, &name, &entry.api];
            Some(Request::new(Method::UnregisterService, params))
        }));
        calls.extend(node.param_subscriptions.iter().filter_map(|key| {
            let name = names::param_name_for(key, caller_id)?;
            let params = [caller_id, api, &name];
            Some(Request::new(Method::UnsubscribeParam, params))
        }));
        calls
    }

    /// The whole state as plain data.
    pub fn snapshot(&self) -> Snapshot {
        let registry = &self.registry;
        let nodes = registry.nodes.iter().map(|(caller_id, node)| {
            let taken_over_services = self.taken_over(caller_id, node).cloned().collect();
            let node = SnapshotNode {
                api: node.api.clone(),
                taken_over_services,
                from: node.from,
            };
            (caller_id.clone(), node)
        });
        Snapshot {
            nodes: nodes.collect(),
            topic_types: self.topic_types.clone(),
            publishers: registry.publishers.clone(),
            subscribers: registry.subscribers.clone(),
            services: registry.services.clone(),
            had_services: registry.had_services,
            param_subscribers: registry.param_subscribers.clone(),
            params: self.params.tree().clone(),
        }
    }

    /// Services that the node `caller_id` has registered and no longer provides.
    pub fn taken_over<'a>(
        &'a self,
        caller_id: &'a str,
        node: &'a Node,
    ) -> impl Iterator<Item = &'a String> {
        node.services.iter().filter(move |service| {
            let entry = self.registry.services.get(service);
            entry.is_none_or(|entry| entry.node != caller_id)
        })
    }

    /// The value of the parameter with this resolved name, as `getParam` returns it.
    pub fn param(&self, key: &str) -> Option<Value> {
        self.params.get(key)
    }

    /// Creates the master that has the state in `snapshot`.
    ///
    /// # Errors
    ///
    /// If no sequence of calls leads to this state.
    pub fn from_snapshot(snapshot: Snapshot) -> Result<Self, InvalidSnapshot> {
        let mut nodes: OrderedMap<Node> = OrderedMap::default();
        for (caller_id, node) in snapshot.nodes {
            if node.api.is_empty() {
                return Err(InvalidSnapshot::NoApi { caller_id });
            }
            let node = Node {
                api: node.api,
                services: node.taken_over_services.into_iter().collect(),
                from: node.from,
                ..Node::default()
            };
            nodes.insert(caller_id, node);
        }
        let had_services = snapshot.had_services
            || !snapshot.services.is_empty()
            || nodes.values().any(|node| !node.services.is_empty());
        for (kind, registrations) in [
            (SharedRegistration::Publishers, &snapshot.publishers),
            (SharedRegistration::Subscribers, &snapshot.subscribers),
            (
                SharedRegistration::ParamSubscribers,
                &snapshot.param_subscribers,
            ),
        ] {
            for (key, callers) in registrations {
                if callers.is_empty() {
                    return Err(InvalidSnapshot::NoNodes { key: key.clone() });
                }
                for caller_id in callers {
                    let node = nodes.get_mut(caller_id);
                    let node = node.ok_or_else(|| unknown_node(key, caller_id))?;
                    if !node.keys(kind).insert(key.clone()) {
                        return Err(InvalidSnapshot::Twice {
                            key: key.clone(),
                            caller_id: caller_id.clone(),
                        });
                    }
                }
            }
        }
        for (service, entry) in &snapshot.services {
            let node = nodes.get_mut(&entry.node);
            let node = node.ok_or_else(|| unknown_node(service, &entry.node))?;
            if !node.services.insert(service.clone()) {
                return Err(InvalidSnapshot::NotTakenOver {
                    service: service.clone(),
                    caller_id: entry.node.clone(),
                });
            }
        }
        if let Some((caller_id, _)) = nodes.iter().find(|(_, node)| node.is_empty()) {
            let caller_id = caller_id.clone();
            return Err(InvalidSnapshot::EmptyNode { caller_id });
        }
        let lacks_type = |topic: &&String| !snapshot.topic_types.contains_key(topic);
        let topic = snapshot.publishers.keys().find(lacks_type).cloned();
        if let Some(topic) = topic {
            return Err(InvalidSnapshot::NoType { topic });
        }
        Ok(Self {
            registry: Registry {
                at_port: registry::by_port(&nodes),
                nodes,
                publishers: snapshot.publishers,
                subscribers: snapshot.subscribers,
                param_subscribers: snapshot.param_subscribers,
                services: snapshot.services,
                had_services,
            },
            topic_types: snapshot.topic_types,
            params: Params::new(snapshot.params),
            ..Self::default()
        })
    }

    pub fn params(&self) -> &Struct {
        self.params.tree()
    }
}

fn unknown_node(key: &str, caller_id: &str) -> InvalidSnapshot {
    InvalidSnapshot::UnknownNode {
        key: key.to_owned(),
        caller_id: caller_id.to_owned(),
    }
}

impl Registry {
    /// Queues the callbacks for changed parameters. Skips values that rosmaster cannot encode, because it never sends
    /// them.
    pub(crate) fn notify_params(&self, updates: Vec<Update<'_>>, notices: &mut dyn NoticeSink) {
        for update in updates {
            if super::returnable::param_error(update.value).is_some() {
                continue;
            }
            let nodes = update.nodes.iter();
            let nodes = nodes.filter(|caller_id| Some(caller_id.as_str()) != update.ignored);
            let to = nodes.filter_map(|caller_id| Some(self.nodes.get(caller_id)?.api.clone()));
            let to: Vec<String> = to.collect();
            notices.param_update(&to, update.key, update.value);
        }
    }
}

impl PartialEq for Master {
    fn eq(&self, other: &Self) -> bool {
        let (a, b) = (&self.registry, &other.registry);
        a.nodes.has_same(&b.nodes)
            && a.publishers == b.publishers
            && a.subscribers == b.subscribers
            && a.services == b.services
            && a.had_services == b.had_services
            && a.param_subscribers == b.param_subscribers
            && self.topic_types == other.topic_types
            && self.params.tree() == other.params.tree()
    }
}

/// Prints only sizes, because parameter values must not appear in the log.
impl fmt::Debug for Master {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Master").field(&self.counts()).finish()
    }
}
