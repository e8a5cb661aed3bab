//! What calls did of late: what nodes may not have heard of, and who registered when.

use std::{
    collections::HashMap,
    sync::Arc,
    time::{Duration, Instant},
};

use indexmap::{IndexMap, IndexSet};

use crate::{
    master::{self, Master, NoticeSink},
    xmlrpc::{Call, Value},
};

/// How long before an outage a change may lie whose notices the dead master still owed. Its three
/// notifier threads can be held up by nodes that cannot be reached.
pub(super) const NOTICE_MEMORY: Duration = Duration::from_secs(30);
/// Topics, and parameters of one node, remembered for that; and news at the same time.
const NOTICES: usize = 4096;
/// So many nodes may be remembered that are not registered any more.
const NODES: usize = 1024;
/// Levels of multicalls that are looked into.
const LEVELS: usize = 8;

/// Something that a node may be told.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Letter {
    /// The full list of a topic's publishers.
    Topic(String),
    /// The value of a parameter. The key ends in a slash.
    Param(Arc<str>),
}

/// An address and what is to be told there; to all subscribers of a topic if there is no address.
pub type News = (Option<String>, Letter);

/// When a node's registrations last changed, as numbers that grow with every call: equal numbers
/// mean that nothing came between.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Deeds {
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

/// What calls did of late. Bounded.
#[derive(Debug, Default)]
pub struct Activity {
    count: u64,
    topics: IndexMap<String, Instant>,
    /// By address and key.
    params: IndexMap<(String, Arc<str>), Instant>,
    deeds: HashMap<String, Deeds>,
    /// Nodes that are no more are forgotten when `deeds` is longer than this.
    prune_at: usize,
    pids: HashMap<String, Pid>,
    /// Nodes that registered and have not been asked for their process id since, and when.
    strangers: IndexMap<String, Instant>,
    /// Nodes with the address that a parked registration is about to take their name from.
    displaced: IndexSet<(String, String)>,
    displaced_seen: usize,
    /// Whether news are collected.
    telling: bool,
    news: IndexSet<News>,
}

/// What a call's notices are about. What they say is read from the mirror when it is told.
#[derive(Debug, Default)]
pub(super) struct Noticed {
    topics: IndexSet<String>,
    /// By address and key.
    params: IndexSet<(String, Arc<str>)>,
}

impl NoticeSink for Noticed {
    fn publisher_update(&mut self, _: &[String], topic: &str, _: &[String]) {
        self.topics.insert(topic.to_owned());
    }

    fn param_update(&mut self, to: &[String], key: &str, _: &Value) {
        let key = Arc::<str>::from(key);
        let params = to.iter().map(|to| (to.clone(), key.clone()));
        self.params.extend(params);
    }
}

impl Activity {
    /// A call has been applied, with these notices. `registered` says of a node whether the mirror
    /// knows it. Answers whether there are news.
    pub(super) fn applied(
        &mut self,
        now: Instant,
        call: &Call,
        noticed: Noticed,
        registered: impl Fn(&str) -> bool,
    ) -> bool {
        self.note(now, call, LEVELS);
        if self.deeds.len() > self.prune_at.max(NODES) {
            self.prune(registered);
        }
        let before = self.news.len();
        for topic in noticed.topics {
            if self.telling && self.news.len() < NOTICES {
                self.news.insert((None, Letter::Topic(topic.clone())));
            }
            self.topics.insert(topic, now);
        }
        for (to, key) in noticed.params {
            if self.telling && self.news.len() < NOTICES {
                self.news
                    .insert((Some(to.clone()), Letter::Param(key.clone())));
            }
            self.params.insert((to, key), now);
        }
        forget(&mut self.topics, now);
        forget(&mut self.params, now);
        self.news.len() > before
    }

    fn note(&mut self, now: Instant, call: &Call, levels: usize) {
        if call.method == "system.multicall" {
            for entry in call.entries() {
                if levels > 0 {
                    self.note(now, &entry, levels - 1);
                }
            }
            return;
        }
        let Some(caller) = call.params.first().and_then(Value::as_str) else {
            return;
        };
        self.count += 1;
        if master::registrant(call).is_some() {
            self.deeds.entry(caller.to_owned()).or_default().registered = self.count;
            if self.strangers.len() < NOTICES {
                self.strangers.insert(caller.to_owned(), now);
            }
        } else if call.method.starts_with("un") {
            self.deeds
                .entry(caller.to_owned())
                .or_default()
                .unregistered = self.count;
        }
    }

