//! Writes recorded changes to the journal.

use std::time::Instant;

use super::{Action, Member, News};
use crate::cluster::{
    machine::{self, EtcdAnswer, Op, Role},
    mutant::Mutant,
    sharing::{Change, Source},
};

impl Member {
    /// Sends a request of the machine to etcd.
    pub(super) fn send(&mut self, now: Instant, number: u64, op: Op) {
        let term = self.machine.term().unwrap_or_default();
        let entry = match &op {
            Op::Beat { seq, .. } => self.outgoing.entry(&self.keys, *seq),
            _ => Ok(None),
        };
        let entry = match entry {
            Ok(entry) => entry,
            Err(error) => {
                self.report_news(News::TooLarge(error.to_string()));
                let answer = EtcdAnswer::Silence;
                return self.queue_input(machine::Input::Answer { number, answer });
            }
        };
        let parts = match &entry {
            Some(_) => self.outgoing.missing_parts(&self.keys),
            None => Vec::new(),
        };
        let requires = match &op {
            Op::Claim {
                begins: Some(_), ..
            } => self.evidence(now),
            _ => None,
        };
        self.act(Action::Send {
            number,
            op,
            entry,
            term,
            parts,
            requires,
        });
    }

    /// Handles changes that the ledger has recorded.
    pub(super) fn recorded(&mut self, changes: Vec<Change>) {
        if !self.records() {
            return;
        }
        let is_alone = self.machine.role() == Role::Alone;
        let leads_on = self.machine.writes_journal();
        if self.keeps_writes() {
            let ours = changes.iter().filter(|of| is_ours(of));
            let kept = self.cut_off.add(ours, leads_on);
            self.also_send(&kept);
            self.store_writes(kept);
        }
        self.outgoing.add(changes);
        if !is_alone {
            return self.prepare();
        }
        self.outgoing.all_ready();
        // If the changes never go to the journal, a later leader gets the partition writes instead.
        match leads_on {
            false => self.outgoing.forget(),
            true if self.outgoing.has_outgrown() => self.act(Action::TakeAsState),
            true => {}
        }
        self.queue_input(machine::Input::Recorded(self.outgoing.ready()));
    }

    /// Replaces the changes that have piled up by one state.
    pub(super) fn recorded_as_state(&mut self, state: Option<Change>) {
        if self.records() && self.outgoing.has_outgrown() {
            self.outgoing.replace_rest(state);
            self.all_ready();
        }
    }

    pub(super) fn all_ready(&mut self) {
        self.outgoing.all_ready();
        self.queue_input(machine::Input::Recorded(self.outgoing.ready()));
    }

    fn prepare(&mut self) {
        let Some(term) = self.machine.term().filter(|_| self.records()) else {
            return;
        };
        loop {
            match self.outgoing.prepare(&self.keys) {
                Ok(Some(parts)) => {
                    let number = self.outgoing.begin_prepare();
                    self.act(Action::Prepare {
                        number,
                        term,
                        parts,
                    });
                    break;
                }
                Ok(None) => break,
                Err(error) => {
                    self.report_news(News::TooLarge(error.to_string()));
                    self.outgoing.leave_out_next();
                }
            }
        }
        self.queue_input(machine::Input::Recorded(self.outgoing.ready()));
    }

    pub(super) fn prepared(&mut self, number: u64, leads: Option<bool>) {
        if !self.outgoing.end_prepare(number) {
            return;
        }
        if leads == Some(true) {
            self.outgoing.prepared();
        }
        // If another computer leads, its keys will show that.
        self.prepare();
    }

    /// Notes that a change is in the journal.
    pub(super) fn hold(&mut self, now: Instant, change: Change) {
        let journal = &mut self.journal;
        if change.seq() <= journal.progress.seq {
            return;
        }
        match change {
            Change::Call(record, _) => {
                if let Ok(new) = journal.progress.take(vec![record], 0) {
                    journal.apply(now, &new);
                    self.cut_off.note(&new);
                }
            }
            Change::State { seq, state } => {
                // The first state of a journal that this computer begins is its own, so it has no changes by others.
                if journal.progress.seq > 0 {
                    self.cut_off.note_difference(Some(&journal.state), &state);
                }
                journal.state = *state;
                journal.progress.take_state(seq, 0);
            }
        }
    }
}

/// Whether a change is this computer's own. Calls that another computer forwarded are not: if they get no answer here,
/// that computer sends them to the next leader.
pub(super) fn is_ours(change: &Change) -> bool {
    !matches!(change, Change::Call(_, Source::Forwarded)) || Mutant::KeepsForwarded.lives()
}
