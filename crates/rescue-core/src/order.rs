//! Makes sure that a node gets the news about a *subject* (a topic, a parameter or the node's own name) in the order in
//! which the state changed.
//!
//! A node hears about one subject in two ways, in the answers to its own calls and in notifications, and it reads these
//! in different threads. rospy believes whatever comes last. roscpp drops every connection to a publisher that is
//! missing in the last list. So a node must have the answer to its own call before it is notified of anything later
//! about the same subject, and of two notifications the newer one must come last:
//!
//! * While the master serves, a write that can notify a node does not go to the master while an answer to
//!   that node about the same subject is under way ([`Order::must_wait`]).
//! * A notification that rosrescue sends waits for such an answer, and for [`LEAD`] after it. While the master may be
//!   notifying the node of the same subject, rosrescue's notification is put off ([`Order::next_notification`]).
//! * A node that is notified shortly after such an answer, or by two senders in a row, is told the state once more
//!   ([`REPEAT_AFTER`]), because it may have read the two in the wrong order. If the master notifies the node of
//!   something newer in the meantime, rosrescue does not tell the state again: on a busy computer, older notifications
//!   in the master's backlog could arrive after it.
//!
//! This module is pure: the time and the mirror are arguments.

mod beside_master;
mod by_subject;
mod outbox;
mod subject;
mod under_way;

use std::{
    collections::{BTreeMap, BTreeSet, HashSet},
    sync::Arc,
    time::{Duration, Instant},
};

pub use self::{
    beside_master::BesideMaster,
    by_subject::BySubject,
    outbox::NextNotification,
    subject::{Concern, Recipient, Subject, recipients_of_read},
};
use self::{
    outbox::{Outbox, Payload},
    under_way::UnderWay,
};
use crate::health::port_of;
use ros1_master::{master::Master, xmlrpc::Call};

/// How long a notification of rosrescue waits after an answer about the same [`Subject`] was written. A notification of
/// rosmaster arrives at least 0.3 ms after the answer, because it goes through another thread and a new connection.
pub const LEAD: Duration = Duration::from_millis(10);
/// A notification that follows an answer within this time may be read before that answer. With thirty runnable
/// processes on two cores, a node took 42 ms to switch threads.
pub const RECENT: Duration = Duration::from_millis(500);
/// How long after a notification that may have been read in the wrong order the node is told the state again. Idle
/// threads of rosmaster look for work every 100 ms, so a master without a backlog has sent its own notifications within
/// this time.
pub const REPEAT_AFTER: Duration = Duration::from_millis(300);
/// Longest time that a master with enough CPU time takes for one notification while many wait. A Python thread gives up
/// its lock every 5 ms.
const MASTER_TAKES: Duration = Duration::from_millis(5);
/// Longest backlog of the master for which rosrescue's notifications wait.
const BACKLOG_MAX: Duration = Duration::from_secs(10);
/// How long a client that does not read its answer can delay other nodes' writes.
pub const ANSWER_LIMIT: Duration = Duration::from_secs(1);
/// How long a node that does not take a notification can delay writes about the same topic, parameter or name. With
/// thirty runnable processes on two cores, a node took more than 100 ms for that, and a newer value from the master
/// came first.
pub const NOTIFICATION_LIMIT: Duration = Duration::from_millis(300);

/// The answers and notifications on their way to nodes, and the notifications that rosrescue still has to send. Decides
/// which calls and notifications must wait.
#[derive(Debug, Default)]
pub struct Order {
    under_way: UnderWay,
    outbox: Outbox,
    /// The calls that the master has not answered yet. The master may be notifying nodes because of them.
    in_flight: InFlight,
    /// What the master will notify nodes of when it runs the writes that the mirror has answered first, by the number of
    /// the write.
    unacknowledged: BySubject<u64>,
    /// The topics, parameters and names about which the master may still be notifying nodes.
    master_notifications: MasterNotifications,
    /// Whether the master was late and has neither got calls again nor gone since. Then it may still be sending
    /// notifications while the mirror answers.
    is_late: bool,
    repeats: Repeats,
    /// Until when notifications of an earlier process may still arrive.
    earlier_until: Option<Instant>,
    /// Whether a call or a notification waits until an answer or a notification has arrived, or until the master has
    /// answered its calls.
    awaited: bool,
}

/// The calls that the master has not answered yet.
#[derive(Debug, Default)]
struct InFlight {
    subjects: BySubject<()>,
    answers: Vec<u64>,
}

