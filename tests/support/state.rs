//! Everything that can be read of a master's state, and how two states differ.

use std::fmt::{self, Display, Formatter};
use std::io;

use ros1_master::xmlrpc::Value;

use super::kinds::{sorted, unordered};
use super::rpc::Client;

/// The state of a master as its clients see it. Every list keeps the master's order, unless the master is
/// [`unordered`].
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct State {
    /// Topics or services, each with the names of its nodes.
    pub(crate) publishers: Vec<(String, Vec<String>)>,
    pub(crate) subscribers: Vec<(String, Vec<String>)>,
    pub(crate) services: Vec<(String, Vec<String>)>,
    pub(crate) topic_types: Vec<(String, String)>,
    /// The address of each node that is named above.
    pub(crate) nodes: Vec<(String, String)>,
    /// The address of each service.
    pub(crate) service_apis: Vec<(String, String)>,
    pub(crate) params: Value,
    pub(crate) param_names: Vec<String>,
}

impl State {
    /// Reads the state with one call after another, so the master should be at rest.
    #[track_caller]
    pub(crate) fn read(client: &Client) -> Self {
        Self::try_read(client).unwrap_or_else(|error| panic!("{}: {error}", client.uri()))
    }

    pub(crate) fn try_read(client: &Client) -> io::Result<Self> {
        // One connection for all calls, because rosmaster starts a thread for each connection.
        let mut wire = client.connect()?;
        let mut ask = |method: &str, argument: Option<&str>| {
            let params = std::iter::once("/test")
                .chain(argument)
                .map(Value::from)
                .collect();
            let (code, text, value) = wire.status(method, params)?;
            match code {
                1 => Ok(value),
                _ => Err(io::Error::other(format!(
                    "{method} {argument:?}: {code} {text}"
                ))),
            }
        };
        let system = ask("getSystemState", None)?;
        let [publishers, subscribers, services] = list(&system) else {
            return Err(io::Error::other(format!("getSystemState: {system:?}")));
        };
        let (publishers, subscribers, services) = (
            registrations(publishers),
            registrations(subscribers),
            registrations(services),
        );
        let mut names: Vec<&String> = Vec::new();
        for (_, nodes) in publishers.iter().chain(&subscribers).chain(&services) {
            names.extend(nodes);
        }
        names.sort();
        names.dedup();
        let mut nodes = Vec::new();
        for name in names {
            nodes.push((name.clone(), text(&ask("lookupNode", Some(name))?)));
        }
        let mut service_apis = Vec::new();
        for (service, _) in &services {
            service_apis.push((service.clone(), text(&ask("lookupService", Some(service))?)));
        }
        let types = ask("getTopicTypes", None)?;
        let mut state = Self {
            topic_types: list(&types)
                .iter()
                .map(|pair| (text(&list(pair)[0]), text(&list(pair)[1])))
                .collect(),
            params: ask("getParam", Some("/"))?,
            param_names: list(&ask("getParamNames", None)?)
                .iter()
                .map(text)
                .collect(),
            publishers,
            subscribers,
            services,
            nodes,
            service_apis,
        };
        if unordered() {
            state.sort();
        }
        Ok(state)
    }

    /// Sorts everything that comes from a dictionary.
    fn sort(&mut self) {
        self.publishers.sort();
        self.subscribers.sort();
        self.services.sort();
        self.topic_types.sort();
        self.service_apis.sort();
        self.params = sorted(&self.params);
        self.param_names.sort();
    }

    /// This state without one node, as after the node has ended. Topic types stay.
    pub(crate) fn without_node(&self, node: &str) -> Self {
        let mut rest = self.clone();
        for table in [
            &mut rest.publishers,
            &mut rest.subscribers,
            &mut rest.services,
        ] {
            for (_, nodes) in table.iter_mut() {
                nodes.retain(|name| name != node);
            }
            table.retain(|(_, nodes)| !nodes.is_empty());
        }
        rest.nodes.retain(|(name, _)| name != node);
        let services = &rest.services;
        rest.service_apis
            .retain(|(name, _)| services.iter().any(|(kept, _)| kept == name));
        rest
    }

    /// This state without one registration of a publisher.
    pub(crate) fn without_publisher(&self, topic: &str, node: &str) -> Self {
        let mut rest = self.clone();
        for (_, nodes) in rest.publishers.iter_mut().filter(|(name, _)| name == topic) {
            nodes.retain(|name| name != node);
        }
        rest.publishers.retain(|(_, nodes)| !nodes.is_empty());
        rest
    }

