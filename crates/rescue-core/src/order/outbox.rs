//! Notifications that wait to be sent by rosrescue: those of each node in order.

use std::{
    collections::{HashMap, HashSet, VecDeque},
    sync::Arc,
    time::Instant,
};

use super::Subject;
use crate::{health::port_of, master::Master, xmlrpc::Call};

/// When more notifications wait for a node, each subject is told once, as it is when it is sent.
const QUEUE_MOST: usize = 256;

/// What to do for a node.
#[derive(Clone, Debug, PartialEq)]
pub enum Next {
    /// Send `call`, then say so by [`taken`](super::Order::taken).
    Send { call: Arc<Call>, number: u64 },
    /// Ask again when something has changed, at `until` at the latest.
    Wait { until: Option<Instant> },
    /// Nothing waits. The port is [idle](super::Order::take_idle_ports) when there is something again.
    Idle,
}

/// The notifications that wait, by port.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    ports: HashMap<String, VecDeque<Notification>>,
    /// Ports with notifications for which nobody sends them yet.
    idle: Vec<String>,
}

/// What a notification says.
#[derive(Clone, Debug)]
pub(super) enum Content {
    /// What a master would have sent.
    Call(Arc<Call>),
    /// The state at the time of sending.
    State,
    /// The same, once more.
    StateAgain,
}

#[derive(Debug)]
pub(super) struct Notification {
    subject: Subject,
    content: Content,
}

impl Notification {
    /// Whether it tells the state at the time of sending.
    pub(super) fn is_state(&self) -> bool {
        !matches!(self.content, Content::Call(_))
    }

    /// Whether it is told once more.
    pub(super) fn is_repeat(&self) -> bool {
        matches!(self.content, Content::StateAgain)
    }
}

impl Outbox {
    pub(super) fn add(&mut self, port: &str, subject: Subject, content: Content) {
        let notification = Notification { subject, content };
        let Some(queue) = self.ports.get_mut(port) else {
            self.idle.push(port.to_owned());
            self.ports
                .insert(port.to_owned(), VecDeque::from([notification]));
            return;
        };
        let subject = &notification.subject;
        let is_told = |other: &Notification| other.is_state() && other.subject == *subject;
        if notification.is_state() && queue.iter().any(is_told) {
            return;
        }
        queue.push_back(notification);
        if queue.len() > QUEUE_MOST {
            renew(queue, |_| true);
        }
    }

    pub(super) fn take_idle_ports(&mut self) -> Vec<String> {
        std::mem::take(&mut self.idle)
    }

    pub(super) fn remove(&mut self, port: &str) {
        self.ports.remove(port);
    }

    /// Drops all. Whoever sends to a port finds nothing more.
    pub(super) fn clear(&mut self) {
        self.ports.values_mut().for_each(VecDeque::clear);
    }

    /// The subject of the next notification to `port`.
    pub(super) fn first(&self, port: &str) -> Option<&Subject> {
        self.ports.get(port)?.front().map(|first| &first.subject)
    }

    /// Takes the next notification to `port`.
    pub(super) fn pop(&mut self, port: &str) -> Option<Notification> {
        self.ports.get_mut(port)?.pop_front()
    }

    /// The call that makes `notification` to `port` now; none if it no longer concerns the node there.
    pub(super) fn call(
        &mut self,
        port: &str,
        notification: Notification,
        mirror: &Master,
    ) -> Option<Arc<Call>> {
        let Notification { subject, content } = notification;
        if let Content::Call(call) = content {
            return Some(call);
        }
        // What waits behind the present state is older than it.
        let queue = self.ports.get_mut(port)?;
        renew(queue, |other| other.concerns(&subject));
        queue.retain(|other| other.subject != subject);
        state(mirror, port, &subject)
    }

    /// What waits for `port` about `subject` is told as it is when it is sent.
    pub(super) fn renew(&mut self, port: &str, subject: &Subject) {
        if let Some(queue) = self.ports.get_mut(port) {
            renew(queue, |other| other.concerns(subject));
        }
    }

    /// As [`Self::renew`], for all ports.
    pub(super) fn renew_all(&mut self, subject: &Subject) {
        for queue in self.ports.values_mut() {
            renew(queue, |other| other.concerns(subject));
        }
    }
}

/// Replaces notifications about these subjects by one each, of the state at the time of sending.
fn renew(queue: &mut VecDeque<Notification>, is_it: impl Fn(&Subject) -> bool) {
    let is_old = |it: &Notification| !it.is_state() && is_it(&it.subject);
    if !queue.iter().any(is_old) {
        return;
    }
    let mut told = HashSet::new();
    queue.retain_mut(|notification| {
        if !notification.is_state() && is_it(&notification.subject) {
            notification.content = Content::State;
        }
        !notification.is_state() || told.insert(notification.subject.clone())
    });
}

/// The call that tells the node at `port` the state of `subject`; none if it does not subscribe it.
fn state(mirror: &Master, port: &str, subject: &Subject) -> Option<Arc<Call>> {
    let at = |api: &str| port_of(api) == port;
    match subject {
        Subject::Topic(topic) => mirror
            .subscribes(at, topic)
            .then(|| mirror.publisher_update(topic).into()),
        Subject::Param(key) if mirror.subscribes_param(at, key) => {
            mirror.param_update(key).map(Arc::new)
        }
        Subject::Param(_) | Subject::Name(_) => None,
    }
}
