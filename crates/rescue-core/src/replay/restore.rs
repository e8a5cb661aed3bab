//! Generates the calls that bring a new master to a state, and tries each one on a model of that master.

use std::collections::{HashMap, HashSet};

use indexmap::IndexMap;

use super::Token;
use super::plan::Skipped;
use super::token::{HELPER, NO_API};
use ros1_master::master::names::{self, CALLER_ID};
use ros1_master::master::{
    Master, Method, Registrations, Registry, Request, Write, WriteTarget, returnable,
};
use ros1_master::xmlrpc::{Reply, Struct, Value};

/// Generates the calls that change state and passes each, with its predicted answer, to `write`. Afterwards `model` has
/// the state that the master will have.
pub(super) struct Restore<'a, W> {
    write: W,
    /// Number of calls so far.
    count: usize,
    pub(super) model: Master,
    pub(super) skipped: Vec<Skipped>,
    target: &'a Master,
    found: &'a Master,
    /// The topic types of `target`, the state to restore, in order.
    types: IndexMap<&'a str, &'a str>,
    /// Number of `types` that the new master has so far.
    types_in: usize,
    /// Whether the new master's list of topic types is a prefix of the list in `target`, the state to restore. If not,
    /// the order of the types cannot be restored.
    ordered: bool,
    manner: Manner,
}

/// How the new master's state is treated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Manner {
    /// What the master holds stays. One `setParam` sets the whole parameter tree.
    Add,
    /// Like [`Self::Add`], but the parameters become exactly those of the target, and each that differs is set or
    /// deleted by its own call. So nothing is overwritten that another program sets at the same time.
    Repair,
    /// The parameters and topic types of the target replace those of the master, which has no registrations.
    Replace,
    /// Like [`Self::Replace`], for a master that still has the registrations that [`outdated`] leaves. Each parameter
    /// that differs is set or deleted by its own call.
    Update,
}

impl Manner {
    /// Whether the topic types of the target win over those of the master.
    fn sets_types(self) -> bool {
        matches!(self, Self::Replace | Self::Update)
    }
}

impl<'a, W: FnMut(Request, Reply)> Restore<'a, W> {
    /// Brings a model of `found` to `target`.
    pub(super) fn run(target: &'a Master, found: &'a Master, manner: Manner, write: W) -> Self {
        let known = found.topic_types().keys();
        let first = target.topic_types().keys().take(found.topic_types().len());
        let types = target.topic_types().iter();
        let types = types.map(|(topic, topic_type)| (topic.as_str(), topic_type.as_str()));
        let mut restore = Self {
            ordered: known.eq(first),
            write,
            count: 0,
            model: found.clone(),
            skipped: Vec::new(),
            target,
            found,
            types: types.collect(),
            types_in: 0,
            manner,
        };
        restore.params();
        restore.nodes();
        restore.publishers();
        restore.services();
        restore.had_services();
        restore.star_types();
        restore.changed_types();
        restore.subscribers();
        restore.types_before(restore.types.len());
        restore.param_subscribers();
        restore
    }

    fn push(&mut self, method: Method, params: impl IntoIterator<Item = impl Into<Value>>) {
        let request = Request::new(method, params);
        let predicted = self.model.apply(&request).reply;
        self.count += 1;
        (self.write)(request, predicted);
    }

    fn params(&mut self) {
        let found = self.found.params();
        let keeps = self.manner == Manner::Add && !found.is_empty();
        let both = keeps.then(|| merged(self.target.params(), found));
        let whole = both.as_ref().unwrap_or_else(|| self.target.params());
        if whole.iter().eq(found) {
            // There is nothing to set, so even parameters that a master cannot return stay.
            return;
        }
        let (tree, left_out) = returnable::writable(whole);
        let keys = left_out.into_iter();
        self.skipped.extend(keys.map(|key| Skipped::Param { key }));
        if tree.iter().eq(found) {
            return;
        }
        if matches!(self.manner, Manner::Repair | Manner::Update) {
            return self.set_different("", tree, found);
        }
        // Another program may have set parameters since the inspection, and this `setParam` removes them. rosmaster
        // answers `getParam` with the tree itself and encodes it when the multicall ends. So the answer also has what
        // was set between the two calls.
        if returnable::is_writable(found) && !self.found.is_inexact() {
            self.push(Method::GetParam, [CALLER_ID, "/"]);
        }
        let params = [CALLER_ID.into(), "/".into(), Value::Struct(tree)];
        self.push(Method::SetParam, params);
    }

