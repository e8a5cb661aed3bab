//! An etcd that has lost data of the journal: its members are new, an older copy was restored, or keys were deleted.
//!
//! What etcd shows then does not continue what it showed before, or the journal cannot be read from its beginning. The
//! most recent state of a living computer becomes the new truth. Each computer writes into its member entry what it
//! holds. A leader begins a new journal at once. Otherwise the computer that holds the most does so after the time to
//! live, and the others wait longer. What is left of the old journal is never read.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use super::{Evidence, Holdings, Member, MemberEntryChange, News};
use crate::cluster::{
    machine::{self, EtcdAnswer, Leader, RevisionGuard, Role, View},
    mutant::Mutant,
    standing::JournalPosition,
};

/// How long a computer waits for each one that holds more of the lost journal, in times to live.
const PATIENCE: u32 = 3;

/// A loss that no new journal has made good yet.
#[derive(Clone, Copy, Debug)]
struct Loss {
    /// When this computer noticed the loss.
    since: Instant,
    /// How much of the lost journal this computer holds.
    holds: Holdings,
    /// The keys as etcd showed them then. A living leader changes them. `None` if they are of a later journal than the lost
    /// one.
    left: Option<RevisionGuard>,
}

/// What is known of the journal that etcd has lost.
#[derive(Debug, Default)]
pub(super) struct DataLoss {
    present: Option<Loss>,
    /// How much of the lost journal the other computers hold, by their names.
    others: BTreeMap<String, Holdings>,
    /// How many computers are known to hold more of the lost journal.
    ahead: u32,
    /// How often etcd has lost data.
    pub(super) times: u64,
    /// The origin of a journal that this computer could not read from its beginning.
    unreadable: u64,
    /// The keys of a journal whose last entry is gone. A snapshot may still hold its record.
    without_end: Option<RevisionGuard>,
}

impl DataLoss {
    pub(super) fn holds(&self) -> Option<Holdings> {
        self.present.map(|loss| loss.holds)
    }

    pub(super) fn since(&self) -> Option<Instant> {
        self.present.map(|loss| loss.since)
    }

    /// Whether `view` shows nothing but what is left of the lost journal.
    pub(super) fn is_remainder(&self, view: &View) -> bool {
        let shown = view.guard();
        let left = self.present.is_some_and(|loss| loss.left == Some(shown));
        left && !Mutant::BelievesOldCopy.lives()
    }

    /// Whether `view` shows a journal that began after the loss.
    pub(super) fn is_made_good_by(&self, view: &View) -> bool {
        self.present
            .is_some_and(|loss| view.journal_number > loss.holds.journal_number)
    }

    /// The origin of the journal that this computer could not read, for its member entry.
    pub(super) fn unreadable(&self) -> u64 {
        self.unreadable
    }
}

impl Member {
    /// Returns `answer`, or silence if it contradicts what etcd showed before. Then etcd is read again.
    pub(super) fn doubt_answer(
        &mut self,
        now: Instant,
        number: u64,
        answer: EtcdAnswer,
    ) -> EtcdAnswer {
        if self.reading.is_doubtful {
            // The request is sent again when the journal has been checked.
            return EtcdAnswer::Silence;
        }
        let view = match &answer {
            EtcdAnswer::Is(view) => view,
            // An older copy is as the request expects, and shorter than the journal has become since.
            EtcdAnswer::Applied { seq, .. }
                if (1..self.view().seq()).contains(seq) && self.data_loss.present.is_none() =>
            {
                self.reading.load_by(now);
                return EtcdAnswer::Silence;
            }
            EtcdAnswer::Applied { .. } | EtcdAnswer::Silence => return answer,
        };
        if self.machine.expects(number, view) && !trusts() {
            // The transaction failed although these keys are as it expects, so the journal's last entry is gone, or this
            // computer's member entry.
            self.data_loss.without_end = Some(view.guard());
            self.reading.load_by(now);
            return EtcdAnswer::Silence;
        }
        if view.revision < self.view().revision {
            // Either the answer is late, which is harmless, or etcd has lost its data.
            self.reading.load_by(now);
            return EtcdAnswer::Silence;
        }
        match self.doubts(now, view) {
            true => EtcdAnswer::Silence,
            false => answer,
        }
    }

    /// Whether `view` contradicts what etcd showed before. If so, etcd is read again.
    pub(super) fn doubts(&mut self, now: Instant, view: &View) -> bool {
        let doubts = self.contradicts(view, self.view());
        if doubts {
            self.reading.load_by(now);
        }
        doubts
    }

