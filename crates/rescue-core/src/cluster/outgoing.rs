//! Changes of this computer that may not be in the journal yet. Pure.

use std::collections::VecDeque;

use crate::{
    checkpoint::format::{self, Checkpoint, Record, RecordContent},
    cluster::{
        journal::{self, JournalError, Keys, Put, weight},
        member::WatchedEntry,
        sharing::{Change, Source},
    },
};
use ros1_master::master::{CALLER_ID, Master, Method, Request};

/// How many changes may be on their way to etcd at once.
const FIRST: usize = journal::BATCH_RECORDS;
/// The approximate size limit of the changes after the [`FIRST`] ones while this computer is cut off, in bytes.
const BYTES_MOST: usize = 16 << 20;

/// The changes of this computer that may not be in the journal yet, in the order of their numbers.
#[derive(Debug, Default)]
pub struct Outgoing {
    changes: VecDeque<Change>,
    /// The number of the last change whose journal entry may be written.
    ready: u64,
    /// The last change whose parts are all in etcd.
    written: u64,
    /// The last change whose call was answered.
    pub acknowledged: u64,
    /// The number of the job that is writing the parts of the next change.
    preparing: Option<u64>,
    /// How many such jobs there have been. The result of an earlier one may still come.
    prepares: u64,
}

impl Outgoing {
    /// Drops all changes. The next change has a number after `seq`.
    pub fn start(&mut self, seq: u64) {
        *self = Self {
            ready: seq,
            written: seq,
            acknowledged: seq,
            prepares: self.prepares,
            ..Self::default()
        };
    }

    pub fn add(&mut self, changes: impl IntoIterator<Item = Change>) {
        self.changes.extend(changes);
    }

    /// How many changes etcd's journal does not have yet.
    pub fn count(&self) -> usize {
        self.changes.len()
    }

    pub fn changes(&self) -> impl Iterator<Item = &Change> {
        self.changes.iter()
    }

    /// Keeps those of the next `entries` of the journal that this computer has added. What follows its last change is kept,
    /// too.
    pub fn retain_own(&self, entries: &mut Vec<(u64, WatchedEntry)>) {
        let mut own = self.changes.iter();
        let mut is_own = |record: &Record| match own.next() {
            Some(Change::Call(own, _)) => own == record,
            Some(Change::State { .. }) => false,
            None => true,
        };
        let others = entries.iter().position(|(_, entry)| match entry {
            WatchedEntry::Records { records, .. } => !records.iter().all(&mut is_own),
            WatchedEntry::Apart(_) => true,
        });
        entries.truncate(others.unwrap_or(entries.len()));
    }

    /// The number of the last change, or 0.
    pub fn last(&self) -> u64 {
        self.changes.back().map_or(0, Change::seq)
    }

    /// Applies the changes after number `seq` to `state`.
    pub fn apply_after(&self, seq: u64, state: &mut Master) {
        for change in self.changes.iter().filter(|of| of.seq() > seq) {
            match change {
                Change::Call(record, _) => {
                    if let RecordContent::Call { call, .. } = &record.entry {
                        state.apply_telling(call, &mut ());
                    }
                }
                Change::State { state: whole, .. } => *state = (**whole).clone(),
            }
        }
    }

    /// Drops all changes.
    pub fn forget(&mut self) {
        self.changes.clear();
    }

    /// Whether so many changes have piled up that the whole state should replace the later ones.
    pub fn has_outgrown(&self) -> bool {
        let later = self.changes.iter().skip(FIRST);
        self.changes.len() > 2 * FIRST || later.map(weight_of).sum::<usize>() > BYTES_MOST
    }

    /// Replaces all changes but the first ones, which may be on their way to etcd, by the state `rest`.
    pub fn replace_rest(&mut self, rest: Option<Change>) {
        if let Some(rest) = rest {
            self.changes.truncate(FIRST);
            self.changes.push_back(rest);
        }
    }

    /// The number of the last change whose journal entry may be written. The parts of a large change must be written
    /// before its entry.
    pub fn ready(&self) -> u64 {
        self.ready
    }

