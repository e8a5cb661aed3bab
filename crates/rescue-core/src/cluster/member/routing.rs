//! Publishes where this computer's calls go, and how current its mirror is.

use super::{Action, Holdings, Member};
use crate::cluster::{
    machine::Role,
    standing::{AnsweredCalls, JournalPosition, Standing},
};

impl Member {
    /// Publishes who has the master and where calls go, if that has changed.
    pub(super) fn publish_standing(&mut self, standing: Standing) {
        if self.published.standing != standing {
            self.published.standing = standing.clone();
            self.act(Action::PublishStanding(standing));
        }
    }

    /// Publishes that this computer leads, if it does. Calls wait while partition writes are being merged.
    pub(super) fn publish_leading(&mut self) {
        let term = self.machine.term();
        let Some(term) = term.filter(|_| self.published.role == Role::Leading) else {
            return;
        };
        let answers = match (self.cut_off.is_empty(), self.release.is_begun()) {
            (false, _) => AnsweredCalls::None,
            (true, true) => AnsweredCalls::Reads,
            (true, false) => AnsweredCalls::All,
        };
        self.publish_standing(Standing::Leads { term, answers });
    }

    /// The address and term of the leader, if it is another computer that has not given up leadership. The leader of a
    /// lost journal is none, although it may not know of the loss yet.
    pub(super) fn leader(&self) -> Option<(&str, u64)> {
        let own = self.settings();
        let view = self.view();
        let leader = view.leader.as_ref()?;
        if self.data_loss.is_remainder(view) {
            return None;
        }
        let released = view.alive.as_ref().is_some_and(|of| of.released.is_some());
        let is_own = leader.id == own.id || leader.name == own.name && leader.uri == own.uri;
        (!released && !is_own).then_some((&*leader.uri, leader.term))
    }

    /// Notes who leads. If this computer follows, publishes where its calls go.
    pub(super) fn update_standing(&mut self) {
        self.update_position();
        let own = &self.settings().id;
        let view = self.view();
        let other = view.leader.as_ref().filter(|leader| leader.id != *own);
        if let Some(leader) = other {
            let released = view.alive.as_ref().is_some_and(|of| of.released.is_some());
            let seen = self.machine.observed();
            self.before.leader = seen.map(|at| (leader.name.clone(), at));
            self.before.released = released;
        }
        if self.machine.role() != Role::Following || self.published.role != Role::Following {
            return;
        }
        // After a restart, a term that etcd has not reached would mean that etcd has lost its data.
        if let Some((_, term)) = self.leader()
            && term == self.held.term
        {
            self.store_term(term);
        }
        let standing = match self.leader() {
            // Partition writes must be merged before new calls.
            Some((uri, term)) if self.cut_off.is_empty() => {
                let uri = uri.to_owned();
                Standing::Follows { uri, term }
            }
            _ => Standing::NoLeader {
                known: self.knows(),
            },
        };
        self.publish_standing(standing);
    }

    /// Updates the position up to which the mirror is current.
    fn update_position(&mut self) {
        if !self.reading.loaded && !self.records() {
            // What the checkpoint holds still counts.
            return;
        }
        if self.data_loss.since().is_some() {
            // The mirror has what it has of the lost journal until a new one has begun.
            return;
        }
        let seq = self.journal.progress.seq;
        // If `differs`, the mirror is at no position of the journal: it holds records or partition writes that the journal
        // lacks.
        let differs = self.local.seq > seq || !self.cut_off.is_empty();
        if self.journal.own_wins && differs && !self.records() {
            return;
        }
        let view = self.view();
        // The leader's term counts only once the mirror has the whole journal before that leader's first record.
        let whole = self.reading.loaded && seq >= view.seq();
        let leader = view.leader.as_ref().filter(|_| whole);
        let term = leader.map_or(self.position.term, |leader| leader.term);
        let journal_number = leader.map_or(self.held.journal_number, |_| view.journal_number);
        let epoch = self.data_loss.times;
        // The mirror of a leader has changes that the journal may lack, also while this computer is cut off.
        let own = view
            .leader
            .as_ref()
            .is_some_and(|of| of.id == self.settings().id);
        let shown = match own {
            true => seq.max(self.outgoing.last()),
            false => seq,
        };
        self.position = JournalPosition {
            epoch,
            term,
            seq: shown,
            lost: (0, 0),
        };
        // What a leader answers while it is cut off is no part of the journal.
        let held = match own && self.keeps_writes() {
            true => seq.max(self.held.seq),
            false => shown,
        };
        self.held = Holdings {
            journal_number,
            term,
            seq: held,
        };
    }
}
