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
        for heard in &heard {
            self.by_subject.add(&heard.subject, self.last);
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
        if let Some(entry) = self.entries.get_mut(&number) {
            entry.written = Some(now);
            self.written.push_back((now, number));
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
        self.by_subject.about(subject).filter_map(move |number| {
            let entry = self.entries.get(&number)?;
            let mut heard = entry.heard.iter();
            let heard = heard.find(|heard| heard.subject.concerns(subject))?;
            Some((number, entry, heard))
        })
    }
}
