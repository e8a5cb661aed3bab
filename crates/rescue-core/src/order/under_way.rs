//! Tracks answers and notifications on their way to nodes.

use std::{
    collections::{HashMap, VecDeque},
    time::Instant,
};

use super::{BySubject, MustWait, RECENT, Recipient, Subject};

/// The answers and notifications on their way, by number, and the answers written recently.
#[derive(Debug, Default)]
pub(super) struct UnderWay {
    last: u64,
    deliveries: HashMap<u64, Delivery>,
    by_subject: BySubject<u64>,
    /// Written answers, oldest first.
    written: VecDeque<(Instant, u64)>,
    /// The last written answer about each subject to each port. Earlier ones no longer count, so a node that makes many
    /// calls does not make each of them slower.
    newest: HashMap<Recipient, u64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum DeliveryKind {
    Answer,
    Notification,
}

#[derive(Debug)]
struct Delivery {
    kind: DeliveryKind,
    recipients: Vec<Recipient>,
    /// When calls and notifications stop waiting for this answer, or calls for this notification. `None` if there is no
    /// limit yet.
    limit: Option<Instant>,
    written: Option<Instant>,
}

impl Delivery {
    /// Whether calls or notifications must wait for this answer or notification, and until when.
    fn delays(&self, now: Instant) -> Option<MustWait> {
        let delays = self.written.is_none() && self.limit.is_none_or(|limit| now < limit);
        delays.then_some(MustWait { until: self.limit })
    }
}

/// The state of the last answer to a node about a [`Subject`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Answer {
    /// The answer is on its way. Calls and notifications about the same [`Subject`] wait for it, but only until `limit`
    /// if that is set.
    UnderWay { limit: Option<Instant> },
    /// The answer was written at this time, less than [`RECENT`] ago.
    Written { at: Instant },
}

impl UnderWay {
    /// Adds an answer or a notification to `recipients`; for `limit` see [`Delivery::limit`]. Returns its number.
    pub(super) fn add(
        &mut self,
        kind: DeliveryKind,
        recipients: Vec<Recipient>,
        limit: Option<Instant>,
    ) -> u64 {
        self.last += 1;
        for (index, one) in recipients.iter().enumerate() {
            let mut before = recipients.iter().take(index);
            if !before.any(|other| other.subject == one.subject) {
                self.by_subject.add(&one.subject, self.last);
            }
        }
        let delivery = Delivery {
            kind,
            recipients,
            limit,
            written: None,
        };
        self.deliveries.insert(self.last, delivery);
        self.last
    }

    pub(super) fn limit(&mut self, number: u64, limit: Instant) {
        if let Some(delivery) = self.deliveries.get_mut(&number) {
            delivery.limit = Some(limit);
        }
    }

    /// Notes that the answer has been written to its caller. Returns its recipients if that was after its limit.
    pub(super) fn written(&mut self, now: Instant, number: u64) -> Vec<Recipient> {
        let Some(delivery) = self.deliveries.get_mut(&number) else {
            return Vec::new();
        };
        let is_overdue = delivery.delays(now).is_none();
        delivery.written = Some(now);
        self.written.push_back((now, number));
        let recipients = delivery.recipients.clone();
        for recipient in &recipients {
            if let Some(before) = self.newest.insert(recipient.clone(), number)
                && before != number
            {
                self.drop_recipient(before, recipient);
            }
        }
        if is_overdue { recipients } else { Vec::new() }
    }

    /// Removes a recipient of an answer.
    fn drop_recipient(&mut self, number: u64, recipient: &Recipient) {
        let Some(delivery) = self.deliveries.get_mut(&number) else {
            return;
        };
        delivery.recipients.retain(|other| other != recipient);
        let mut others = delivery.recipients.iter();
        if !others.any(|other| other.subject == recipient.subject) {
            self.by_subject.remove(&recipient.subject, number);
        }
        if delivery.recipients.is_empty() {
            self.deliveries.remove(&number);
        }
    }

    /// Removes an answer or a notification. Returns its recipients.
    pub(super) fn remove(&mut self, number: u64) -> Vec<Recipient> {
        let delivery = self.deliveries.remove(&number);
        let recipients = delivery.map_or_else(Vec::new, |delivery| delivery.recipients);
        for recipient in &recipients {
            self.by_subject.remove(&recipient.subject, number);
            if self.newest.get(recipient) == Some(&number) {
                self.newest.remove(recipient);
            }
        }
        recipients
    }

