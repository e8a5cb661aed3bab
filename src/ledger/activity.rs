//! Recent effects of calls: notifications that nodes may have missed, and when nodes registered.

use std::{
    collections::{BTreeMap, HashMap, VecDeque},
    sync::Arc,
    time::{Duration, Instant},
};

use indexmap::{IndexMap, IndexSet};
use rescue_core::order::Subject;
use ros1_master::{
    master::{self, Displaced, Effect, Master, NoticeSink, Request, Write, WriteTarget},
    xmlrpc::{Call, Value},
};

/// A dead master may not have sent the notifications of changes that happened up to this long before the outage,
/// because unreachable nodes can hold up its three notifier threads.
pub(super) const NOTICE_MEMORY: Duration = Duration::from_secs(30);
/// Longest time to tell a node to shut down, with all retries.
const TELLING: Duration = Duration::from_secs(60);
/// Maximum length of each list of changes, of displaced nodes and of removed registrations.
const NOTICES: usize = 4096;
/// A removed registration is remembered only if its names have at most this many bytes.
const LOST_MOST: usize = 1024;
/// Up to this many nodes are remembered even after they have unregistered.
const NODES: usize = 1024;

/// A change for which a master may send a late notification.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum NotifyingChange {
    /// The publishers of a topic changed.
    Topic(String),
    /// A parameter changed, for the subscriber at an address. The key ends in a slash.
    Param(String, Arc<str>),
}

/// Notifications that a dead master may not have sent.
#[derive(Debug, Default)]
pub struct Owed {
    /// Topics whose subscribers must all be notified.
    pub topics: Vec<String>,
    /// Parameters, each as the address of a subscriber and a key.
    pub params: Vec<(String, Arc<str>)>,
    /// Nodes that must shut down because another node has their name.
    pub displaced: Vec<Displaced>,
}

/// Changes and displaced nodes that `nodes::watch` has not handled yet.
#[derive(Debug, Default)]
pub struct Unseen {
    /// Nodes that must shut down because another node has their name.
    pub displaced: Vec<Displaced>,
    /// Changes that a master also sends notifications for, perhaps late.
    pub changes: IndexSet<NotifyingChange>,
}

/// Numbers of the last calls that changed a node's registrations. Numbers only grow, so an equal number means no
/// change.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LastCalls {
    /// Number of the last call that registered something.
    pub registered: u64,
    /// Number of the last call that unregistered something.
    pub unregistered: u64,
}

/// A topic registration that was removed.
#[derive(Clone, Debug, PartialEq, Eq)]
struct RemovedRegistration {
    node: String,
    api: String,
    /// True if the node published the topic, false if it subscribed to the topic.
    publishes: bool,
    topic: String,
}

/// The process id that answered at a node's port.
#[derive(Clone, Debug)]
struct Pid {
    api: String,
    registered: u64,
    pid: i32,
}

#[derive(Clone, Copy, Debug)]
struct Noted {
    at: Instant,
    /// Whether rosrescue has notified the nodes itself. False if a master did, which may have died before it finished.
    is_notified: bool,
}

/// Recent effects of calls. All lists are bounded.
#[derive(Debug, Default)]
pub struct Activity {
    count: u64,
    topics: IndexMap<String, Noted>,
    /// Changed parameters, by subscriber address and key.
    params: IndexMap<(String, Arc<str>), Noted>,
    last_calls: HashMap<String, LastCalls>,
    /// Unregistered nodes are dropped when `last_calls` grows longer than this.
    prune_at: usize,
    pids: HashMap<String, Pid>,
    /// Nodes whose process id is not known since they registered, with the time of the registration.
    unidentified: IndexMap<String, Instant>,
    /// The latest topic registrations that any client has removed.
    lost: VecDeque<RemovedRegistration>,
    /// Nodes that a master had to tell to shut down, with the time.
    displaced: Vec<(Instant, Displaced)>,
    /// All nodes that lost their names to other nodes recently, with the time. The next start cannot know whether they
    /// were told to shut down.
    lately: Vec<(Instant, Displaced)>,
    /// Nodes that lost their names to other nodes, from a checkpoint. They may not have been told to shut down.
    restored: Vec<Displaced>,
    /// Whether changes that a master notifies nodes of are also collected in `unseen`.
    notifying: bool,
    unseen: Unseen,
}

