//! What calls did of late: what nodes may not have heard of, and who registered when.

use std::{
    collections::HashMap,
    sync::Arc,
    time::{Duration, Instant},
};

use indexmap::{IndexMap, IndexSet};

use crate::{
    master::{self, Kind, Master, NoticeSink, Request},
    xmlrpc::{Call, Value},
};

/// How long before an outage a change may lie whose notices the dead master still owed. Its three
/// notifier threads can be held up by nodes that cannot be reached.
pub(super) const NOTICE_MEMORY: Duration = Duration::from_secs(30);
/// Topics, and parameters of one node, remembered for that; and changes to tell at the same time.
const NOTICES: usize = 4096;
/// So many nodes may be remembered that are not registered any more.
const NODES: usize = 1024;

/// Something that a node is notified of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Notification {
    /// What a master would have sent at that moment.
    Call(Arc<Call>),
    /// The full list of a topic's publishers, as it is when it is sent.
    Topic(String),
    /// The value of a parameter, as it is when it is sent. The key ends in a slash.
    Param(Arc<str>),
}

/// Something that has changed, which a master may tell late.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Change {
    /// The publishers of a topic.
    Topic(String),
    /// A parameter, for the subscriber at an address. The key ends in a slash.
    Param(String, Arc<str>),
}

/// A node whose name another one has taken at another address: it is to shut down.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Displaced {
    pub node: String,
    pub api: String,
    /// The process id that was last seen behind the address.
    pub pid: Option<i32>,
    /// What it published and subscribed.
    pub topics: Vec<String>,
}

/// What a master that died may not have told.
#[derive(Debug, Default)]
pub struct Owed {
    /// Topics, to all their subscribers.
    pub topics: Vec<String>,
    /// Parameters, each as the address of a subscriber and a key.
    pub params: Vec<(String, Arc<str>)>,
    /// Nodes that are to shut down.
    pub displaced: Vec<Displaced>,
}

/// What nodes are to be notified of, since the last time.
#[derive(Debug, Default)]
pub struct Outbox {
    /// By address, in order.
    pub calls: Vec<(String, Arc<Call>)>,
    /// Nodes that are to shut down.
    pub displaced: Vec<Displaced>,
    /// Changes that a master tells, and may tell late.
    pub changes: IndexSet<Change>,
}

/// When a node's registrations last changed, as numbers that grow with every call: equal numbers
/// mean that nothing came between.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LastCalls {
    /// It registered something.
    pub registered: u64,
    /// Something of it was unregistered.
    pub unregistered: u64,
}

/// A process id that was behind a node's port.
#[derive(Clone, Debug)]
struct Pid {
    api: String,
    registered: u64,
    pid: i32,
}

/// A change that nodes are to be notified of.
#[derive(Clone, Copy, Debug)]
struct Noted {
    at: Instant,
    /// We have notified them, and not only a master that may have died before it could.
    told: bool,
}

/// What calls did of late. Bounded.
#[derive(Debug, Default)]
pub struct Activity {
    count: u64,
    topics: IndexMap<String, Noted>,
    /// By address and key.
    params: IndexMap<(String, Arc<str>), Noted>,
    last_calls: HashMap<String, LastCalls>,
    /// Nodes that are no more are forgotten when `last_calls` is longer than this.
    prune_at: usize,
    pids: HashMap<String, Pid>,
    /// Nodes that registered and have not been asked for their process id since, and when.
    unidentified: IndexMap<String, Instant>,
    /// Nodes that a master was to shut down, and when.
    displaced: Vec<(Instant, Displaced)>,
    /// Whether changes that a master tells are collected.
    notifying: bool,
    outbox: Outbox,
}

/// Whom a call is told to.
#[derive(Debug, Default)]
pub(super) struct Noticed {
    topics: IndexSet<String>,
    /// By address and key.
    params: IndexSet<(String, Arc<str>)>,
    /// The calls themselves, if no master makes them.
    calls: Option<Vec<(String, Arc<Call>)>>,
    pub(super) displaced: Vec<Displaced>,
}

impl Noticed {
    /// `standing_in`: no master notifies anybody.
    pub(super) fn new(standing_in: bool) -> Self {
        Self {
            calls: standing_in.then(Vec::new),
            ..Self::default()
        }
    }

    fn add(&mut self, to: &[String], call: impl FnOnce() -> Call) {
        if let Some(calls) = &mut self.calls {
            let call = Arc::new(call());
            calls.extend(to.iter().map(|to| (to.clone(), call.clone())));
        }
    }
}

