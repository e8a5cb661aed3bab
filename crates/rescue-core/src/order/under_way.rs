//! Tracks answers and notifications on their way to nodes.

use std::{
    collections::{HashMap, VecDeque},
    time::Instant,
};

use super::{BySubject, Heard, MustWait, RECENT, Subject};

/// The answers and notifications on their way, by number, and the answers written recently.
#[derive(Debug, Default)]
pub(super) struct UnderWay {
    last: u64,
    entries: HashMap<u64, Entry>,
    by_subject: BySubject<u64>,
    /// Written answers, oldest first.
    written: VecDeque<(Instant, u64)>,
    /// The last written answer about each subject to each port. Earlier ones no longer count, so a node that makes many
    /// calls does not make each of them slower.
    newest: HashMap<Heard, u64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum DeliveryKind {
    Answer,
    Notification,
}

#[derive(Debug)]
struct Entry {
    kind: DeliveryKind,
    heard: Vec<Heard>,
    /// When calls and notifications stop waiting for this answer, or calls for this notification. `None` if there is no
    /// limit yet.
    limit: Option<Instant>,
    written: Option<Instant>,
}

impl Entry {
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
    /// Adds an answer or a notification about `heard`. `limit` is explained at [`Entry::limit`]. Returns its number.
    pub(super) fn add(
        &mut self,
        kind: DeliveryKind,
        heard: Vec<Heard>,
        limit: Option<Instant>,
    ) -> u64 {
        self.last += 1;
        for (index, one) in heard.iter().enumerate() {
            let mut before = heard.iter().take(index);
            if !before.any(|other| other.subject == one.subject) {
                self.by_subject.add(&one.subject, self.last);
            }
        }
        let entry = Entry {
            kind,
            heard,
            limit,
            written: None,
        };
        self.entries.insert(self.last, entry);
        self.last
    }

    pub(super) fn limit(&mut self, number: u64, limit: Instant) {
        if let Some(entry) = self.entries.get_mut(&number) {
            entry.limit = Some(limit);
        }
    }

    /// Notes that the answer has been written to its caller.
    pub(super) fn written(&mut self, now: Instant, number: u64) {
        let Some(entry) = self.entries.get_mut(&number) else {
            return;
        };
        entry.written = Some(now);
        self.written.push_back((now, number));
        for heard in entry.heard.clone() {
            if let Some(before) = self.newest.insert(heard.clone(), number)
                && before != number
            {
                self.leave_out(before, &heard);
            }
        }
    }

    /// Removes one of the things that an answer is about.
    fn leave_out(&mut self, number: u64, heard: &Heard) {
        let Some(entry) = self.entries.get_mut(&number) else {
            return;
        };
        entry.heard.retain(|other| other != heard);
        let mut others = entry.heard.iter();
        if !others.any(|other| other.subject == heard.subject) {
            self.by_subject.remove(&heard.subject, number);
        }
        if entry.heard.is_empty() {
            self.entries.remove(&number);
        }
    }

    /// Removes an answer or a notification.
    pub(super) fn remove(&mut self, number: u64) {
        for heard in self
            .entries
            .remove(&number)
            .into_iter()
            .flat_map(|entry| entry.heard)
        {
            self.by_subject.remove(&heard.subject, number);
            if self.newest.get(&heard) == Some(&number) {
                self.newest.remove(&heard);
            }
        }
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
        self.entries.values().find_map(|entry| entry.delays(now))
    }

    /// Whether a call about `subject` must wait for an answer or a notification on its way to a port other than `port`,
    /// and until when.
    pub(super) fn must_wait_for(
        &self,
        now: Instant,
        subject: &Subject,
        port: Option<&str>,
    ) -> Option<MustWait> {
        let mut entries = self.concerned(subject);
        entries.find_map(|(_, entry, heard)| match port == Some(&heard.port) {
            true => None,
            false => entry.delays(now),
        })
    }

    /// Numbers and ports of the answers and notifications about `subject` that are on their way, and of answers about
    /// it that were written recently.
    pub(super) fn about(&mut self, now: Instant, subject: &Subject) -> Vec<(u64, String)> {
        self.forget(now);
        self.concerned(subject)
            .map(|(number, _, heard)| (number, heard.port.clone()))
            .collect()
    }

    /// The last answer to the node at `port` about `subject`, if it is on its way or was written recently.
    pub(super) fn answer_to(&self, now: Instant, port: &str, subject: &Subject) -> Option<Answer> {
        let to_port = self
            .concerned(subject)
            .filter(|(_, entry, heard)| entry.kind == DeliveryKind::Answer && heard.port == port);
        let mut last = None;
        for (_, entry, _) in to_port {
            if let Some(MustWait { until }) = entry.delays(now) {
                return Some(Answer::UnderWay { limit: until });
            }
            last = last.max(entry.written);
        }
        last.map(|at| Answer::Written { at })
    }

    fn concerned<'a>(
        &'a self,
        subject: &'a Subject,
    ) -> impl Iterator<Item = (u64, &'a Entry, &'a Heard)> {
        let entries = self.by_subject.about(subject);
        let entries = entries.filter_map(|number| Some((number, self.entries.get(&number)?)));
        entries.flat_map(move |(number, entry)| {
            let heard = entry.heard.iter();
            let heard = heard.filter(|heard| heard.subject.concerns(subject));
            heard.map(move |heard| (number, entry, heard))
        })
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn heard(port: &str, topic: &str) -> Heard {
        Heard {
            port: port.to_owned(),
            subject: Subject::Topic(topic.to_owned()),
        }
    }

    /// The test's answers go to two ports and are about two topics.
    #[test]
    fn only_the_last_written_answer_to_a_port_about_a_subject_is_remembered() {
        let (mut under_way, start) = (UnderWay::default(), Instant::now());
        let both = vec![heard("a", "/t"), heard("b", "/t"), heard("a", "/u")];
        let first = under_way.add(DeliveryKind::Answer, both, None);
        let second = under_way.add(DeliveryKind::Answer, vec![heard("a", "/t")], None);
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
            let next = under_way.add(DeliveryKind::Answer, vec![heard("a", "/u")], None);
            under_way.written(later, next);
        }
        assert_eq!(under_way.entries.len(), 3);
        under_way.forget(later + RECENT);
        assert!(under_way.entries.is_empty() && under_way.newest.is_empty());
        assert!(under_way.by_subject.is_empty());
    }
}
