//! Records the changes that other computers must get, and who changed what recently. Pure.

use std::{collections::VecDeque, sync::Arc};

use crate::{
    checkpoint::format::{self, Label, Record, RecordContent},
    cluster::{
        merge::{self, ChangeSubject, Changes, MergeVerdict},
        mutant::Mutant,
    },
};
use ros1_master::master::{Master, Request};

/// How many changes are remembered for computers that were cut off.
const RECENT_MOST: usize = 4096;
/// The approximate size limit of the remembered changes, in bytes.
const RECENT_BYTES_MOST: usize = 4 << 20;

/// The source of a recorded call.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Source {
    /// A node of this computer, or rosrescue itself.
    #[default]
    Here,
    /// Another computer, which repeats the call elsewhere if it gets no answer.
    Forwarded,
    /// A computer that was cut off and now sends its writes under this name.
    Merge(Arc<str>),
}

/// The latest changes, oldest first.
#[derive(Debug, Default)]
struct Recent {
    /// The list holds all changes after this record.
    after: u64,
    changes: VecDeque<(u64, Source, Vec<ChangeSubject>)>,
    bytes: usize,
}

impl Recent {
    /// Creates a list that is complete after record `seq`.
    fn from(seq: u64) -> Self {
        Self {
            after: seq,
            ..Self::default()
        }
    }

    fn add(&mut self, seq: u64, source: &Source, call: &Request) {
        let subjects: Vec<_> = call
            .calls()
            .into_iter()
            .flat_map(ChangeSubject::changed_by)
            .collect();
        self.bytes += bytes_of(&subjects);
        self.changes.push_back((seq, source.clone(), subjects));
        while (self.changes.len() > RECENT_MOST || self.bytes > RECENT_BYTES_MOST)
            && let Some((seq, _, subjects)) = self.changes.pop_front()
        {
            self.after = seq;
            self.bytes -= bytes_of(&subjects);
        }
    }

    /// The changes after record `seq`, except those that were sent under the name `merge`. `None` if the list does not
    /// reach back so far.
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

fn bytes_of(subjects: &[ChangeSubject]) -> usize {
    subjects.iter().map(ChangeSubject::size).sum()
}

/// A change that the other computers must get.
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
    /// The change's number in the journal.
    pub fn seq(&self) -> u64 {
        match self {
            Self::Call(record, _) => record.seq,
            Self::State { seq, .. } => *seq,
        }
    }
}

/// The changes that a computer records while it leads or is cut off, numbered as in the journal.
#[derive(Debug)]
pub struct Sharing {
    /// The number of the last recorded change.
    last: u64,
    changes: Vec<Change>,
    recent: Recent,
}

impl Sharing {
    /// Creates an empty list whose first record comes after `seq`.
    pub fn after(seq: u64) -> Self {
        Self {
            last: seq,
            changes: Vec::new(),
            recent: Recent::from(seq),
        }
    }

    /// The number of the last recorded change.
    pub fn last(&self) -> u64 {
        self.last
    }

    /// Records a call from `source`. A call that cannot be encoded is left out, as in the checkpoint.
    pub fn record(&mut self, call: &Request, source: &Source) {
        self.record_labelled(call, source, Label::default());
    }

    /// Like [`Self::record`], with the label of the call's record.
    pub fn record_labelled(&mut self, call: &Request, source: &Source, label: Label) {
        let record = Record {
            seq: self.last + 1,
            entry: RecordContent::labelled(call.clone(), label),
        };
        if format::push_record(&mut Vec::new(), &record).is_ok() {
            self.last += 1;
            self.recent.add(self.last, source, call);
            self.changes.push(Change::Call(record, source.clone()));
        }
    }

    /// Records that the state was replaced by `mirror`.
    pub fn record_state(&mut self, mirror: &Master) {
        self.last += 1;
        // A new state may differ in any part, so earlier changes say nothing.
        self.recent = Recent::from(self.last);
        let (seq, state) = (self.last, Box::new(mirror.clone()));
        self.changes.push(Change::State { seq, state });
    }

    /// Takes the changes recorded since they were last taken.
    pub fn take(&mut self) -> Vec<Change> {
        std::mem::take(&mut self.changes)
    }

    /// Takes the recorded changes as a single one: their result, which is `mirror`.
    pub fn take_as_state(&mut self, mirror: &Master) -> Change {
        self.changes.clear();
        let (seq, state) = (self.last, Box::new(mirror.clone()));
        Change::State { seq, state }
    }

    /// Decides what happens to the partition writes `calls` of a computer in the state `mirror`. That computer sends
    /// them under the name `merge`, and has taken the others' changes up to record `seq` into account.
    /// `None` if that computer must read the journal again and decide again: the changes after that record are no longer
    /// known, the record is of a journal that etcd has lost, or the same node has made a change. The leader before may
    /// have sent that change, and only the computer of the node knows whether it is an earlier write.
    pub fn merge_verdicts(
        &self,
        mirror: &Master,
        seq: u64,
        merge: &str,
        calls: &[&Request],
    ) -> Option<Vec<MergeVerdict>> {
        let changes = match Mutant::JudgesOnce.lives() {
            true => Changes::default(),
            false if seq > self.last => return None,
            false => self.recent.since(seq, merge)?,
        };
        let verdicts = calls.iter().map(|call| {
            match merge::judge_write(&changes, mirror, call) {
                // It sets the present value again, so that nodes are notified.
                MergeVerdict::Redundant if call.text(0) == Some(merge::TELLER) => {
                    Some(MergeVerdict::Apply)
                }
                MergeVerdict::Overtaken(lost) if changes.are_of_same_node(&lost) => None,
                verdict => Some(verdict),
            }
        });
        verdicts.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::{master::Method, xmlrpc::Value};

    fn set_of(key: &str, value: i32) -> Request {
        let params = [Value::from("/n"), key.into(), value.into()];
        Request::new(Method::SetParam, params)
    }

    /// A leader before may have sent what the node's computer had forwarded to it.
    #[test]
    fn whether_a_change_by_the_same_node_conflicts_is_left_to_its_computer() {
        let mut sharing = Sharing::after(3);
        let by = |node: &str, value: i32| {
            let params = [Value::from(node), "/a".into(), value.into()];
            Request::new(Method::SetParam, params)
        };
        sharing.record(&by("/n", 1), &Source::Merge("of the leader before".into()));
        let judge = |call: Request| {
            let verdicts = sharing.merge_verdicts(&Master::default(), 3, "mine", &[&call])?;
            let lost = matches!(verdicts.as_slice(), [MergeVerdict::Overtaken(_)]);
            Some(lost)
        };
        assert_eq!(judge(by("/n", 2)), None);
        assert_eq!(judge(by("/m", 2)), Some(true));
    }

    #[test]
    fn old_changes_are_forgotten() {
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
