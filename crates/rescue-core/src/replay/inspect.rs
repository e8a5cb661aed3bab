//! Reads the state of an unknown master with two requests.

use std::collections::HashSet;

use indexmap::IndexMap;
use thiserror::Error;

use super::{Token, TokenState, unordered};
use ros1_master::master::names::{self, CALLER_ID};
use ros1_master::master::{
    Master, Method, OrderedMap, Registrations, Request, ServiceEntry, Snapshot, SnapshotNode,
};
use ros1_master::xmlrpc::{Reply, Struct, Value};

/// Why the answer to an inspection cannot be used.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum NotAMaster {
    /// The whole inspection was answered with a fault.
    #[error(
        "the server answered the request for the master's state with a fault, `{text}`: it is not a rosmaster, or it is failing"
    )]
    Fault { text: String },
    /// The parameters cannot be read, because one of them cannot be returned. Inspect again with
    /// [`Inspection::call_without_params`].
    #[error(
        "the master holds a parameter that it cannot return ({text}): read its state again without parameters"
    )]
    ParamsUnreadable { text: String },
    /// Another program changed the parameters while the master encoded its answer. Inspect again.
    #[error(
        "another program changed the parameters while the master returned them ({text}): read its state again"
    )]
    ParamsChanging { text: String },
    /// An answer does not have the form of a master's answer.
    #[error(
        "the answer to {method} does not have the form of a master's answer: check that the upstream address is that of a rosmaster"
    )]
    Form { method: Method },
}

/// The part of a master's state that the first request of an inspection shows.
#[derive(Clone, Debug)]
pub struct Inspection {
    pid: i32,
    bears: TokenState,
    publishers: IndexMap<String, Vec<String>>,
    subscribers: IndexMap<String, Vec<String>>,
    /// Providers by service.
    services: IndexMap<String, String>,
    topic_types: IndexMap<String, String>,
    /// `None` if the parameters were left out because they cannot be read.
    params: Option<Struct>,
}

impl Inspection {
    /// The inspection of a new rosmaster with the process id `pid`, which is known to be empty.
    pub fn at_new(pid: i32) -> Self {
        Self {
            pid,
            bears: TokenState::Nothing,
            publishers: IndexMap::new(),
            subscribers: IndexMap::new(),
            services: IndexMap::new(),
            topic_types: IndexMap::new(),
            params: Some(Struct::new()),
        }
    }

    /// Puts everything that `mirror` also has into the mirror's order. Needed for a master with unordered dictionaries,
    /// as on Python 2.
    pub fn arrange_like(&mut self, mirror: &Master) {
        let registry = mirror.registry();
        unordered::arrange(&mut self.publishers, registry.publishers.keys());
        unordered::arrange(&mut self.subscribers, registry.subscribers.keys());
        unordered::arrange(&mut self.services, registry.services.keys());
        unordered::arrange(&mut self.topic_types, mirror.topic_types().keys());
        if let Some(params) = &mut self.params {
            unordered::arrange_params(params, mirror.params());
        }
    }

    /// Whether the parameters could be read.
    pub fn has_params(&self) -> bool {
        self.params.is_some()
    }

    /// The first request: a multicall of `getPid`, `lookupNode` for the token and for its session,
    /// `getSystemState`, `getTopicTypes` and `getParam('/')`. It changes nothing.
    pub fn call(token: &Token) -> Request {
        let params = Request::new(Method::GetParam, [CALLER_ID, "/"]);
        Request::multicall(Self::reads(token).into_iter().chain([params]))
    }

    /// The first request for a master whose parameters cannot be read.
    pub fn call_without_params(token: &Token) -> Request {
        Request::multicall(Self::reads(token))
    }

    fn reads(token: &Token) -> [Request; 5] {
        let read = |method| Request::new(method, [CALLER_ID]);
        [
            read(Method::GetPid),
            token.lookup(),
            token.lookup_session(),
            read(Method::GetSystemState),
            read(Method::GetTopicTypes),
        ]
    }