/// A notification that rosrescue must send because there is no master: the receiver's address, the topic or parameter,
/// and the call.
type Unsent = (String, Subject, Arc<Call>);

/// Collects what one call changes, and which nodes must be notified of the changes.
#[derive(Debug, Default)]
pub(super) struct Noticed {
    topics: IndexSet<String>,
    /// The number of subscribers of the topic that has the most.
    subscribers: usize,
    /// Subscribers of parameters, by address and key.
    params: IndexSet<(String, Arc<str>)>,
    /// Whether the mirror answers in a master's place, so that rosrescue sends the notifications.
    standing_in: bool,
    /// Whether a master that lives may send these notifications itself. Then rosrescue's own wait for them, and may not
    /// be sent before that master dies.
    pub(super) left_to_master: bool,
    /// The notifications to send while the mirror answers in a master's place.
    calls: Vec<Unsent>,
    pub(super) displaced: Vec<Displaced>,
}

impl Noticed {
    /// Creates an empty set. If `standing_in` is true, rosrescue sends the notifications itself.
    pub(super) fn new(standing_in: bool) -> Self {
        Self {
            standing_in,
            ..Self::default()
        }
    }

    fn add(&mut self, to: &[String], subject: &Subject, call: impl FnOnce() -> Call) {
        if self.standing_in {
            let call = Arc::new(call());
            let calls = to
                .iter()
                .map(|to| (to.clone(), subject.clone(), call.clone()));
            self.calls.extend(calls);
        }
    }

    /// Takes the notifications that rosrescue must send. `None` if a master sends them.
    pub(super) fn take_calls(&mut self) -> Option<Vec<Unsent>> {
        self.standing_in.then(|| std::mem::take(&mut self.calls))
    }

    /// The topics and parameters of the notifications, each with the number of nodes to notify.
    pub(super) fn subjects(&self) -> impl Iterator<Item = (Subject, usize)> {
        let topics = self.topics.iter().cloned().map(Subject::Topic);
        let topics = topics.map(|topic| (topic, self.subscribers));
        let mut keys = IndexMap::<&Arc<str>, usize>::new();
        for (_, key) in &self.params {
            *keys.entry(key).or_default() += 1;
        }
        let keys = keys.into_iter();
        topics.chain(keys.map(|(key, nodes)| (Subject::Param(key.to_string()), nodes)))
    }
}

impl NoticeSink for Noticed {
    fn publisher_update(&mut self, to: &[String], topic: &str, publishers: &[String]) {
        self.topics.insert(topic.to_owned());
        self.subscribers = self.subscribers.max(to.len());
        let subject = Subject::Topic(topic.to_owned());
        self.add(to, &subject, || master::publisher_update(topic, publishers));
    }

    fn param_update(&mut self, to: &[String], key: &str, value: &Value) {
        let subject = Subject::Param(key.to_owned());
        self.add(to, &subject, || master::param_update(key, value.clone()));
        let key = Arc::<str>::from(key);
        let params = to.iter().map(|to| (to.clone(), key.clone()));
        self.params.extend(params);
    }
}

