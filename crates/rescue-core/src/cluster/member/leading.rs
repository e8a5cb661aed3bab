//! Changes of this computer's role, and what its ledger records.

use std::time::Instant;

use super::{Action, Cause, Member, News};
use crate::{
    cluster::{
        machine::{self, EtcdAnswer, JournalSession, Op, Role, WhenAlone},
        mutant::Mutant,
        sharing::{Change, Source},
        standing::{Pass, Standing},
    },
    master::{Master, Request},
};

/// How often a follower asks the leader's rosrescue whether it leads, per time to live.
pub const PROBES: u32 = 4;
/// Probes per time to live while etcd is silent, when only the leader itself shows whether it still leads.
const PROBES_IN_SILENCE: u32 = 20;

/// Whether a change is this computer's own. Calls that another computer forwarded are not: if they get no answer here,
/// that computer sends them to the next leader.
fn is_ours(change: &Change) -> bool {
    !matches!(change, Change::Call(_, Source::Forwarded)) || Mutant::KeepsForwarded.lives()
}

impl Member {
    pub(super) fn become_role(&mut self, now: Instant, role: Role) {
        let before = std::mem::replace(&mut self.told.role, role);
        if before == Role::Alone && role != Role::Alone {
            self.tell(News::NotAlone);
        }
        match role {
            Role::Leading => self.lead(now),
            Role::Alone => self.be_alone(),
            Role::Joining | Role::Following | Role::CatchingUp => {
                if self.records() {
                    self.tell(News::Deposed);
                }
                self.released();
                // What is left was not answered, and its callers call again.
                self.outgoing.forget();
                self.give_up();
            }
        }
        self.chores.say_at(now);
    }

    fn lead(&mut self, now: Instant) {
        let term = self.machine.term().unwrap_or_default();
        match self.records() {
            false => self.begin_to_lead(now),
            true => {
                self.tell(News::LeadsAgain);
                self.act(Action::ServeOwnOnly(false));
                self.begin_master(Cause::WasCutOff);
                self.cut_off.resumed();
                let last = self.outgoing.last();
                let at_once = Mutant::DeletesKeptWrites.lives();
                self.chores.keep_until(if at_once { 0 } else { last });
            }
        }
        self.keep_term(term);
        self.stand_leading(term);
    }

    /// Has the checkpoint name the present term.
    fn keep_term(&mut self, term: u64) {
        if std::mem::replace(&mut self.before.term, term) != term {
            self.act(Action::Term(term));
        }
    }

    fn begin_to_lead(&mut self, now: Instant) {
        let over = matches!(self.machine.session(), JournalSession::Over(_));
        let before = self.before.leader.take();
        let own = &self.settings().name;
        let cause = match before.as_ref().is_some_and(|(name, _)| name != own) {
            true => Cause::TakenOver,
            false => Cause::Started,
        };
        let released = self.before.released;
        self.tell(News::Leads { before, released });
        let owns = std::mem::take(&mut self.journal.own_wins);
        let seq = self.machine.committed();
        if seq > 0 {
            // Keys may have been deleted that this computer did not have to read.
            self.reading.check_all(now);
        }
        self.outgoing.start(seq);
        let held = self.journal.state.clone();
        let state = match over {
            true => Some(Master::default()),
            // Writes answered while cut off are merged later. They are not part of the state that the others get.
            false => (!self.cut_off.is_empty() && !owns).then(|| held.clone()),
        };
        self.act(Action::Lead { seq, held, state });
        let displaced = self.journal.displaced.at(now);
        self.act(Action::TellDisplaced(displaced));
        self.begin_master(cause);
    }

    fn be_alone(&mut self) {
        let serves = self.settings().alone == WhenAlone::Serve;
        self.tell(News::Alone { serves });
        if !serves {
            self.give_up();
            return self.stand(Standing::Nobody { known: true });
        }
        let led = self.records();
        self.end_master();
        let base = match led || self.follows() {
            true => &self.journal.state,
            false => &self.own.state,
        };
        // The nodes continue from what they wrote in earlier periods of being cut off.
        let base = self.cut_off.on(base);
        self.begin_cut_off(base.clone());
        self.act(Action::ServeOwnOnly(true));
        if led {
            // Recorded calls are answered from now on, except forwarded ones, which their computers send elsewhere.
            let answered = self.outgoing.acknowledged;
            let changes = self.outgoing.changes();
            let kept = changes.filter(|change| change.seq() <= answered || is_ours(change));
            let kept = self.cut_off.add(kept, true);
            self.keep(kept);
        } else {
            // The standing changes first, so that no more calls are forwarded.
            self.stand(Standing::Nobody { known: true });
            self.act(Action::AskForwarded);
            let seq = self.machine.committed();
            self.outgoing.start(seq);
            let (held, state) = (base.clone(), Some(base));
            self.act(Action::Lead { seq, held, state });
        }
        self.act(Action::StandIn);
        self.stand(Standing::Alone);
        self.all_ready();
    }

