//! Changes of this computer's role: it starts a master, or gives it up.

use std::time::Instant;

use super::{Action, Cause, Member, News};
use crate::cluster::{
    machine::{JournalSession, Role},
    mutant::Mutant,
    standing::Standing,
};
use ros1_master::master::Master;

impl Member {
    pub(super) fn become_role(&mut self, now: Instant, role: Role) {
        let before = std::mem::replace(&mut self.published.role, role);
        if before == Role::Alone && role != Role::Alone {
            self.report_news(News::NotAlone);
        }
        match role {
            Role::Leading => self.lead(now),
            Role::Alone => self.be_alone(),
            Role::Joining | Role::Following | Role::CatchingUp => {
                if self.records() {
                    self.report_news(News::Deposed);
                }
                self.released();
                // What is left was not answered, and its callers call again.
                self.outgoing.forget();
                self.give_up();
            }
        }
        self.chores.publish_entry_by(now);
    }

    fn lead(&mut self, now: Instant) {
        let term = self.machine.term().unwrap_or_default();
        self.act(Action::NotifyOwnOnly(false));
        match self.records() {
            false => self.begin_to_lead(now),
            true => {
                self.report_news(News::LeadsAgain);
                self.begin_master(Cause::WasCutOff);
                self.cut_off.resumed();
                let last = self.outgoing.last();
                let at_once = Mutant::DeletesKeptWrites.lives();
                self.chores.keep_until(if at_once { 0 } else { last });
            }
        }
        self.store_term(term);
        self.publish_leading();
    }

    /// Has the checkpoint name the present term.
    pub(super) fn store_term(&mut self, term: u64) {
        let journal_number = self.view().journal_number;
        let stored = (term, journal_number);
        if std::mem::replace(&mut self.before.term, stored) != stored {
            let seq = self.held.seq;
            self.act(Action::StoreTerm {
                term,
                journal_number,
                seq,
            });
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
        self.report_news(News::Leads { before, released });
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
            // Partition writes are merged later. They are not part of the state that the others get.
            false => (!self.cut_off.is_empty() && !owns).then(|| held.clone()),
        };
        self.act(Action::StartRecording { seq, held, state });
        let displaced = self.journal.displaced.at(now);
        self.act(Action::ShutDownDisplaced(displaced));
        self.begin_master(cause);
    }

    fn begin_master(&mut self, cause: Cause) {
        self.published.has_master = true;
        self.act(Action::BeginMaster(cause));
    }

    pub(super) fn end_master(&mut self) {
        if Mutant::MasterWhileAlone.lives() && self.published.role == Role::Alone {
            return;
        }
        if std::mem::take(&mut self.published.has_master) {
            self.act(Action::EndMaster);
        }
    }

    /// Runs a master as long as the machine allows it.
    pub(super) fn update_master(&mut self) {
        let may = self.machine.may_have_master();
        if self.published.has_master && !may {
            self.report_news(News::Lapsed);
            self.end_master();
            self.act(Action::AnswerFromMirror);
        } else if !self.published.has_master && may && self.records() {
            self.begin_master(Cause::WasCutOff);
        }
    }

    /// Stops recording calls and ends this computer's master, because another computer may lead.
    pub(super) fn give_up(&mut self) {
        if self.records() {
            self.chores.notifying.stop();
            // Its own state is the only one, as long as it is not in the journal. After a loss, the journal need not have been
            // read for that.
            let is_known = self.reading.loaded || self.data_loss.times > 0;
            self.journal.own_wins |= is_known && self.journal.is_empty();
        }
        // A computer that is cut off and serves has its own history.
        let binds = !self.keeps_writes();
        self.act(Action::StopRecording { binds });
        let known = self.knows();
        self.publish_standing(Standing::NoLeader { known });
        self.end_master();
        self.act(Action::NotifyOwnOnly(false));
        self.act(Action::AnswerNothing);
        self.adopt();
    }
}