/// Says that a call or a notification has to wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MustWait {
    /// When to ask again at the latest. Before that, ask again when [`Order::answer_ready`], [`Order::answer_written`],
    /// [`Order::calls_settled`] or [`Order::notification_taken`] returns true.
    pub until: Option<Instant>,
}

impl Order {
    /// Adds an answer that is on its way and informs `recipients`. Returns its number, for [`Self::answer_written`].
    /// `None` if there are no recipients, because nothing needs to wait for such an answer.
    pub fn begin_answer(&mut self, now: Instant, recipients: Vec<Recipient>) -> Option<u64> {
        self.under_way.forget(now);
        if recipients.is_empty() {
            return None;
        }
        for Recipient { port, subject } in &recipients {
            // Notifications that already wait for this node are older than the answer, so the node gets the present
            // state instead.
            self.outbox.replace_with_state(port, subject);
        }
        Some(
            self.under_way
                .add(under_way::DeliveryKind::Answer, recipients, None),
        )
    }

    /// Notes that the answer can be sent to its caller. From now on, calls and notifications wait for it for at most
    /// [`ANSWER_LIMIT`]. Returns whether one waits already, which does not know of that limit.
    pub fn answer_ready(&mut self, now: Instant, answer: u64) -> bool {
        self.under_way.limit(answer, now + ANSWER_LIMIT);
        std::mem::take(&mut self.awaited)
    }

    /// Notes that the answer has been written to its caller, or never will be. If that took longer than [`ANSWER_LIMIT`],
    /// the node is told the state again. Returns whether a call or a notification waits for that.
    pub fn answer_written(&mut self, now: Instant, answer: u64) -> bool {
        // The node may have been notified while the answer was overdue. It is older, and comes last.
        for Recipient { port, subject } in self.under_way.written(now, answer) {
            self.repeats.add(now + REPEAT_AFTER, port, subject);
        }
        std::mem::take(&mut self.awaited)
    }

    /// Whether a call must wait before it goes to the master. It must wait if it may notify a node while an answer to
    /// that node about the same [`Subject`] is on its way.
    pub fn must_wait(&mut self, now: Instant, concern: &Concern) -> Option<MustWait> {
        let wait = match concern.may_change_anything() {
            true => self.under_way.must_wait(now),
            false => concern.notified_subjects().iter().find_map(|subject| {
                let port = concern.port_if_name(subject);
                self.under_way.must_wait_for(now, subject, port)
            }),
        };
        self.awaited |= wait.is_some();
        wait
    }

    /// Whether a read whose answer informs `recipients` must wait until the master has answered its calls. If the read did
    /// not wait, its answer could be older than a notification that the master sends to the reader.
    pub fn read_must_wait(&mut self, recipients: &[Recipient]) -> bool {
        let mut recipients = recipients.iter();
        let waits = recipients.any(|it| self.master_will_notify(&it.subject));
        self.awaited |= waits;
        waits
    }

    /// Whether the answer to a write may not be given before the master has run it: the answer is about something of
    /// which the master may be notifying the caller, who has subscribed to it before.
    pub fn answer_must_wait(&self, mirror: &Master, recipients: &[Recipient]) -> bool {
        let is_told = |recipient: &Recipient| match &recipient.subject {
            Subject::Topic(topic) => {
                let subscribers = mirror.subscribers_of(topic);
                subscribers.iter().any(|api| port_of(api) == recipient.port)
            }
            Subject::Param(_) => true,
            Subject::Name(_) => false,
        };
        let mut recipients = recipients.iter();
        recipients.any(|it| is_told(it) && self.master_will_notify(&it.subject))
    }

    /// Whether the master may notify nodes of `subject` because of calls that it has not answered.
    fn master_will_notify(&self, subject: &Subject) -> bool {
        self.in_flight.subjects.has(subject) || self.unacknowledged.has(subject)
    }

