//! Simulated nodes: their calls, and what they believe after what they have heard.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use rescue_core::health::port_of;
use ros1_master::{
    master::{Master, Method, Request},
    xmlrpc::{Call, Reply, Struct, Value},
};

use super::{PARAMS, TOPICS, text};
use test_support::dice::Dice;

/// When each parameter was first and last set to each value.
pub(super) type Values = HashMap<(String, Option<i32>), (u64, u64)>;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Library {
    Rospy,
    Roscpp,
}

/// Data that a thread of a node has read.
#[derive(Debug)]
pub(super) enum Thread {
    /// The thread that made a call reads the answer.
    Main(Request, Reply),
    /// The thread that serves XML-RPC reads a notification.
    Server(Call),
}

/// A process of a node, and what it believes.
#[derive(Debug)]
pub(super) struct Node {
    pub(super) name: String,
    pub(super) api: String,
    /// The number of the node, and how many processes it has had before.
    number: u64,
    earlier: u64,
    pub(super) is_dead: bool,
    library: Library,
    /// The publishers of each subscribed topic, as the node last heard.
    topics: BTreeMap<String, Vec<String>>,
    /// Cached parameters.
    params: BTreeMap<String, Value>,
    published: BTreeSet<String>,
    /// Parameters that the node subscribes to, and those that it has set.
    subscribed: BTreeSet<String>,
    set: BTreeSet<String>,
    /// A call of roscpp that holds the mutex which a publisherUpdate needs.
    subscribing: Option<String>,
    /// Notifications that wait for the mutex of roscpp.
    blocked: Vec<Call>,
    /// For each parameter, when the value that arrived last was first set.
    arrived: BTreeMap<String, u64>,
    pub(super) gone_back: Vec<String>,
}

impl Node {
    pub(super) fn new(number: u64, library: Library) -> Self {
        Self {
            name: format!("/n{number}"),
            api: format!("http://n{number}:1/"),
            number,
            earlier: 0,
            is_dead: false,
            library,
            topics: BTreeMap::new(),
            params: BTreeMap::new(),
            published: BTreeSet::new(),
            subscribed: BTreeSet::new(),
            set: BTreeSet::new(),
            subscribing: None,
            blocked: Vec::new(),
            arrived: BTreeMap::new(),
            gone_back: Vec::new(),
        }
    }

    /// An address that no process has had.
    pub(super) fn next_api(&self) -> String {
        format!("http://n{}:{}/", self.number, self.earlier + 2)
    }

    /// Ends this process. Returns the next one, at this address.
    pub(super) fn restart(&mut self, api: String) -> Self {
        self.is_dead = true;
        let earlier = self.earlier + 1;
        Self {
            api,
            earlier,
            // A master never notifies a name of a parameter that it has set itself.
            set: self.set.clone(),
            ..Self::new(self.number, self.library)
        }
    }

    pub(super) fn port(&self) -> &str {
        port_of(&self.api)
    }

    /// The node's next call.
    /// `subscribes` says whether it may subscribe to parameters: no master tells who does, so these subscriptions are lost
    /// if rosrescue dies while the disk has failed.
    pub(super) fn call(&mut self, dice: &mut Dice, value: i32, subscribes: bool) -> Request {
        let topic = format!("/t{}", dice.below(TOPICS));
        let key = format!("/p{}", dice.below(PARAMS));
        let (name, api) = (self.name.as_str(), self.api.as_str());
        match dice.below(10) {
            0..4 if !self.topics.contains_key(&topic) => {
                self.topics.insert(topic.clone(), Vec::new());
                if self.library == Library::Roscpp {
                    self.subscribing = Some(topic.clone());
                }
                Request::new(Method::RegisterSubscriber, [name, &topic, "x/Y", api])
            }
            0..6 if self.published.remove(&topic) => {
                Request::new(Method::UnregisterPublisher, [name, &topic, api])
            }
            0..6 => {
                self.published.insert(topic.clone());
                Request::new(Method::RegisterPublisher, [name, &topic, "x/Y", api])
            }
            6..8 if subscribes
                && !self.set.contains(&key)
                && self.subscribed.insert(key.clone()) =>
            {
                Request::new(Method::SubscribeParam, [name, api, &key])
            }
            // A node that sets a parameter is not notified of it by any master.
            _ if self.subscribed.contains(&key) => {
                Request::new(Method::UnregisterService, [name, "/none", "rosrpc://n:1"])
            }
            _ => {
                self.set.insert(key.clone());
                let params = [Value::from(name), key.as_str().into(), value.into()];
                Request::new(Method::SetParam, params)
            }
        }
    }

