//! What is known of the nodes beyond their registrations, and the watch over it.

use std::{
    collections::HashSet,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use tokio::sync::Notify;

use super::{
    census::{self, Outcome},
    healing::{self, Post},
    node::{self, Sign},
};
use crate::{
    census::{Repeats, Suspects, Verdict},
    proxy::{
        Proxy,
        activity::{Letter, News},
        gate::{StandIn, State},
        shadow::Shadow,
    },
    wait,
    xmlrpc::{Call, Value},
};

/// A node is asked for its process id so long after it last registered something: starting nodes
/// have better to do.
const ACQUAINTANCE: Duration = Duration::from_secs(2);
/// How often it is looked whether a node is to be asked.
const ROUND: Duration = Duration::from_millis(500);
/// So many registrations that masters died of are remembered: one is rare.
const DEADLY: usize = 1000;
/// How long a node whose name another one is about to take may need to answer.
const DISPLACED_TIME: Duration = Duration::from_secs(1);

/// What is known of the nodes beyond their registrations.
#[derive(Debug, Default)]
pub struct Nodes {
    /// Letters under way.
    pub(super) post: Post,
    suspects: Mutex<Suspects>,
    /// Registrations that masters died of: method, node and topic.
    deadly: Mutex<HashSet<Vec<String>>>,
    /// Recoveries whose census is not over.
    censuses: AtomicUsize,
    /// Nodes that are being asked, or are about to be, and have not answered yet.
    pub(super) unanswered: AtomicUsize,
    changed: Notify,
}

impl Nodes {
    fn lock(&self) -> MutexGuard<'_, Suspects> {
        self.suspects.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the node at `api` is a suspect.
    pub fn is_suspect(&self, api: &str) -> bool {
        self.lock().contains(api)
    }

    /// A master died of this call: it is not made again to mend what a node says.
    pub(super) fn forbid(&self, call: &Call) {
        let mut deadly = self.deadly.lock().unwrap_or_else(PoisonError::into_inner);
        if deadly.len() < DEADLY {
            deadly.insert(essence(call));
        }
    }

    /// Whether [`Nodes::forbid`] was told so.
    pub(super) fn is_forbidden(&self, call: &Call) -> bool {
        let deadly = self.deadly.lock().unwrap_or_else(PoisonError::into_inner);
        deadly.contains(&essence(call))
    }

    /// The names of the suspects.
    pub fn suspects(&self, shadow: &Shadow) -> Vec<String> {
        // No lock is held while the other one is taken.
        let suspects = self.lock().clone();
        let mut names: Vec<String> = shadow.with_mirror(|mirror| {
            let nodes = mirror.nodes().filter(|(_, api)| suspects.contains(api));
            nodes.map(|(name, _)| name.to_owned()).collect()
        });
        names.sort();
        names
    }

    /// The node at `api` did not answer.
    pub(super) fn suspect(&self, proxy: &Arc<Proxy>, api: &str) {
        let now = Instant::now();
        if !self.lock().add(api, now) {
            return;
        }
        tracing::debug!(api, "a node does not answer");
        self.changed.notify_one();
        if self.update_telling(proxy) {
            // What changed before, the master may be about to tell this very node first.
            proxy
                .shadow
                .with_activity(|_, activity| activity.repeat_news(now));
            proxy.shadow.news.notify_one();
        }
    }

    /// The node at `api` has answered, or is no more. Answers whether it was a suspect.
    pub(super) fn clear(&self, proxy: &Proxy, api: &str) -> bool {
        let was = self.lock().remove(api);
        if was {
            self.update_telling(proxy);
        }
        was
    }

    /// News are told by us as long as somebody is suspect, or may be. Answers whether that begins.
    fn update_telling(&self, proxy: &Proxy) -> bool {
        // One lock around the other, here and nowhere else: the last word is the latest.
        let suspects = self.lock();
        let telling = !suspects.is_empty() || self.censuses.load(Ordering::Relaxed) > 0;
        proxy
            .shadow
            .with_activity(|_, activity| activity.set_telling(telling))
            && telling
    }

    /// News are told by us until the result is dropped: nobody knows yet who is suspect.
    pub(super) fn begin_census(proxy: &Arc<Proxy>) -> CensusUnderWay {
        proxy.nodes.censuses.fetch_add(1, Ordering::Relaxed);
        proxy.nodes.update_telling(proxy);
        CensusUnderWay(proxy.clone())
    }
}

/// What a registration is about, whatever its type and address.
fn essence(call: &Call) -> Vec<String> {
    let subject = call.params.iter().take(2).filter_map(Value::as_str);
    std::iter::once(call.method.as_str())
        .chain(subject)
        .map(str::to_owned)
        .collect()
}

/// The census of a recovery.
pub(super) struct CensusUnderWay(Arc<Proxy>);

impl Drop for CensusUnderWay {
    fn drop(&mut self) {
        self.0.nodes.censuses.fetch_sub(1, Ordering::Relaxed);
        self.0.nodes.update_telling(&self.0);
    }
}

/// Watches over the nodes for as long as it is polled: tells news, asks suspects again, gets
/// acquainted with new nodes, and takes the census that is due.
pub async fn watch(proxy: Arc<Proxy>) {
    let mut round = tokio::time::interval(ROUND);
    let mut reaping = proxy
        .config
        .reap_interval
        .map(|pause| tokio::time::interval_at(tokio::time::Instant::now() + pause, pause));
    let mut repeats = Repeats::<News>::default();
    loop {
        let next = proxy.nodes.lock().next().map(Into::into);
        tokio::select! {
            () = proxy.shadow.news.notified() => take_news(&proxy, &mut repeats),
            () = wait::until(next) => ask_suspects(&proxy),
            () = wait::until(repeats.next().map(Into::into)) => {
                let unanswered = proxy.nodes.unanswered.load(Ordering::Relaxed) > 0;
                let holding_up = unanswered || !proxy.nodes.lock().is_empty();
                for news in repeats.due(Instant::now(), holding_up) {
                    tell(&proxy, news);
                }
            }
            // A suspect that is new may be due before the others.
            () = proxy.nodes.changed.notified() => {}
            _ = round.tick() => get_acquainted(&proxy),
            () = wait::tick(&mut reaping) => {
                if matches!(proxy.gate.state(), State::Open { .. }) {
                    tokio::spawn(reap(proxy.clone()));
                }
            }
        }
    }
}

fn take_news(proxy: &Arc<Proxy>, repeats: &mut Repeats<News>) {
    let (news, displaced) = proxy
        .shadow
        .with_activity(|_, activity| (activity.take_news(), activity.take_displaced()));
    for news in news {
        repeats.changed(news, Instant::now());
    }
    for (node, api) in displaced {
        tokio::spawn(displace(proxy.clone(), node, api));
    }
}

fn tell(proxy: &Arc<Proxy>, news: News) {
    match news {
        (Some(api), letter) => healing::send(proxy, &api, letter),
        (None, Letter::Topic(topic)) => {
            healing::tell_subscribers(proxy, &topic);
        }
        (None, Letter::Param(_)) => {}
    }
}

fn ask_suspects(proxy: &Arc<Proxy>) {
    let registered = proxy.shadow.with_mirror(|mirror| {
        let apis = mirror.nodes().map(|(_, api)| api.to_owned());
        apis.collect::<HashSet<_>>()
    });
    let due = {
        let mut suspects = proxy.nodes.lock();
        suspects.retain(|api| registered.contains(api));
        suspects.due(Instant::now())
    };
    proxy.nodes.update_telling(proxy);
    for api in due {
        let proxy = proxy.clone();
        tokio::spawn(async move {
            let outcome = census::visit(&proxy, api).await;
            if outcome.sign != Sign::Silent {
                say(&outcome, "a suspect answers again");
            }
        });
    }
}

fn say(outcome: &Outcome, what: &str) {
    let Outcome {
        removed, mended, ..
    } = outcome;
    let names = &outcome.names;
    tracing::info!(?names, ?removed, ?mended, "{what}");
}

/// Asks nodes that have registered lately for their process ids: another one at the same port will
/// be another node.
fn get_acquainted(proxy: &Arc<Proxy>) {
    let Some(before) = Instant::now().checked_sub(ACQUAINTANCE) else {
        return;
    };
    let new = proxy.shadow.with_activity(|mirror, activity| {
        let new = activity.take_strangers(before).into_iter();
        let new = new.filter_map(|name| {
            let api = mirror.api_of(&name)?.to_owned();
            let registered = activity.deeds(&name).registered;
            Some((name, api, registered))
        });
        new.collect::<Vec<_>>()
    });
    for (name, api, registered) in new {
        let proxy = proxy.clone();
        tokio::spawn(async move {
            let permit = census::permit().await;
            let call = Call::new("getPid", vec![crate::master::CALLER_ID.into()]);
            let answer = node::ask_for(&api, &call, proxy.config.census_timeout).await;
            drop(permit);
            if let Some(pid) = answer.1.and_then(|pid| pid.as_int()) {
                proxy.shadow.with_activity(|_, activity| {
                    activity.remember_pid(&name, &api, registered, pid);
                });
            }
        });
    }
}

/// The standing census.
async fn reap(proxy: Arc<Proxy>) {
    let outcome = census::census(&proxy).await;
    if !outcome.removed.is_empty() || !outcome.mended.is_empty() {
        let (removed, mended) = (outcome.removed, outcome.mended);
        tracing::info!(?removed, ?mended, "standing census");
    }
}

/// A parked registration is about to take the name `node` from `api`. A master that never died would
/// have told the node there to shut down when the call came; the one that comes back will do it then,
/// and the port may be another node's by that time. So if the old node is gone it is taken out now.
async fn displace(proxy: Arc<Proxy>, node: String, api: String) {
    let interview = node::interview(&api, DISPLACED_TIME).await;
    let gone = match interview.sign {
        Sign::Dead => true,
        Sign::Silent => false,
        Sign::Alive => proxy.shadow.with_activity(|mirror, activity| {
            let names = census::names_at(mirror, activity, &api);
            let verdicts =
                crate::census::judge(mirror, &names, interview.pid, interview.claims.as_ref());
            let mut judged = names.iter().zip(verdicts);
            judged.any(|(name, verdict)| name.node == node && verdict == Verdict::Stranger)
        }),
    };
    let calls = proxy.shadow.with_mirror(|mirror| {
        let same = gone && mirror.api_of(&node) == Some(&*api);
        same.then(|| mirror.unregister_calls(&node))
    });
    let Some(calls) = calls.filter(|calls| !calls.is_empty()) else {
        return;
    };
    if proxy.gate.state() == State::Shut(StandIn::Unregistrations) {
        tracing::info!(
            node,
            api,
            "came back at another address; the old node is gone"
        );
        let call = Call::multicall(calls);
        proxy.shadow.unregister(Instant::now(), &call);
    }
}
