//! Keeps this computer's partition writes until a leader has them. Pure; `app/cluster` also stores them beside the
//! checkpoint.

use std::collections::VecDeque;

use crate::{
    checkpoint::format::{Record, RecordContent},
    cluster::{
        member::PartitionWrites,
        merge::{self, Changes, WritesToSend},
        mutant::Mutant,
        sharing::{Change, Source},
    },
};
use ros1_master::master::{Master, Request};

/// How many partitions are kept apart.
const PARTITIONS_MOST: usize = 8;
/// How many writes of one partition can be recognised when they appear in the journal.
const EXPECTED_MOST: usize = 4_000;

/// One partition.
#[derive(Clone, Debug)]
pub struct Partition {
    /// The state when this computer was cut off.
    pub base: Master,
    /// The writes answered since this computer was cut off.
    pub pending: WritesToSend,
    /// The other computers' changes since this computer was cut off.
    pub changes: Changes,
    /// How many of the writes may also be in the journal.
    expected: usize,
}

impl Partition {
    fn new(base: Master) -> Self {
        Self {
            base,
            pending: WritesToSend::default(),
            changes: Changes::default(),
            expected: 0,
        }
    }
}

/// The partitions whose writes have not all reached a leader, oldest first.
#[derive(Clone, Debug, Default)]
pub struct CutOff {
    partitions: VecDeque<Partition>,
}

impl CutOff {
    /// Restores what an earlier process left.
    pub fn restored(left: PartitionWrites) -> Self {
        let mut partition = Partition::new(left.base);
        for call in left.calls {
            if Mutant::GuessesByValues.lives() {
                partition.changes.expect([call.clone()]);
            }
            partition.pending.add(&call);
        }
        Self {
            partitions: VecDeque::from([partition]),
        }
    }

    /// Notes that an earlier process has seen `state`. What differs there, except by this computer's own writes, was
    /// changed by others.
    pub fn note_seen(&mut self, state: &Master) {
        for partition in &mut self.partitions {
            let mut seen = Changes::default();
            seen.expect(partition.pending.calls().cloned());
            seen.note_difference(&partition.base, state);
            partition.changes.add_all(&seen);
        }
    }

    /// Whether a leader has all partition writes.
    pub fn is_empty(&self) -> bool {
        self.partitions.is_empty()
    }

    /// Whether the writes of all partitions but the present one have reached a leader.
    pub fn is_last_partition(&self) -> bool {
        self.partitions.len() == 1
    }

    /// Begins a partition, in the state `base`.
    pub fn begin(&mut self, base: Master) {
        // The writes of earlier partitions may still be on their way.
        let earlier: Vec<_> = self.calls().cloned().collect();
        let is_empty = self
            .partitions
            .back()
            .is_some_and(|last| last.pending.is_empty());
        if is_empty && self.partitions.len() > 1 {
            self.partitions.pop_back();
        }
        // The oldest partition stays, because its writes may be on their way. The next two become one.
        if self.partitions.len() >= PARTITIONS_MOST
            && let Some(second) = self.partitions.remove(2)
            && let Some(first) = self.partitions.get_mut(1)
        {
            // The others' changes since the first of the two count for both.
            second
                .pending
                .calls()
                .for_each(|call| first.pending.add(call));
        }
        let mut partition = Partition::new(base);
        partition.changes.expect(earlier);
        self.partitions.push_back(partition);
    }

    /// Notes that the other computers may make these calls of this computer. The calls do not count as their changes.
    pub fn expect(&mut self, calls: impl IntoIterator<Item = Request>) {
        if let Some(partition) = self.partitions.back_mut() {
            partition.changes.expect(calls);
        }
    }

    /// Notes that the leader may make these calls of this computer. They do not count as others' changes in any partition.
    pub fn expect_in_all(&mut self, calls: &[Request]) {
        for partition in &mut self.partitions {
            partition.changes.expect(calls.iter().cloned());
        }
    }

    /// Notes new records of the journal. They count as others' changes, unless they were expected.
    pub fn note(&mut self, records: &[Record]) {
        for partition in &mut self.partitions {
            for record in records {
                if let RecordContent::Call { call, .. } = &record.entry {
                    partition.changes.note(record.seq, call);
                }
            }
        }
    }

    /// Notes that the journal's state changed from `was` to `is`, without the records in between. `None` stands for
    /// the state when this computer was cut off.
    pub fn note_difference(&mut self, was: Option<&Master>, is: &Master) {
        for partition in &mut self.partitions {
            let was = was.unwrap_or(&partition.base);
            partition.changes.note_difference(was, is);
        }
    }

    /// Returns the others' `state`, changed by those partition writes that conflict with no change by others.
    pub fn on(&self, state: &Master) -> Master {
        let mut state = state.clone();
        for partition in &self.partitions {
            for call in merge::merge(&partition.changes, &state, partition.pending.calls()).send {
                state.apply_telling(&call, &mut ());
            }
        }
        state
    }