impl NoticeSink for Noticed {
    fn publisher_update(&mut self, to: &[String], topic: &str, publishers: &[String]) {
        self.topics.insert(topic.to_owned());
        self.add(to, || master::publisher_update(topic, publishers));
    }

    fn param_update(&mut self, to: &[String], key: &str, value: &Value) {
        self.add(to, || master::param_update(key, value.clone()));
        let key = Arc::<str>::from(key);
        let params = to.iter().map(|to| (to.clone(), key.clone()));
        self.params.extend(params);
    }
}

impl Activity {
    /// A call has been applied, with these notices. `registered` says of a node whether the mirror
    /// knows it. Answers whether there is something new in the outbox.
    pub(super) fn applied(
        &mut self,
        now: Instant,
        call: &Request,
        noticed: Noticed,
        registered: impl Fn(&str) -> bool,
    ) -> bool {
        let nobody_new = self.unidentified.is_empty();
        for call in call.calls() {
            self.note(now, call);
        }
        if self.last_calls.len() > self.prune_at.max(NODES) {
            self.prune(registered);
        }
        let standing_in = noticed.calls.is_some();
        let notifying = self.notifying && !standing_in;
        let noted = Noted {
            at: now,
            told: standing_in,
        };
        let outbox = &mut self.outbox;
        let before = outbox.len();
        if let Some(calls) = noticed.calls {
            outbox.calls.extend(calls);
        }
        for topic in noticed.topics {
            if notifying && outbox.changes.len() < NOTICES {
                outbox.changes.insert(Change::Topic(topic.clone()));
            }
            self.topics.insert(topic, noted);
        }
        for (to, key) in noticed.params {
            if notifying && outbox.changes.len() < NOTICES {
                outbox
                    .changes
                    .insert(Change::Param(to.clone(), key.clone()));
            }
            self.params.insert((to, key), noted);
        }
        if standing_in {
            outbox.displaced.extend(noticed.displaced);
        } else if self.displaced.len() < NOTICES {
            self.displaced
                .extend(noticed.displaced.into_iter().map(|it| (now, it)));
        }
        let changed = outbox.len() > before || (nobody_new && !self.unidentified.is_empty());
        forget(&mut self.topics, now);
        forget(&mut self.params, now);
        self.displaced.retain(|(at, _)| is_recent(*at, now));
        changed
    }

    /// The nodes that `call` takes the names of, as they are before it is applied.
    pub(super) fn displaced_by(&self, mirror: &Master, call: &Request) -> Vec<Displaced> {
        let found = call.calls().into_iter().filter_map(|call| {
            let (node, api) = mirror.displaced_by(call)?;
            let topics = mirror
                .publications(&node)
                .chain(mirror.subscriptions(&node));
            Some(Displaced {
                pid: self.pid_of(&node, &api).map(|(pid, _)| pid),
                topics: topics.map(str::to_owned).collect(),
                node,
                api,
            })
        });
        found.collect()
    }

    fn note(&mut self, now: Instant, call: &Request) {
        let Some(caller) = call.caller() else {
            return;
        };
        self.count += 1;
        if call.registrant().is_some() {
            self.last_calls
                .entry(caller.to_owned())
                .or_default()
                .registered = self.count;
            if self.unidentified.len() < NOTICES {
                self.unidentified.insert(caller.to_owned(), now);
            }
        } else if call.kind() == Kind::Unregister {
            self.last_calls
                .entry(caller.to_owned())
                .or_default()
                .unregistered = self.count;
        }
    }

    fn prune(&mut self, registered: impl Fn(&str) -> bool) {
        self.last_calls.retain(|node, _| registered(node));
        self.pids.retain(|node, _| registered(node));
        self.unidentified.retain(|node, _| registered(node));
        self.prune_at = 2 * self.last_calls.len();
    }

    /// When the registrations of `node` last changed.
    pub fn last_calls(&self, node: &str) -> LastCalls {
        self.last_calls.get(node).copied().unwrap_or_default()
    }

