//! Tracks which parameters, nodes, services and topic registrations others have changed. Comparing two states would not
//! show that a parameter was set and set back.

use std::{
    borrow::Cow,
    collections::{BTreeMap, BTreeSet, HashMap, HashSet},
    ops::Bound,
};

use super::{Conflict, LostWrite, TELLER};
use crate::cluster::mutant::Mutant;
use ros1_master::{
    master::{Effect, Master, Request, Write, names},
    xmlrpc::{Struct, Value},
};

/// What a call changes. Two calls can conflict if they change the same.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum ChangeSubject {
    /// A parameter: its resolved name, with a slash at the end, and the node that changed it.
    Param {
        path: String,
        node: String,
    },
    /// A registration by the node with this name.
    Node(String),
    Service(String),
    Topic {
        publishes: bool,
        topic: String,
        node: String,
    },
}

impl ChangeSubject {
    /// The approximate memory for this value, in bytes.
    pub fn size(&self) -> usize {
        size_of::<Self>()
            + match self {
                Self::Node(name) | Self::Service(name) => name.len(),
                Self::Param { path, node } => path.len() + node.len(),
                Self::Topic { topic, node, .. } => topic.len() + node.len(),
            }
    }

    /// What `call`, which is no multicall, changes. Empty for an unregistration, which conflicts with nothing, and for a
    /// value that a merge sets again.
    pub fn changed_by(call: &Request) -> Vec<Self> {
        let Some(Write { caller, effect }) =
            Write::parse(call).filter(|write| write.caller != TELLER)
        else {
            return Vec::new();
        };
        let node = Self::Node(caller.to_owned());
        let topic = |publishes, topic: Cow<'_, str>| Self::Topic {
            publishes,
            topic: topic.into_owned(),
            node: caller.to_owned(),
        };
        match effect {
            Effect::SetParam { key, .. } | Effect::DeleteParam { key } => {
                let (path, node) = (param_path(&key), caller.to_owned());
                vec![Self::Param { path, node }]
            }
            Effect::RegisterPublisher { topic: name, .. } => vec![topic(true, name), node],
            Effect::RegisterSubscriber { topic: name, .. } => vec![topic(false, name), node],
            Effect::RegisterService { service, .. } => {
                vec![Self::Service(service.into_owned()), node]
            }
            Effect::SubscribeParam { .. } => vec![node],
            Effect::UnregisterPublisher { .. }
            | Effect::UnregisterSubscriber { .. }
            | Effect::UnregisterService { .. }
            | Effect::UnsubscribeParam { .. } => Vec::new(),
        }
    }
}

/// A parameter's name with a slash at the end, so that the names above it are its prefixes.
pub(super) fn param_path(key: &str) -> String {
    let mut path = String::with_capacity(key.len() + 1);
    path.push('/');
    for part in names::parts(key) {
        path.push_str(part);
        path.push('/');
    }
    path
}

/// The resolved name of the parameter that `call` sets or deletes.
pub fn parameter_of(call: &Request) -> Option<String> {
    Write::parse(call)?.parameter().map(str::to_owned)
}

/// The path of the parameter that `call` sets or deletes.
pub(super) fn param_of(call: &Request) -> Option<String> {
    parameter_of(call).map(|name| param_path(&name))
}

/// The changes that others than the cut-off computer have made since some point of the journal.
#[derive(Clone, Debug, Default)]
pub struct Changes {
    /// The paths of changed parameters, and the nodes that changed each, as far as they are known.
    params: BTreeMap<String, BTreeSet<String>>,
    rest: HashSet<ChangeSubject>,
    expected: ExpectedCalls,
    forwarded: ExpectedCalls,
}

impl Changes {
    /// Notes calls of this computer that the others may have run, or may still run. They do not count as others'
    /// changes.
    pub fn expect(&mut self, calls: impl IntoIterator<Item = Request>) {
        for call in calls {
            self.expected.add(call);
        }
    }

    /// Notes that this computer sent `call` to the journal as record `seq`, and the journal may contain it.
    pub fn expect_record(&mut self, seq: u64, call: Request) {
        self.expected.records.insert(seq, call);
    }

