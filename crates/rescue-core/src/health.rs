//! Judges a node's answers: whether the answering node is the one that has registered, and where the mirror,
//! rosrescue's model of the master, differs from what the node reports.
//!
//! The answering node counts as the one that has registered unless there is evidence against that, because losing a
//! healthy node is worse than keeping a dead one.
//!
//! * `kernel`: what the kernel proves about nodes of this computer; `origin`: what an address proves.
//! * `liveness`, `unreachable`: who is alive, and who does not answer; `rates`, `backoff`: how often a host is asked.
//! * `moves`: a name that another program registers; `feuds`: two programs that take it from each other.
//! * `addresses`: nodes at an address that this computer has lost.

mod addresses;
pub(crate) mod backoff;
mod feuds;
mod kernel;
mod liveness;
mod moves;
mod mutant;
mod origin;
mod rates;
#[cfg(test)]
mod simulation;
mod unreachable;

pub use addresses::{AddressChanges, NodeAddresses};
pub use feuds::{Feud, Feuds};
pub use kernel::{Death, Evidence, LocalName, Owner, Process, Registrants};
pub use liveness::{Health, Liveness};
pub use moves::{Eviction, Moving, Reap};
pub use origin::Reach;
pub use rates::Rates;
pub use ros1_master::master::port_of;
pub use unreachable::Unreachable;

use std::collections::BTreeMap;

use ros1_master::{
    master::{self, Displaced, Master, Method, Request},
    xmlrpc::Value,
};

/// Topics that most nodes have, so they do not show which node answers.
const COMMON: [&str; 6] = [
    "/rosout",
    "/clock",
    "/statistics",
    "/tf",
    "/tf_static",
    "/diagnostics",
];

/// The reaction of a node to a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reaction {
    /// The node answered.
    Alive,
    /// The node's port refuses connections, so its process is gone.
    Dead,
    /// There was no answer in time. That does not prove that the node is dead.
    Silent,
}

/// Types by topic, as a node reports them.
type Topics = BTreeMap<String, String>;

/// The topics that a node says it publishes and subscribes to.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Claims {
    publications: Topics,
    subscriptions: Topics,
}

impl Claims {
    /// Reads the results of `getPublications` and `getSubscriptions`, which are lists of topic and type. `None` if any
    /// entry could not be registered as it is, because the whole answer is doubtful in that case.
    pub fn read(publications: &Value, subscriptions: &Value) -> Option<Self> {
        Some(Self {
            publications: topics(publications)?,
            subscriptions: topics(subscriptions)?,
        })
    }

    /// Whether the node reports one of `topics`. Topics that most nodes have, such as `/rosout`, do not count.
    pub fn shares(&self, topics: &[String]) -> bool {
        let mut own = self.topics().filter(|topic| !COMMON.contains(topic));
        own.any(|topic| topics.iter().any(|other| other == topic))
    }

    fn topics(&self) -> impl Iterator<Item = &str> {
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

/// Whether the node that answers at a port is the one registered under a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IdentityVerdict {
    /// There is evidence that the answering node has this name.
    Itself,
    /// There is evidence that another node answers.
    Another,
    /// There is no evidence in either direction.
    Unknown,
}

/// A name registered at a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RegisteredName {
    /// The caller id.
    pub node: String,
    /// The process id that the port answered when it was last asked.
    pub known_pid: Option<i32>,
    /// Whether the name has registered anything since the answer with [`Self::known_pid`]. If so, another process may
    /// have taken the port under the same name.
    pub registered_since: bool,
    /// The number of the name's latest registration, which grows with each registration of any node. 0 if unknown.
    pub registered: u64,
}

/// Judges each of `names`, which are all registered at the same port. `pid` and `claims` are the present answers from
/// that port.
pub fn judge_node(
    mirror: &Master,
    names: &[RegisteredName],
    pid: Option<i32>,
    claims: Option<&Claims>,
) -> Vec<IdentityVerdict> {
    let said = claims.into_iter().flat_map(Claims::topics);
    let said: Vec<&str> = said.filter(|topic| !COMMON.contains(topic)).collect();
    // How many of the node's topics the answer reports, and whether it reports all of them.
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
    let by_topics = |name: &RegisteredName, found: &Option<(usize, bool)>| match found {
        None => IdentityVerdict::Unknown,
        Some((0, _)) => IdentityVerdict::Another,
        // All topics of a node that registered later are reported, so the answer is that node's.
        Some((_, false)) if last_fitting > Some(name.registered) => IdentityVerdict::Another,
        Some(_) => IdentityVerdict::Itself,
    };
    // The known process id of an older name can be that of a newer node, if the port was asked when only the older name
    // was known there.
    let of_pid = names.iter().filter(|name| name.known_pid == pid);
    let last_of_pid = of_pid.map(|name| name.registered).max();
    let last = names.iter().map(|name| name.registered).max();
    let verdicts = names.iter().zip(&matches);
    let verdicts = verdicts.map(|(name, found)| match (name.known_pid, pid) {
        (Some(known), Some(pid)) if known == pid => match by_topics(name, found) {
            IdentityVerdict::Another if last_of_pid > Some(name.registered) => {
                IdentityVerdict::Another
            }
            _ => IdentityVerdict::Itself,
        },
        // All topics of this name are reported, and no node registered here later. The process id can differ
        // nevertheless, with some client libraries or after a restart at the same port.
        (Some(_), Some(_)) if matches!(found, Some((_, true))) && last == Some(name.registered) => {
            IdentityVerdict::Itself
        }
        (Some(_), Some(_)) if !name.registered_since => IdentityVerdict::Another,
        _ => by_topics(name, found),
    });
    let mut verdicts: Vec<_> = verdicts.collect();
    // A port belongs to one process, so nodes that registered before the present one are gone.
    let present = names.iter().zip(&verdicts);
    let present = present.filter(|(_, verdict)| **verdict == IdentityVerdict::Itself);
    if let Some(last) = present.map(|(name, _)| name.registered).max() {
        for (name, verdict) in names.iter().zip(&mut verdicts) {
            if *verdict == IdentityVerdict::Unknown && name.registered < last {
                *verdict = IdentityVerdict::Another;
            }
        }
    }
    verdicts
}