    /// Decodes the reply to [`Self::call`] or [`Self::call_without_params`], made with the same `token`.
    ///
    /// # Errors
    ///
    /// If this is not a master's reply. After [`NotAMaster::ParamsUnreadable`], send
    /// [`Inspection::call_without_params`]. After [`NotAMaster::ParamsChanging`], send the same call again.
    pub fn decode(reply: &Reply, token: &Token) -> Result<Self, NotAMaster> {
        let results = results(reply)?;
        let [pid, number, session, state, types, params @ ..] = results else {
            return Err(form(Method::Multicall));
        };
        let success = |result, method| match answer(result) {
            Some((1, value)) => Ok(value),
            _ => Err(form(method)),
        };
        let pid = success(pid, Method::GetPid)?
            .as_int()
            .ok_or_else(|| form(Method::GetPid))?;
        let api = |result| match answer(result) {
            Some((1, api)) => Ok(Some(api.as_str().unwrap_or_default())),
            Some(_) => Ok(None),
            None => Err(form(Method::LookupNode)),
        };
        let bears = token.state_in_master(api(number)?.is_some(), api(session)?);
        let state = success(state, Method::GetSystemState)?.as_array();
        let Some([publishers, subscribers, services]) = state else {
            return Err(form(Method::GetSystemState));
        };
        let lists = |value| lists(value).ok_or_else(|| form(Method::GetSystemState));
        let services = lists(services)?.into_iter().map(|(service, mut nodes)| {
            let provider = nodes.pop().filter(|_| nodes.is_empty());
            Ok((
                service,
                provider.ok_or_else(|| form(Method::GetSystemState))?,
            ))
        });
        let params = match params {
            [] => None,
            [params, ..] => {
                let tree = success(params, Method::GetParam)?.as_struct();
                Some(tree.ok_or_else(|| form(Method::GetParam))?.clone())
            }
        };
        Ok(Self {
            pid,
            bears,
            publishers: lists(publishers)?,
            subscribers: lists(subscribers)?,
            services: services.collect::<Result<_, NotAMaster>>()?,
            topic_types: pairs(success(types, Method::GetTopicTypes)?)
                .ok_or_else(|| form(Method::GetTopicTypes))?,
            params,
        })
    }

    pub fn pid(&self) -> i32 {
        self.pid
    }

    /// The token that the master has.
    pub fn bears(&self) -> TokenState {
        self.bears
    }

    /// Whether the master holds nothing that an inspection would show.
    pub fn is_empty(&self) -> bool {
        self.publishers.is_empty()
            && self.subscribers.is_empty()
            && self.services.is_empty()
            && self.topic_types.is_empty()
            && self.params.as_ref().is_some_and(|params| params.is_empty())
    }

    /// The nodes of this inspection and of `previous`, without duplicates.
    fn nodes<'a>(&'a self, previous: &'a Master) -> Vec<&'a str> {
        let shared = [&self.publishers, &self.subscribers];
        let registered = shared.into_iter().flat_map(IndexMap::values).flatten();
        let seen = registered.chain(self.services.values()).map(String::as_str);
        let known = previous.nodes().map(|(caller_id, _)| caller_id);
        let known = known.filter(|caller_id| !Token::is_ours(caller_id));
        let mut once = HashSet::new();
        seen.chain(known)
            .filter(|caller_id| once.insert(*caller_id))
            .collect()
    }

    /// The second request, which asks for all addresses: `lookupNode` of each node of the inspection or of `previous`,
    /// and `lookupService` of each service. `None` if there are no nodes and no services.
    pub fn second_call(&self, previous: &Master) -> Option<Request> {
        let nodes = self.nodes(previous).into_iter();
        let nodes = nodes.filter_map(|node| lookup(Method::LookupNode, node));
        let services = self.services.keys();
        let services = services.filter_map(|service| lookup(Method::LookupService, service));
        let mut calls = nodes.chain(services).peekable();
        calls.peek()?;
        Some(Request::multicall(calls))
    }

