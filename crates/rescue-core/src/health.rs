//! Judges a node's answers: whether it is the node that registered, and where the mirror differs from its
//! report.
//!
//! Without evidence to the contrary a node is the registered one: losing a healthy node is worse than keeping
//! a dead one.

mod backoff;
mod liveness;
mod rates;
mod repeats;
mod taken_port;
mod unreachable;

pub use liveness::{Health, Liveness};
pub use rates::Rates;
pub use repeats::Repeats;
pub use taken_port::{Eviction, first_taking};
pub use unreachable::Unreachable;

use std::collections::BTreeMap;

use crate::{
    master::{self, Master, Method, Request},
    xmlrpc::Value,
};

/// Topics that nodes of all kinds have: no evidence.
const COMMON: [&str; 6] = [
    "/rosout",
    "/clock",
    "/statistics",
    "/tf",
    "/tf_static",
    "/diagnostics",
];

/// A node's reaction to a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sign {
    /// It answered.
    Alive,
    /// Its port refuses connections: the process is gone.
    Dead,
    /// No answer in time, or no valid one. That is no proof of death.
    Silent,
}

/// Topics with their types, as listed by a node.
type Topics = BTreeMap<String, String>;

/// The part of a node's address that says where to connect: what follows the port is not sent. Names whose
/// addresses differ only there share a port, and what is asked there.
pub fn port_of(api: &str) -> &str {
    let api = api.trim();
    let host = api.find("//").map_or(0, |at| at + 2);
    let end = api.match_indices('/').find(|(at, _)| *at >= host);
    end.map_or(api, |(end, _)| api.split_at(end).0)
}

/// What a node reports to publish and subscribe.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Claims {
    publications: Topics,
    subscriptions: Topics,
}

impl Claims {
    /// Reads the results of `getPublications` and `getSubscriptions`: lists of topic and type. None if any
    /// entry could not be registered as it is: then the node's meaning is unclear.
    pub fn read(publications: &Value, subscriptions: &Value) -> Option<Self> {
        Some(Self {
            publications: topics(publications)?,
            subscriptions: topics(subscriptions)?,
        })
    }

    /// Whether it includes one of these topics, common ones excluded.
    pub fn shares(&self, topics: &[String]) -> bool {
        let mut own = self.all().filter(|topic| !COMMON.contains(topic));
        own.any(|topic| topics.iter().any(|other| other == topic))
    }

    fn all(&self) -> impl Iterator<Item = &str> {
        let both = self.publications.keys().chain(self.subscriptions.keys());
        both.map(String::as_str)
    }
}

fn topics(list: &Value) -> Option<Topics> {
    let topics = list.as_array()?.iter().map(|entry| {
        let [topic, topic_type] = entry.as_array()? else {
            return None;
        };
        let topic = topic
            .as_str()
            .filter(|topic| master::is_plain_topic(topic))?;
        Some((topic.to_owned(), topic_type.as_str()?.to_owned()))
    });
    topics.collect()
}

/// Whether the node behind a port is the one registered under a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// There is evidence that it has this name.
    Itself,
    /// There is evidence that it is another node.
    Another,
    /// No evidence.
    Unknown,
}

/// A name registered with a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Name {
    /// The caller id.
    pub node: String,
    /// The process id behind the port when it was last asked.
    pub known_pid: Option<i32>,
    /// Whether it has registered something since: another process may have taken the port under the same
    /// name.
    pub registered_since: bool,
    /// Grows with each registration; 0 if unknown.
    pub registered: u64,
}

/// Judges each of `names`, which are registered with the same port. `pid` and `claims` are the present
/// answers from the port.
pub fn judge(
    mirror: &Master,
    names: &[Name],
    pid: Option<i32>,
    claims: Option<&Claims>,
) -> Vec<Verdict> {
    let said = claims.into_iter().flat_map(Claims::all);
    let said: Vec<&str> = said.filter(|topic| !COMMON.contains(topic)).collect();
    // How many of its topics are reported, and whether all are.
    let match_of = |node: &str| {
        let held = mirror.publications(node).chain(mirror.subscriptions(node));
        let held: Vec<_> = held.filter(|topic| !COMMON.contains(topic)).collect();
        let count = held.iter().filter(|topic| said.contains(topic)).count();
        let comparable = !held.is_empty() && !said.is_empty();
        comparable.then_some((count, count == held.len()))
    };
    let matches: Vec<_> = names.iter().map(|name| match_of(&name.node)).collect();
    let fitting = names.iter().zip(&matches);
    let fitting = fitting.filter(|(_, found)| found.is_some_and(|(_, all)| all));
    let last_fitting = fitting.map(|(name, _)| name.registered).max();
    let by_topics = |name: &Name, found: &Option<(usize, bool)>| match found {
        None => Verdict::Unknown,
        Some((0, _)) => Verdict::Another,
        // It only shares topics with a later node.
        Some((_, false)) if last_fitting > Some(name.registered) => Verdict::Another,
        Some(_) => Verdict::Itself,
    };
    // A new node at the port may have been asked under the previous node's name.
    let of_pid = names.iter().filter(|name| name.known_pid == pid);
    let last_of_pid = of_pid.map(|name| name.registered).max();
    let last = names.iter().map(|name| name.registered).max();
    let verdicts = names.iter().zip(&matches);
    let verdicts = verdicts.map(|(name, found)| match (name.known_pid, pid) {
        (Some(known), Some(pid)) if known == pid => match by_topics(name, found) {
            Verdict::Another if last_of_pid > Some(name.registered) => Verdict::Another,
            _ => Verdict::Itself,
        },
        // All its topics are there, and no later node is: a process id can change, as behind some node
        // libraries or when a node is restarted at its port.
        (Some(_), Some(_)) if matches!(found, Some((_, true))) && last == Some(name.registered) => {
            Verdict::Itself
        }
        (Some(_), Some(_)) if !name.registered_since => Verdict::Another,
        _ => by_topics(name, found),
    });
    let mut verdicts: Vec<_> = verdicts.collect();
    // A port has one process behind it: earlier registrants are gone.
    let present = names.iter().zip(&verdicts);
    let present = present.filter(|(_, verdict)| **verdict == Verdict::Itself);
    if let Some(last) = present.map(|(name, _)| name.registered).max() {
        for (name, verdict) in names.iter().zip(&mut verdicts) {
            if *verdict == Verdict::Unknown && name.registered < last {
                *verdict = Verdict::Another;
            }
        }
    }
    verdicts
}