    /// From now on, keeps answered writes for the leader. `base` is the present state.
    fn begin_cut_off(&mut self, base: Master) {
        let first = self.cut_off.is_empty();
        // Before etcd has been read, the others' state is unknown. It will be compared with the first period's base.
        if first || self.reading.loaded {
            self.cut_off.begin(base);
        }
        if first {
            self.keep_all();
        }
    }

    fn begin_master(&mut self, cause: Cause) {
        self.told.has_master = true;
        self.act(Action::BeginMaster(cause));
    }

    fn end_master(&mut self) {
        if Mutant::MasterWhileAlone.lives() && self.told.role == Role::Alone {
            return;
        }
        if std::mem::take(&mut self.told.has_master) {
            self.act(Action::EndMaster);
        }
    }

    /// Runs a master as long as the machine allows it.
    pub(super) fn update_master(&mut self) {
        let may = self.machine.may_have_master();
        if self.told.has_master && !may {
            self.tell(News::Lapsed);
            self.end_master();
            self.act(Action::StandIn);
        } else if !self.told.has_master && may && self.records() {
            self.begin_master(Cause::WasCutOff);
        }
    }

    /// Stops recording calls and ends this computer's master, because another computer may lead.
    fn give_up(&mut self) {
        if self.records() {
            self.chores.notifying.stop();
        }
        // A computer that is cut off and serves has its own history.
        let binds = !self.keeps();
        self.act(Action::Leave { binds });
        let known = self.knows();
        self.stand(Standing::Nobody { known });
        self.end_master();
        self.act(Action::ServeOwnOnly(false));
        self.act(Action::TurnAway);
        self.adopt();
    }

    /// Publishes who has the master and where calls go, if that has changed.
    fn stand(&mut self, standing: Standing) {
        if self.told.standing != standing {
            self.told.standing = standing.clone();
            self.act(Action::Stand(standing));
        }
    }

    /// Publishes that this computer leads. Calls wait while earlier writes, answered while cut off, are being merged.
    pub(super) fn stand_leading(&mut self, term: u64) {
        let pass = match (self.cut_off.is_empty(), self.release.is_begun()) {
            (false, _) => Pass::Nothing,
            (true, true) => Pass::Reads,
            (true, false) => Pass::Calls,
        };
        self.stand(Standing::Leads { term, pass });
    }

    /// The address and term of the leader, if it is another computer that has not given up leadership.
    pub(super) fn leader(&self) -> Option<(&str, u64)> {
        let own = self.settings();
        let view = self.view();
        let leader = view.leader.as_ref()?;
        let released = view.alive.as_ref().is_some_and(|of| of.released.is_some());
        let is_own = leader.id == own.id || leader.name == own.name && leader.uri == own.uri;
        (!released && !is_own).then_some((&*leader.uri, leader.term))
    }

    /// Notes who leads. If this computer follows, publishes where its calls go.
    pub(super) fn update_standing(&mut self) {
        self.look_at_place();
        let own = &self.settings().id;
        let view = self.view();
        let other = view.leader.as_ref().filter(|leader| leader.id != *own);
        if let Some(leader) = other {
            let released = view.alive.as_ref().is_some_and(|of| of.released.is_some());
            let seen = self.machine.observed();
            self.before.leader = seen.map(|at| (leader.name.clone(), at));
            self.before.released = released;
        }
        if self.machine.role() != Role::Following || self.told.role != Role::Following {
            return;
        }
        // After a restart, a term that etcd has not reached would mean that etcd has lost its data.
        if let Some((_, term)) = self.leader() {
            self.keep_term(term);
        }
        let standing = match self.leader() {
            // Writes answered while cut off must be merged before new calls.
            Some((uri, term)) if self.cut_off.is_empty() => {
                let uri = uri.to_owned();
                Standing::Follows { uri, term }
            }
            _ => Standing::Nobody {
                known: self.knows(),
            },
        };
        self.stand(standing);
    }

    /// Asks the leader's rosrescue regularly whether it leads.
    pub(super) fn update_probes(&mut self, now: Instant) {
        let asks = matches!(self.machine.role(), Role::Following | Role::Alone);
        let leader = self.leader().filter(|_| asks);
        let leader = leader.map(|(uri, term)| (uri.to_owned(), term));
        let Some((uri, term)) = leader else {
            (self.probing.under_way, self.probing.at) = (false, None);
            return;
        };
        let ttl = self.settings().ttl;
        let silent = self.machine.heard().is_none_or(|heard| heard + ttl <= now);
        let pause = ttl / if silent { PROBES_IN_SILENCE } else { PROBES };
        let probing = &mut self.probing;
        if !probing.under_way && *probing.at.get_or_insert(now) <= now {
            probing.number += 1;
            (probing.under_way, probing.at) = (true, Some(now + pause));
            let number = probing.number;
            self.act(Action::Probe { number, uri, term });
        }
    }