    /// The request that asks for the addresses of these nodes.
    pub fn ask_addresses<'a>(nodes: impl IntoIterator<Item = &'a str>) -> Request {
        let ask = |node| Request::new(Method::LookupNode, [CALLER_ID, node]);
        Request::multicall(nodes.into_iter().map(ask))
    }

    /// The addresses in the reply to [`Self::ask_addresses`], in the order of the nodes. `None` for a node that the master
    /// does not know.
    pub fn read_addresses(reply: &Reply) -> Vec<Option<String>> {
        let results = results(reply).unwrap_or_default().iter();
        let address = |result| match answer(result) {
            Some((1, Value::String(api))) => Some(api.clone()),
            _ => None,
        };
        results.map(address).collect()
    }

    /// Builds a model of the master's state.
    ///
    /// Takes what a master does not show from `previous`, for nodes whose address is the same: parameter subscriptions,
    /// references to nodes whose services were taken over, and the parameters if they cannot be read. Anything that
    /// vanished between the two requests is left out.
    ///
    /// # Errors
    ///
    /// If `second`, the reply to [`Inspection::second_call`] with the same `previous`, is not a master's reply.
    pub fn into_master(
        self,
        second: Option<&Reply>,
        previous: &Master,
    ) -> Result<Master, NotAMaster> {
        let mut results = match second {
            Some(reply) => results(reply)?,
            None => &[],
        }
        .iter();
        let mut address = |method: Method, name: &str, fallback: Option<&str>| {
            if lookup(method.clone(), name).is_none() {
                return Ok(fallback.map(str::to_owned));
            }
            match results.next().and_then(answer) {
                Some((1, Value::String(api))) => Ok(Some(api.clone())),
                Some((_, Value::String(_))) => Ok(None),
                _ => Err(form(method)),
            }
        };
        let mut found = Snapshot {
            params: self
                .params
                .clone()
                .unwrap_or_else(|| previous.params().clone()),
            topic_types: self.topic_types.clone().into_iter().collect(),
            had_services: previous.registry().had_services,
            ..Snapshot::default()
        };
        for caller_id in self.nodes(previous) {
            if let Some(api) = address(Method::LookupNode, caller_id, previous.api_of(caller_id))? {
                let node = SnapshotNode {
                    api,
                    ..SnapshotNode::default()
                };
                found.nodes.insert(caller_id.to_owned(), node);
            }
        }
        for (service, provider) in &self.services {
            let known = previous.registry().services.get(service);
            let known = known.filter(|known| known.node == *provider);
            let api = address(
                Method::LookupService,
                service,
                known.map(|known| known.api.as_str()),
            )?;
            if let Some(api) = api.filter(|_| found.nodes.contains_key(provider)) {
                let node = provider.clone();
                found
                    .services
                    .insert(service.clone(), ServiceEntry { node, api });
            }
        }
        let same = |caller_id: &str| {
            let node = found.nodes.get(caller_id);
            node.is_some_and(|node| previous.api_of(caller_id) == Some(node.api.as_str()))
        };
        found.publishers = retain_nodes(self.publishers, |node| found.nodes.contains_key(node));
        found.subscribers = retain_nodes(self.subscribers, |node| found.nodes.contains_key(node));
        let subscriptions = previous.registry().param_subscribers.clone();
        found.param_subscribers = retain_nodes(subscriptions, same);
        for topic in found.publishers.keys() {
            if !found.topic_types.contains_key(topic) {
                found.topic_types.insert(topic.clone(), "*".to_owned());
            }
        }
        keep_references(&mut found, previous);
        let mut master = Master::from_snapshot(found).map_err(|_| form(Method::GetSystemState))?;
        master.set_inexact(self.params.is_none());
        Ok(master)
    }
}