    /// Notes that the parts of the next change are being written. Returns the number of that job.
    pub fn begin_prepare(&mut self) -> u64 {
        self.prepares += 1;
        self.preparing = Some(self.prepares);
        self.prepares
    }

    /// Notes that the job `number` has ended. False if what it wrote is no longer the next change.
    pub fn end_prepare(&mut self, number: u64) -> bool {
        self.preparing.take_if(|it| *it == number).is_some()
    }

    /// Raises [`Self::ready()`] to the last change without writing parts, because this computer is cut off.
    pub fn all_ready(&mut self) {
        self.preparing = None;
        self.ready = self.changes.back().map_or(self.ready, Change::seq);
    }

    /// Raises [`Self::ready()`] to the last change before a large one, and returns the parts of the large one, which
    /// must be written first.
    pub fn prepare(&mut self, keys: &Keys) -> Result<Option<Vec<Put>>, JournalError> {
        if self.preparing.is_some() {
            return Ok(None);
        }
        for change in &self.changes {
            if change.seq() <= self.ready {
                continue;
            }
            let parts = parts(keys, change)?;
            if !parts.is_empty() {
                return Ok(Some(parts));
            }
            self.ready = change.seq();
            self.written = self.ready;
        }
        Ok(None)
    }

    /// Notes that the parts of the change after [`Self::ready()`] have been written.
    pub fn prepared(&mut self) {
        let next = self.changes.iter().find(|of| of.seq() > self.ready);
        self.ready = next.map_or(self.ready, Change::seq);
        self.written = self.ready;
    }

    /// Replaces the change after [`Self::ready()`], which cannot be written, by a call that changes nothing.
    pub fn leave_out_next(&mut self) {
        let ready = self.ready;
        if let Some(next) = self.changes.iter_mut().find(|of| of.seq() > ready) {
            let (seq, entry) = (next.seq(), RecordContent::call(no_change()));
            *next = Change::Call(Record { seq, entry }, Source::Here);
        }
    }

    /// The parts that the journal entry of the next heartbeat needs and that are not in etcd, because the change was
    /// recorded while this computer was cut off.
    pub fn missing_parts(&self, keys: &Keys) -> Vec<Put> {
        let first = self.changes.front().filter(|of| of.seq() > self.written);
        let parts = first.map(|change| parts(keys, change));
        parts.and_then(Result::ok).unwrap_or_default()
    }

    /// The journal entry that the next heartbeat adds, with the changes up to `seq`.
    pub fn entry(&self, keys: &Keys, seq: u64) -> Result<Option<Put>, JournalError> {
        if let Some(first @ Change::State { .. }) =
            self.changes.front().filter(|of| of.seq() <= seq)
        {
            return Ok(Some(state(keys, first)?.1));
        }
        let records = self.changes.iter().map_while(|change| match change {
            Change::Call(record, _) if record.seq <= seq => Some(record.clone()),
            _ => None,
        });
        Ok(journal::pack(keys, &records.collect::<Vec<_>>())?.entry)
    }

    /// Removes and returns all changes.
    pub fn take_all(&mut self) -> Vec<Change> {
        self.preparing = None;
        self.changes.drain(..).collect()
    }

    /// Removes and returns the changes up to `seq`, which are in the journal.
    pub fn committed(&mut self, seq: u64) -> Vec<Change> {
        let count = self.changes.iter().take_while(|of| of.seq() <= seq).count();
        self.ready = self.ready.max(seq);
        self.written = self.written.max(seq);
        self.changes.drain(..count).collect()
    }
}

/// A call that changes nothing.
fn no_change() -> Request {
    Request::new(Method::GetPid, [CALLER_ID])
}

fn parts(keys: &Keys, change: &Change) -> Result<Vec<Put>, JournalError> {
    match change {
        Change::Call(record, _) => journal::parts(keys, record),
        Change::State { .. } => Ok(state(keys, change)?.0),
    }
}

