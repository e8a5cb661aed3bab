//! The notifications that rosrescue still has to send, in order for each node.

use std::{
    collections::{HashMap, HashSet, VecDeque},
    sync::Arc,
    time::Instant,
};

use super::Subject;
use crate::health::port_of;
use ros1_master::{master::Master, xmlrpc::Call};

/// If more notifications than this wait for a node, those about the same topic or parameter become a single one with
/// the state at the time of sending.
const QUEUE_MAX: usize = 256;

/// What to do next about the notifications for a node.
#[derive(Clone, Debug, PartialEq)]
pub enum NextNotification {
    /// Send `call`, then pass `number` to [`notification_taken`](super::Order::notification_taken).
    Send { call: Arc<Call>, number: u64 },
    /// Ask again when the answer that is on its way to the node has been written, or at `until` at the latest.
    Wait { until: Option<Instant> },
    /// No notification waits. When there is one again, the port is among the [idle
    /// ports](super::Order::take_idle_ports).
    Idle,
}

/// The waiting notifications, by port.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    ports: HashMap<String, VecDeque<Notification>>,
    /// Ports with waiting notifications and no task that sends them.
    idle: Vec<String>,
}

/// The content of a notification.
#[derive(Clone, Debug)]
pub(super) enum Payload {
    /// The call that a master would have sent.
    Call(Arc<Call>),
    /// What the topic or parameter is when the notification is sent; nothing is stored here.
    State,
    /// The same, told once more in case the node has read notifications in the wrong order.
    StateAgain,
}

#[derive(Debug)]
pub(super) struct Notification {
    subject: Subject,
    content: Payload,
}

impl Notification {
    /// Whether the notification contains the state at the time of sending.
    pub(super) fn is_state(&self) -> bool {
        !matches!(self.content, Payload::Call(_))
    }

    /// Whether the notification only tells a state once more; see [`Payload::StateAgain`].
    pub(super) fn is_repeat(&self) -> bool {
        matches!(self.content, Payload::StateAgain)
    }
}

impl Outbox {
    pub(super) fn add(&mut self, port: &str, subject: Subject, content: Payload) {
        let notification = Notification { subject, content };
        let Some(queue) = self.ports.get_mut(port) else {
            self.idle.push(port.to_owned());
            self.ports
                .insert(port.to_owned(), VecDeque::from([notification]));
            return;
        };
        let subject = &notification.subject;
        let is_queued = |other: &Notification| other.is_state() && other.subject == *subject;
        if notification.is_state() && queue.iter().any(is_queued) {
            return;
        }
        queue.push_back(notification);
        if queue.len() > QUEUE_MAX {
            replace_with_state(queue, |_| true);
        }
    }

    pub(super) fn take_idle_ports(&mut self) -> Vec<String> {
        std::mem::take(&mut self.idle)
    }

    pub(super) fn remove(&mut self, port: &str) {
        self.ports.remove(port);
    }

    /// Drops all notifications. Tasks that send them find nothing left to do.
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

    /// The call to make to `port` for `notification`. `None` if the node there no longer subscribes to the subject.
    pub(super) fn call(
        &mut self,
        port: &str,
        notification: Notification,
        mirror: &Master,
    ) -> Option<Arc<Call>> {
        let Notification { subject, content } = notification;
        if let Payload::Call(call) = content {
            return Some(call);
        }
        // Waiting notifications about the same subject are older than the present state, so they are dropped. Those
        // about keys above or below a parameter get the present state.
        let queue = self.ports.get_mut(port)?;
        replace_with_state(queue, |other| other.concerns(&subject));
        queue.retain(|other| other.subject != subject);
        state_notification(mirror, port, &subject)
    }

    /// Replaces the notifications to `port` about `subject` by one with the state at the time of sending.
    pub(super) fn replace_with_state(&mut self, port: &str, subject: &Subject) {
        if let Some(queue) = self.ports.get_mut(port) {
            replace_with_state(queue, |other| other.concerns(subject));
        }
    }

    /// Replaces, for each port, the notifications about `subject` by one with the state at the time of sending.
    pub(super) fn replace_all_with_state(&mut self, subject: &Subject) {
        for queue in self.ports.values_mut() {
            replace_with_state(queue, |other| other.concerns(subject));
        }
    }
}

/// Replaces the notifications about each subject that `is_it` accepts by a single one with the state at the time of
/// sending.
fn replace_with_state(queue: &mut VecDeque<Notification>, is_it: impl Fn(&Subject) -> bool) {
    let is_old = |it: &Notification| !it.is_state() && is_it(&it.subject);
    if !queue.iter().any(is_old) {
        return;
    }
    let mut seen = HashSet::new();
    queue.retain_mut(|notification| {
        if !notification.is_state() && is_it(&notification.subject) {
            notification.content = Payload::State;
        }
        !notification.is_state() || seen.insert(notification.subject.clone())
    });
}

/// The call that notifies the node at `port` of the state of `subject`. `None` if the node does not subscribe to it.
fn state_notification(mirror: &Master, port: &str, subject: &Subject) -> Option<Arc<Call>> {
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