    /// Sets or deletes each parameter in the namespace `path` in which `tree` and `found` differ.
    fn set_different(&mut self, path: &str, tree: Struct, found: &Struct) {
        let is_nameable = |key: &str| !key.is_empty() && !key.contains('/');
        let differs = |(key, value): (&String, &Value)| found.get(key) != Some(value);
        let set = tree.iter().filter(|entry| differs(*entry));
        let gone = found.keys().filter(|key| !tree.contains_key(*key));
        let mut keys = set.map(|(key, _)| key).chain(gone.clone());
        if !keys.all(|key| is_nameable(key)) {
            let path = if path.is_empty() { "/" } else { path };
            let params = [CALLER_ID.into(), path.into(), Value::Struct(tree)];
            return self.push(Method::SetParam, params);
        }
        for key in gone {
            self.push(Method::DeleteParam, [CALLER_ID, &format!("{path}/{key}")]);
        }
        for (key, value) in tree.iter() {
            let path = format!("{path}/{key}");
            match (value, found.get(key)) {
                (value, Some(known)) if value == known => {}
                (Value::Struct(inner), Some(Value::Struct(known))) => {
                    self.set_different(&path, inner.clone(), known);
                }
                (value, _) => {
                    let params = [CALLER_ID.into(), path.as_str().into(), value.clone()];
                    self.push(Method::SetParam, params);
                }
            }
        }
    }

    /// Notes the nodes that are left out because the new master has them at another address.
    fn nodes(&mut self) {
        for (caller_id, api) in self.target.nodes() {
            if let Some(found_api) = self.found.api_of(caller_id)
                && found_api != api
                && !Token::is_ours(caller_id)
            {
                self.skipped.push(Skipped::Node {
                    caller_id: caller_id.to_owned(),
                    api: api.to_owned(),
                    found_api: found_api.to_owned(),
                });
            }
        }
    }