    pub(super) fn probed(&mut self, number: u64, leads: bool) {
        if self.probing.under_way && self.probing.number == number {
            self.probing.under_way = false;
            self.tell_machine(machine::Input::Peer(leads));
        }
    }

    /// Sends a request of the machine to etcd.
    pub(super) fn send(&mut self, number: u64, op: Op) {
        let term = self.machine.term().unwrap_or_default();
        let entry = match &op {
            Op::Beat { seq, .. } => self.outgoing.entry(&self.keys, *seq),
            _ => Ok(None),
        };
        let entry = match entry {
            Ok(entry) => entry,
            Err(error) => {
                self.tell(News::TooLarge(error.to_string()));
                let answer = EtcdAnswer::Silence;
                return self.tell_machine(machine::Input::Answer { number, answer });
            }
        };
        let parts = match &entry {
            Some(_) => self.outgoing.missing_parts(&self.keys),
            None => Vec::new(),
        };
        self.act(Action::Send {
            number,
            op,
            entry,
            term,
            parts,
        });
    }

    /// Handles changes that the ledger has recorded.
    pub(super) fn recorded(&mut self, changes: Vec<Change>) {
        if !self.records() {
            return;
        }
        let is_alone = self.machine.role() == Role::Alone;
        let leads_on = self.machine.writes_journal();
        if self.keeps() {
            let ours = changes.iter().filter(|of| is_ours(of));
            let kept = self.cut_off.add(ours, leads_on);
            self.keep(kept);
        }
        self.outgoing.add(changes);
        if !is_alone {
            return self.prepare();
        }
        self.outgoing.all_ready();
        // If the changes never go to the journal, a later leader gets the kept writes instead.
        match leads_on {
            false => self.outgoing.forget(),
            true if self.outgoing.has_outgrown() => self.act(Action::TakeAsState),
            true => {}
        }
        self.tell_machine(machine::Input::Recorded(self.outgoing.ready()));
    }

    /// Replaces the changes that have piled up by one state.
    pub(super) fn recorded_as_state(&mut self, state: Option<Change>) {
        if self.records() && self.outgoing.has_outgrown() {
            self.outgoing.replace_rest(state);
            self.all_ready();
        }
    }

    fn all_ready(&mut self) {
        self.outgoing.all_ready();
        self.tell_machine(machine::Input::Recorded(self.outgoing.ready()));
    }

    fn prepare(&mut self) {
        let Some(term) = self.machine.term().filter(|_| self.records()) else {
            return;
        };
        loop {
            match self.outgoing.prepare(&self.keys) {
                Ok(Some(parts)) => {
                    self.outgoing.preparing = true;
                    self.act(Action::Prepare { term, parts });
                    break;
                }
                Ok(None) => break,
                Err(error) => {
                    self.tell(News::TooLarge(error.to_string()));
                    self.outgoing.leave_out_next();
                }
            }
        }
        self.tell_machine(machine::Input::Recorded(self.outgoing.ready()));
    }

    pub(super) fn prepared(&mut self, leads: Option<bool>) {
        if !std::mem::take(&mut self.outgoing.preparing) {
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

    /// Keeps the writes after record `committed` up to `acknowledged`: they were answered but are not in the journal.
    pub(super) fn give_back(&mut self, committed: u64, acknowledged: u64) {
        let changes = self.outgoing.take_all();
        if self.keeps() {
            return;
        }
        let answered = |of: &&Change| of.seq() > committed && of.seq() <= acknowledged;
        let answered: Vec<_> = changes.iter().filter(answered).collect();
        if !answered.is_empty() {
            let base = self.journal.state.clone();
            self.begin_cut_off(base);
            let kept = self.cut_off.add(answered, true);
            self.keep(kept);
        }
    }

    /// Stores exactly the writes that a leader must still get.
    pub(super) fn keep_all(&mut self) {
        let kept = self.kept().map(|(base, calls)| (base.clone(), calls));
        self.act(match kept {
            Some((base, calls)) => Action::KeepAll { base, calls },
            None => Action::KeepNothing,
        });
    }

    pub(super) fn keep(&mut self, calls: Vec<Request>) {
        if !calls.is_empty() {
            self.act(Action::Keep(calls));
        }
    }
}