impl Activity {
    /// Notes an applied call and its notifications. `registered` says whether the mirror knows a node. Returns whether
    /// the task that notifies nodes has new work.
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
        let standing_in = noticed.standing_in;
        let notifying = self.notifying && !standing_in;
        let noted = Noted {
            at: now,
            is_notified: standing_in && !noticed.left_to_master,
        };
        let unseen = &mut self.unseen;
        let before = unseen.len();
        for topic in noticed.topics {
            if notifying && unseen.changes.len() < NOTICES {
                unseen.changes.insert(NotifyingChange::Topic(topic.clone()));
            }
            self.topics.insert(topic, noted);
        }
        for (to, key) in noticed.params {
            if notifying && unseen.changes.len() < NOTICES {
                unseen
                    .changes
                    .insert(NotifyingChange::Param(to.clone(), key.clone()));
            }
            self.params.insert((to, key), noted);
        }
        self.lately
            .retain(|(at, _)| now.duration_since(*at) < TELLING);
        if self.lately.len() < NOTICES {
            let lately = noticed.displaced.iter().cloned();
            self.lately.extend(lately.map(|it| (now, it)));
        }
        if standing_in {
            unseen.displaced.extend(noticed.displaced);
        } else if self.displaced.len() < NOTICES {
            self.displaced
                .extend(noticed.displaced.into_iter().map(|it| (now, it)));
        }
        let changed = unseen.len() > before || (nobody_new && !self.unidentified.is_empty());
        forget(&mut self.topics, now);
        forget(&mut self.params, now);
        self.displaced.retain(|(at, _)| is_recent(*at, now));
        changed
    }

    /// The nodes that `call` displaces, because it registers their names at another address.
    pub(super) fn displaced_by(&self, mirror: &Master, call: &Request) -> Vec<Displaced> {
        let found = call.calls().into_iter().filter_map(|call| {
            let displaced = mirror.displaced_by(call)?;
            let pid = self.pid_of(&displaced.node, &displaced.api);
            Some(Displaced {
                pid: pid.map(|(pid, _)| pid),
                ..displaced
            })
        });
        found.collect()
    }

    /// Notes the topic registrations that `call` removes, before it is applied to `mirror`.
    pub(super) fn note_lost(&mut self, mirror: &Master, call: &Request) {
        for write in Write::all(call).filter(Write::unregisters) {
            let publishes = match write.target() {
                WriteTarget::Publisher => true,
                WriteTarget::Subscriber => false,
                WriteTarget::Service | WriteTarget::ParamSubscriber | WriteTarget::Parameter => {
                    continue;
                }
            };
            let (node, topic) = (write.caller, write.name());
            if let Some(api) = mirror.api_of(node)
                && mirror.has_topic(node, publishes, topic)
                && node.len() + api.len() + topic.len() <= LOST_MOST
            {
                if self.lost.len() == NOTICES {
                    self.lost.pop_front();
                }
                self.lost.push_back(RemovedRegistration {
                    node: node.to_owned(),
                    api: api.to_owned(),
                    publishes,
                    topic: topic.to_owned(),
                });
            }
        }
    }

    /// Whether `node` at `api` had registered this topic and then unregistered it.
    pub fn has_lost(&self, node: &str, api: &str, publishes: bool, topic: &str) -> bool {
        self.lost.iter().any(|lost| {
            lost.publishes == publishes
                && lost.topic == topic
                && lost.node == node
                && lost.api == api
        })
    }

    fn note(&mut self, now: Instant, call: &Request) {
        let Some(write) = Write::parse(call) else {
            return;
        };
        let caller = write.caller;
        self.count += 1;
        // Loggers subscribe to the same parameter at each line. A process that starts again registers topics, too.
        let is_repeated = matches!(write.effect, Effect::SubscribeParam { .. })
            && self.last_calls.contains_key(caller);
        if is_repeated {
            return;
        }
        if write.registrant().is_some() {
            self.last_calls
                .entry(caller.to_owned())
                .or_default()
                .registered = self.count;
            if self.unidentified.len() < NOTICES {
                self.unidentified.insert(caller.to_owned(), now);
            }
        } else if write.unregisters() {
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

    /// Numbers of the last calls that changed the registrations of `node`.
    pub fn last_calls(&self, node: &str) -> LastCalls {
        self.last_calls.get(node).copied().unwrap_or_default()
    }

    /// Takes all changes of which rosrescue has not notified nodes. These are the recent ones before `now`, which a
    /// master that died then may not have sent, and all later ones. Afterwards they count as sent.
    pub fn take_owed(&mut self, now: Instant) -> Owed {
        fn take<K: Clone>(noted: &mut IndexMap<K, Noted>, now: Instant) -> Vec<K> {
            let not_notified = noted.iter_mut().filter(|(_, noted)| !noted.is_notified);
            let recent = not_notified.filter(|(_, noted)| is_recent(noted.at, now));
            recent
                .map(|(key, noted)| {
                    noted.is_notified = true;
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

    /// Marks recent changes as not sent, because a master that continues may send outdated notifications.
    pub fn notify_again(&mut self) {
        let params = self.params.values_mut();
        for noted in self.topics.values_mut().chain(params) {
            noted.is_notified = false;
        }
    }

    /// Starts or stops collecting changes that a master notifies nodes of. Returns whether that changed anything.
    pub fn set_notifying(&mut self, notifying: bool) -> bool {
        if !notifying {
            self.unseen.changes.clear();
        }
        std::mem::replace(&mut self.notifying, notifying) != notifying
    }

    pub fn take_unseen(&mut self) -> Unseen {
        std::mem::take(&mut self.unseen)
    }

    /// Keeps the nodes of a checkpoint that lost their names to other nodes (`displaced`) until [`Self::notice_all`].
    pub fn restore_displaced(&mut self, displaced: Vec<Displaced>) {
        self.restored = displaced;
    }

    /// Nodes that may not have been told to shut down by `now`, for a checkpoint.
    pub(super) fn displaced_lately(&self, now: Instant) -> Vec<Displaced> {
        let lately = self.lately.iter();
        let lately = lately.filter(|(at, _)| now.duration_since(*at) < TELLING);
        let all = self.restored.iter().chain(lately.map(|(_, node)| node));
        let all: BTreeMap<_, _> = all.map(|node| (&node.api, node)).collect();
        all.into_values().cloned().collect()
    }

    /// Treats everything that nodes subscribe to as changed at `now`, and the checkpoint's displaced nodes as having
    /// lost their names at `now`. `mirror` must equal the master, because a node that has taken its name back is left
    /// out.
    pub fn notice_all(&mut self, mirror: &Master, now: Instant) {
        let noted = Noted {
            at: now,
            is_notified: false,
        };
        let topics = mirror.subscribed_topics();
        self.topics
            .extend(topics.map(|topic| (topic.to_owned(), noted)));
        let params = mirror.param_subscribers().into_iter();
        self.params.extend(params.map(|param| (param, noted)));
        let displaced = std::mem::take(&mut self.restored).into_iter();
        let displaced = displaced.filter(|it| mirror.is_held_elsewhere(&it.node, &it.api));
        let displaced: Vec<_> = displaced.take(NOTICES).map(|it| (now, it)).collect();
        self.lately.extend(displaced.iter().cloned());
        self.displaced.extend(displaced);
    }

    /// Collects again the changes of which the master may not have notified nodes by `now`.
    pub fn repeat_changes(&mut self, now: Instant) {
        let recent = |noted: &Noted| is_recent(noted.at, now);
        let topics = self.topics.iter().filter(|(_, noted)| recent(noted));
        let topics = topics.map(|(topic, _)| NotifyingChange::Topic(topic.clone()));
        let params = self.params.iter().filter(|(_, noted)| recent(noted));
        let params = params.map(|((api, key), _)| NotifyingChange::Param(api.clone(), key.clone()));
        self.unseen.changes.extend(topics.chain(params));
    }

    /// Notes that process `pid` answers at `api`, where `node` is registered. `registered` is the number of the node's
    /// last registration when it was asked.
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

    /// The process id that last answered at `api`, where `node` is registered, and whether the node has registered
    /// since. A new process that takes an old port under the same name registers again.
    pub fn pid_of(&self, node: &str, api: &str) -> Option<(i32, bool)> {
        let pid = self.pids.get(node).filter(|pid| pid.api == api)?;
        Some((pid.pid, pid.registered != self.last_calls(node).registered))
    }

    /// The earliest registration of a node whose process id is not known since.
    pub fn next_unidentified(&self) -> Option<Instant> {
        self.unidentified.values().min().copied()
    }

    /// Takes the nodes that registered at `before` or earlier and whose process id is not known since.
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

impl Unseen {
    fn len(&self) -> usize {
        self.displaced.len() + self.changes.len()
    }
}

fn is_recent(at: Instant, now: Instant) -> bool {
    now.duration_since(at) < NOTICE_MEMORY
}

/// Forgets old notices if there are too many. The newest ones are those that a master may still owe.
fn forget<K: std::hash::Hash + Eq>(notices: &mut IndexMap<K, Noted>, now: Instant) {
    if notices.len() > NOTICES {
        notices.retain(|_, noted| is_recent(noted.at, now));
        if notices.len() > NOTICES {
            notices.sort_by(|_, a, _, b| a.at.cmp(&b.at));
            notices.drain(..NOTICES / 4);
        }
    }
}

#[cfg(test)]
mod tests;