    /// The address at which to register a node. `None` if the node is left out.
    fn api(&self, caller_id: &str) -> Option<&'a str> {
        let api = self.target.api_of(caller_id)?;
        let free = self
            .found
            .api_of(caller_id)
            .is_none_or(|found| found == api);
        (free && !Token::is_ours(caller_id)).then_some(api)
    }

    /// The nodes among `callers` that must still be registered under `key`: caller id, name that leads to `key`,
    /// address.
    fn missing(
        &mut self,
        key: &'a str,
        callers: &'a [String],
        there: Option<&Vec<String>>,
        name_for: fn(&str, &str) -> Option<String>,
    ) -> Vec<(&'a str, String, &'a str)> {
        let mut missing = Vec::with_capacity(callers.len());
        let there: HashSet<&String> = there.into_iter().flatten().collect();
        for caller_id in callers {
            let Some(api) = self.api(caller_id) else {
                continue;
            };
            if there.contains(caller_id) {
                continue;
            }
            match name_for(key, caller_id) {
                Some(name) => missing.push((caller_id.as_str(), name, api)),
                None => self.skip_unnameable(key, caller_id),
            }
        }
        missing
    }

    fn skip_unnameable(&mut self, key: &str, caller_id: &str) {
        let skipped = Skipped::Unnameable {
            key: key.to_owned(),
            caller_id: caller_id.to_owned(),
        };
        if !self.skipped.contains(&skipped) {
            self.skipped.push(skipped);
        }
    }

    /// The type with which to register a topic. A type that the new master has stays, unless the target's types win.
    fn topic_type(&self, topic: &str) -> &'a str {
        let known = self.found.type_of(topic);
        let known = known.filter(|known| *known != "*" && !self.manner.sets_types());
        known.or_else(|| self.target.type_of(topic)).unwrap_or("*")
    }

    fn publishers(&mut self) {
        let (target, found) = (self.target, self.found);
        for (topic, callers) in &target.registry().publishers {
            let there = found.registry().publishers.get(topic);
            let mut missing = self.missing(topic, callers, there, names::name_for);
            if missing.is_empty() {
                continue;
            }
            self.types_up_to(topic);
            let topic_type = self.topic_type(topic);
            let mut put_back = Vec::new();
            if missing.len() > 1 {
                put_back = self.remove_subscribers(topic);
            }
            let last = missing.pop();
            for (caller_id, name, api) in missing {
                self.push(
                    Method::RegisterPublisher,
                    [caller_id, &name, topic_type, api],
                );
            }
            for (caller_id, name, api) in put_back {
                self.push(Method::RegisterSubscriber, [caller_id, &name, "*", api]);
            }
            if let Some((caller_id, name, api)) = last {
                self.push(
                    Method::RegisterPublisher,
                    [caller_id, &name, topic_type, api],
                );
            }
        }
    }

    /// Unregisters the new master's own subscribers of a topic, so that they are not notified of each publisher
    /// separately.
    fn remove_subscribers(&mut self, topic: &str) -> Vec<(&'a str, String, &'a str)> {
        let found = self.found;
        let subscribers = found
            .registry()
            .subscribers
            .get(topic)
            .map_or(&[][..], Vec::as_slice);
        let mut out = Vec::new();
        for caller_id in subscribers {
            let name = names::name_for(topic, caller_id);
            if let (Some(name), Some(api)) = (name, found.api_of(caller_id)) {
                self.push(Method::UnregisterSubscriber, [caller_id, &name, api]);
                out.push((caller_id.as_str(), name, api));
            }
        }
        out
    }

    fn services(&mut self) {
        let target = self.target;
        let mut losers: HashMap<&str, Vec<&str>> = HashMap::new();
        for (caller_id, node) in &target.registry().nodes {
            for service in target.taken_over(caller_id, node) {
                losers.entry(service).or_default().push(caller_id);
            }
        }
        for (service, entry) in &target.registry().services {
            let losers = losers.remove(service.as_str()).unwrap_or_default();
            if self.skip_if_provided(service, &losers) {
                continue;
            }
            let owner = self.api(&entry.node);
            let name = names::name_for(service, &entry.node);
            match (owner, name) {
                (Some(api), Some(name)) => {
                    self.register_for_losers(service, &losers);
                    let params = [entry.node.as_str(), &name, &entry.api, api];
                    self.push(Method::RegisterService, params);
                }
                (owner, _) => {
                    if owner.is_some() {
                        self.skip_unnameable(service, &entry.node);
                    }
                    self.register_for_losers_without_provider(service, &losers);
                }
            }
        }
        for (caller_id, node) in &target.registry().nodes {
            for service in target.taken_over(caller_id, node) {
                if let Some(losers) = losers.remove(service.as_str())
                    && !self.skip_if_provided(service, &losers)
                {
                    self.register_for_losers_without_provider(service, &losers);
                }
            }
        }
    }

    /// Registers and unregisters a service if the target ever had one. A master that never had a service answers
    /// `unregisterService` with a different message.
    fn had_services(&mut self) {
        if self.target.registry().had_services
            && !self.model.registry().had_services
            && let Some((helper, name)) = self.helper("/rosrescue")
        {
            self.take_and_give_up(&helper, &name);
        }
    }

    fn take_and_give_up(&mut self, helper: &str, service: &str) {
        self.push(Method::RegisterService, [helper, service, NO_API, NO_API]);
        self.push(Method::UnregisterService, [helper, service, NO_API]);
    }

    /// Whether a service has a provider in the new master. If so, the service and its previous providers are left out.
    fn skip_if_provided(&mut self, service: &str, losers: &[&str]) -> bool {
        let Some(found) = self.found.registry().services.get(service) else {
            return false;
        };
        let entry = self.target.registry().services.get(service);
        if let Some(entry) = entry.filter(|entry| *entry != found)
            && self.api(&entry.node).is_some()
        {
            self.skipped.push(Skipped::Service {
                service: service.to_owned(),
                caller_id: entry.node.clone(),
                found: found.node.clone(),
            });
        }
        for caller_id in losers {
            let node = self.found.registry().nodes.get(caller_id);
            let there = node.is_some_and(|node| node.services.contains(service));
            if self.api(caller_id).is_some() && !there {
                self.skipped.push(Skipped::Reference {
                    caller_id: (*caller_id).to_owned(),
                    service: service.to_owned(),
                });
            }
        }
        true
    }

    /// Registers `service` for `losers`, the nodes from which other nodes have taken it over.
    fn register_for_losers(&mut self, service: &str, losers: &[&str]) {
        for caller_id in losers {
            let Some(api) = self.api(caller_id) else {
                continue;
            };
            match names::name_for(service, caller_id) {
                Some(name) => {
                    self.push(
                        Method::RegisterService,
                        [caller_id, name.as_str(), NO_API, api],
                    );
                }
                None => self.skip_unnameable(service, caller_id),
            }
        }
    }

    /// Registers `service`, which has no provider now, for `losers`, the nodes that have lost it. Then a helper, a
    /// caller id that no node has, takes the service over and unregisters it.
    fn register_for_losers_without_provider(&mut self, service: &str, losers: &[&str]) {
        let before = self.count;
        let Some((helper, name)) = self.helper(service) else {
            for caller_id in losers {
                self.skip_unnameable(service, caller_id);
            }
            return;
        };
        self.register_for_losers(service, losers);
        if self.count > before {
            self.take_and_give_up(&helper, &name);
        }
    }

    fn subscribers(&mut self) {
        let (target, found) = (self.target, self.found);
        for (topic, callers) in &target.registry().subscribers {
            let there = found.registry().subscribers.get(topic);
            let missing = self.missing(topic, callers, there, names::name_for);
            if missing.is_empty() {
                continue;
            }
            self.types_up_to(topic);
            let topic_type = self.topic_type(topic);
            for (caller_id, name, api) in missing {
                self.push(
                    Method::RegisterSubscriber,
                    [caller_id, &name, topic_type, api],
                );
            }
        }
    }

    fn param_subscribers(&mut self) {
        let (target, found) = (self.target, self.found);
        for (key, callers) in &target.registry().param_subscribers {
            let there = found.registry().param_subscribers.get(key);
            for (caller_id, name, api) in self.missing(key, callers, there, names::param_name_for) {
                self.push(Method::SubscribeParam, [caller_id, api, &name]);
            }
        }
    }

    /// Adds the target's topic types that come before the type of `topic`, which is about to be registered.
    fn types_up_to(&mut self, topic: &str) {
        if self.ordered
            && !self.model.topic_types().contains_key(topic)
            && let Some(index) = self.types.get_index_of(topic)
        {
            self.types_before(index);
        }
    }

    /// Adds the types `*` of topics without publishers. Only the registration of a publisher can set such a type. It
    /// must come before the registrations of subscribers, because these would be notified of the publisher.
    fn star_types(&mut self) {
        let target = self.target;
        for (topic, topic_type) in target.topic_types() {
            if topic_type == "*" && !self.model.topic_types().contains_key(topic) {
                self.types_up_to(topic);
                self.bring_type(topic, topic_type);
            }
        }
    }

    /// Corrects the types of topics without publishers. Only the registration of a publisher can change a type. It must
    /// come before the registrations of subscribers, because these would be notified of the publisher.
    fn changed_types(&mut self) {
        let target = self.target;
        for (topic, topic_type) in target.topic_types() {
            let known = self.model.type_of(topic);
            let differs = known.is_some_and(|known| known != topic_type);
            if self.manner.sets_types() && differs && topic_type != "*" {
                self.set_type(topic, topic_type, true);
            }
        }
    }

    /// Adds the first `end` types of the target.
    fn types_before(&mut self, end: usize) {
        while self.types_in < end
            && let Some((&topic, &topic_type)) = self.types.get_index(self.types_in)
        {
            self.types_in += 1;
            self.bring_type(topic, topic_type);
        }
    }

    /// A caller id that no node has, with the name by which it can register `key`.
    fn helper(&self, key: &str) -> Option<(String, String)> {
        let is_node = |caller_id: &str| {
            let nodes = [self.target, self.found].map(|master| &master.registry().nodes);
            nodes.iter().any(|nodes| nodes.contains_key(caller_id))
        };
        names::reach(key, HELPER, |caller_id| !is_node(caller_id))
    }

    fn bring_type(&mut self, topic: &str, topic_type: &str) {
        if self.model.topic_types().contains_key(topic) {
            return;
        }
        let is_star = topic_type == "*";
        if is_star && self.model.registry().subscribers.contains_key(topic) {
            let skipped = Skipped::Type {
                topic: topic.to_owned(),
            };
            // This function runs for the topic a second time at the end, but the topic is listed once.
            if !self.skipped.contains(&skipped) {
                self.skipped.push(skipped);
            }
            return;
        }
        self.set_type(topic, topic_type, is_star);
    }

    /// Registers the topic for a helper, as a publisher or a subscriber, and unregisters it again.
    fn set_type(&mut self, topic: &str, topic_type: &str, as_publisher: bool) {
        let Some((helper, name)) = self.helper(topic) else {
            return self.skip_unnameable(topic, HELPER);
        };
        let (register, unregister) = match as_publisher {
            true => (Method::RegisterPublisher, Method::UnregisterPublisher),
            false => (Method::RegisterSubscriber, Method::UnregisterSubscriber),
        };
        self.push(register, [&helper, name.as_str(), topic_type, NO_API]);
        self.push(unregister, [&helper, name.as_str(), NO_API]);
    }
}