    /// Notes that the mirror has answered a write first, and that the master may notify nodes of `subjects` when it runs
    /// it. `write` is any number that identifies it.
    pub fn answered_first<'a>(
        &mut self,
        write: u64,
        subjects: impl IntoIterator<Item = &'a Subject>,
    ) {
        let subjects = subjects.into_iter();
        let subjects = subjects.filter(|it| !matches!(it, Subject::Name(_)));
        subjects.for_each(|subject| self.unacknowledged.add(subject, write));
    }

    /// Notes that the master has run the write of [`Self::answered_first`], or never will. Returns whether a call or a
    /// notification waits for that.
    pub fn acknowledged<'a>(
        &mut self,
        write: u64,
        subjects: impl IntoIterator<Item = &'a Subject>,
    ) -> bool {
        let subjects = subjects.into_iter();
        subjects.for_each(|subject| self.unacknowledged.remove(subject, write));
        std::mem::take(&mut self.awaited)
    }

    /// Notes that the master gets calls because of which it may notify nodes of `subjects`. `answers` are the numbers
    /// that [`Self::begin_answer`] gave the answers to these calls.
    pub fn calls_sent<'a>(
        &mut self,
        subjects: impl IntoIterator<Item = &'a Subject>,
        answers: Vec<u64>,
    ) {
        // A call never displaces its own node, so the node's other calls need not wait for its own name.
        let notified = subjects
            .into_iter()
            .filter(|it| !matches!(it, Subject::Name(_)));
        for subject in notified {
            self.in_flight.subjects.add(subject, ());
        }
        self.in_flight.answers = answers;
    }

    /// Notes that the master has no unanswered calls left, or that the mirror has answered these calls. Returns whether
    /// a call or a notification waits for that.
    pub fn calls_settled(&mut self) -> bool {
        let in_flight = std::mem::take(&mut self.in_flight);
        !in_flight.subjects.is_empty() && std::mem::take(&mut self.awaited)
    }

    /// Notes that the master now notifies nodes of a change of `subject`. `nodes` is the number of these nodes.
    pub fn master_notifies(&mut self, now: Instant, subject: &Subject, nodes: usize) {
        self.master_may_notify(now, subject, nodes);
        let about = self.under_way.about(now, subject);
        let ports: HashSet<&str> = about.iter().map(|(_, port)| port.as_str()).collect();
        self.repeats.drop_all_but(subject, &ports);
    }

    /// Like [`Self::master_notifies`], if the master may have nothing to notify of: what rosrescue was going to tell nodes
    /// again, it tells them afterwards.
    pub fn master_may_notify(&mut self, now: Instant, subject: &Subject, nodes: usize) {
        let until = self.master_notifications.add(now, subject, nodes);
        self.outbox.replace_all_with_state(subject);
        self.repeats.put_off(subject, until);
        for (answer, port) in self.under_way.about(now, subject) {
            // An answer in the same batch does not count: its call ran later, or has itself caused the notification.
            if !self.in_flight.answers.contains(&answer) {
                self.repeats.add(until, port, subject.clone());
            }
        }
    }

    /// Notes that the master answered calls that were sent together, `calls` in number, after `took`. A busy computer
    /// delays the master's notifications as much as its answers.
    pub fn master_answered(&mut self, took: Duration, calls: usize) {
        let per_call = took / u32::try_from(calls.max(1)).unwrap_or(u32::MAX);
        self.master_notifications.pace = per_call.max(self.master_notifications.pace * 7 / 8);
    }

    /// Notes that the master has not answered for a while, so the mirror answers. Until [`Self::late_answered`], the
    /// master's notifications make no progress either.
    pub fn master_is_late(&mut self, now: Instant) {
        self.is_late = true;
        self.master_notifications.pause(now);
    }

    /// Notes that the late master has answered its calls.
    pub fn late_answered(&mut self, now: Instant) {
        self.master_notifications.resume(now);
    }

    /// Notes that calls pass to the master again, or that the late master may be gone.
    pub fn lateness_is_over(&mut self) {
        (self.is_late, self.master_notifications.paused_since) = (false, None);
    }

    /// Whether the master, and not rosrescue, may notify nodes of what the mirror answers now: it is late, or is still
    /// being examined since it was, or it has not answered its calls. It may die before it sends these notifications.
    pub fn is_left_to_master(&self) -> bool {
        self.is_late || !self.in_flight.subjects.is_empty() || !self.unacknowledged.is_empty()
    }

    /// Whether the master is late, or is still being examined since it was.
    #[cfg(test)]
    fn is_late(&self) -> bool {
        self.is_late
    }

    /// Notes that the master has been away for a while, so it is taken for gone. Returns when to ask again if it was
    /// only late and may still be sending notifications.
    pub fn master_is_away(&mut self, now: Instant) -> Option<Instant> {
        let until = self
            .master_notifications
            .all_sent_by(now)
            .filter(|_| self.is_late);
        if until.is_none() {
            self.master_is_gone();
        }
        until
    }

    /// Notes that the master is gone and sends no more notifications.
    pub fn master_is_gone(&mut self) {
        (self.master_notifications, self.is_late) = Default::default();
    }

    /// Notes that notifications of an earlier process may still arrive until `until`. Nodes that are told something before
    /// then are told the state once more. That process may have recorded nothing of what it was sending.
    pub fn expect_earlier(&mut self, until: Instant) {
        self.earlier_until = Some(until);
    }

    /// Queues `call`, which a master would send now, for the node at `port`. If a master that is gone may already have
    /// run a write about `subject`, it may have sent something newer than `call`. In that case, the node is told the
    /// present state instead. If the master is only late and may still have notifications about `subject` to send, they
    /// come first: either the master then also sends the newer one, or the node is told the state.
    pub fn notify(&mut self, now: Instant, port: &str, subject: Subject, call: Arc<Call>) {
        let sending_until = self
            .master_notifications
            .sent_by(now, &subject)
            .filter(|_| self.is_late);
        if let Some(until) = sending_until {
            self.repeats.add(until, port.to_owned(), subject);
            return;
        }
        let is_news = !self.master_will_notify(&subject);
        let content = is_news.then_some(Payload::Call(call));
        self.outbox
            .add(port, subject, content.unwrap_or(Payload::State));
    }

    /// Queues a notification for the node at `port` with the state of `subject` at the time of sending.
    pub fn notify_of_state(&mut self, port: &str, subject: Subject) {
        self.outbox.add(port, subject, Payload::State);
    }

    /// Queues, at the time `at`, a notification for the node at `port` with the state of `subject` at the time of
    /// sending.
    pub fn notify_of_state_at(&mut self, at: Instant, port: &str, subject: Subject) {
        let thing = (subject.clone(), port.to_owned());
        self.repeats.last.insert(thing, at);
        self.repeats.add(at, port.to_owned(), subject);
    }

    /// The ports that have waiting notifications and need a task to send them.
    pub fn take_idle_ports(&mut self) -> Vec<String> {
        self.outbox.take_idle_ports()
    }

    /// What to do next about the notifications for the node at `port`.
    pub fn next_notification(
        &mut self,
        now: Instant,
        port: &str,
        mirror: &Master,
    ) -> NextNotification {
        self.under_way.forget(now);
        while let Some(subject) = self.outbox.first(port) {
            let answer = self.under_way.answer_to(now, port, subject);
            let written = match answer {
                Some(under_way::Answer::UnderWay { limit }) => {
                    self.awaited = true;
                    return NextNotification::Wait { until: limit };
                }
                Some(under_way::Answer::Written { at }) if now < at + LEAD => {
                    return NextNotification::Wait {
                        until: Some(at + LEAD),
                    };
                }
                Some(under_way::Answer::Written { .. }) => true,
                None => false,
            };
            let subject = subject.clone();
            let sending_until = self.master_notifications.sent_by(now, &subject);
            let may_be_notified_now = self.master_will_notify(&subject);
            let Some(notification) = self.outbox.pop(port) else {
                continue;
            };
            // The master may be notifying the node of the same subject. The slower of the two senders may send
            // something older, so the node is told the state again after both.
            if may_be_notified_now || sending_until.is_some() && notification.is_state() {
                let again = sending_until.unwrap_or(now + REPEAT_AFTER);
                self.repeats.add(again, port.to_owned(), subject);
                continue;
            }
            let is_repeat = notification.is_repeat();
            let Some(call) = self.outbox.call(port, notification, mirror) else {
                self.repeats.last.remove(&(subject, port.to_owned()));
                continue;
            };
            if written && !is_repeat || sending_until.is_some() {
                let again = now + REPEAT_AFTER;
                self.repeats.add(again, port.to_owned(), subject.clone());
            }
            if let Some(until) = self.earlier_until.filter(|until| now < *until) {
                self.notify_of_state_at(until, port, subject.clone());
            }
            self.repeats.sent(now, port, &subject);
            let recipient = Recipient {
                port: port.to_owned(),
                subject,
            };
            let limit = Some(now + NOTIFICATION_LIMIT);
            let kind = under_way::DeliveryKind::Notification;
            let number = self.under_way.add(kind, vec![recipient], limit);
            return NextNotification::Send { call, number };
        }
        self.outbox.remove(port);
        NextNotification::Idle
    }

    /// Notes that the node has taken the notification `number`, or that the notification could not be delivered. A node
    /// reads later notifications after one that it has taken. Returns whether a call or a notification waits for this
    /// one.
    pub fn notification_taken(&mut self, number: u64) -> bool {
        self.under_way.remove(number);
        std::mem::take(&mut self.awaited)
    }

    /// Notes that the notification `number` was given up before the node took it, because another computer may notify nodes
    /// now. If this one still does, the node is told the state. Returns whether a call or a notification waits for this one.
    pub fn notification_withdrawn(&mut self, number: u64) -> bool {
        for Recipient { port, subject } in self.under_way.remove(number) {
            self.notify_of_state(&port, subject);
        }
        std::mem::take(&mut self.awaited)
    }

    /// Drops all waiting notifications for the node at `port`.
    pub fn drop_port(&mut self, port: &str) {
        self.outbox.remove(port);
        let repeats = &mut self.repeats;
        let planned = &repeats.at.at;
        repeats
            .last
            .retain(|thing, _| thing.1 != port || planned.contains_key(thing));
    }

    /// Drops all waiting notifications. From now on another computer notifies nodes.
    pub fn forget_notifications(&mut self) {
        self.outbox.clear();
        (self.master_notifications, self.repeats) = Default::default();
    }

    /// Queues the notifications whose time has come: those that tell a state once more (see [`REPEAT_AFTER`]), and
    /// those of [`Self::notify_of_state_at`].
    pub fn queue_due_repeats(&mut self, now: Instant) {
        while let Some((_, (subject, port))) = self.repeats.at.take_due(now) {
            self.outbox.add(&port, subject, Payload::StateAgain);
        }
    }

    /// Whether [`Self::next_repeat`] has become earlier since the last call of this method.
    pub fn has_new_repeat(&mut self) -> bool {
        std::mem::take(&mut self.repeats.is_new)
    }

    /// When to call [`Self::queue_due_repeats`] next.
    pub fn next_repeat(&self) -> Option<Instant> {
        self.repeats.at.next()
    }

    /// Whether an answer to the node at `port` about `subject` is on its way, and until when to wait for it.
    pub fn answer_under_way(
        &mut self,
        now: Instant,
        port: &str,
        subject: &Subject,
    ) -> Option<MustWait> {
        match self.under_way.answer_to(now, port, subject)? {
            under_way::Answer::UnderWay { limit } => {
                self.awaited = true;
                Some(MustWait { until: limit })
            }
            under_way::Answer::Written { .. } => None,
        }
    }
}

