//! A computer that is cut off answers its own nodes, and keeps their writes for a leader.

use super::{Action, ForwardedWrites, Member, News, journal_writes::is_ours};
use crate::cluster::{
    machine::{Role, WhenAlone},
    sharing::Change,
    standing::Standing,
};
use ros1_master::master::{Master, Request};

impl Member {
    pub(super) fn be_alone(&mut self) {
        let serves = self.settings().alone == WhenAlone::Serve;
        self.report_news(News::Alone { serves });
        if !serves {
            self.give_up();
            return self.publish_standing(Standing::NoLeader { known: true });
        }
        // First, because what follows waits for the disk, and another computer may lead already.
        self.act(Action::NotifyOwnOnly(true));
        let led = self.records();
        self.end_master();
        let base = match led || self.follows() {
            true => self.known_state(),
            false => &self.local.state,
        };
        // The nodes continue from what they wrote in earlier partitions.
        let base = self.cut_off.on(base);
        if led {
            self.begin_cut_off(base);
            // Recorded calls are answered from now on, except forwarded ones, which their computers send elsewhere.
            let answered = self.outgoing.acknowledged;
            let changes = self.outgoing.changes();
            let kept = changes.filter(|change| change.seq() <= answered || is_ours(change));
            let kept = self.cut_off.add(kept, true);
            self.also_send(&kept);
            self.store_writes(kept);
            self.serve_alone();
        } else {
            // The standing changes first, so that no more calls are forwarded.
            self.publish_standing(Standing::NoLeader { known: true });
            self.act(Action::CollectForwarded { base });
        }
    }

    /// Begins to serve this computer's nodes after it was cut off from a leader: in the state `base`, with the writes of
    /// these nodes that the leader answered.
    ///
    /// The journal has these writes, although this computer has not read them. With `--cluster-sync interval` they may
    /// not be in the journal; then the leader sends them later.
    pub(super) fn serve_from(&mut self, mut base: Master, forwarded: ForwardedWrites) {
        if self.published.role != Role::Alone || self.records() {
            // This computer's role has changed again since.
            return;
        }
        let ForwardedWrites {
            unanswered,
            answered,
        } = forwarded;
        for call in &answered {
            base.apply_telling(call, &mut ());
        }
        self.begin_cut_off(base.clone());
        self.cut_off.expect(unanswered.into_iter().chain(answered));
        let seq = self.machine.committed();
        self.outgoing.start(seq);
        let (held, state) = (base.clone(), Some(base));
        self.act(Action::StartRecording { seq, held, state });
        self.serve_alone();
    }

    fn serve_alone(&mut self) {
        self.act(Action::AnswerFromMirror);
        self.publish_standing(Standing::Alone);
        self.all_ready();
    }

    /// The journal's state as far as it has been read. An empty journal says nothing, so this computer's own state counts.
    fn known_state(&self) -> &Master {
        match self.journal.is_empty() {
            true => &self.local.state,
            false => &self.journal.state,
        }
    }

    /// From now on, keeps answered writes for the leader. `base` is the present state.
    fn begin_cut_off(&mut self, base: Master) {
        let first = self.cut_off.is_empty();
        // Before etcd has been read, the others' state is unknown. It will be compared with the first partition's base.
        if first || self.reading.loaded {
            self.cut_off.begin(base);
        }
        if first {
            self.store_all_writes();
        }
    }

    /// Keeps the writes after record `committed` up to `acknowledged`: they were answered but are not in the journal.
    pub(super) fn give_back(&mut self, committed: u64, acknowledged: u64) {
        let changes = self.outgoing.take_all();
        if self.keeps_writes() {
            return;
        }
        let answered = |of: &&Change| of.seq() > committed && of.seq() <= acknowledged;
        let answered: Vec<_> = changes.iter().filter(answered).collect();
        if !answered.is_empty() {
            let base = self.known_state().clone();
            self.begin_cut_off(base);
            let kept = self.cut_off.add(answered, true);
            self.also_send(&kept);
            self.store_writes(kept);
        }
    }

    /// Stores exactly the writes that a leader must still get.
    pub(super) fn store_all_writes(&mut self) {
        self.act(match self.partition_writes() {
            Some(writes) => Action::ReplacePartitionWrites(writes),
            None => Action::DeletePartitionWrites,
        });
    }

    pub(super) fn store_writes(&mut self, calls: Vec<Request>) {
        if !calls.is_empty() {
            self.act(Action::AddPartitionWrites(calls));
        }
    }
}