/// What to do when a port refuses connections.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// Keep the nodes at the port as unreachable, and ask again later.
    Keep,
    /// Ask the port again after a pause.
    AskAgain,
    /// The nodes at the port are dead.
    Dead,
}

/// Judges a port that refuses connections. `may_unregister` says that the master serves, and that the port has failed a
/// health check. If it has only refused a notification, its nodes stay registered, as with a bare master.
///
/// `calls` are the last calls of its nodes, and `before` are their last calls when the port refused for the first time.
/// The nodes are dead only if the two are equal, because a node may close its port before it unregisters, as roslisp
/// does.
pub fn judge_refusal<C: PartialEq>(may_unregister: bool, before: Option<&C>, calls: &C) -> Refusal {
    match before {
        // While the master is gone, the health check after the recovery decides.
        _ if !may_unregister => Refusal::Keep,
        Some(before) if before == calls => Refusal::Dead,
        _ => Refusal::AskAgain,
    }
}

/// Whether the process that answers at the address of a displaced node is that node. It answers with the process id
/// `pid` and reports `claims`.
///
/// False if neither its process id nor its topics tell. Its topics count for more than an equal process id: a node may
/// have died, and another process have got its port, before rosrescue asked for the id.
pub fn is_displaced_node(displaced: &Displaced, pid: Option<i32>, claims: Option<&Claims>) -> bool {
    let shares = claims.is_some_and(|claims| claims.shares(&displaced.topics));
    let has_topics = displaced
        .topics
        .iter()
        .any(|topic| !COMMON.contains(&topic.as_str()));
    match (displaced.pid, pid) {
        (Some(known), Some(pid)) => known == pid && (claims.is_none() || !has_topics || shares),
        _ => shares,
    }
}

/// A topic that a node publishes or subscribes to.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Registration {
    /// True if the node publishes the topic, false if it subscribes to the topic.
    pub publishes: bool,
    pub topic: String,
    topic_type: String,
}

impl Registration {
    /// The call by which the node itself would register for the topic.
    pub fn register(&self, node: &str, api: &str) -> Request {
        let method = match self.publishes {
            true => Method::RegisterPublisher,
            false => Method::RegisterSubscriber,
        };
        Request::new(method, [node, &self.topic, &self.topic_type, api])
    }

    /// The call by which the node itself would unregister from the topic.
    pub fn unregister(&self, node: &str, api: &str) -> Request {
        let method = match self.publishes {
            true => Method::UnregisterPublisher,
            false => Method::UnregisterSubscriber,
        };
        Request::new(method, [node, &self.topic, api])
    }

    /// A description such as `/talker publishes /chatter`.
    pub fn describe(&self, node: &str) -> String {
        let verb = match self.publishes {
            true => "publishes",
            false => "subscribes",
        };
        format!("{node} {verb} {}", self.topic)
    }

    /// Whether both are equal apart from the topic type.
    pub fn is_same(&self, other: &Self) -> bool {
        self.publishes == other.publishes && self.topic == other.topic
    }
}

/// The differences between the mirror and a node's report.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Reconciliation {
    /// Topics that the node reports and the mirror lacks. rosrescue must not register these topics, because the node
    /// may have another master. It may be known here only because a program synchronises the two masters.
    pub missing: Vec<Registration>,
    /// Topics that the mirror has and the node does not report. The caller must ask the node again before it believes
    /// this, because a node may register a topic before it reports the topic. Empty if the node reports no topic at
    /// all, because some nodes cannot report topics.
    pub extra: Vec<Registration>,
}

impl Reconciliation {
    /// Compares the mirror with the report of `node`. Services are left out, because nodes do not report them.
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
            // A malformed topic cannot be compared. Such a topic exists if the node's own name is malformed, because
            // the master resolves topics with that name.
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