    fn prune(&mut self, registered: impl Fn(&str) -> bool) {
        self.deeds.retain(|node, _| registered(node));
        self.pids.retain(|node, _| registered(node));
        self.strangers.retain(|node, _| registered(node));
        self.prune_at = 2 * self.deeds.len();
    }

    /// When the registrations of `node` last changed.
    pub fn deeds(&self, node: &str) -> Deeds {
        self.deeds.get(node).copied().unwrap_or_default()
    }

    /// Topics whose publishers changed so shortly before `now`, or since, that a master which died
    /// then may have owed its subscribers the news.
    pub fn topics_noticed(&self, now: Instant) -> Vec<String> {
        recent(&self.topics, now).cloned().collect()
    }

    /// As [`Self::topics_noticed`]: parameters, each as the address of a subscriber and a key.
    pub fn params_noticed(&self, now: Instant) -> Vec<(String, Arc<str>)> {
        recent(&self.params, now).cloned().collect()
    }

    /// Collects news from now on, or no longer. Answers whether that changes anything.
    pub fn set_telling(&mut self, telling: bool) -> bool {
        if !telling {
            self.news.clear();
        }
        std::mem::replace(&mut self.telling, telling) != telling
    }

    /// The news since the last time.
    pub fn take_news(&mut self) -> IndexSet<News> {
        std::mem::take(&mut self.news)
    }

    /// Takes everything that a node may be told for changed just now.
    pub fn notice_all(&mut self, mirror: &Master, now: Instant) {
        let topics = mirror.subscribed_topics();
        self.topics
            .extend(topics.map(|topic| (topic.to_owned(), now)));
        let params = mirror.param_subscribers().into_iter();
        self.params.extend(params.map(|param| (param, now)));
    }

    /// What the master may not have told by `now` is news once more.
    pub fn repeat_news(&mut self, now: Instant) {
        let topics = self.topics_noticed(now).into_iter();
        let params = self.params_noticed(now).into_iter();
        let params = params.map(|(api, key)| (Some(api), Letter::Param(key)));
        let topics = topics.map(|topic| (None, Letter::Topic(topic)));
        self.news.extend(topics.chain(params));
    }