/// The topics, parameters and names about which the master may still be notifying nodes.
#[derive(Debug, Default)]
struct MasterNotifications {
    /// For each [`Subject`], when the master will certainly have sent all notifications about it.
    sent_by: BySubject<Instant>,
    schedule: Schedule<Subject>,
    /// When the master is expected to have sent all notifications that it has begun.
    busy_until: Option<Instant>,
    /// How long the master recently took for a call.
    pace: Duration,
    /// Since when the master does not answer, so its notifications make no progress.
    paused_since: Option<Instant>,
}

impl MasterNotifications {
    fn pause(&mut self, now: Instant) {
        self.drop_sent(now);
        self.paused_since.get_or_insert(now);
    }

    /// Gives the master the time that it has lost since [`Self::pause`].
    fn resume(&mut self, now: Instant) {
        self.drop_sent(now);
        let Some(since) = self.paused_since.take() else {
            return;
        };
        let lost = now.duration_since(since).min(BACKLOG_MAX);
        self.busy_until = self.busy_until.map(|busy| busy + lost);
        for (subject, until) in std::mem::take(&mut self.schedule).at {
            self.sent_by.remove(&subject, until);
            self.sent_by.add(&subject, until + lost);
            self.schedule.set(subject, until + lost);
        }
    }

    /// Notes that the master has begun to notify `nodes` nodes of `subject`. Returns when the master will certainly
    /// have sent all these notifications.
    fn add(&mut self, now: Instant, subject: &Subject, nodes: usize) -> Instant {
        self.drop_sent(now);
        let takes = MASTER_TAKES.max(self.pace) * u32::try_from(nodes).unwrap_or(u32::MAX);
        let busy = self.busy_until.map_or(now, |busy| busy.max(now));
        let busy = (busy + takes.min(BACKLOG_MAX)).min(now + BACKLOG_MAX);
        self.busy_until = Some(busy);
        let until = busy + REPEAT_AFTER;
        if let Some(before) = self.schedule.set(subject.clone(), until) {
            self.sent_by.remove(subject, before);
        }
        self.sent_by.add(subject, until);
        until
    }