/// What follows when a port refuses connections.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// Nothing: the nodes there are kept as unreachable, and asked again later.
    Keep,
    /// The port is asked again after a pause.
    AskAgain,
    /// The nodes there are dead.
    Dead,
}

/// Judges a port that refuses connections. `calls` are the last calls of the nodes there, and `before` those when
/// it refused for the first time. A node may close its port before it unregisters: roslisp does.
pub fn judge_refusal<C: PartialEq>(master_serves: bool, before: Option<&C>, calls: &C) -> Refusal {
    match before {
        // A living master would not have noticed. The health check after the recovery decides.
        _ if !master_serves => Refusal::Keep,
        Some(before) if before == calls => Refusal::Dead,
        _ => Refusal::AskAgain,
    }
}

/// One registration of a node.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Registration {
    /// Whether the node publishes the topic; else it subscribes it.
    pub publishes: bool,
    pub topic: String,
    topic_type: String,
}

impl Registration {
    /// The call with which the node itself would register it.
    pub fn register(&self, node: &str, api: &str) -> Request {
        let method = match self.publishes {
            true => Method::RegisterPublisher,
            false => Method::RegisterSubscriber,
        };
        Request::new(method, [node, &self.topic, &self.topic_type, api])
    }

    /// The call with which the node itself would unregister it.
    pub fn unregister(&self, node: &str, api: &str) -> Request {
        let method = match self.publishes {
            true => Method::UnregisterPublisher,
            false => Method::UnregisterSubscriber,
        };
        Request::new(method, [node, &self.topic, api])
    }

    /// In words, such as `/talker publishes /chatter`.
    pub fn describe(&self, node: &str) -> String {
        let verb = match self.publishes {
            true => "publishes",
            false => "subscribes",
        };
        format!("{node} {verb} {}", self.topic)
    }

    /// Whether both are the same, types ignored.
    pub fn is_same(&self, other: &Self) -> bool {
        self.publishes == other.publishes && self.topic == other.topic
    }
}

/// Where the mirror differs from a node's report.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Reconciliation {
    /// Reported by the node, missing in the mirror. No reason to register it: the node may have another
    /// master, and be known here through a program that synchronises both.
    pub missing: Vec<Registration>,
    /// In the mirror, but not reported by the node. Must be confirmed: a node may register first and list the
    /// topic later. Nothing if the node lists nothing at all: it may be unable to tell.
    pub extra: Vec<Registration>,
}

impl Reconciliation {
    /// The difference for `node`. Services are excluded: nodes cannot be asked for theirs.
    pub fn new(mirror: &Master, node: &str, claims: &Claims) -> Self {
        let mut reconciliation = Self::default();
        let publications: Vec<&str> = mirror.publications(node).collect();
        let subscriptions: Vec<&str> = mirror.subscriptions(node).collect();
        for (publishes, held, said) in [
            (true, &publications, &claims.publications),
            (false, &subscriptions, &claims.subscriptions),
        ] {
            let missing = said
                .iter()
                .filter(|(topic, _)| !held.contains(&topic.as_str()));
            reconciliation
                .missing
                .extend(missing.map(|(topic, topic_type)| Registration {
                    publishes,
                    topic: topic.clone(),
                    topic_type: topic_type.clone(),
                }));
            // Topics that a strange node name has changed cannot be compared.
            let extra = held.iter().filter(|topic| {
                !said.is_empty() && master::is_plain_topic(topic) && !said.contains_key(**topic)
            });
            reconciliation.extra.extend(extra.map(|topic| Registration {
                publishes,
                topic: (*topic).to_owned(),
                topic_type: mirror.type_of(topic).unwrap_or("*").to_owned(),
            }));
        }
        reconciliation
    }

    pub fn is_empty(&self) -> bool {
        self.missing.is_empty() && self.extra.is_empty()
    }
}

#[cfg(test)]
mod tests;
