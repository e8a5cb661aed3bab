//! Reads the journal, and brings the ledger there while another computer leads.

use std::time::Instant;

use super::{AGAIN, Action, Entry, Heard, Member, News, Read};
use crate::{
    checkpoint::format::Record,
    cluster::{
        machine::{self, Leader, Role, Session, View},
        mutant::Mutant,
        namesake::{self, Sign},
        standing::Place,
    },
};

/// What is read of etcd, and what is not.
#[derive(Debug, Default)]
pub(super) struct Reading {
    /// Whether the journal has been read once.
    pub(super) loaded: bool,
    /// The machine waits for the journal up to here.
    pub(super) wanted: Option<u64>,
    /// How far the machine knows that it has been read.
    reported: u64,
    /// It is being read,
    loading: bool,
    /// by a read that began when this revision was known,
    floor: u64,
    /// or will be.
    load_at: Option<Instant>,
    /// Who wants what etcd holds now waits for so many readings to end.
    fresh: Option<u8>,
    watching: bool,
    /// Both keys, as etcd has shown them last. The machine is shown nothing before it is started.
    view: View,
}

impl Reading {
    /// The journal is read at `at` at the latest.
    pub(super) fn load_by(&mut self, at: Instant) {
        self.load_at = Some(self.load_at.map_or(at, |before| before.min(at)));
    }

    /// The journal is to be read to a moment after `now`. What the watch has told may be of long before.
    pub(super) fn refresh(&mut self, now: Instant) {
        self.fresh = Some(1 + u8::from(self.loading));
        self.load_by(now);
    }

    /// Whether what [`Self::refresh`] asked for is there.
    pub(super) fn is_fresh(&self) -> bool {
        self.fresh == Some(0)
    }

    pub(super) fn due(&self) -> Option<Instant> {
        self.load_at.filter(|_| !self.loading)
    }

    /// The watch has ended.
    pub(super) fn ended(&mut self, now: Instant) {
        self.watching = false;
        self.load_at = Some(now + AGAIN);
    }

    /// etcd shows `view`, and has lost what it held before.
    pub(super) fn forget(&mut self, view: &View) {
        (self.wanted, self.reported) = (None, 0);
        (self.watching, self.view) = (false, view.clone());
    }

    pub(super) fn view(&self) -> &View {
        &self.view
    }
}

impl Member {
    /// Has the journal read if it is not known as far as it must be.
    pub(super) fn catch_up(&mut self, now: Instant) {
        let seq = self.journal.progress.seq;
        let wanted = self.reading.wanted;
        let news = wanted.is_some() || self.reading.reported != seq;
        let there = seq >= wanted.unwrap_or_default();
        if news && self.reading.loaded && !self.records() && there {
            (self.reading.wanted, self.reading.reported) = (None, seq);
            self.tell_machine(machine::Input::Followed(seq));
        }
        if self.reading.loaded && seq >= self.view().seq() {
            self.decide(seq);
        }
        if !there && !self.reading.loading && self.reading.load_at.is_none() {
            self.reading.load_by(now);
        }
        if self.reading.due().is_some_and(|at| at <= now) {
            (self.reading.load_at, self.reading.loading) = (None, true);
            self.reading.floor = self.view().revision;
            self.act(Action::Load(self.journal.progress));
        }
    }

    /// Has it found out whether the session in etcd goes on, if the machine waits for that.
    fn decide(&mut self, seq: u64) {
        let waits = self.machine.role() == Role::CatchingUp
            && self.machine.session() == Session::Unknown
            && !self.deciding;
        if !waits {
            return;
        }
        if self.own_wins || seq == 0 {
            let goes_on = true;
            return self.tell_machine(machine::Input::Decided { seq, goes_on });
        }
        self.deciding = true;
        let (state, closed) = (self.journal.state.clone(), self.before.released);
        self.act(Action::Decide { seq, state, closed });
    }