    /// Keeps partition writes. `given` says whether they may also get into the journal. Returns the writes.
    pub fn add<'a>(
        &mut self,
        changes: impl IntoIterator<Item = &'a Change>,
        given: bool,
    ) -> Vec<Request> {
        let Some(partition) = self.partitions.back_mut() else {
            return Vec::new();
        };
        let mut calls = Vec::new();
        for change in changes {
            // A whole state comes from a master, not from a node.
            let Change::Call(record, source) = change else {
                continue;
            };
            let RecordContent::Call { call, .. } = &record.entry else {
                continue;
            };
            // No node wrote a value that a merge sets again.
            if call.caller() == Some(merge::TELLER) {
                continue;
            }
            // No more writes than this can be on their way to etcd at once.
            if given && partition.expected < EXPECTED_MOST {
                partition.expected += 1;
                partition.changes.expect_record(record.seq, call.clone());
            }
            if *source == Source::Forwarded {
                partition.changes.note_forwarded(call);
            }
            partition.pending.add(call);
            calls.push(call.clone());
        }
        calls
    }

    /// The state at the beginning of the oldest partition.
    pub fn base(&self) -> Option<&Master> {
        self.partitions.front().map(|partition| &partition.base)
    }

    /// All partition writes, in the order in which they were answered.
    pub fn calls(&self) -> impl Iterator<Item = &Request> {
        self.partitions
            .iter()
            .flat_map(|partition| partition.pending.calls())
    }

    /// How many writes are kept.
    pub fn len(&self) -> usize {
        self.partitions
            .iter()
            .map(|partition| partition.pending.len())
            .sum()
    }

    /// The oldest partition whose writes have not all reached a leader.
    pub fn first_mut(&mut self) -> Option<&mut Partition> {
        self.partitions.front_mut()
    }

    /// Drops the oldest partition: its writes have reached the leader, or are lost and reported.
    pub fn sent(&mut self) {
        self.partitions.pop_front();
    }

    /// Drops the present partition: its writes are in the journal after all.
    pub fn resumed(&mut self) {
        self.partitions.pop_back();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::{master::Method, xmlrpc::Value};

    fn set(key: &str, value: i32) -> Request {
        let params = [Value::from("/n"), key.into(), value.into()];
        Request::new(Method::SetParam, params)
    }

    fn record(seq: u64, call: Request) -> Record {
        let entry = RecordContent::call(call);
        Record { seq, entry }
    }

    fn change(seq: u64, call: Request) -> Change {
        Change::Call(record(seq, call), Source::Here)
    }

    fn calls_of(partition: &Partition) -> Vec<Request> {
        partition.pending.calls().cloned().collect()
    }

    fn first(cut_off: &CutOff) -> Vec<Request> {
        cut_off.partitions.front().map(calls_of).unwrap_or_default()
    }

    fn base() -> Master {
        let mut base = Master::default();
        base.apply(&set("/before", 1));
        base
    }

    fn begun() -> CutOff {
        let mut cut_off = CutOff::default();
        cut_off.begin(base());
        cut_off
    }

    #[test]
    fn a_partition_that_ends_without_loss_keeps_the_writes_of_the_one_before() {
        let mut cut_off = begun();
        cut_off.add(&[change(5, set("/a", 1))], false);
        cut_off.begin(base());
        cut_off.add(&[change(6, set("/b", 2))], false);
        // etcd has the second partition's write after all.
        cut_off.resumed();
        assert_eq!(first(&cut_off), [set("/a", 1)]);
        cut_off.resumed();
        assert!(cut_off.is_empty());
    }

    /// The leader made the first partition's write twice, because its first answer was lost.
    #[test]
    fn a_write_that_is_sent_again_is_no_change_of_others_in_later_partitions() {
        let mut cut_off = begun();
        cut_off.add(&[change(5, set("/count", 1))], false);
        cut_off.begin(base());
        cut_off.add(&[change(6, set("/count", 2))], false);
        cut_off.expect_in_all(&[set("/count", 1)]);
        cut_off.note(&[record(7, set("/count", 1))]);
        cut_off.note(&[record(8, set("/count", 1))]);
        for partition in &cut_off.partitions {
            let merged = merge::merge(&partition.changes, &base(), partition.pending.calls());
            assert!(merged.lost.is_empty(), "{:?}", merged.lost);
        }
        // The same call by another node is a change.
        let of_another = Request::new(
            Method::SetParam,
            [Value::from("/m"), "/count".into(), 1.into()],
        );
        cut_off.note(&[record(9, of_another)]);
        let last = cut_off.partitions.back().unwrap();
        let merged = merge::merge(&last.changes, &base(), last.pending.calls());
        assert_eq!(merged.lost.len(), 1);
    }

    /// The first partition's writes are on their way when the second begins.
    #[test]
    fn the_second_of_two_partitions_continues_from_the_first() {
        let others = base();
        let mut cut_off = begun();
        cut_off.add(&[change(5, set("/count", 1))], false);
        let second = cut_off.on(&others);
        assert_eq!(second.params().get("count"), Some(&1.into()));
        cut_off.begin(second);
        cut_off.add(&[change(6, set("/count", 2))], false);
        // The others get the first partition's write.
        let merged = |cut_off: &CutOff, others: &Master| {
            let first = cut_off.partitions.front().unwrap();
            merge::merge(&first.changes, others, first.pending.calls())
        };
        assert_eq!(merged(&cut_off, &others).send, [set("/count", 1)]);
        let mut others = others;
        others.apply(&set("/count", 1));
        cut_off.note(&[record(7, set("/count", 1))]);
        cut_off.sent();
        let second = merged(&cut_off, &others);
        assert_eq!((second.send, second.lost), (vec![set("/count", 2)], vec![]));
        cut_off.sent();
        assert!(cut_off.is_empty());
    }

    #[test]
    fn a_network_that_comes_and_goes_piles_up_no_times() {
        let mut cut_off = begun();
        for value in 0..50 {
            cut_off.begin(base());
            cut_off.begin(base());
            cut_off.add(&[change(5, set("/a", value))], false);
        }
        assert!(cut_off.partitions.len() <= PARTITIONS_MOST);
        let last = cut_off.partitions.back().unwrap();
        assert_eq!(calls_of(last), [set("/a", 49)]);
        // The last partition's write is in the journal after all.
        cut_off.resumed();
        assert_eq!(first(&cut_off), []);
        assert_eq!(
            calls_of(cut_off.partitions.back().unwrap()),
            [set("/a", 48)]
        );
    }
}
