//! Changes of this computer that are not known to be in the journal.

use std::{collections::VecDeque, pin::Pin};

use crate::{
    checkpoint::format::{self, Checkpoint},
    cluster::journal::{self, JournalError, Keys, Put},
    ledger::Change,
};

/// Writes the parts of a change. Gives whether this process still leads, if that is known.
pub(super) type Preparing = Pin<Box<dyn Future<Output = Option<bool>> + Send>>;

/// In the order of their numbers.
#[derive(Default)]
pub(super) struct Outgoing {
    changes: VecDeque<Change>,
    /// The last one that is ready: its parts, if it has any, are in etcd.
    ready: u64,
    /// The parts of the one after that are being written.
    pub(super) preparing: Option<Preparing>,
}

impl Outgoing {
    /// Nothing is left of earlier changes; the next one has a number after `seq`.
    pub(super) fn start(&mut self, seq: u64) {
        *self = Self {
            ready: seq,
            ..Self::default()
        };
    }

    pub(super) fn add(&mut self, changes: impl IntoIterator<Item = Change>) {
        self.changes.extend(changes);
    }

    pub(super) fn len(&self) -> usize {
        self.changes.len()
    }

    pub(super) fn changes(&self) -> impl Iterator<Item = &Change> {
        self.changes.iter()
    }

    /// The last one that is ready.
    pub(super) fn ready(&self) -> u64 {
        self.ready
    }

    /// All are ready: this computer is alone, and nobody is given them now.
    pub(super) fn all_ready(&mut self) {
        self.preparing = None;
        self.ready = self.changes.back().map_or(self.ready, Change::seq);
    }

    /// Those that need no parts are ready, up to the first one that does. Returns its parts.
    pub(super) fn prepare(&mut self, keys: &Keys) -> Result<Option<Vec<Put>>, JournalError> {
        if self.preparing.is_some() {
            return Ok(None);
        }
        for change in &self.changes {
            if change.seq() <= self.ready {
                continue;
            }
            let parts = match change {
                Change::Call(record) => journal::parts(keys, record)?,
                Change::State { .. } => state(keys, change)?.0,
            };
            if !parts.is_empty() {
                return Ok(Some(parts));
            }
            self.ready = change.seq();
        }
        Ok(None)
    }

    /// The parts of the next one have been written.
    pub(super) fn prepared(&mut self) {
        let next = self.changes.iter().find(|of| of.seq() > self.ready);
        self.ready = next.map_or(self.ready, Change::seq);
    }

    /// What the next beat adds to the journal, up to `seq`.
    pub(super) fn entry(&self, keys: &Keys, seq: u64) -> Result<Option<Put>, JournalError> {
        if let Some(first @ Change::State { .. }) =
            self.changes.front().filter(|of| of.seq() <= seq)
        {
            return Ok(Some(state(keys, first)?.1));
        }
        let records = self.changes.iter().map_while(|change| match change {
            Change::Call(record) if record.seq <= seq => Some(record.clone()),
            _ => None,
        });
        Ok(journal::pack(keys, &records.collect::<Vec<_>>())?.entry)
    }

    /// Takes out all.
    pub(super) fn take_all(&mut self) -> Vec<Change> {
        self.preparing = None;
        self.changes.drain(..).collect()
    }

    /// Takes out those that are in the journal, up to `seq`.
    pub(super) fn committed(&mut self, seq: u64) -> Vec<Change> {
        let count = self
            .changes
            .iter()
            .take_while(|of| of.seq() <= seq)
            .count();
        self.ready = self.ready.max(seq);
        self.changes.drain(..count).collect()
    }
}

/// The parts and the entry of a change of the whole state.
fn state(keys: &Keys, change: &Change) -> Result<(Vec<Put>, Put), JournalError> {
    let snapshot = match change {
        Change::State { state, .. } => state.snapshot(),
        Change::Call(_) => Default::default(),
    };
    let checkpoint = Checkpoint {
        seq: change.seq(),
        snapshot,
        ..Checkpoint::default()
    };
    let encoded = format::encode_checkpoint(&checkpoint, 1)?;
    Ok(journal::state(keys, change.seq(), &encoded.bytes))
}
