//! Sends notifications in place of the master, or repeats those that the master has not sent or will send late.
//!
//! Each port gets its notifications in [order](rescue_core::order), one at a time. A node that does not answer delays no
//! other node.

use std::{
    pin::pin,
    sync::Arc,
    time::{Duration, Instant},
};

use rescue_core::{
    health::{self, port_of},
    order::{NextNotification, Order, Subject},
};
use ros1_master::master::{self, Displaced, Master};
use tokio::sync::Semaphore;

use super::{
    Nodes,
    client::{self, Outcome, Reaction},
};
use crate::{limit::rarely, wait};

/// Number of nodes that are notified at the same time. Each takes a file descriptor.
const AT_ONCE: usize = 64;
/// Time after which a slow node no longer delays the next one. Living nodes answer within milliseconds.
const PROMPT: Duration = Duration::from_millis(10);
/// How long to wait for the answer of a node that never answers `paramUpdate` but answers other calls, like rosnodejs.
/// That is long enough for the node to read the notification.
const MUTE: Duration = Duration::from_millis(500);
/// Maximum number of slow nodes whose answers are awaited in addition to [`AT_ONCE`]. There may be many on a computer
/// that has vanished.
const SLOW: usize = 128;
/// Pauses in seconds before each attempt to shut down a node that does not answer.
const SHUTDOWN_PAUSES: [u64; 6] = [0, 1, 2, 4, 8, 16];

/// The notifications in progress.
#[derive(Debug)]
pub(crate) struct Notifications {
    permits: Semaphore,
    slow: Semaphore,
}

impl Default for Notifications {
    fn default() -> Self {
        Self {
            permits: Semaphore::new(AT_ONCE),
            slow: Semaphore::new(SLOW),
        }
    }
}

/// Notifies every subscriber of `topic`. Returns whether there are subscribers.
pub(crate) fn notify_subscribers(nodes: &Arc<Nodes>, topic: &str) -> bool {
    let subscribers = nodes
        .ledger
        .with_mirror(|mirror| mirror.subscribers_of(topic));
    for api in &subscribers {
        notify_node(nodes, api, Subject::Topic(topic.to_owned()));
    }
    !subscribers.is_empty()
}

/// Notifies each node of every topic and parameter that it subscribes to.
pub(crate) fn notify_all(nodes: &Arc<Nodes>) {
    notify_of_all_subjects(nodes, |mirror| mirror.nodes().collect());
}

/// Notifies the nodes at these ports of every topic and parameter that they subscribe to.
pub(super) fn notify_ports(nodes: &Arc<Nodes>, ports: &[impl AsRef<str>]) {
    notify_of_all_subjects(nodes, |mirror| {
        let nodes = ports.iter().flat_map(|port| mirror.nodes_at(port.as_ref()));
        nodes.collect()
    });
}

fn notify_of_all_subjects(nodes: &Arc<Nodes>, select: impl Fn(&Master) -> Vec<(&str, &str)>) {
    nodes.ledger.with_order(|order, mirror| {
        for (name, api) in select(mirror) {
            let port = port_of(api);
            for topic in mirror.subscriptions(name) {
                order.notify_of_state(port, Subject::Topic(topic.to_owned()));
            }
            // A parameter that is not set, and perhaps never was, needs no notification.
            for key in mirror
                .param_subscriptions(name)
                .filter(|key| mirror.is_set(key))
            {
                order.notify_of_state(port, Subject::Param(key.to_owned()));
            }
        }
    });
    send_waiting(nodes);
}

/// Tells the node at `api` the present publishers of a topic, or the present value of a parameter, which `subject`
/// names.
pub(crate) fn notify_node(nodes: &Arc<Nodes>, api: &str, subject: Subject) {
    let port = port_of(api);
    let tell = |order: &mut Order, _: &Master| order.notify_of_state(port, subject);
    nodes.ledger.with_order(tell);
    send_waiting(nodes);
}

/// Sends all waiting notifications. An unreachable node gets the present state of all its topics and parameters once it
/// answers.
pub(super) fn send_waiting(nodes: &Arc<Nodes>) {
    let ports = nodes.ledger.with_order(|order, _| order.take_idle_ports());
    for port in ports {
        match nodes.is_unreachable(&port) {
            true => nodes.ledger.with_order(|order, _| order.drop_port(&port)),
            false => drop(crate::task::spawn(deliver(nodes.clone(), port))),
        }
    }
}