    /// The watch shows both keys, and entries of the journal.
    pub(super) fn watched(&mut self, now: Instant, view: View, entries: Vec<Entry>) {
        // First: what this computer has answered in vain was before what others have changed.
        self.see(now, view);
        for entry in entries {
            let new = match entry {
                Entry::Records { records, bytes } => {
                    self.journal.progress.take(records, bytes).ok()
                }
                Entry::Apart(seq) if seq <= self.journal.progress.seq => continue,
                Entry::Apart(_) => None,
            };
            match new {
                Some(new) => self.follow(now, &new),
                // What does not follow is read apart, too.
                None => {
                    self.reading.load_by(now);
                    break;
                }
            }
        }
        self.yield_to_others();
    }

    /// Shows the machine both keys.
    fn see(&mut self, now: Instant, view: View) {
        if view.revision >= self.reading.view.revision {
            self.reading.view = view.clone();
        }
        self.yield_to_others();
        self.drive(now, machine::Input::View(view));
    }

    /// The journal wins if another computer leads. Where etcd has lost its data, that one's state has to be there.
    fn yield_to_others(&mut self) {
        let leader = self.view().leader.as_ref();
        let other = leader.filter(|leader| leader.id != self.settings().id);
        let leads = other.is_some_and(|leader| !self.was_self(leader));
        if self.own_wins && leads && !self.lost.waits_for(self.journal.progress) {
            self.own_wins = false;
            self.adopt();
        }
    }

    /// New records of the journal.
    fn follow(&mut self, now: Instant, records: &[Record]) {
        if records.is_empty() {
            return;
        }
        self.journal.go_on(now, records);
        self.cut_off.note(records);
        if !self.cut_off.is_empty() || self.outgoing.count() > 0 {
            self.adopt();
        } else if self.follows() {
            self.act(Action::Follow(records.to_vec()));
        }
    }

    /// Brings the ledger to the journal's state, if it follows it, with what was answered alone and is not there yet:
    /// who wrote that is to see it.
    pub(super) fn adopt(&mut self) {
        if self.follows() {
            let mut state = self.cut_off.on(&self.journal.state);
            // As a leader that may answer nothing more, and does not know yet whether another one leads.
            let (held, answered) = (self.journal.progress.seq, self.acknowledged);
            self.outgoing.apply(held + 1..=answered, &mut state);
            self.act(Action::FollowState(state));
        }
    }

    pub(super) fn loaded(&mut self, now: Instant, read: Option<Read>) {
        self.reading.loading = false;
        // One that began before it was wanted counts for nothing, whether it has failed or not.
        let earlier = self.reading.fresh == Some(2);
        if earlier {
            self.reading.fresh = Some(1);
        }
        let Some(read) = read else {
            self.reading.load_at = Some(now + AGAIN);
            return;
        };
        // The term of a checkpoint is a revision, too.
        let floor = match self.reading.loaded {
            true => self.reading.floor,
            false => self.reading.floor.max(self.own.term),
        };
        if self.has_lost(&read.view, floor) {
            return self.begin_anew(now, &read.view);
        }
        if !earlier {
            self.reading.fresh = self.reading.fresh.map(|_| 0);
        }
        if !self.reading.watching {
            self.reading.watching = true;
            self.act(Action::Watch(read.view.clone()));
        }
        let first = !std::mem::replace(&mut self.reading.loaded, true);
        if first {
            if self.namesake.watch.is_none() {
                self.begin_watch_for_namesake(now, &read.view);
            }
            // etcd's journal is the truth. Our checkpoint may only hold more of it, written in the same term.
            let leader = read.view.leader.as_ref();
            let whole = self.own.seq >= read.view.seq() || Mutant::OwnDiskWins.lives();
            let own = leader.is_none_or(|leader| self.was_self(leader) && whole);
            self.own_wins = own || self.lost.since().is_some();
        } else {
            self.see(now, read.view.clone());
        }
        let journal = &mut self.journal;
        if let Some((state, displaced)) = read.state
            && read.progress.seq >= journal.progress.seq
        {
            let before = std::mem::replace(&mut journal.state, state);
            // In a new journal the first state is that of the computer that held most.
            let before = match self.own_wins {
                true => &self.own.state,
                false => &before,
            };
            if !first {
                self.cut_off.note_difference(Some(before), &journal.state);
                self.cut_off.note(&read.records);
            }
            journal.displaced.add(now, displaced);
            journal.go_on(now, &read.records);
            journal.progress = read.progress;
            self.adopt();
        } else if let Ok(new) = journal.progress.take(read.records, 0) {
            match first {
                // The ledger may hold something else.
                true => {
                    self.journal.go_on(now, &new);
                    self.adopt();
                }
                false => self.follow(now, &new),
            }
        }
        if first {
            if !self.begun_anew() {
                self.cut_off.note_difference(None, &self.journal.state);
            }
            if self
                .namesake
                .watch
                .as_ref()
                .is_none_or(|of| of.is_over(now))
            {
                self.start(now);
            }
            self.see(now, read.view);
        }
        self.yield_to_others();
    }

