//! Describes how two states of a master differ. Ignores the order of lists, because only a master's replies show it.

use std::collections::BTreeSet;

use serde::Serialize;

use crate::{checkpoint::format::shown, hide::Hide};
use ros1_master::{
    master::{Master, Snapshot},
    xmlrpc::{Struct, Value},
};

/// What kind of entry differs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum What {
    Node,
    Publisher,
    Subscriber,
    /// A subscription to a parameter.
    ParamSubscriber,
    Service,
    TopicType,
    Parameter,
}

/// One difference between two states, A and B.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Difference {
    pub what: What,
    /// Name of the node, topic, service or parameter.
    pub name: String,
    /// For publishers and subscribers, the node that is registered.
    pub node: Option<String>,
    /// The address, type or value in A. `None` if A does not have it.
    pub a: Option<String>,
    /// The address, type or value in B. `None` if B does not have it.
    pub b: Option<String>,
    /// For a node that only one state has, everything for which it is registered.
    pub registrations: Vec<String>,
}

/// A difference with its description.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Described {
    pub text: String,
    #[serde(flatten)]
    pub difference: Difference,
}

impl Difference {
    /// Adds the [`text`](Self::text).
    pub fn described(self, names: [&str; 2]) -> Described {
        Described {
            text: self.text(names),
            difference: self,
        }
    }

    /// Describes the difference. The arguments are names for A and B.
    pub fn text(&self, [a, b]: [&str; 2]) -> String {
        let (name, node) = (&self.name, self.node.as_deref().unwrap_or_default());
        let (side, value) = match (&self.a, &self.b) {
            (Some(in_a), Some(in_b)) => {
                return match self.what {
                    What::Node => format!("node {name} is at {in_a} in {a} and at {in_b} in {b}"),
                    What::Service => {
                        format!("service {name} is provided by {in_a} in {a} and by {in_b} in {b}")
                    }
                    What::TopicType => {
                        format!("topic {name} has the type {in_a} in {a} and {in_b} in {b}")
                    }
                    _ => format!("parameter {name}: {in_a} -> {in_b}"),
                };
            }
            (Some(value), None) => (a, value),
            (None, Some(value)) => (b, value),
            (None, None) => return format!("{name} differs"),
        };
        match self.what {
            What::Node => {
                let held = grouped(&self.registrations);
                format!("node {name} at {value} only in {side}: {held}")
            }
            What::Publisher => format!("{node} publishes {name} only in {side}"),
            What::Subscriber => format!("{node} subscribes {name} only in {side}"),
            What::ParamSubscriber => format!("{node} watches the parameter {name} only in {side}"),
            What::Service => format!("service {name} of {value} only in {side}"),
            What::TopicType => format!("topic {name} has a type, {value}, only in {side}"),
            What::Parameter => format!("parameter {name} only in {side}: {value}"),
        }
    }
}

/// Joins a list of registrations, as in `publishes /a, /b; subscribes /c`.
fn grouped(registrations: &[String]) -> String {
    let (mut text, mut last) = (String::new(), "");
    for registration in registrations {
        let (verb, name) = registration.split_once(' ').unwrap_or_default();
        text += match (last.is_empty(), verb == last) {
            (true, _) => "",
            (_, true) => ", ",
            (_, false) => "; ",
        };
        text += if verb == last { name } else { registration };
        last = verb;
    }
    text
}

/// Lists where `a` and `b` differ. Values of hidden parameters are masked.
pub fn compare(a: &Master, b: &Master, hide: &Hide) -> Vec<Difference> {
    let mut found = Comparison {
        a: a.snapshot(),
        b: b.snapshot(),
        hide,
        found: Vec::new(),
    };
    found.nodes(a, b);
    found.registrations();
    found.services();
    found.types();
    found.params("", a.params(), b.params());
    found.found
}

/// Lists where two values of the parameter `name` differ, one difference for each parameter below it. `None` stands for
/// no parameter. Values of hidden parameters are masked.
pub fn compare_param(
    name: &str,
    a: Option<&Value>,
    b: Option<&Value>,
    hide: &Hide,
) -> Vec<Difference> {
    let mut found = Comparison {
        a: Snapshot::default(),
        b: Snapshot::default(),
        hide,
        found: Vec::new(),
    };
    found.param(name.trim_end_matches('/'), a, b);
    found.found
}

/// Describes all registrations of a node, one per element.
pub fn registrations(master: &Master, node: &str) -> Vec<String> {
    let services = master
        .services_of(node)
        .map(|(name, _)| format!("provides {name}"));
    let publishes = master
        .publications(node)
        .map(|topic| format!("publishes {topic}"));
    let subscribes = master
        .subscriptions(node)
        .map(|topic| format!("subscribes {topic}"));
    let watches = master.param_subscriptions(node);
    let watches = watches.map(|key| format!("watches the parameter {}", plain(key)));
    publishes
        .chain(subscribes)
        .chain(services)
        .chain(watches)
        .collect()
}

/// The parameter's name, from the key of a subscription.
pub fn plain(key: &str) -> &str {
    match key {
        "/" => key,
        _ => key.trim_end_matches('/'),
    }
}

struct Comparison<'h> {
    a: Snapshot,
    b: Snapshot,
    hide: &'h Hide,
    found: Vec<Difference>,
}