    fn contradicts(&self, view: &View, before: &View) -> bool {
        // Nothing brings back a key that was deleted.
        let is_whole_again = before.is_torn() && !view.is_torn();
        let is_other = view.origin != before.origin || is_whole_again;
        let continues = match self.data_loss.present {
            // A new journal does not continue the lost one. Any other is an older copy.
            Some(loss) if view.origin != 0 && is_other => {
                view.journal_number > before.journal_number.max(loss.holds.journal_number)
            }
            _ => view.continues(before),
        };
        (!continues || self.lacks_what_was_read(view)) && !trusts()
    }

    /// Whether `view` shows less of the journal than this computer has read of it. The watch also delivers what was added to
    /// a journal after its keys had been seen last, and before it was lost.
    fn lacks_what_was_read(&self, view: &View) -> bool {
        let seen = self.view();
        let is_late = view.revision < seen.revision;
        let is_same = self.reading.loaded && view.origin == seen.origin && !is_late;
        is_same && view.seq() < self.journal.progress.seq
    }

    /// Whether etcd has lost data, if a read that began when etcd had shown `before` shows `view`.
    pub(super) fn has_lost(&self, view: &View, before: &View, is_readable: bool) -> bool {
        // The term in a checkpoint is a revision of etcd, too.
        let known = match self.reading.loaded {
            true => 0,
            false => self.local.term,
        };
        let floor = before.revision.max(known);
        let older = view.revision < floor && !Mutant::TrustsLostEtcd.lives();
        let is_without_end = self.data_loss.without_end == Some(view.guard());
        // What has been seen since the read began counts more: this computer may have begun a new journal, or etcd may have
        // lost that, too.
        let seen = self.view();
        let contradicts = match view.revision < seen.revision {
            true => !seen.continues(view) && self.contradicts(view, before),
            false => self.contradicts(view, seen),
        };
        if let Some(loss) = self.data_loss.present {
            let is_torn = view.is_torn() && loss.left != Some(view.guard());
            // No other computer can repair a journal that this one is to continue.
            let is_unreadable = !is_readable && self.machine.role() == Role::CatchingUp;
            let torn = (is_torn || is_without_end) && !trusts();
            return older || contradicts || torn || is_unreadable;
        }
        let is_old = !self.reading.loaded && view.journal_number < self.local.journal_number;
        let is_old = is_old || view.term() < known || self.lacks_what_the_checkpoint_holds(view);
        let torn = view.is_torn() || is_old || !is_readable || is_without_end;
        older || contradicts || torn && !trusts()
    }

    /// Whether the checkpoint holds more of the journal in `view`, from the same leader, than etcd. The checkpoint of a
    /// computer that follows has nothing that etcd did not have.
    fn lacks_what_the_checkpoint_holds(&self, view: &View) -> bool {
        let (own, held) = (self.settings(), self.held);
        let follows = |leader: &Leader| leader.name != own.name && leader.term == held.term;
        !self.reading.loaded
            && view.leader.as_ref().is_some_and(follows)
            && view.journal_number == held.journal_number
            && view.seq() < held.seq
            && !Mutant::StartsFromOldCopy.lives()
    }

    /// Starts over with the etcd that shows `view`, and with this computer's state.
    pub(super) fn start_over(&mut self, now: Instant, view: &View) {
        let holds = self.held;
        self.report_news(News::EtcdLost);
        // The ledger keeps its state, if no leader has written its own to the journal yet.
        self.journal.own_wins |= self.reading.loaded && self.journal.is_empty();
        // A leader holds the most, as long as no other computer can lead.
        let leads = self.published.role == Role::Leading && self.machine.is_sole(now);
        let wait = if leads {
            Duration::ZERO
        } else {
            self.settings().ttl
        };
        let until = now + wait;
        let view = view.clone();
        self.reading.forget(&view);
        let is_later = !view.is_torn() && view.journal_number > holds.journal_number;
        let left = (!is_later).then(|| view.guard());
        self.drive(now, machine::Input::Lost { view, left, until });
        self.machine.hold_claims(until);
        self.data_loss.without_end = None;
        // The numbers of a new journal begin again, and so do the revisions of a new etcd.
        (self.chores.replaced, self.namesake.led_in) = (0, 0);
        self.data_loss.times += 1;
        let epoch = self.data_loss.times;
        self.restart_merge(now);
        let journal = std::mem::take(&mut self.journal);
        if std::mem::take(&mut self.reading.loaded) {
            // Before the new journal has the state, it holds nothing.
            if !journal.own_wins && journal.progress.seq > 0 {
                (self.local.state, self.local.restored) = (journal.state, true);
            }
        }
        // The mirror goes on answering if it has all that was shown. That of a process which has just started may be older
        // than the new journal.
        let JournalPosition { term, seq, .. } = self.position;
        self.position = JournalPosition {
            epoch,
            lost: self.position.lost.max((term, seq)),
            ..JournalPosition::default()
        };
        self.journal.own_wins = true;
        (self.local.term, self.local.journal_number) = (0, 0);
        self.reading.load_by(now);
        let since = now;
        self.data_loss.present = Some(Loss { since, holds, left });
        self.data_loss.ahead = 0;
        self.publish_entry();
    }