    /// Drops the answers that were written at least [`RECENT`] ago.
    pub(super) fn forget(&mut self, now: Instant) {
        while let Some((at, number)) = self.written.front()
            && now.duration_since(*at) >= RECENT
        {
            let number = *number;
            self.written.pop_front();
            self.remove(number);
        }
    }

    /// Whether a call that may change anything must wait for an answer or a notification on its way, and until when.
    pub(super) fn must_wait(&self, now: Instant) -> Option<MustWait> {
        self.deliveries
            .values()
            .find_map(|delivery| delivery.delays(now))
    }

    /// Whether a call about `subject` must wait for an answer or a notification on its way to a port other than `port`,
    /// and until when.
    pub(super) fn must_wait_for(
        &self,
        now: Instant,
        subject: &Subject,
        port: Option<&str>,
    ) -> Option<MustWait> {
        let mut deliveries = self.deliveries_about(subject);
        deliveries.find_map(
            |(_, delivery, recipient)| match port == Some(&recipient.port) {
                true => None,
                false => delivery.delays(now),
            },
        )
    }

    /// Numbers and ports of the answers and notifications about `subject` that are on their way, and of answers about
    /// it that were written recently.
    pub(super) fn about(&mut self, now: Instant, subject: &Subject) -> Vec<(u64, String)> {
        self.forget(now);
        self.deliveries_about(subject)
            .map(|(number, _, recipient)| (number, recipient.port.clone()))
            .collect()
    }

    /// The last answer to the node at `port` about `subject`, if it is on its way or was written recently.
    pub(super) fn answer_to(&self, now: Instant, port: &str, subject: &Subject) -> Option<Answer> {
        let to_port = self
            .deliveries_about(subject)
            .filter(|(_, delivery, recipient)| {
                delivery.kind == DeliveryKind::Answer && recipient.port == port
            });
        let mut last = None;
        for (_, delivery, _) in to_port {
            if let Some(MustWait { until }) = delivery.delays(now) {
                return Some(Answer::UnderWay { limit: until });
            }
            last = last.max(delivery.written);
        }
        last.map(|at| Answer::Written { at })
    }

    fn deliveries_about<'a>(
        &'a self,
        subject: &'a Subject,
    ) -> impl Iterator<Item = (u64, &'a Delivery, &'a Recipient)> {
        let deliveries = self.by_subject.about(subject);
        let deliveries =
            deliveries.filter_map(|number| Some((number, self.deliveries.get(&number)?)));
        deliveries.flat_map(move |(number, delivery)| {
            let recipients = delivery.recipients.iter();
            let recipients = recipients.filter(|recipient| recipient.subject.concerns(subject));
            recipients.map(move |recipient| (number, delivery, recipient))
        })
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn recipient(port: &str, topic: &str) -> Recipient {
        Recipient {
            port: port.to_owned(),
            subject: Subject::Topic(topic.to_owned()),
        }
    }

    /// The test's answers go to two ports and are about two topics.
    #[test]
    fn only_the_last_written_answer_to_a_port_about_a_subject_is_remembered() {
        let (mut under_way, start) = (UnderWay::default(), Instant::now());
        let both = vec![
            recipient("a", "/t"),
            recipient("b", "/t"),
            recipient("a", "/u"),
        ];
        let first = under_way.add(DeliveryKind::Answer, both, None);
        let second = under_way.add(DeliveryKind::Answer, vec![recipient("a", "/t")], None);
        let later = start + Duration::from_millis(1);
        under_way.written(start, first);
        under_way.written(later, second);
        let topic = Subject::Topic("/t".to_owned());
        let mut about = under_way.about(later, &topic);
        about.sort();
        assert_eq!(about, [(first, "b".to_owned()), (second, "a".to_owned())]);
        let to = |port| under_way.answer_to(later, port, &topic);
        assert_eq!(to("a"), Some(Answer::Written { at: later }));
        assert_eq!(to("b"), Some(Answer::Written { at: start }));
        for _ in 0..1_000 {
            let next = under_way.add(DeliveryKind::Answer, vec![recipient("a", "/u")], None);
            under_way.written(later, next);
        }
        assert_eq!(under_way.deliveries.len(), 3);
        under_way.forget(later + RECENT);
        assert!(under_way.deliveries.is_empty() && under_way.newest.is_empty());
        assert!(under_way.by_subject.is_empty());
    }
}