/// The calls that remove all registrations from a master that holds `found`. Subscribers are removed first, so that they
/// are not notified of the rest.
pub(super) fn removal(found: &Master) -> Vec<Request> {
    let nodes = found.nodes().filter(|(name, _)| !Token::is_ours(name));
    removal_of(
        found,
        nodes.map(|(name, _)| (name, found.unregister_calls(name), true)),
    )
}

/// The calls with which a helper subscribes to `key` and ends that, if there are subscribers of `key` in `target`.
fn helper_calls(of: WriteTarget, key: &str, target: &Registry) -> Option<(Request, Request)> {
    match of {
        WriteTarget::Subscriber if target.subscribers.contains_key(key) => {
            let name = names::name_for(key, HELPER)?;
            let subscribe = [HELPER, &name, "*", NO_API];
            let unsubscribe = [HELPER, &name, NO_API];
            Some((
                Request::new(Method::RegisterSubscriber, subscribe),
                Request::new(Method::UnregisterSubscriber, unsubscribe),
            ))
        }
        WriteTarget::ParamSubscriber if target.param_subscribers.contains_key(key) => {
            let name = names::param_name_for(key, HELPER)?;
            let of = [HELPER, NO_API, &name];
            Some((
                Request::new(Method::SubscribeParam, of),
                Request::new(Method::UnsubscribeParam, of),
            ))
        }
        _ => None,
    }
}

