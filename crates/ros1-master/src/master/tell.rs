//! Builds the notifications that a master would send for its present state.

use std::{net::IpAddr, sync::Arc};

use super::registry::SharedRegistration;
use super::{CALLER_ID, Master, Method, Request, Write, returnable};
use crate::xmlrpc::{Call, Struct, Value};

/// The caller id of rosmaster's calls to nodes.
pub const MASTER: &str = "/master";
/// The method that sends a topic's publishers to a node.
pub const PUBLISHER_UPDATE: &str = "publisherUpdate";
/// The method that sends a parameter's value to a node.
pub const PARAM_UPDATE: &str = "paramUpdate";

/// A node that must shut down because another node has taken its name, at another address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Displaced {
    /// The node's name.
    pub node: String,
    /// The node's address.
    pub api: String,
    /// The last process id that was seen at this address, if any.
    pub pid: Option<i32>,
    /// The topics that the node published and subscribed to.
    pub topics: Vec<String>,
    /// See [`Master::registered_from`].
    pub from: Option<IpAddr>,
}

impl Master {
    /// The `publisherUpdate` with the full list of a topic's publishers.
    pub fn publisher_update(&self, topic: &str) -> Call {
        publisher_update(topic, &self.publishers_of(topic))
    }

    /// The `paramUpdate` with the value under `key`, which ends in a slash. As in rosmaster, the value is an empty
    /// struct if the key is not set. `None` if rosmaster cannot encode the value and so never sends it.
    pub fn param_update(&self, key: &str) -> Option<Call> {
        let value = self.params.get(key);
        let value = value.unwrap_or_else(|| Value::Struct(Struct::new()));
        if returnable::param_error(&value).is_some() {
            return None;
        }
        Some(param_update(key, value))
    }

    /// Whether anything is set under `key`, with or without a trailing slash.
    pub fn is_set(&self, key: &str) -> bool {
        self.params.has(key)
    }

    /// The parameter keys to which a node subscribes, each with a trailing slash.
    pub fn param_subscriptions(&self, caller_id: &str) -> impl Iterator<Item = &str> {
        let node = self.registry.nodes.get(caller_id);
        node.into_iter()
            .flat_map(|node| &node.param_subscriptions)
            .map(String::as_str)
    }

    /// Whether a node subscribes to any parameter.
    pub fn subscribes_params(&self, caller_id: &str) -> bool {
        self.param_subscriptions(caller_id).next().is_some()
    }

    /// All subscriptions to parameters that are set: address of the subscriber, and key with a trailing
    /// slash.
    pub fn param_subscribers(&self) -> Vec<(String, Arc<str>)> {
        let subscribers = self
            .registry
            .shared(SharedRegistration::ParamSubscribers)
            .keys();
        let set = subscribers.filter(|key| self.is_set(key));
        let all = set.flat_map(|key| {
            let apis = self
                .registry
                .apis(SharedRegistration::ParamSubscribers, key)
                .into_iter();
            let key = Arc::<str>::from(key.as_str());
            apis.map(move |api| (api, key.clone()))
        });
        all.collect()
    }

    /// Whether any node subscribes to `topic`. Counts only nodes whose address `at` accepts.
    pub fn subscribes(&self, at: impl Fn(&str) -> bool, topic: &str) -> bool {
        let nodes = self
            .registry
            .shared(SharedRegistration::Subscribers)
            .get(topic);
        self.any_at(&at, nodes)
    }

    /// Whether any node subscribes to `key`, to a namespace above it, or to a key below it. Counts only nodes whose
    /// address `at` accepts.
    pub fn subscribes_param(&self, at: impl Fn(&str) -> bool, key: &str) -> bool {
        let subscribers = self
            .registry
            .shared(SharedRegistration::ParamSubscribers)
            .iter();
        let mut related = subscribers.filter(|(subscribed, _)| {
            key.starts_with(subscribed.as_str()) || subscribed.starts_with(key)
        });
        related.any(|(_, nodes)| self.any_at(&at, Some(nodes)))
    }

    fn any_at(&self, at: &impl Fn(&str) -> bool, nodes: Option<&Vec<String>>) -> bool {
        nodes
            .into_iter()
            .flatten()
            .any(|node| self.api_of(node).is_some_and(at))
    }

    /// The node that `call` displaces: the call registers something under that node's name at another address, so the
    /// master tells the old node to shut down. Leaves [`Displaced::pid`] empty.
    pub fn displaced_by(&self, call: &Request) -> Option<Displaced> {
        let (node, api) = Write::parse(call)?.registrant()?;
        let held = self.api_of(node).filter(|held| *held != api)?;
        let topics = self.publications(node).chain(self.subscriptions(node));
        Some(Displaced {
            topics: topics.map(str::to_owned).collect(),
            node: node.to_owned(),
            api: held.to_owned(),
            pid: None,
            from: self.registered_from(node),
        })
    }

