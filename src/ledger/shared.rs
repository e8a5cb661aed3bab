//! What other computers are given of our writes, and what we follow of theirs.

use super::{Inner, Ledger, Superseded};
use crate::{
    checkpoint::format::{self, Entry, Record},
    master::{Master, Request},
};

/// Which computer's writes the ledger holds.
#[derive(Debug)]
pub(super) enum Shared {
    /// There is no other computer.
    Nobody,
    /// Another one has the master: what it records is followed, and nothing else is recorded.
    Elsewhere,
    /// Ours: the others are given them.
    Here {
        /// The number of the last one.
        last: Agreed,
        changes: Vec<Change>,
    },
}

/// A place in the journal of all computers: which time that this one has the master, and the number of a
/// record.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Agreed {
    reign: u64,
    seq: u64,
}

/// A change to be given to the other computers.
#[derive(Clone, Debug)]
pub enum Change {
    Call(Record),
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
            Self::Call(record) => record.seq,
            Self::State { seq, .. } => *seq,
        }
    }
}

impl Shared {
    pub(super) fn last(&self) -> Option<Agreed> {
        match self {
            Self::Here { last, .. } => Some(*last),
            _ => None,
        }
    }
}

impl Ledger {
    /// Another computer has the master, or may have it: from now on nothing is recorded but what
    /// [`Self::follow`] is given. Calls whose records the others lack are not acknowledged.
    pub fn leave(&self) {
        self.lock().shared = Shared::Elsewhere;
        self.agreed.send_modify(|agreed| {
            *agreed = Agreed {
                reign: agreed.reign + 1,
                seq: 0,
            }
        });
    }

    /// This computer has the master: its records are given to the others, with numbers after `seq`. `held`:
    /// the state that they hold; if ours differs, they are given ours as a whole.
    pub fn lead(&self, seq: u64, held: &Master) {
        let mut inner = self.lock();
        let reign = self.agreed.borrow().reign;
        inner.shared = Shared::Here {
            last: Agreed { reign, seq },
            changes: Vec::new(),
        };
        if inner.mirror != *held {
            inner.share_state();
        }
        drop(inner);
        self.shared.notify_one();
    }

    /// What is to be given to the others, once.
    pub fn take_changes(&self) -> Vec<Change> {
        match &mut self.lock().shared {
            Shared::Here { changes, .. } => std::mem::take(changes),
            _ => Vec::new(),
        }
    }

    /// The others have the records up to `seq`, or need not have them.
    pub fn agree(&self, seq: u64) {
        self.agreed.send_if_modified(|agreed| {
            let more = seq > agreed.seq;
            agreed.seq = agreed.seq.max(seq);
            more
        });
    }

    /// Returns when the others have the record at `place`. False if this computer no longer has the master.
    pub(super) async fn agreed(&self, place: Agreed) -> bool {
        let mut agreed = self.agreed.subscribe();
        // We own the sender.
        let reached = agreed.wait_for(|reached| *reached >= place).await;
        reached.is_ok_and(|reached| reached.reign == place.reign)
    }

    /// Applies and records what the computer that has the master has recorded.
    ///
    /// # Errors
    ///
    /// If this computer has it.
    pub fn follow(&self, records: &[Record]) -> Result<(), Superseded> {
        let mut inner = self.lock();
        if !inner.is_elsewhere() {
            return Err(Superseded);
        }
        let entries: Vec<Entry> = records.iter().map(|record| record.entry.clone()).collect();
        for entry in &entries {
            if let Entry::Call { call, .. } = entry {
                inner
                    .mirror
                    .apply_telling(&Request::from(call.clone()), &mut ());
                inner.version += 1;
            }
        }
        inner.append(&entries);
        drop(inner);
        self.work.notify_one();
        Ok(())
    }

    /// Replaces the state by that of the computer that has the master.
    ///
    /// # Errors
    ///
    /// If this computer has it.
    pub fn follow_state(&self, state: Master) -> Result<(), Superseded> {
        let mut inner = self.lock();
        if !inner.is_elsewhere() {
            return Err(Superseded);
        }
        inner.pending.clear();
        inner.activity = Default::default();
        (inner.doubted, inner.abandoned) = (false, false);
        inner.adopt(state);
        drop(inner);
        self.work.notify_one();
        Ok(())
    }
}

impl Inner {
    /// Whether another computer has the master.
    pub(super) fn is_elsewhere(&self) -> bool {
        matches!(self.shared, Shared::Elsewhere)
    }

    pub(super) fn share(&mut self, entries: &[Entry]) {
        let Shared::Here { last, changes } = &mut self.shared else {
            return;
        };
        for entry in entries {
            let Entry::Call { call, .. } = entry else {
                continue;
            };
            let record = Record {
                seq: last.seq + 1,
                entry: Entry::call(call.clone()),
            };
            // What cannot be written is in no journal, as in that of one computer.
            if format::push_record(&mut Vec::new(), &record).is_ok() {
                last.seq += 1;
                changes.push(Change::Call(record));
            }
        }
    }

    /// The state has changed otherwise than by calls.
    pub(super) fn share_state(&mut self) {
        if let Shared::Here { last, changes } = &mut self.shared {
            last.seq += 1;
            let (seq, state) = (last.seq, Box::new(self.mirror.clone()));
            changes.push(Change::State { seq, state });
        }
    }
}