/// The registrations under some keys that stay.
struct Kept<'a> {
    nodes: HashMap<&'a str, HashSet<&'a str>>,
    /// The keys whose nodes change.
    changed: HashSet<&'a str>,
}

impl<'a> Kept<'a> {
    /// What stays if the registrations `old` become `new`, and the nodes for which `moves` get another address. A list
    /// grows only at its end, so nothing of a list stays whose first nodes would differ.
    fn of(old: &'a Registrations, new: &'a Registrations, moves: impl Fn(&str) -> bool) -> Self {
        let mut kept = Self {
            nodes: HashMap::new(),
            changed: HashSet::new(),
        };
        for (key, before) in old {
            let after = new.get(key).map_or(&[][..], Vec::as_slice);
            let wanted: HashSet<&str> = after.iter().map(String::as_str).collect();
            let stays = |node: &&String| wanted.contains(node.as_str()) && !moves(node);
            let nodes: Vec<&String> = before.iter().filter(stays).collect();
            let is_prefix = nodes
                .iter()
                .zip(after)
                .all(|(node, wanted)| *node == wanted);
            if nodes.len() < before.len() || nodes.len() < after.len() || !is_prefix {
                kept.changed.insert(key);
            }
            if is_prefix {
                let nodes = nodes.into_iter().map(String::as_str).collect();
                kept.nodes.insert(key, nodes);
            }
        }
        let added = new.keys().filter(|key| !old.contains_key(key));
        kept.changed.extend(added.map(String::as_str));
        kept
    }

    fn has(&self, key: &str, node: &str) -> bool {
        let nodes = self.nodes.get(key);
        nodes.is_some_and(|nodes| nodes.contains(node))
    }

    fn differ(&self, key: &str) -> bool {
        self.changed.contains(key)
    }
}

/// The calls that remove from a master, which holds `found`, registrations of some nodes: the given calls, and all that
/// the master knows of a node if the flag says so. A service that another node has taken over must be taken back for
/// that, so it has no provider afterwards. Publishers come last, so that no subscriber is notified.
fn removal_of<'a>(
    found: &Master,
    nodes: impl Iterator<Item = (&'a str, Vec<Request>, bool)>,
) -> Vec<Request> {
    let (mut calls, mut taken_back, mut publishers) = (Vec::new(), Vec::new(), Vec::new());
    for (caller_id, registrations, is_all) in nodes {
        for call in registrations {
            match call.method() {
                Method::UnregisterPublisher => publishers.push(call),
                _ => calls.push(call),
            }
        }
        let Some(node) = found.registry().nodes.get(caller_id).filter(|_| is_all) else {
            continue;
        };
        for service in found.taken_over(caller_id, node) {
            if let Some(name) = names::name_for(service, caller_id) {
                let register = [caller_id, &name, NO_API, &node.api];
                taken_back.push(Request::new(Method::RegisterService, register));
                let unregister = [caller_id, &name, NO_API];
                taken_back.push(Request::new(Method::UnregisterService, unregister));
            }
        }
    }
    calls.extend(taken_back);
    calls.extend(publishers);
    calls
}