    /// Whether a node named `node` is registered at an address other than `api`.
    pub fn is_held_elsewhere(&self, node: &str, api: &str) -> bool {
        self.api_of(node).is_some_and(|held| held != api)
    }
}

/// The `publisherUpdate` with this list of publishers.
pub fn publisher_update(topic: &str, publishers: &[String]) -> Call {
    let publishers = publishers.iter().cloned().map(Value::String);
    let list = Value::Array(publishers.collect());
    Call::new(PUBLISHER_UPDATE, vec![MASTER.into(), topic.into(), list])
}

/// The `paramUpdate` with this value.
pub fn param_update(key: &str, value: Value) -> Call {
    Call::new(PARAM_UPDATE, vec![MASTER.into(), key.into(), value])
}

/// The `shutdown` sent to a node whose name another node has taken.
pub fn shutdown(node: &str) -> Call {
    Call::new(
        Method::Shutdown.name(),
        vec![MASTER.into(), bump_reason(node, false).into()],
    )
}

/// The reason in the `shutdown` that rosmaster sends to a node whose name `node` was taken. An old rosmaster (see
/// [`Master::set_old`]) leaves out the name. So do 1.12.15 to 1.12.17, 1.14.4 to 1.14.6 and 1.15.0 to 1.15.7, which are
/// not told apart from later ones here.
pub(crate) fn bump_reason(node: &str, old: bool) -> String {
    let reason = "new node registered with same name";
    match old {
        true => reason.to_owned(),
        false => format!("[{node}] Reason: {reason}"),
    }
}

/// A call of `method`, for a node or a master, with rosrescue's caller id as its only parameter.
pub fn question(method: &str) -> Call {
    Call::new(method, vec![CALLER_ID.into()])
}

/// The call that asks a node or a master for its process id.
pub fn get_pid() -> Call {
    question(Method::GetPid.name())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn call(method: &str, params: &[&str]) -> Request {
        Request::new(Method::named(method), params.iter().copied())
    }

    #[test]
    fn a_state_is_told_in_the_words_of_the_callbacks_that_led_to_it() {
        let mut master = Master::default();
        master.apply(&call(
            "registerSubscriber",
            &["/s", "/t", "*", "http://s:1/"],
        ));
        master.apply(&call("subscribeParam", &["/s", "http://s:1/", "/a"]));
        let publish = call("registerPublisher", &["/p", "/t", "x/Y", "http://p:1/"]);
        let told = master.apply(&publish).notices;
        let update = master.publisher_update("/t");
        let list = update.params.get(2).unwrap().as_array().unwrap();
        assert_eq!(list, [Value::from("http://p:1/")]);
        assert_eq!(told.len(), 1);
        let at = |api: &'static str| move |at: &str| at == api;
        assert!(master.subscribes(at("http://s:1/"), "/t"));
        assert!(!master.subscribes(at("http://p:1/"), "/t"));

        let set = Request::new(
            Method::SetParam,
            [Value::from("/x"), "/a/b".into(), 7.into()],
        );
        let told = master.apply(&set).notices;
        let super::super::Notice::ParamUpdate { key, value, .. } = told.first().unwrap() else {
            panic!("{told:?}");
        };
        let update = master.param_update(key).unwrap();
        assert_eq!(update.params.get(2), Some(value));
        assert!(master.subscribes_param(|api| api == "http://s:1/", key));
        assert!(!master.subscribes_param(|api| api == "http://s:1/", "/b/"));
        let gone = master.param_update("/not/there/").unwrap();
        assert_eq!(gone.params.get(2), Some(&Value::Struct(Struct::new())));
    }

    #[test]
    fn a_node_is_displaced_when_its_name_is_registered_at_another_address() {
        let mut master = Master::default();
        let publish = |api: &str| call("registerPublisher", &["/p", "/t", "x/Y", api]);
        assert_eq!(master.displaced_by(&publish("http://p:1/")), None);
        master.apply(&publish("http://p:1/"));
        assert_eq!(master.displaced_by(&publish("http://p:1/")), None);
        let displaced = Some(Displaced {
            node: "/p".to_owned(),
            api: "http://p:1/".to_owned(),
            pid: None,
            topics: vec!["/t".to_owned()],
            from: None,
        });
        assert!(!master.is_held_elsewhere("/p", "http://p:1/"));
        assert!(master.is_held_elsewhere("/p", "http://p:2/"));
        assert!(!master.is_held_elsewhere("/q", "http://p:1/"));
        assert_eq!(master.displaced_by(&publish("http://p:2/")), displaced);
        let watch = call("subscribeParam", &["/p", "http://p:2/", "/k"]);
        assert_eq!(master.displaced_by(&watch), displaced);
        let gone = call("unregisterPublisher", &["/p", "/t", "http://p:2/"]);
        assert_eq!(master.displaced_by(&gone), None);
    }
}