/// The approximate size of a change in bytes.
fn weight_of(change: &Change) -> usize {
    match change {
        Change::Call(record, _) => weight(record),
        // A state does not count, because replacing it by a state would save nothing.
        Change::State { .. } => 0,
    }
}

/// The parts and the entry of a change of the whole state.
fn state(keys: &Keys, change: &Change) -> Result<(Vec<Put>, Put), JournalError> {
    let snapshot = match change {
        Change::State { state, .. } => state.snapshot(),
        Change::Call(..) => Default::default(),
    };
    let checkpoint = Checkpoint {
        seq: change.seq(),
        snapshot,
        ..Checkpoint::default()
    };
    let encoded = format::encode_checkpoint(&checkpoint, 1)?;
    Ok(journal::state(keys, change.seq(), &encoded.bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cluster::journal::Manifest;

    fn call(seq: u64, bytes: usize) -> Change {
        let value = "x".repeat(bytes);
        let call = Request::new(Method::SetParam, ["/n", "/p", value.as_str()]);
        let entry = RecordContent::call(call);
        Change::Call(Record { seq, entry }, Source::Here)
    }

    fn state(seq: u64) -> Change {
        let state = Box::new(Master::default());
        Change::State { seq, state }
    }

    fn outgoing(changes: impl IntoIterator<Item = Change>) -> (Outgoing, Keys) {
        let mut outgoing = Outgoing::default();
        outgoing.start(4);
        outgoing.add(changes);
        (outgoing, Keys::new("robot"))
    }

    fn seqs(changes: &[Change]) -> Vec<u64> {
        changes.iter().map(Change::seq).collect()
    }

    /// The numbers of the records that the next heartbeat adds to the journal.
    fn added(outgoing: &Outgoing, keys: &Keys, seq: u64) -> Vec<u64> {
        let entry = outgoing.entry(keys, seq).unwrap();
        let records = entry.map(|put| journal::decode_records(&put.key, &put.value).unwrap());
        let records = records.into_iter().flatten();
        records.map(|record| record.seq).collect()
    }

    const LARGE: usize = journal::BATCH_BYTES + 1;

    #[test]
    fn small_calls_are_ready_at_once_and_leave_when_they_are_in_the_journal() {
        let (mut outgoing, keys) = outgoing([5, 6, 7].map(|seq| call(seq, 1)));
        assert_eq!(outgoing.ready(), 4);
        assert!(outgoing.prepare(&keys).unwrap().is_none());
        assert_eq!(outgoing.ready(), 7);
        assert_eq!(added(&outgoing, &keys, 6), [5, 6]);
        assert_eq!(seqs(&outgoing.committed(6)), [5, 6]);
        assert_eq!(added(&outgoing, &keys, 7), [7]);
        assert_eq!(seqs(&outgoing.take_all()), [7]);
        assert_eq!(outgoing.count(), 0);
    }

    #[test]
    fn a_large_call_is_ready_when_its_parts_are_in_etcd_and_holds_up_those_behind_it() {
        let (mut outgoing, keys) = outgoing([call(5, 1), call(6, LARGE), call(7, 1)]);
        let parts = outgoing.prepare(&keys).unwrap().unwrap();
        assert_eq!((outgoing.ready(), parts.len()), (5, 1));
        let job = outgoing.begin_prepare();
        // Only one change is prepared at a time.
        assert!(outgoing.prepare(&keys).unwrap().is_none());
        assert_eq!(outgoing.ready(), 5);
        assert!(outgoing.end_prepare(job));
        // The parts were not written, so they are returned again.
        assert_eq!(outgoing.prepare(&keys).unwrap(), Some(parts));
        outgoing.prepared();
        assert_eq!(outgoing.ready(), 6);
        assert!(outgoing.prepare(&keys).unwrap().is_none());
        assert_eq!(outgoing.ready(), 7);
        outgoing.committed(5);
        let entry = outgoing.entry(&keys, 7).unwrap().unwrap();
        assert_eq!(entry.key, keys.journal(6));
        assert!(Manifest::read(&entry.value).is_some());
        assert_eq!(outgoing.missing_parts(&keys), []);
    }

    #[test]
    fn what_became_ready_alone_has_its_parts_written_with_the_beat() {
        let (mut outgoing, keys) = outgoing([call(5, 1), call(6, LARGE), call(7, 1)]);
        let job = outgoing.begin_prepare();
        outgoing.all_ready();
        assert!(!outgoing.end_prepare(job));
        assert_eq!(outgoing.ready(), 7);
        assert_eq!(outgoing.missing_parts(&keys), []);
        outgoing.committed(5);
        assert_eq!(outgoing.missing_parts(&keys).len(), 1);
        outgoing.committed(6);
        assert_eq!(outgoing.missing_parts(&keys), []);
    }

    #[test]
    fn a_state_goes_by_itself() {
        let (mut outgoing, keys) = outgoing([call(5, 1), state(6), call(7, 1)]);
        assert!(!outgoing.prepare(&keys).unwrap().unwrap().is_empty());
        assert_eq!(outgoing.ready(), 5);
        outgoing.prepared();
        outgoing.prepare(&keys).unwrap();
        assert_eq!(outgoing.ready(), 7);
        // The calls before and after the state go in other beats.
        assert_eq!(added(&outgoing, &keys, 7), [5]);
        outgoing.committed(5);
        let entry = outgoing.entry(&keys, 7).unwrap().unwrap();
        assert_eq!(entry.key, keys.journal(6));
        assert!(Manifest::read(&entry.value).is_some());
        outgoing.committed(6);
        assert_eq!(added(&outgoing, &keys, 7), [7]);
    }

    #[test]
    fn what_piles_up_becomes_a_state_behind_what_may_be_on_its_way() {
        let count = 2 * FIRST as u64;
        let (mut outgoing, keys) = outgoing((5..5 + count).map(|seq| call(seq, 1)));
        outgoing.all_ready();
        assert!(!outgoing.has_outgrown());
        let before = added(&outgoing, &keys, 4 + count);
        outgoing.add([call(5 + count, 1)]);
        outgoing.all_ready();
        assert!(outgoing.has_outgrown());
        outgoing.replace_rest(Some(state(6 + count)));
        outgoing.all_ready();
        assert_eq!((outgoing.count(), outgoing.ready()), (FIRST + 1, 6 + count));
        // A repeated beat has the same records.
        assert_eq!(added(&outgoing, &keys, 4 + count), before);
        outgoing.committed(4 + FIRST as u64);
        let entry = outgoing.entry(&keys, 6 + count).unwrap().unwrap();
        assert_eq!(entry.key, keys.journal(6 + count));
        assert!(!outgoing.missing_parts(&keys).is_empty());
        let large = (FIRST as u64 + 5..)
            .take(4)
            .map(|seq| call(seq, BYTES_MOST / 3));
        let first = (5..FIRST as u64 + 5).map(|seq| call(seq, 1));
        let mut outgoing = Outgoing::default();
        outgoing.add(first.chain(large));
        assert!(outgoing.has_outgrown());
    }

    #[test]
    fn what_cannot_be_written_leaves_its_number_to_a_call_that_changes_nothing() {
        let most = journal::RECORD_BYTES_MAX;
        let (mut outgoing, keys) = outgoing([call(5, 1), call(6, most), call(7, 1)]);
        assert!(outgoing.prepare(&keys).is_err());
        assert_eq!(outgoing.ready(), 5);
        outgoing.leave_out_next();
        assert!(outgoing.prepare(&keys).unwrap().is_none());
        assert_eq!(outgoing.ready(), 7);
        let instead: Vec<_> = outgoing.changes().skip(1).take(1).collect();
        let [Change::Call(Record { seq: 6, entry }, _)] = instead.as_slice() else {
            panic!("{instead:?}");
        };
        assert_eq!(*entry, RecordContent::call(no_change()));
        assert_eq!(added(&outgoing, &keys, 7), [5, 6, 7]);
    }
}