    /// Starts the machine, once.
    pub(super) fn start(&mut self, now: Instant) {
        if self.queue.start_by.take().is_some() {
            self.drive(now, machine::Input::Start(0));
        }
    }

    /// Whether an earlier process of this computer leads, and nobody has since the checkpoint was written.
    fn was_self(&self, leader: &Leader) -> bool {
        let own = self.settings();
        leader.id != own.id && leader.name == own.name && leader.term == self.own.term
    }

    /// How far the mirror holds the journal.
    pub(super) fn look_at_place(&mut self) {
        let seq = self.journal.progress.seq;
        // What only the checkpoint holds is lost if another computer leads next, and what is owed is not in it.
        let differs = self.own.seq > seq || !self.cut_off.is_empty();
        if self.own_wins && differs && !self.records() {
            return;
        }
        let view = self.view();
        // The whole journal up to this leader's first record, at least.
        let whole = self.reading.loaded && seq >= view.seq();
        let leader = view.leader.as_ref().filter(|_| whole);
        let term = leader.map_or(self.place.term, |leader| leader.term);
        let epoch = self.lost.times;
        self.place = Place { epoch, term, seq };
    }

    /// Takes what computers say of themselves.
    pub(super) fn hear(&mut self, heard: &[Heard]) {
        let own = self.machine.settings();
        for heard in heard.iter().filter(|heard| heard.name == own.name) {
            self.namesake.sign = heard.sign_of_namesake(own);
        }
        for heard in heard.iter().filter(|heard| heard.name != own.name) {
            self.lost.hear(heard);
        }
    }

    /// Holds the start back if another computer may have this one's name.
    fn begin_watch_for_namesake(&mut self, now: Instant, view: &View) {
        let signs = self.signs_of_namesake(view);
        let watch = namesake::Watch::new(now, self.settings().ttl, signs);
        if let (Some(until), Some(uri)) = (watch.hold(), watch.suspect()) {
            let uri = uri.to_owned();
            self.queue.start_by = self.queue.start_by.map(|_| until);
            self.tell(News::Suspect { uri, until });
        }
        self.namesake.watch = Some(watch);
    }

    /// Notices another living computer of this name, best before this one takes part.
    pub(super) fn look_for_namesake(&mut self, now: Instant) {
        let view = self.view();
        let signs = self.signs_of_namesake(view);
        let watch = self.namesake.watch.as_ref();
        let living = watch.and_then(|watch| watch.living(now, &signs));
        let mut there = living.map(|sign| sign.uri.clone());
        if let Some(leader) = &view.leader {
            let own = self.machine.settings();
            // There is one process at a time on a computer, so that one is another computer's.
            if leader.id == own.id {
                self.namesake.led = true;
            } else if self.namesake.led && leader.name == own.name {
                there = there.or_else(|| Some(leader.uri.clone()));
            }
        }
        if let Some(uri) = there.filter(|_| !Mutant::IgnoresNamesake.lives()) {
            self.act(Action::EndForNamesake(uri));
        }
    }

    /// What etcd shows of another computer with this one's name.
    fn signs_of_namesake(&self, view: &View) -> Vec<Sign> {
        let leader = namesake::sign_of_leader(self.settings(), view);
        let member = self.namesake.sign.clone();
        leader.into_iter().chain(member).collect()
    }
}