    /// `pid` is behind `api`, at which `node` is registered, and was asked for after the deed that
    /// `registered` numbers.
    pub fn remember_pid(&mut self, node: &str, api: &str, registered: u64, pid: i32) {
        if self.deeds(node).registered == registered {
            self.strangers.shift_remove(node);
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
        Some((pid.pid, pid.registered != self.deeds(node).registered))
    }

    /// Nodes that last registered something at `before` or earlier, and have not been asked for
    /// their process id since. Each is named once.
    pub fn take_strangers(&mut self, before: Instant) -> Vec<String> {
        let ripe = |_: &String, at: &mut Instant| *at <= before;
        let mut taken = Vec::new();
        self.strangers.retain(|node, at| {
            let ripe = ripe(node, at);
            if ripe {
                taken.push(node.clone());
            }
            !ripe
        });
        taken
    }

    /// A call is parked that would take the name of `node`, which is registered at `api`. Answers
    /// whether that is new.
    pub(super) fn displace(&mut self, node: String, api: String) -> bool {
        self.displaced.len() < NOTICES && self.displaced.insert((node, api))
    }

    /// What was displaced since the last time.
    pub fn take_displaced(&mut self) -> Vec<(String, String)> {
        let new = self.displaced.iter().skip(self.displaced_seen);
        let new: Vec<_> = new.cloned().collect();
        self.displaced_seen = self.displaced.len();
        new
    }

    /// A new incarnation: what was parked travels.
    pub(super) fn forget_displaced(&mut self) {
        self.displaced.clear();
        self.displaced_seen = 0;
    }
}

fn recent<K>(notices: &IndexMap<K, Instant>, now: Instant) -> impl Iterator<Item = &K> {
    let recent = notices.iter();
    let recent = recent.filter(move |(_, at)| now.duration_since(**at) < NOTICE_MEMORY);
    recent.map(|(key, _)| key)
}

fn forget<K: std::hash::Hash + Eq>(notices: &mut IndexMap<K, Instant>, now: Instant) {
    if notices.len() > NOTICES {
        notices.retain(|_, at| now.duration_since(*at) < NOTICE_MEMORY);
        notices.truncate(NOTICES);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn call(method: &str, params: &[&str]) -> Call {
        let params = params.iter().map(|text| Value::from(*text));
        Call::new(method, params.collect())
    }

    fn publish(node: &str, topic: &str) -> Call {
        call("registerPublisher", &[node, topic, "x/Y", "http://n:1/"])
    }

    fn apply(activity: &mut Activity, now: Instant, call: &Call) {
        activity.applied(now, call, Noticed::default(), |_| true);
    }

    #[test]
    fn a_process_id_is_sure_until_the_node_registers_again() {
        let now = Instant::now();
        let mut activity = Activity::default();
        apply(&mut activity, now, &publish("/a", "/t"));
        let registered = activity.deeds("/a").registered;
        activity.remember_pid("/a", "http://n:1/", registered, 7);
        assert_eq!(activity.pid_of("/a", "http://n:1/"), Some((7, false)));
        assert_eq!(activity.pid_of("/a", "http://n:2/"), None);
        let gone = call("unregisterPublisher", &["/a", "/t", "http://n:1/"]);
        apply(&mut activity, now, &gone);
        assert_eq!(activity.pid_of("/a", "http://n:1/"), Some((7, false)));
        apply(&mut activity, now, &Call::multicall([publish("/a", "/u")]));
        assert_eq!(activity.pid_of("/a", "http://n:1/"), Some((7, true)));
        // An answer to a question that was asked before is too old.
        activity.remember_pid("/a", "http://n:1/", registered, 8);
        assert_eq!(activity.pid_of("/a", "http://n:1/"), Some((7, true)));
    }

    #[test]
    fn a_new_node_is_to_be_asked_once_after_its_last_registration() {
        let start = Instant::now();
        let second = Duration::from_secs(1);
        let mut activity = Activity::default();
        apply(&mut activity, start, &publish("/a", "/t"));
        apply(&mut activity, start + second, &publish("/a", "/u"));
        let none = Vec::<String>::new();
        assert_eq!(activity.take_strangers(start), none);
        assert_eq!(activity.take_strangers(start + second), ["/a"]);
        assert_eq!(activity.take_strangers(start + second), none);
    }

    #[test]
    fn news_are_collected_only_while_somebody_tells_them() {
        let now = Instant::now();
        let mut activity = Activity::default();
        let notice = || {
            let mut noticed = Noticed::default();
            noticed.publisher_update(&["http://s:1/".to_owned()], "/t", &[]);
            noticed
        };
        let publish = publish("/a", "/t");
        assert!(!activity.applied(now, &publish, notice(), |_| true));
        assert!(activity.take_news().is_empty());
        activity.set_telling(true);
        assert!(activity.applied(now, &publish, notice(), |_| true));
        let expected = (None, Letter::Topic("/t".to_owned()));
        assert_eq!(
            activity.take_news().into_iter().collect::<Vec<_>>(),
            [expected]
        );
        assert_eq!(activity.topics_noticed(now), ["/t"]);
    }

    #[test]
    fn a_key_is_kept_once_for_all_its_subscribers() {
        let now = Instant::now();
        let mut activity = Activity::default();
        activity.set_telling(true);
        let subscribers: Vec<_> = (0..NOTICES)
            .map(|port| format!("http://s:{port}/"))
            .collect();
        let mut noticed = Noticed::default();
        noticed.param_update(&subscribers, "/key/", &Value::Int(1));
        activity.applied(now, &publish("/a", "/t"), noticed, |_| true);
        let noticed = activity.params_noticed(now);
        assert_eq!(noticed.len(), NOTICES);
        let (_, first) = &noticed[0];
        assert!(noticed.iter().all(|(_, key)| Arc::ptr_eq(key, first)));
        let shared = |news: &News| matches!(&news.1, Letter::Param(key) if Arc::ptr_eq(key, first));
        let news = activity.take_news();
        assert!(news.len() == NOTICES && news.iter().all(shared));
    }

    #[test]
    fn what_is_displaced_is_named_once_in_an_outage() {
        let mut activity = Activity::default();
        let displace =
            |activity: &mut Activity| activity.displace("/a".to_owned(), "http://n:1/".to_owned());
        assert!(displace(&mut activity) && !displace(&mut activity));
        assert_eq!(activity.take_displaced().len(), 1);
        assert!(!displace(&mut activity));
        assert_eq!(activity.take_displaced().len(), 0);
        activity.forget_displaced();
        assert!(displace(&mut activity));
        assert_eq!(activity.take_displaced().len(), 1);
    }
}