    /// What a claim that begins a new journal requires of the entries among the members, after a loss.
    pub(super) fn evidence(&self, now: Instant) -> Option<Evidence> {
        let loss = self.data_loss.present?;
        // A leader claims at once.
        let is_written = loss.since + self.settings().ttl <= now;
        let own = self.chores.published.clone().filter(|_| is_written)?;
        let read_up_to = self.reading.view().revision;
        Some(Evidence { own, read_up_to })
    }

    /// Notes whether the journal with this `origin` could be read from its beginning.
    pub(super) fn note_readable(&mut self, origin: u64, is_readable: bool) {
        let unreadable = if is_readable { 0 } else { origin };
        if std::mem::replace(&mut self.data_loss.unreadable, unreadable) != unreadable {
            self.machine.set_unreadable(unreadable);
            self.publish_entry();
        }
    }

    /// Notes how much another computer holds of a journal that etcd has lost, and whether it cannot read the present
    /// one.
    pub(super) fn note_holdings(&mut self, now: Instant, change: &MemberEntryChange) {
        let entry = change.entry.as_ref();
        let holds = entry.and_then(|entry| entry.holds);
        let before = match holds {
            Some(holds) => self.data_loss.others.insert(change.name.clone(), holds),
            None => self.data_loss.others.remove(&change.name),
        };
        // Another computer may have lost a later journal, which this one has not seen.
        if holds != before {
            self.data_loss.ahead = 0;
        }
        let (leads, view) = (self.published.role == Role::Leading, self.view());
        let shown = Holdings {
            journal_number: view.journal_number,
            term: view.term(),
            seq: view.seq(),
        };
        let unreadable = entry.map_or(0, |entry| entry.unreadable);
        let journal_number = holds.map_or(0, |holds| holds.journal_number);
        if leads && unreadable != 0 && unreadable == view.origin {
            self.reading.check_all(now);
        }
        // This computer has not noticed the loss, because it has just started. It leaves the claim to those that hold more.
        let known = shown.max(self.held);
        if !leads && self.data_loss.present.is_none() && holds.is_some_and(|holds| holds > known) {
            let until = now + self.settings().ttl * PATIENCE;
            self.machine.hold_claims(until);
        }
        self.machine.note_journal(journal_number);
    }

    /// Lets computers that hold more of the lost journal claim leadership first, one after the other: the one that holds
    /// the most may be unable to.
    pub(super) fn update_data_loss(&mut self, now: Instant) {
        let Some(Loss { holds, .. }) = self.data_loss.present else {
            return;
        };
        if !self.journal.own_wins || self.published.role == Role::Leading {
            self.data_loss.present = None;
            return self.chores.publish_entry_by(now);
        }
        let name = &self.settings().name;
        let mine = (holds, name);
        let others = self.data_loss.others.iter();
        let others = others.map(|(name, holds)| (*holds, name));
        let ahead = others.map(|other| u32::from(other > mine)).sum();
        if ahead > self.data_loss.ahead {
            self.data_loss.ahead = ahead;
            let until = now + self.settings().ttl * PATIENCE * ahead;
            self.machine.hold_claims(until);
        }
        // A request of this computer may have succeeded since.
        if self.data_loss.is_remainder(self.view()) || self.leader().is_none() {
            return;
        }
        // Another computer has led since, so its journal counts. Those that have read it claim first. If it is still empty,
        // nobody has, and the one that holds the most of the lost journal is the first.
        let patience = self.settings().ttl * PATIENCE * (1 + ahead);
        if let Some(seen) = self.machine.observed() {
            self.machine.hold_claims(seen + patience);
        }
        if self.reading.loaded && self.journal.progress.seq < self.view().seq() {
            self.reading.load_by(now);
        }
    }
}

/// Whether a defect of the past hides what is not a matter of etcd's revision.
fn trusts() -> bool {
    Mutant::TrustsDeletedKeys.lives() || Mutant::TrustsLostEtcd.lives()
}