    /// This state without one topic type.
    pub(crate) fn without_type(&self, topic: &str) -> Self {
        let mut rest = self.clone();
        rest.topic_types.retain(|(name, _)| name != topic);
        rest
    }

    /// This state with the parameters of another.
    pub(crate) fn with_params_of(&self, other: &Self) -> Self {
        Self {
            params: other.params.clone(),
            param_names: other.param_names.clone(),
            ..self.clone()
        }
    }

    /// Whether `node` has any registration.
    pub(crate) fn knows(&self, node: &str) -> bool {
        self.nodes.iter().any(|(name, _)| name == node)
    }

    /// The names of the subscribers of a topic, without the rest of the state.
    pub(crate) fn read_subscribers(client: &Client, topic: &str) -> Option<Vec<String>> {
        let system = client.ask("getSystemState", vec!["/test".into()])?;
        let subscribers = registrations(list(&system).get(1)?);
        let found = subscribers.into_iter().find(|(name, _)| name == topic);
        Some(found.map(|(_, nodes)| nodes).unwrap_or_default())
    }

    pub(crate) fn publishers_of(&self, topic: &str) -> Vec<String> {
        let found = self.publishers.iter().find(|(name, _)| name == topic);
        found.map(|(_, nodes)| nodes.clone()).unwrap_or_default()
    }

    pub(crate) fn subscribers_of(&self, topic: &str) -> Vec<String> {
        let found = self.subscribers.iter().find(|(name, _)| name == topic);
        found.map(|(_, nodes)| nodes.clone()).unwrap_or_default()
    }

    /// The differences to `other`, one fact per line. Empty if there are none.
    pub(crate) fn difference(&self, other: &Self) -> String {
        let (mine, theirs) = (self.to_string(), other.to_string());
        let (mine, theirs): (Vec<_>, Vec<_>) = (mine.lines().collect(), theirs.lines().collect());
        let mut lines = Vec::new();
        lines.extend(
            mine.iter()
                .filter(|line| !theirs.contains(line))
                .map(|line| format!("- {line}")),
        );
        lines.extend(
            theirs
                .iter()
                .filter(|line| !mine.contains(line))
                .map(|line| format!("+ {line}")),
        );
        if lines.is_empty() && mine != theirs {
            lines.push("the same facts in another order; they were:".to_owned());
            lines.extend(mine.iter().map(|line| format!("- {line}")));
            lines.push("is:".to_owned());
            lines.extend(theirs.iter().map(|line| format!("+ {line}")));
        }
        lines.join("\n")
    }

    /// Panics with the differences unless `now` is the same state.
    #[track_caller]
    pub(crate) fn assert_same(&self, now: &Self, when: &str) {
        assert!(
            self == now,
            "the state differs {when}:\n{}",
            self.difference(now)
        );
    }
}

/// Prints one fact per line.
impl Display for State {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let tables = [
            ("publishers of", &self.publishers),
            ("subscribers of", &self.subscribers),
            ("provider of", &self.services),
        ];
        for (what, table) in tables {
            for (name, nodes) in table {
                writeln!(f, "{what} {name}: {}", nodes.join(", "))?;
            }
        }
        let pairs = [
            ("type of", &self.topic_types),
            ("address of node", &self.nodes),
            ("address of service", &self.service_apis),
        ];
        for (what, table) in pairs {
            for (name, value) in table {
                writeln!(f, "{what} {name}: {value}")?;
            }
        }
        parameters(f, "", &self.params)?;
        writeln!(f, "parameter names: {}", self.param_names.join(", "))
    }
}

fn parameters(f: &mut Formatter<'_>, key: &str, value: &Value) -> fmt::Result {
    match value {
        Value::Struct(members) if !members.is_empty() => {
            for (name, member) in members {
                parameters(f, &format!("{key}/{name}"), member)?;
            }
            Ok(())
        }
        other => {
            let text: String = format!("{other:?}").chars().take(300).collect();
            writeln!(f, "parameter {key}: {text}")
        }
    }
}

fn list(value: &Value) -> &[Value] {
    value
        .as_array()
        .unwrap_or_else(|| panic!("not an array: {value:?}"))
}

fn text(value: &Value) -> String {
    value
        .as_str()
        .unwrap_or_else(|| panic!("not a string: {value:?}"))
        .to_owned()
}

fn registrations(table: &Value) -> Vec<(String, Vec<String>)> {
    list(table)
        .iter()
        .map(|entry| {
            (
                text(&list(entry)[0]),
                list(&list(entry)[1]).iter().map(text).collect(),
            )
        })
        .collect()
}