    /// A notification arrives. `values` tells when each parameter had each value.
    pub(super) fn arrives(&mut self, call: &Call, values: &Values) {
        let [_, subject, value] = call.params.as_slice() else {
            return;
        };
        let key = text(subject);
        if let Some((first, last)) = values.get(&(key.clone(), value.as_int())) {
            let before = self.arrived.insert(key, *first);
            if before.is_some_and(|before| before > *last) {
                let mistake = format!("{}: {subject:?} goes back to {value:?}", self.name);
                self.gone_back.push(mistake);
            }
        }
    }

    /// One of the node's threads reads something. Returns the call that follows at once, if any.
    pub(super) fn hears(&mut self, thread: Thread) -> Option<Request> {
        match thread {
            Thread::Server(call) => {
                let is_blocked = self.subscribing.is_some() && call.method == "publisherUpdate";
                match is_blocked {
                    true => self.blocked.push(call),
                    false => self.notified(&call),
                }
                None
            }
            Thread::Main(call, reply) => self.answered(&call, &reply),
        }
    }

    /// The node's registrations that `state` lacks.
    pub(super) fn lost_registrations(&self, state: &Master) -> Vec<String> {
        let mut lost = Vec::new();
        for topic in &self.published {
            if !state.publishers_of(topic).contains(&self.api) {
                lost.push(format!("{} does not publish {topic}", self.name));
            }
        }
        for topic in self.topics.keys() {
            if !state.subscribers_of(topic).contains(&self.api) {
                lost.push(format!("{} does not subscribe to {topic}", self.name));
            }
        }
        lost
    }

    fn notified(&mut self, call: &Call) {
        let [_, subject, value] = call.params.as_slice() else {
            return;
        };
        let subject = text(subject);
        if call.method == "publisherUpdate" {
            if let Some(list) = self.topics.get_mut(&subject) {
                *list = value.as_array().unwrap().iter().map(text).collect();
            }
            return;
        }
        let key = subject.trim_end_matches('/').to_owned();
        // rospy ignores parameters that are not in its cache yet.
        if self.library == Library::Roscpp || self.params.contains_key(&key) {
            self.params.insert(key, value.clone());
        }
    }

    fn answered(&mut self, call: &Request, reply: &Reply) -> Option<Request> {
        let Reply::Value(Value::Array(answer)) = reply else {
            panic!("{reply:?}")
        };
        let [code, _, value] = answer.as_slice() else {
            panic!("{reply:?}")
        };
        match call.method() {
            Method::RegisterSubscriber => {
                let topic = call.text(1).unwrap().to_owned();
                let list = value.as_array().unwrap().iter().map(text).collect();
                self.topics.insert(topic, list);
                self.subscribing = None;
                for call in std::mem::take(&mut self.blocked) {
                    self.notified(&call);
                }
            }
            Method::SubscribeParam => {
                let key = call.text(2).unwrap();
                match self.library {
                    Library::Rospy => {
                        self.params.insert(key.to_owned(), value.clone());
                    }
                    // roscpp ignores this value and reads the parameter again.
                    Library::Roscpp => {
                        return Some(Request::new(Method::GetParam, [&*self.name, key]));
                    }
                }
            }
            Method::GetParam if *code == Value::Int(1) => {
                let key = call.text(1).unwrap();
                self.params.insert(key.to_owned(), value.clone());
            }
            _ => {}
        }
        None
    }

    /// The node's beliefs that contradict `state`. No master tells subscribers that a publisher at one of the `dead`
    /// addresses has lost its name to another process. The writer of an `abandoned` value has ended before it was
    /// answered. If rosrescue dies, too, that value is unknown, and subscribers are not told that a parameter is not set.
    pub(super) fn mistakes(
        &self,
        state: &Master,
        dead: &BTreeSet<&str>,
        abandoned: &[Request],
    ) -> Vec<String> {
        let mut mistakes = Vec::new();
        for (topic, list) in &self.topics {
            let truth = state.publishers_of(topic);
            let living = |list: &[String]| {
                let living = list.iter().filter(|api| !dead.contains(api.as_str()));
                living.cloned().collect::<Vec<_>>()
            };
            if living(list) != living(&truth) {
                let name = &self.name;
                mistakes.push(format!("{name} {topic}: {list:?} instead of {truth:?}"));
            }
        }
        for (key, value) in &self.params {
            let truth = state.param_update(&format!("{key}/")).unwrap();
            let truth = truth.params.get(2).unwrap();
            // A parameter that was not set is an empty struct in both.
            let unset = Value::Struct(Struct::new());
            let is_abandoned = *truth == unset
                && abandoned
                    .iter()
                    .any(|call| call.text(1) == Some(key) && call.params().get(2) == Some(value));
            if value != truth && !(*value == unset && *truth == unset) && !is_abandoned {
                let name = &self.name;
                mistakes.push(format!("{name} {key}: {value:?} instead of {truth:?}"));
            }
        }
        mistakes
    }
}