    fn sent_by(&mut self, now: Instant, subject: &Subject) -> Option<Instant> {
        self.drop_sent(now);
        let until = self.sent_by.about(subject).max()?;
        // How long the master stays stopped is not known.
        let again = self.paused_since.map(|_| now + REPEAT_AFTER);
        Some(again.map_or(until, |again| again.max(until)))
    }

    /// When the master will certainly have sent all notifications.
    fn all_sent_by(&mut self, now: Instant) -> Option<Instant> {
        self.drop_sent(now);
        self.schedule.queue.last().map(|(until, _)| *until)
    }

    fn drop_sent(&mut self, now: Instant) {
        // While the master is stopped, its time stands still, but not for ever.
        let now = self.paused_since.map_or(now, |since| {
            let earliest = now.checked_sub(BACKLOG_MAX);
            earliest.map_or(since, |earliest| earliest.max(since))
        });
        while let Some((until, subject)) = self.schedule.take_due(now) {
            self.sent_by.remove(&subject, until);
        }
    }
}

/// The repeats that are due: which node, named by its port, is told the state of which [`Subject`] once more, and when:
/// after the last moment at which it may read older notifications.
#[derive(Debug, Default)]
struct Repeats {
    at: Schedule<(Subject, String)>,
    /// Those that come after older notifications of another sender, which nothing that the master sends makes needless.
    /// The node is told the state at or after this time.
    last: BTreeMap<(Subject, String), Instant>,
    is_new: bool,
}