impl Comparison<'_> {
    fn add(&mut self, what: What, name: &str, a: Option<String>, b: Option<String>) {
        self.found.push(Difference {
            what,
            name: name.to_owned(),
            node: None,
            a,
            b,
            registrations: Vec::new(),
        });
    }

    fn nodes(&mut self, a: &Master, b: &Master) {
        let names: BTreeSet<&str> = a.nodes().chain(b.nodes()).map(|(name, _)| name).collect();
        for name in names {
            let apis = [a, b].map(|master| master.api_of(name).map(str::to_owned));
            if apis[0] == apis[1] {
                continue;
            }
            let only = match &apis {
                [Some(_), None] => Some(a),
                [None, Some(_)] => Some(b),
                _ => None,
            };
            let [in_a, in_b] = apis;
            self.add(What::Node, name, in_a, in_b);
            if let (Some(only), Some(last)) = (only, self.found.last_mut()) {
                last.registrations = registrations(only, name);
            }
        }
    }

    /// Compares the registrations of nodes that are in both states.
    fn registrations(&mut self) {
        let both =
            |node: &String| self.a.nodes.contains_key(node) && self.b.nodes.contains_key(node);
        let mut found = Vec::new();
        for (what, a, b) in [
            (What::Publisher, &self.a.publishers, &self.b.publishers),
            (What::Subscriber, &self.a.subscribers, &self.b.subscribers),
            (
                What::ParamSubscriber,
                &self.a.param_subscribers,
                &self.b.param_subscribers,
            ),
        ] {
            let keys: BTreeSet<_> = a.keys().chain(b.keys()).collect();
            for key in keys {
                let [in_a, in_b] =
                    [a, b].map(|lists| lists.get(key).map_or(&[][..], Vec::as_slice));
                let nodes: BTreeSet<_> =
                    in_a.iter().chain(in_b).filter(|node| both(node)).collect();
                for node in nodes {
                    let [there, here] =
                        [in_a, in_b].map(|list| list.contains(node).then(String::new));
                    if there != here {
                        found.push(Difference {
                            what,
                            name: plain(key).to_owned(),
                            node: Some(node.clone()),
                            a: there,
                            b: here,
                            registrations: Vec::new(),
                        });
                    }
                }
            }
        }
        self.found.extend(found);
    }

    fn services(&mut self) {
        let (a, b) = (&self.a, &self.b);
        let names: BTreeSet<_> = a
            .services
            .keys()
            .chain(b.services.keys())
            .cloned()
            .collect();
        for name in names {
            let entries = [&self.a, &self.b].map(|state| state.services.get(&name));
            if entries[0] == entries[1] {
                continue;
            }
            // A node that is only in one state has already been listed, with its services.
            let told = match entries {
                [Some(entry), None] => !self.b.nodes.contains_key(&entry.node),
                [None, Some(entry)] => !self.a.nodes.contains_key(&entry.node),
                _ => false,
            };
            if !told {
                let words = |entry: &ros1_master::master::ServiceEntry| {
                    format!("{} at {}", entry.node, entry.api)
                };
                let [in_a, in_b] = entries.map(|entry| entry.map(words));
                self.add(What::Service, &name, in_a, in_b);
            }
        }
    }

    fn types(&mut self) {
        let (a, b) = (&self.a, &self.b);
        let topics: BTreeSet<_> = a
            .topic_types
            .keys()
            .chain(b.topic_types.keys())
            .cloned()
            .collect();
        for topic in topics {
            let [in_a, in_b] =
                [&self.a, &self.b].map(|state| state.topic_types.get(&topic).cloned());
            // A topic that is used only in one state has already been listed, with its nodes.
            let used = |state: &Snapshot| {
                state.publishers.contains_key(&topic) || state.subscribers.contains_key(&topic)
            };
            let told = (in_a.is_none() || in_b.is_none()) && used(&self.a) != used(&self.b);
            if in_a != in_b && !told {
                self.add(What::TopicType, &topic, in_a, in_b);
            }
        }
    }

    fn params(&mut self, path: &str, a: &Struct, b: &Struct) {
        if a.iter().eq(b) {
            return;
        }
        let keys: BTreeSet<_> = a.keys().chain(b.keys()).collect();
        for key in keys {
            self.param(&format!("{path}/{key}"), a.get(key), b.get(key));
        }
    }

    fn param(&mut self, name: &str, a: Option<&Value>, b: Option<&Value>) {
        let empty = Struct::new();
        let members = |value: Option<&Value>| match value {
            None => Some(empty.clone()),
            Some(Value::Struct(members)) if !members.is_empty() => Some(members.clone()),
            Some(_) => None,
        };
        match (a, b, members(a), members(b)) {
            // In each of the two states, this is a namespace or absent.
            (.., Some(a), Some(b)) => self.params(name, &a, &b),
            _ if a.is_some_and(|a| b.is_some_and(|b| a.equals_in_any_order(b))) => {}
            _ => {
                let [in_a, in_b] =
                    [a, b].map(|value| value.map(|value| shown(&self.hide.mask(name, value))));
                self.add(What::Parameter, name, in_a, in_b);
            }
        }
    }
}

#[cfg(test)]
mod tests;