    /// Changes so shortly before `now`, or since, that a master which died then may not have told
    /// them, and we have not. From now on they count as told.
    pub fn take_owed(&mut self, now: Instant) -> Owed {
        fn take<K: Clone>(noted: &mut IndexMap<K, Noted>, now: Instant) -> Vec<K> {
            let untold = noted.iter_mut().filter(|(_, noted)| !noted.told);
            let recent = untold.filter(|(_, noted)| is_recent(noted.at, now));
            recent
                .map(|(key, noted)| {
                    noted.told = true;
                    key.clone()
                })
                .collect()
        }
        let displaced = std::mem::take(&mut self.displaced).into_iter();
        let recent = displaced.filter(|(at, _)| is_recent(*at, now));
        Owed {
            topics: take(&mut self.topics, now),
            params: take(&mut self.params, now),
            displaced: recent.map(|(_, displaced)| displaced).collect(),
        }
    }

    /// All that changed so shortly before `now`, or since, is to be told once more: a master that goes
    /// on may tell what it knew before.
    pub fn tell_again(&mut self) {
        let params = self.params.values_mut();
        for noted in self.topics.values_mut().chain(params) {
            noted.told = false;
        }
    }

    /// Collects what a master tells from now on, or no longer. Answers whether that changes anything.
    pub fn set_notifying(&mut self, notifying: bool) -> bool {
        if !notifying {
            self.outbox.changes.clear();
        }
        std::mem::replace(&mut self.notifying, notifying) != notifying
    }

    /// What nodes are to be notified of.
    pub fn take_outbox(&mut self) -> Outbox {
        std::mem::take(&mut self.outbox)
    }

    /// Takes everything that a node may be told for changed just now.
    pub fn notice_all(&mut self, mirror: &Master, now: Instant) {
        let noted = Noted {
            at: now,
            told: false,
        };
        let topics = mirror.subscribed_topics();
        self.topics
            .extend(topics.map(|topic| (topic.to_owned(), noted)));
        let params = mirror.param_subscribers().into_iter();
        self.params.extend(params.map(|param| (param, noted)));
    }

    /// What the master may not have told by `now` is collected once more.
    pub fn repeat_changes(&mut self, now: Instant) {
        let recent = |noted: &Noted| is_recent(noted.at, now);
        let topics = self.topics.iter().filter(|(_, noted)| recent(noted));
        let topics = topics.map(|(topic, _)| Change::Topic(topic.clone()));
        let params = self.params.iter().filter(|(_, noted)| recent(noted));
        let params = params.map(|((api, key), _)| Change::Param(api.clone(), key.clone()));
        self.outbox.changes.extend(topics.chain(params));
    }

    /// `pid` is behind `api`, at which `node` is registered, and was asked for after the call that
    /// `registered` numbers.
    pub fn remember_pid(&mut self, node: &str, api: &str, registered: u64, pid: i32) {
        if self.last_calls(node).registered == registered {
            self.unidentified.shift_remove(node);
            let api = api.to_owned();
            let pid = Pid {
                api,
                registered,
                pid,
            };
            self.pids.insert(node.to_owned(), pid);
        }
    }

    /// The process id that was last behind `api`, at which `node` is registered, and whether the node
    /// has registered something since: a process that takes an old port under the same name does.
    pub fn pid_of(&self, node: &str, api: &str) -> Option<(i32, bool)> {
        let pid = self.pids.get(node).filter(|pid| pid.api == api)?;
        Some((pid.pid, pid.registered != self.last_calls(node).registered))
    }

    /// When the node registered that nobody has asked for its process id for longest.
    pub fn next_unidentified(&self) -> Option<Instant> {
        self.unidentified.values().min().copied()
    }

    /// Nodes that last registered something at `before` or earlier, and have not been asked for
    /// their process id since. Each is named once.
    pub fn take_unidentified(&mut self, before: Instant) -> Vec<String> {
        let ripe = |_: &String, at: &mut Instant| *at <= before;
        let mut taken = Vec::new();
        self.unidentified.retain(|node, at| {
            let ripe = ripe(node, at);
            if ripe {
                taken.push(node.clone());
            }
            !ripe
        });
        taken
    }
}

impl Outbox {
    fn len(&self) -> usize {
        self.calls.len() + self.displaced.len() + self.changes.len()
    }
}

fn is_recent(at: Instant, now: Instant) -> bool {
    now.duration_since(at) < NOTICE_MEMORY
}

fn forget<K: std::hash::Hash + Eq>(notices: &mut IndexMap<K, Noted>, now: Instant) {
    if notices.len() > NOTICES {
        notices.retain(|_, noted| is_recent(noted.at, now));
        notices.truncate(NOTICES);
    }
}

#[cfg(test)]
mod tests;