/// The calls that remove from a master that holds `found` what differs in `target`: registrations that `target` lacks or
/// has at another address, and what would be notified of the rest, which is the subscribers of topics whose publishers or
/// type differ and, if any parameter differs, the subscribers of parameters.
///
/// A topic or key that keeps subscribers keeps its place, because a helper subscribes to it first. Also returns the calls
/// that remove the helper in the end. A master never connects to its address.
pub(super) fn outdated(found: &Master, target: &Master) -> (Vec<Request>, Vec<Request>) {
    let (old, new) = (found.registry(), target.registry());
    let same_params = found.params() == target.params();
    let moves = |node: &str| found.api_of(node) != target.api_of(node);
    let publishers = Kept::of(&old.publishers, &new.publishers, moves);
    let subscribers = Kept::of(&old.subscribers, &new.subscribers, moves);
    let param_subscribers = Kept::of(&old.param_subscribers, &new.param_subscribers, moves);
    let stays = |node: &str, call: &Request| {
        let Some(write) = Write::parse(call) else {
            return false;
        };
        let key = write.name();
        match write.target() {
            WriteTarget::Publisher => publishers.has(key, node),
            WriteTarget::Subscriber => {
                subscribers.has(key, node)
                    && !publishers.differ(key)
                    && found.type_of(key) == target.type_of(key)
            }
            WriteTarget::Service => old.services.get(key) == new.services.get(key),
            WriteTarget::ParamSubscriber => param_subscribers.has(key, node) && same_params,
            WriteTarget::Parameter => false,
        }
    };
    let nodes = old.nodes.keys().filter(|name| !Token::is_ours(name));
    let removed = nodes.map(|name| {
        let moves = moves(name);
        let mut calls = found.unregister_calls(name);
        calls.retain(|call| moves || !stays(name, call));
        (name.as_str(), calls, moves)
    });
    let removed = removal_of(found, removed);
    let (mut calls, mut last) = (Vec::new(), Vec::new());
    let mut held = HashSet::new();
    for write in removed.iter().filter_map(Write::parse) {
        let key = write.name();
        if held.insert((write.target(), key.to_owned()))
            && let Some((subscribe, unsubscribe)) = helper_calls(write.target(), key, new)
        {
            calls.push(subscribe);
            last.push(unsubscribe);
        }
    }
    calls.extend(removed);
    (calls, last)
}

/// Makes the changes that lead from the parameter tree `from` to `to` in the tree `onto`. What `to` lacks is removed only
/// where `onto` still has the value of `from`.
pub(super) fn changed(from: &Struct, to: &Struct, onto: &Struct) -> Struct {
    let nothing = Struct::new();
    let inner = |value: Option<&Value>| match value {
        Some(Value::Struct(inner)) => inner.clone(),
        _ => nothing.clone(),
    };
    let mut tree = onto.clone();
    tree.retain(|key, value| match (from.get(key), value) {
        _ if to.contains_key(key) => true,
        (Some(Value::Struct(from)), Value::Struct(value)) => {
            *value = changed(from, &nothing, value);
            !value.is_empty()
        }
        (before, value) => before != Some(value),
    });
    for (key, value) in to
        .iter()
        .filter(|(key, value)| from.get(*key) != Some(*value))
    {
        match (value, tree.get_mut(key)) {
            (Value::Struct(value), Some(Value::Struct(known))) => {
                *known = changed(&inner(from.get(key)), value, known);
            }
            _ => {
                tree.insert(key.clone(), value.clone());
            }
        }
    }
    tree
}

/// Merges two parameter trees namespace by namespace. `ours` wins over `theirs`.
pub(super) fn merged(ours: &Struct, theirs: &Struct) -> Struct {
    let mut tree = ours.clone();
    for (key, value) in theirs {
        match (tree.get_mut(key), value) {
            (Some(Value::Struct(inner)), Value::Struct(theirs)) => *inner = merged(inner, theirs),
            (Some(_), _) => {}
            (None, value) => {
                tree.insert(key.clone(), value.clone());
            }
        }
    }
    tree
}