    /// Notes that `call` is a write of another computer's node, which this computer has answered as the leader. A later
    /// write of that node replaces it.
    pub fn note_forwarded(&mut self, call: &Request) {
        for call in call.calls() {
            self.forwarded.add(call.clone());
        }
    }

    /// Whether `call`, which was answered for a node of another computer, is no longer needed: the same node has set the
    /// same parameter, or one above it, since.
    pub(super) fn has_replaced(&self, call: &Request) -> bool {
        let (Some(path), Some(node)) = (param_of(call), call.caller()) else {
            return false;
        };
        self.forwarded.has(call) && self.above(&path).any(|nodes| nodes.contains(node))
    }

    /// Whether the node whose write is lost has itself made one of the changes that it is lost to.
    pub(in crate::cluster) fn are_of_same_node(&self, lost: &LostWrite) -> bool {
        let node = lost.call.caller().unwrap_or_default();
        match &lost.why {
            Conflict::Parameter(key) => {
                let path = param_path(key);
                let mut nodes = self.above(&path).chain(self.below(&path));
                nodes.any(|nodes| nodes.contains(node))
            }
            Conflict::Service { node: provider, .. } => provider == node,
            Conflict::Node { .. } | Conflict::Registration { .. } => true,
        }
    }

    /// Notes what record `seq` of the journal, a `call`, has changed, unless the call was expected.
    pub fn note(&mut self, seq: u64, call: &Request) {
        if self
            .expected
            .records
            .remove(&seq)
            .is_some_and(|own| own == *call)
        {
            return;
        }
        for call in call.calls() {
            if !self.expected.has(call) {
                ChangeSubject::changed_by(call)
                    .into_iter()
                    .for_each(|it| self.add(it));
            }
        }
    }

    pub fn add(&mut self, subject: ChangeSubject) {
        match subject {
            ChangeSubject::Param { path, node } => {
                self.params.entry(path).or_default().insert(node);
            }
            other => {
                self.rest.insert(other);
            }
        }
    }

    /// Adds the changes of others that `seen` has.
    pub fn add_all(&mut self, seen: &Self) {
        for (path, nodes) in &seen.params {
            let all = self.params.entry(path.clone()).or_default();
            all.extend(nodes.iter().cloned());
        }
        self.rest.extend(seen.rest.iter().cloned());
    }

    /// Notes that the others' state changed from `was` to `is`, without the calls in between. A value that was changed
    /// and changed back does not show.
    pub fn note_difference(&mut self, was: &Master, is: &Master) {
        let mut paths = Vec::new();
        differing("/", was.params(), is.params(), &mut paths);
        for path in paths {
            let parts: Vec<&str> = names::parts(&path).collect();
            if !self.expected.explains(&path, value_at(is.params(), &parts)) {
                self.params.entry(path).or_default();
            }
        }
        for (node, api) in is.nodes() {
            if was.api_of(node) != Some(api) && !self.expected.registers(node, api) {
                self.add(ChangeSubject::Node(node.to_owned()));
            }
            for publishes in [true, false] {
                let topics: Vec<_> = match publishes {
                    true => is.publications(node).collect(),
                    false => is.subscriptions(node).collect(),
                };
                let new = topics.into_iter();
                let new = new.filter(|topic| !was.has_topic(node, publishes, topic));
                for topic in new.filter(|_| !self.expected.registers(node, api)) {
                    let (topic, node) = (topic.to_owned(), node.to_owned());
                    self.rest.insert(ChangeSubject::Topic {
                        publishes,
                        topic,
                        node,
                    });
                }
            }
        }
        for (name, service) in &is.registry().services {
            let node = is.api_of(&service.node).unwrap_or_default();
            if was.registry().services.get(name) != Some(service)
                && !self.expected.registers(&service.node, node)
            {
                self.add(ChangeSubject::Service(name.clone()));
            }
        }
    }

    /// Whether the parameter at this path or one above it was changed.
    pub(super) fn has_above(&self, path: &str) -> bool {
        self.above(path).next().is_some()
    }

    /// Whether the parameter at this path, one above it or one below it was changed.
    pub(super) fn has_param(&self, path: &str) -> bool {
        self.has_above(path) || self.below(path).next().is_some()
    }