impl Repeats {
    fn add(&mut self, at: Instant, port: String, subject: Subject) {
        self.is_new |= self.at.next().is_none_or(|next| at < next);
        self.at.set((subject, port), at);
    }

    /// Notes that the node at `port` is told the state of `subject` now.
    fn sent(&mut self, now: Instant, port: &str, subject: &Subject) {
        let thing = (subject.clone(), port.to_owned());
        match self.last.get(&thing) {
            Some(last) if now < *last && !self.at.at.contains_key(&thing) => {
                self.add(*last, thing.1, thing.0);
            }
            Some(last) if now >= *last => drop(self.last.remove(&thing)),
            _ => {}
        }
    }

    /// The planned notifications about `subject`.
    fn about(&self, subject: &Subject) -> Vec<(Instant, (Subject, String))> {
        let from = (subject.clone(), String::new());
        let about = self.at.at.range(from..);
        let about = about.take_while(|((of, _), _)| of == subject);
        about.map(|(thing, at)| (*at, thing.clone())).collect()
    }

    /// Puts the planned notifications about `subject` off until the master has sent its own, at `until`.
    fn put_off(&mut self, subject: &Subject, until: Instant) {
        for (at, thing) in self.about(subject) {
            if let Some(last) = self.last.get_mut(&thing) {
                *last = until.max(*last);
            }
            self.at.set(thing, at.max(until));
        }
    }

    /// Drops the planned notifications about `subject` for nodes at ports other than `kept`, except those that must come
    /// last.
    fn drop_all_but(&mut self, subject: &Subject, kept: &HashSet<&str>) {
        for (at, thing) in self.about(subject) {
            if !kept.contains(thing.1.as_str()) && !self.last.contains_key(&thing) {
                self.at.at.remove(&thing);
                self.at.queue.remove(&(at, thing));
            }
        }
    }
}

/// Things to do, each with its time.
#[derive(Debug)]
struct Schedule<T> {
    at: BTreeMap<T, Instant>,
    queue: BTreeSet<(Instant, T)>,
}

impl<T> Default for Schedule<T> {
    fn default() -> Self {
        Self {
            at: BTreeMap::new(),
            queue: BTreeSet::new(),
        }
    }
}

impl<T: Clone + Ord> Schedule<T> {
    /// Sets the time of `thing`. Returns its previous time.
    fn set(&mut self, thing: T, at: Instant) -> Option<Instant> {
        let before = self.at.insert(thing.clone(), at);
        if let Some(before) = before {
            self.queue.remove(&(before, thing.clone()));
        }
        self.queue.insert((at, thing));
        before
    }

    fn take_due(&mut self, now: Instant) -> Option<(Instant, T)> {
        self.next().filter(|at| *at <= now)?;
        let (at, thing) = self.queue.pop_first()?;
        self.at.remove(&thing);
        Some((at, thing))
    }

    fn next(&self) -> Option<Instant> {
        self.queue.first().map(|(at, _)| *at)
    }
}

#[cfg(test)]
mod tests;
