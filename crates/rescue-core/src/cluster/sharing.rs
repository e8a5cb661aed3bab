//! What a computer that has the master gives to the others, and who has changed what lately. Pure.

use std::{collections::VecDeque, sync::Arc};

use crate::{
    checkpoint::format::{self, Entry, Record},
    cluster::{
        merge::{self, Changes, Subject, Verdict},
        mutant::Mutant,
    },
    master::{Master, Request},
};

/// Most changes that are remembered for computers that were alone.
const RECENT_MOST: usize = 4096;
/// And their most bytes, about.
const RECENT_BYTES_MOST: usize = 4 << 20;

/// Where a call that is recorded comes from.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Source {
    /// A node of this computer, or rosrescue itself.
    #[default]
    Here,
    /// Another computer, which makes it again elsewhere if it gets no answer.
    Forwarded,
    /// A computer that was alone sends what was answered there, all under this name.
    Merge(Arc<str>),
}

/// What was changed lately, the oldest first.
#[derive(Debug, Default)]
struct Recent {
    /// All changes after this record are here.
    after: u64,
    changes: VecDeque<(u64, Source, Vec<Subject>)>,
    bytes: usize,
}

impl Recent {
    /// All changes after record `seq` will be here.
    fn from(seq: u64) -> Self {
        Self {
            after: seq,
            ..Self::default()
        }
    }

    fn add(&mut self, seq: u64, source: &Source, call: &Request) {
        let subjects: Vec<_> = call.calls().into_iter().flat_map(Subject::of).collect();
        self.bytes += bytes_of(&subjects);
        self.changes.push_back((seq, source.clone(), subjects));
        while (self.changes.len() > RECENT_MOST || self.bytes > RECENT_BYTES_MOST)
            && let Some((seq, _, subjects)) = self.changes.pop_front()
        {
            self.after = seq;
            self.bytes -= bytes_of(&subjects);
        }
    }

    /// What was changed after record `seq`, and not by `merge`. None if that is not known any more.
    fn since(&self, seq: u64, merge: &str) -> Option<Changes> {
        if seq < self.after {
            return None;
        }
        let later = self.changes.iter().filter(|(of, ..)| *of > seq);
        let theirs = later
            .filter(|(_, source, _)| !matches!(source, Source::Merge(name) if **name == *merge));
        let mut changes = Changes::default();
        for subject in theirs.flat_map(|(.., subjects)| subjects) {
            changes.add(subject.clone());
        }
        Some(changes)
    }
}

fn bytes_of(subjects: &[Subject]) -> usize {
    subjects.iter().map(Subject::size).sum()
}

/// A change to be given to the other computers.
#[derive(Clone, Debug)]
pub enum Change {
    Call(Record, Source),
    /// The state was replaced as a whole by record `seq`.
    State {
        seq: u64,
        state: Box<Master>,
    },
}

impl Change {
    /// Its number in the journal of all computers.
    pub fn seq(&self) -> u64 {
        match self {
            Self::Call(record, _) => record.seq,
            Self::State { seq, .. } => *seq,
        }
    }
}

/// What a computer records while it has the master, or answers alone, with numbers of the journal of all
/// computers.
#[derive(Debug)]
pub struct Sharing {
    /// The number of the last record.
    last: u64,
    changes: Vec<Change>,
    recent: Recent,
}

impl Sharing {
    /// The first record has a number after `seq`.
    pub fn after(seq: u64) -> Self {
        Self {
            last: seq,
            changes: Vec::new(),
            recent: Recent::from(seq),
        }
    }

    /// The number of the last record.
    pub fn last(&self) -> u64 {
        self.last
    }

    /// A call of `source` was recorded. One that cannot be written is left out, as in the checkpoint.
    pub fn record(&mut self, call: &Request, source: &Source) {
        let record = Record {
            seq: self.last + 1,
            entry: Entry::call(call.clone().into()),
        };
        if format::push_record(&mut Vec::new(), &record).is_ok() {
            self.last += 1;
            self.recent.add(self.last, source, call);
            self.changes.push(Change::Call(record, source.clone()));
        }
    }

    /// The state has changed otherwise than by calls, to `mirror`.
    pub fn record_state(&mut self, mirror: &Master) {
        self.last += 1;
        // Anything may have changed.
        self.recent = Recent::from(self.last);
        let (seq, state) = (self.last, Box::new(mirror.clone()));
        self.changes.push(Change::State { seq, state });
    }

    /// What is to be given to the others, once.
    pub fn take(&mut self) -> Vec<Change> {
        std::mem::take(&mut self.changes)
    }

    /// The same as one change: the state that they have led to, which is `mirror`.
    pub fn take_as_state(&mut self, mirror: &Master) -> Change {
        self.changes.clear();
        let (seq, state) = (self.last, Box::new(mirror.clone()));
        Change::State { seq, state }
    }

    /// What becomes of `calls`, which a computer has answered while it was alone, if they are made now, in the
    /// state `mirror`. It sends them under the name `merge`, and knows what others have changed up to record
    /// `seq`. None if the changes after that are not known any more.
    pub fn judge(
        &self,
        mirror: &Master,
        seq: u64,
        merge: &str,
        calls: &[&Request],
    ) -> Option<Vec<Verdict>> {
        let changes = match Mutant::JudgesOnce.lives() {
            true => Changes::default(),
            false => self.recent.since(seq, merge)?,
        };
        let calls = calls.iter();
        Some(
            calls
                .map(|call| merge::judge(&changes, mirror, call))
                .collect(),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{master::Method, xmlrpc::Value};

    fn set_of(key: &str, value: i32) -> Request {
        let params = [Value::from("/n"), key.into(), value.into()];
        Request::new(Method::SetParam, params)
    }

    #[test]
    fn what_was_changed_long_ago_is_not_known_any_more() {
        let mut recent = Recent::from(3);
        for seq in 4..=u64::try_from(RECENT_MOST).unwrap() + 13 {
            recent.add(seq, &Source::Here, &set_of("/a", 1));
        }
        assert!(recent.since(12, "mine").is_none());
        assert!(recent.since(13, "mine").is_some());
        let key = "k".repeat(RECENT_BYTES_MOST);
        recent.add(9_000, &Source::Here, &set_of(&key, 1));
        assert!(recent.since(8_999, "mine").is_none() && recent.changes.is_empty());
        assert_eq!(recent.bytes, 0);
    }
}