/// Sends a node its notifications in order, one at a time. A node that does not take a notification becomes
/// unreachable. A node that answers other calls but not `paramUpdate` still gets the next notification.
async fn deliver(nodes: Arc<Nodes>, port: String) {
    let notifications = &nodes.notifications;
    let mut changed = nodes.ledger.order_changed();
    loop {
        // The semaphore is never closed.
        let permit = notifications.permits.acquire().await.ok();
        nodes.ledger.lease.wait().await;
        if !nodes.may_notify(&port).await {
            return nodes.ledger.with_order(|order, _| order.drop_port(&port));
        }
        changed.mark_unchanged();
        let (call, number) = match nodes
            .ledger
            .with_order(|order, mirror| order.next_notification(Instant::now(), &port, mirror))
        {
            NextNotification::Send { call, number } => (call, number),
            NextNotification::Wait { until } => {
                drop(permit);
                tokio::select! {
                    // The ledger lives as long as this task.
                    _ = changed.changed() => {}
                    () = wait::sleep_until(until.map(Into::into)) => {}
                }
                continue;
            }
            NextNotification::Idle => return,
        };
        nodes.stats.notifications_sent.count();
        let is_param = call.method == master::PARAM_UPDATE;
        let is_mute = is_param && nodes.is_mute(&port);
        let limit = match is_mute {
            true => MUTE.min(nodes.timeout),
            false => nodes.timeout,
        };
        // Behind a cut cable, the connection may be made much later, when another leader has told newer news.
        let withdrawn = nodes.ledger.lease.lapsed();
        let mut asked = pin!(client::call_unless(&port, &call, limit, withdrawn));
        let answer = match tokio::time::timeout(PROMPT, &mut asked).await {
            Ok(answer) => answer,
            Err(_) => {
                let _room = notifications.slow.try_acquire().ok().or(permit);
                asked.await
            }
        };
        let Some(Outcome {
            sign, is_connected, ..
        }) = answer
        else {
            nodes
                .ledger
                .release(|order| order.notification_withdrawn(number));
            continue;
        };
        nodes
            .ledger
            .release(|order| order.notification_taken(number));
        // Without a connection, the network was away: the node has not heard, and is told the state when it answers.
        let may_be_mute = is_param && sign == Reaction::Silent && is_connected;
        if may_be_mute && is_answering(&nodes, &port).await {
            nodes.set_mute(&port, true);
            continue;
        }
        if is_mute && sign == Reaction::Alive {
            nodes.set_mute(&port, false);
        }
        if sign != Reaction::Alive {
            nodes.mark_unreachable(&port, false);
            nodes.ledger.with_order(|order, _| order.drop_port(&port));
            return;
        }
    }
}

/// Whether the node at `port` answers a question.
async fn is_answering(nodes: &Nodes, port: &str) -> bool {
    client::call(port, &master::get_pid(), nodes.timeout).await == Reaction::Alive
}

/// Asks a node to shut down because another node has taken its name, as a master does. Does nothing if a different node
/// listens at the address by now.
pub(crate) fn shut_down(nodes: &Arc<Nodes>, displaced: Displaced) {
    let nodes = nodes.clone();
    crate::task::spawn(async move {
        for seconds in SHUTDOWN_PAUSES {
            tokio::time::sleep(Duration::from_secs(seconds)).await;
            let name = Subject::Name(displaced.node.clone());
            answers_are_written(&nodes, port_of(&displaced.api), &name).await;
            nodes.ledger.lease.wait().await;
            if !nodes.may_notify(port_of(&displaced.api)).await {
                return;
            }
            if is_taken(&nodes, &displaced.api) {
                return;
            }
            let reach = nodes.reach(port_of(&displaced.api), displaced.from).await;
            if !reach.answer_counts() {
                return;
            }
            // The permit is held until the node has been told.
            let Some(_admitted) = nodes
                .visits
                .admit(port_of(&displaced.api), nodes.timeout)
                .await
            else {
                continue;
            };
            let interview = client::interview(&displaced.api, nodes.timeout).await;
            match interview.sign {
                Reaction::Dead => return,
                Reaction::Silent => continue,
                Reaction::Alive => {}
            }
            let Displaced { node, api, .. } = &displaced;
            if is_taken(&nodes, api) {
                return;
            }
            if health::is_displaced_node(&displaced, interview.pid, interview.claims.as_ref()) {
                rarely!(
                    info,
                    node,
                    api,
                    "telling a node to shut down: another node has taken its name"
                );
                nodes.stats.notifications_sent.count();
                client::call(api, &master::shutdown(node), nodes.timeout).await;
            } else {
                rarely!(
                    info,
                    node,
                    api,
                    "a node whose name another node has taken is not told to shut down: it may not be the one that \
                     answers at its address"
                );
            }
            return;
        }
        rarely!(
            info,
            node = displaced.node,
            api = displaced.api,
            "a node whose name another node has taken is not told to shut down: it does not answer"
        );
    });
}

/// Waits until each answer to the node at `port` about `subject`, a topic, parameter or node name, has been written or
/// has taken too long.
async fn answers_are_written(nodes: &Nodes, port: &str, subject: &Subject) {
    let mut changed = nodes.ledger.order_changed();
    loop {
        changed.mark_unchanged();
        let under_way =
            |order: &mut Order, _: &Master| order.answer_under_way(Instant::now(), port, subject);
        let Some(held) = nodes.ledger.with_order(under_way) else {
            return;
        };
        tokio::select! {
            // The ledger lives as long as this task.
            _ = changed.changed() => {}
            () = wait::sleep_until(held.until.map(Into::into)) => {}
        }
    }
}

/// Whether a node is registered at this address.
fn is_taken(nodes: &Nodes, api: &str) -> bool {
    nodes
        .ledger
        .with_mirror(|mirror| mirror.nodes_at(port_of(api)).any(|(_, at)| at == api))
}