    /// The nodes that changed the parameter at this path, and those that changed one above it.
    fn above(&self, path: &str) -> impl Iterator<Item = &BTreeSet<String>> {
        let above = path.match_indices('/');
        above.filter_map(|(end, _)| self.params.get(path.get(..=end)?))
    }

    /// The nodes that changed the parameter at this path, and those that changed one below it.
    fn below(&self, path: &str) -> impl Iterator<Item = &BTreeSet<String>> {
        let from = (Bound::Included(path), Bound::Unbounded);
        let below = self.params.range::<str, _>(from);
        let below = below.take_while(move |(of, _)| of.starts_with(path));
        below.map(|(_, nodes)| nodes)
    }

    pub(super) fn has(&self, subject: &ChangeSubject) -> bool {
        self.rest.contains(subject)
    }
}

/// Calls of this computer that the others may have run.
#[derive(Clone, Debug, Default)]
struct ExpectedCalls {
    /// The calls, by method, caller and first argument.
    calls: HashMap<String, Vec<Request>>,
    /// The calls, by their numbers in the journal.
    records: HashMap<u64, Request>,
}

fn slot(call: &Request) -> String {
    let name = call.text(1).unwrap_or_default();
    let caller = call.caller().unwrap_or_default();
    format!("{} {caller} {name}", call.method().name())
}

impl ExpectedCalls {
    fn add(&mut self, call: Request) {
        if !self.has(&call) {
            self.calls.entry(slot(&call)).or_default().push(call);
        }
    }

    /// Whether `call` is one of these calls. It may be in the journal several times, because it is sent again after a
    /// lost answer.
    fn has(&self, call: &Request) -> bool {
        if Mutant::GuessesByValues.lives() {
            let mut own = self.calls.values().flatten();
            return own.any(|of| of.params().get(1..) == call.params().get(1..));
        }
        let calls = self.calls.get(&slot(call));
        calls.is_some_and(|calls| calls.contains(call))
    }

    fn calls(&self) -> impl Iterator<Item = &Request> {
        let records = self.records.values();
        self.calls.values().flatten().chain(records)
    }

    /// Whether one of the calls explains the value of the parameter at `path`.
    fn explains(&self, path: &str, is: Option<&Value>) -> bool {
        self.calls().any(|call| {
            let below = param_of(call).and_then(|of| path.strip_prefix(of.as_str()));
            let Some(below) = below else { return false };
            let set = Write::parse(call).and_then(|write| write.value());
            let parts: Vec<&str> = names::parts(below).collect();
            let value = match (set, parts.as_slice()) {
                (set, []) => set,
                (Some(Value::Struct(tree)), parts) => value_at(tree, parts),
                _ => None,
            };
            value == is
        })
    }

    fn registers(&self, node: &str, api: &str) -> bool {
        let mut calls = self.calls();
        calls.any(|call| Write::parse(call).and_then(|it| it.registrant()) == Some((node, api)))
    }
}

/// The value at a path. `None` at the root.
pub(in crate::cluster) fn value_at<'a>(tree: &'a Struct, path: &[&str]) -> Option<&'a Value> {
    let (first, rest) = path.split_first()?;
    match (tree.get(*first)?, rest) {
        (value, []) => Some(value),
        (Value::Struct(below), rest) => value_at(below, rest),
        _ => None,
    }
}

/// Adds the deepest paths at which the trees differ.
fn differing(path: &str, was: &Struct, is: &Struct, found: &mut Vec<String>) {
    let added = is.iter().map(|(key, _)| key);
    let added = added.filter(|key| was.get(key.as_str()).is_none());
    for key in was.iter().map(|(key, _)| key).chain(added) {
        let path = format!("{path}{key}/");
        let empty = Struct::new();
        match (was.get(key.as_str()), is.get(key.as_str())) {
            (was, is) if was == is => {}
            (Some(Value::Struct(was)), Some(Value::Struct(is))) => {
                differing(&path, was, is, found);
            }
            (None, Some(Value::Struct(is))) if !is.is_empty() => {
                differing(&path, &empty, is, found);
            }
            (Some(Value::Struct(was)), None) if !was.is_empty() => {
                differing(&path, was, &empty, found);
            }
            _ => found.push(path),
        }
    }
}