/// Adds to each node the services that other nodes have taken over from it, because a master still knows a node that
/// has nothing else. Drops a node that has neither a registration nor a service that was taken over.
fn keep_references(found: &mut Snapshot, previous: &Master) {
    let shared = [
        &found.publishers,
        &found.subscribers,
        &found.param_subscribers,
    ];
    let registered = shared
        .into_iter()
        .flat_map(OrderedMap::values)
        .flatten()
        .cloned();
    let providers = found.services.values().map(|entry| entry.node.clone());
    let held: HashSet<String> = registered.chain(providers).collect();
    let services = &found.services;
    found.nodes.retain(|caller_id, node| {
        let before = previous.registry().nodes.get(caller_id);
        if let Some(before) = before.filter(|before| before.api == node.api) {
            let lost = |service: &&String| {
                services
                    .get(service)
                    .is_none_or(|entry| entry.node != *caller_id)
            };
            let known = previous.taken_over(caller_id, before).filter(lost);
            node.taken_over_services = known.cloned().collect();
            // The master knows this node although it has no registration, so another node has taken over one of its
            // services since `previous`.
            if node.taken_over_services.is_empty() && !held.contains(caller_id) {
                let lost = before.services.iter().filter(lost);
                node.taken_over_services = lost.cloned().collect();
            }
        }
        held.contains(caller_id) || !node.taken_over_services.is_empty()
    });
}

/// The registrations of the nodes that `of` accepts, without lists that would be empty.
fn retain_nodes(
    registrations: impl IntoIterator<Item = (String, Vec<String>)>,
    of: impl Fn(&str) -> bool,
) -> Registrations {
    let lists = registrations.into_iter().filter_map(|(key, mut nodes)| {
        nodes.retain(|node| of(node));
        (!nodes.is_empty()).then_some((key, nodes))
    });
    lists.collect()
}

/// A call of `method` that looks up `name`. `None` if no call can name it.
pub(super) fn lookup(method: Method, name: &str) -> Option<Request> {
    let (caller_id, name) = names::reach(name, CALLER_ID, |_| true)?;
    Some(Request::new(method, [caller_id, name]))
}

fn form(method: Method) -> NotAMaster {
    NotAMaster::Form { method }
}

/// The results of a multicall.
fn results(reply: &Reply) -> Result<&[Value], NotAMaster> {
    match reply {
        Reply::Value(value) => value.as_array().ok_or_else(|| form(Method::Multicall)),
        Reply::Fault { text, .. } => {
            let text = text.clone();
            Err(if text.contains(super::plan::CHANGED_MEANWHILE) {
                NotAMaster::ParamsChanging { text }
            } else if super::accepted::is_write_error(&text) {
                NotAMaster::ParamsUnreadable { text }
            } else {
                NotAMaster::Fault { text }
            })
        }
    }
}

/// Code and value of one result of a multicall.
fn answer(result: &Value) -> Option<(i32, &Value)> {
    match result.as_array()? {
        [answer] => match answer.as_array()? {
            [Value::Int(code), Value::String(_), value] => Some((*code, value)),
            _ => None,
        },
        _ => None,
    }
}

/// Reads a value of the form `[[key, [node, …]], …]`.
fn lists(value: &Value) -> Option<IndexMap<String, Vec<String>>> {
    let lists = value.as_array()?.iter().map(|list| match list.as_array()? {
        [Value::String(key), Value::Array(nodes)] => {
            let nodes = nodes.iter().map(|node| Some(node.as_str()?.to_owned()));
            Some((key.clone(), nodes.collect::<Option<_>>()?))
        }
        _ => None,
    });
    lists.collect()
}

/// Reads a value of the form `[[topic, type], …]`. A date whose text is `*` counts as a type, and is restored
/// as a string.
fn pairs(value: &Value) -> Option<IndexMap<String, String>> {
    let pairs = value.as_array()?.iter().map(|pair| match pair.as_array()? {
        [
            Value::String(topic),
            Value::String(topic_type) | Value::DateTime(topic_type),
        ] => Some((topic.clone(), topic_type.clone())),
        _ => None,
    });
    pairs.collect()
}
