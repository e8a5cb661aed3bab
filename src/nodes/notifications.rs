//! Notifications to nodes that the master would send, has not sent, or will send late.
//!
//! Each port gets its notifications in order, one at a time; a node that does not answer delays no other. A
//! node ignores a list of publishers that it knows already, but a stale list could make it drop links. So a
//! repeated notification takes its content from the mirror when it is sent, and if that changes on the way,
//! another one follows.

use std::{
    collections::{HashMap, VecDeque},
    pin::pin,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use tokio::sync::Semaphore;

use super::{
    Nodes,
    client::{self, Sign},
};
use crate::{
    health::{Claims, port_of},
    ledger::activity::{Displaced, Notification},
    limit::rarely,
    master::{self, Master},
    xmlrpc::{Call, Value},
};

/// Nodes notified at the same time. Each takes a file descriptor.
const AT_ONCE: usize = 64;
/// A node that takes longer yields its place to the next one: living nodes answer within milliseconds.
const PROMPT: Duration = Duration::from_millis(10);
/// Further slow nodes that may be waited for: many nodes on a computer whose packets vanish.
const SLOW: usize = 128;
/// When more notifications wait for a node, it gets only the latest of each kind.
const QUEUE_MAX: usize = 256;
/// Pauses before asking a node again to shut down, if it does not answer.
const SHUTDOWN_PAUSES: [u64; 6] = [0, 1, 2, 4, 8, 16];

/// The notifications under way.
#[derive(Debug)]
pub(crate) struct Notifications {
    /// Waiting notifications by port. A port being notified has an entry, which may be empty.
    pending: Mutex<HashMap<String, VecDeque<Notification>>>,
    permits: Semaphore,
    slow: Semaphore,
}

impl Default for Notifications {
    fn default() -> Self {
        Self {
            pending: Mutex::default(),
            permits: Semaphore::new(AT_ONCE),
            slow: Semaphore::new(SLOW),
        }
    }
}

impl Notifications {
    fn lock(&self) -> MutexGuard<'_, HashMap<String, VecDeque<Notification>>> {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Notifies every subscriber of `topic`. Returns whether there are any.
pub(crate) fn notify_subscribers(nodes: &Arc<Nodes>, topic: &str) -> bool {
    let subscribers = nodes
        .ledger
        .with_mirror(|mirror| mirror.subscribers_of(topic));
    for api in &subscribers {
        send(nodes, api, Notification::Topic(topic.to_owned()));
    }
    !subscribers.is_empty()
}

/// Notifies the node at `port` of every topic and parameter that it subscribes.
pub(crate) fn notify_of_all(nodes: &Arc<Nodes>, port: &str) {
    let notifications = nodes.ledger.with_mirror(|mirror| {
        let names = mirror.nodes().filter(|(_, api)| port_of(api) == port);
        let notifications = names.flat_map(|(name, _)| {
            let topics = mirror.subscriptions(name).map(str::to_owned);
            // Nothing to send for a parameter that is not set, and may never have been.
            let keys = mirror.param_subscriptions(name);
            let keys = keys.filter(|key| mirror.is_set(key)).map(Arc::from);
            topics
                .map(Notification::Topic)
                .chain(keys.map(Notification::Param))
        });
        notifications.collect::<Vec<_>>()
    });
    for notification in notifications {
        send(nodes, port, notification);
    }
}

/// Notifies the node at `api`, unless it is unreachable: such a node gets everything once it answers. A node
/// that does not take a notification becomes unreachable.
pub(crate) fn send(nodes: &Arc<Nodes>, api: &str, notification: Notification) {
    let port = port_of(api);
    if nodes.is_unreachable(port) {
        return;
    }
    let mut pending = nodes.notifications.lock();
    if let Some(queue) = pending.get_mut(port) {
        add(queue, notification);
        return;
    }
    pending.insert(port.to_owned(), VecDeque::from([notification]));
    drop(pending);
    tokio::spawn(deliver(nodes.clone(), port.to_owned()));
}

fn add(queue: &mut VecDeque<Notification>, notification: Notification) {
    let repeated = !matches!(notification, Notification::Call(_));
    if repeated && queue.contains(&notification) {
        return;
    }
    queue.push_back(notification);
    if queue.len() > QUEUE_MAX {
        let all = std::mem::take(queue);
        for notification in all.into_iter().filter_map(latest) {
            if !queue.contains(&notification) {
                queue.push_back(notification);
            }
        }
    }
}

/// One notification that replaces all others of its kind; it takes its content when it is sent.
fn latest(notification: Notification) -> Option<Notification> {
    let Notification::Call(call) = notification else {
        return Some(notification);
    };
    let subject = call.params.get(1).and_then(Value::as_str)?;
    Some(match call.method == master::PUBLISHER_UPDATE {
        true => Notification::Topic(subject.to_owned()),
        false => Notification::Param(subject.into()),
    })
}

async fn deliver(nodes: Arc<Nodes>, port: String) {
    let notifications = &nodes.notifications;
    loop {
        let notification = {
            let mut pending = notifications.lock();
            match pending.get_mut(&port).and_then(VecDeque::pop_front) {
                Some(notification) => notification,
                None => {
                    pending.remove(&port);
                    return;
                }
            }
        };
        let compose = || {
            nodes
                .ledger
                .with_mirror(|mirror| compose(mirror, &port, &notification))
        };
        // Never closed.
        let permit = notifications.permits.acquire().await.ok();
        let Some(call) = compose() else { continue };
        nodes.stats.notifications_sent.count();
        let mut asked = pin!(client::ask(&port, &call, nodes.timeout));
        let sign = match tokio::time::timeout(PROMPT, &mut asked).await {
            Ok(sign) => sign,
            Err(_) => {
                let _room = notifications.slow.try_acquire().ok().or(permit);
                asked.await
            }
        };
        if sign != Sign::Alive {
            notifications.lock().remove(&port);
            nodes.mark_unreachable(&port);
            return;
        }
        if compose().is_some_and(|now| now != call)
            && let Some(queue) = notifications.lock().get_mut(&port)
        {
            add(queue, notification);
        }
    }
}

/// The call to send to the node at `port` now; none if it no longer concerns that node.
fn compose(mirror: &Master, port: &str, notification: &Notification) -> Option<Arc<Call>> {
    let at = |api: &str| port_of(api) == port;
    match notification {
        Notification::Call(call) => Some(call.clone()),
        Notification::Topic(topic) => mirror
            .subscribes(at, topic)
            .then(|| mirror.publisher_update(topic).into()),
        Notification::Param(key) => match mirror.subscribes_param(at, key) {
            true => mirror.param_update(key).map(Arc::new),
            false => None,
        },
    }
}

/// Asks a node to shut down because another one has taken its name, as a master does. Never a different node
/// that has its address by now.
pub(crate) fn shut_down(nodes: &Arc<Nodes>, displaced: Displaced) {
    let nodes = nodes.clone();
    tokio::spawn(async move {
        for seconds in SHUTDOWN_PAUSES {
            tokio::time::sleep(Duration::from_secs(seconds)).await;
            if is_taken(&nodes, &displaced.api) {
                return;
            }
            // Held until it has been told.
            let Some(_admitted) = nodes
                .visits
                .admit(port_of(&displaced.api), nodes.timeout)
                .await
            else {
                continue;
            };
            let interview = client::interview(&displaced.api, nodes.timeout).await;
            match interview.sign {
                Sign::Dead => return,
                Sign::Silent => continue,
                Sign::Alive => {}
            }
            let Displaced { node, api, .. } = &displaced;
            if is_itself(&displaced, interview.pid, interview.claims.as_ref())
                && !is_taken(&nodes, api)
            {
                rarely!(
                    info,
                    node,
                    api,
                    "telling a node to shut down: another has its name"
                );
                nodes.stats.notifications_sent.count();
                client::ask(api, &master::shutdown(node), nodes.timeout).await;
            }
            return;
        }
    });
}

/// Whether a node is registered at this address.
fn is_taken(nodes: &Nodes, api: &str) -> bool {
    nodes
        .ledger
        .with_mirror(|mirror| mirror.nodes().any(|(_, at)| at == api))
}

/// Whether the node at the address is the displaced one. Without evidence it is not.
fn is_itself(displaced: &Displaced, pid: Option<i32>, claims: Option<&Claims>) -> bool {
    match (displaced.pid, pid) {
        (Some(known), Some(pid)) => known == pid,
        _ => claims.is_some_and(|claims| claims.shares(&displaced.topics)),
    }
}
