//! Reads the journal, and keeps the ledger current while another computer leads.

use std::time::Instant;

use super::{AGAIN, Action, Entry, Heard, Member, News, Read};
use crate::{
    checkpoint::format::Record,
    cluster::{
        machine::{self, JournalSession, Leader, Role, View},
        mutant::Mutant,
        namesake::{self, Sign},
        standing::Place,
    },
};

/// How far etcd has been read, and what must be read next.
#[derive(Debug, Default)]
pub(super) struct Reading {
    /// Whether the journal has been read once.
    pub(super) loaded: bool,
    /// The machine waits until the journal has been read up to this record.
    pub(super) wanted: Option<u64>,
    /// The machine knows that the journal has been read up to this record.
    reported: u64,
    /// Whether a read is under way.
    loading: bool,
    /// The newest revision of etcd that was known when the read under way began.
    floor: u64,
    /// When the next read is due.
    load_at: Option<Instant>,
    /// How many reads must still end until one has ended that began after [`Self::refresh`] was called.
    fresh: Option<u8>,
    watching: bool,
    /// Whether `app/cluster` is finding out if the session in etcd continues.
    pub(super) deciding: bool,
    /// The keys `leader` and `alive` as etcd showed them last, also before the machine starts.
    view: View,
}

impl Reading {
    /// Makes the next read due at `at` at the latest.
    pub(super) fn load_by(&mut self, at: Instant) {
        self.load_at = Some(self.load_at.map_or(at, |before| before.min(at)));
    }

    /// Asks for a read that begins after `now`. What the watch on etcd delivers may be much older.
    pub(super) fn refresh(&mut self, now: Instant) {
        self.fresh = Some(1 + u8::from(self.loading));
        self.load_by(now);
    }

    /// Whether the read that [`Self::refresh`] asked for has ended.
    pub(super) fn is_fresh(&self) -> bool {
        self.fresh == Some(0)
    }

    pub(super) fn due(&self) -> Option<Instant> {
        self.load_at.filter(|_| !self.loading)
    }

    /// Handles the end of the watch on etcd.
    pub(super) fn ended(&mut self, now: Instant) {
        self.watching = false;
        self.load_at = Some(now + AGAIN);
    }

    /// Starts over with the keys in `view`, because etcd has lost its data.
    pub(super) fn forget(&mut self, view: &View) {
        (self.wanted, self.reported) = (None, 0);
        (self.watching, self.view) = (false, view.clone());
    }

    pub(super) fn view(&self) -> &View {
        &self.view
    }
}

impl Member {
    /// Has the journal read if the machine waits for more of it than has been read.
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

    /// Finds out whether the session in etcd continues, if the machine waits for that.
    fn decide(&mut self, seq: u64) {
        let waits = self.machine.role() == Role::CatchingUp
            && self.machine.session() == JournalSession::Unknown
            && !self.reading.deciding;
        if !waits {
            return;
        }
        if self.own_wins || seq == 0 {
            let goes_on = true;
            return self.tell_machine(machine::Input::Decided { seq, goes_on });
        }
        self.reading.deciding = true;
        let (state, closed) = (self.journal.state.clone(), self.before.released);
        self.act(Action::Decide { seq, state, closed });
    }

    /// Handles the keys `leader` and `alive` and the journal entries that the watch on etcd delivered.
    pub(super) fn watched(&mut self, now: Instant, view: View, entries: Vec<Entry>) {
        // The keys first: if they depose this computer, its writes are kept, and count as older than the entries.
        self.see(now, view);
        let progress = &mut self.journal.progress;
        // All records at once, because each new state may take long.
        let mut records = Vec::new();
        for entry in entries {
            let new = match entry {
                Entry::Records { records, bytes } => progress.take(records, bytes).ok(),
                Entry::Apart(seq) if seq <= progress.seq => continue,
                Entry::Apart(_) => None,
            };
            match new {
                Some(new) => records.extend(new),
                // A gap is filled by a separate read.
                None => {
                    self.reading.load_by(now);
                    break;
                }
            }
        }
        self.follow(now, &records);
        self.yield_own_state();
    }

    /// Passes the keys `leader` and `alive` to the machine.
    fn see(&mut self, now: Instant, view: View) {
        if view.revision >= self.reading.view.revision {
            self.reading.view = view.clone();
        }
        self.yield_own_state();
        self.drive(now, machine::Input::View(view));
    }

    /// Gives up this computer's own state if another computer leads, or if the journal has more. After etcd has lost its
    /// data, the other computer's state must be in the journal first.
    fn yield_own_state(&mut self) {
        let leader = self.view().leader.as_ref();
        let other = leader.filter(|leader| leader.id != self.settings().id);
        let leads = other.is_some_and(|leader| !self.was_self(leader));
        let leads = leads && !self.lost.waits_for(self.journal.progress);
        // A request of this computer's earlier process may reach the journal after the first read.
        let has_more = !self.is_whole(self.journal.progress.seq) && self.lost.since().is_none();
        if self.own_wins && (leads || has_more) {
            self.own_wins = false;
            self.adopt();
        }
    }

    /// Whether the checkpoint holds all of a journal that ends with the record `seq`.
    fn is_whole(&self, seq: u64) -> bool {
        self.own.seq >= seq || Mutant::OwnDiskWins.lives()
    }

    /// Applies new records of the journal.
    fn follow(&mut self, now: Instant, records: &[Record]) {
        if records.is_empty() {
            return;
        }
        self.journal.apply(now, records);
        self.cut_off.note(records);
        if !self.cut_off.is_empty() || self.outgoing.count() > 0 {
            self.adopt();
        } else if self.follows() {
            self.act(Action::Follow(records.to_vec()));
        }
    }

    /// Sets the ledger, if it follows the journal, to the journal's state plus the writes that were answered here and are
    /// not in the journal yet. Callers must see their own writes.
    pub(super) fn adopt(&mut self) {
        if self.follows() {
            let mut state = self.cut_off.on(&self.journal.state);
            // Also what this computer showed as a leader, as long as it is unknown whether another computer leads.
            self.outgoing
                .apply_after(self.journal.progress.seq, &mut state);
            self.act(Action::FollowState(state));
        }
    }

    pub(super) fn loaded(&mut self, now: Instant, read: Option<Read>) {
        self.reading.loading = false;
        // A read that began before `refresh` was called does not count, whether it failed or not.
        let earlier = self.reading.fresh == Some(2);
        if earlier {
            self.reading.fresh = Some(1);
        }
        let Some(read) = read else {
            self.reading.load_at = Some(now + AGAIN);
            return;
        };
        // The term in a checkpoint is a revision of etcd, too.
        let floor = match self.reading.loaded {
            true => self.reading.floor,
            false => self.reading.floor.max(self.own.term),
        };
        if self.has_lost(&read.view, floor) {
            return self.start_over(now, &read.view);
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
            // etcd's journal is the truth. The checkpoint counts only if it continues that journal in the same term.
            let leader = read.view.leader.as_ref();
            let whole = self.is_whole(read.view.seq());
            let own = leader.is_none_or(|leader| self.was_self(leader) && whole);
            self.own_wins = own || self.lost.since().is_some();
        } else {
            self.see(now, read.view.clone());
        }
        let journal = &mut self.journal;
        let mut is_new_state = first;
        if let Some((state, displaced)) = read.state
            && read.progress.seq >= journal.progress.seq
        {
            let before = std::mem::replace(&mut journal.state, state);
            // The first state of a new journal comes from the computer that held the most.
            let before = match self.own_wins {
                true => &self.own.state,
                false => &before,
            };
            if !first {
                self.cut_off.note_difference(Some(before), &journal.state);
                self.cut_off.note(&read.records);
            }
            journal.displaced.add(now, displaced);
            journal.apply(now, &read.records);
            journal.progress = read.progress;
            is_new_state = true;
        } else {
            match journal.progress.take(read.records, 0) {
                Ok(new) if first => self.journal.apply(now, &new),
                Ok(new) => self.follow(now, &new),
                Err(_) => is_new_state = false,
            }
        }
        // Before the state is shown, because kept writes that conflict with others' changes are not part of it. An empty
        // journal after a loss says nothing of what others have changed.
        if first && (!self.is_starting_over() || self.journal.progress.seq > 0) {
            self.cut_off.note_difference(None, &self.journal.state);
        }
        if is_new_state {
            self.adopt();
        }
        if first {
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
        self.yield_own_state();
    }

    /// Starts the machine, unless it has started already.
    pub(super) fn start(&mut self, now: Instant) {
        if self.queue.start_by.take().is_some() {
            self.drive(now, machine::Input::Start(0));
        }
    }

    /// Whether `leader` is an earlier process of this computer, and still in the term of the checkpoint.
    fn was_self(&self, leader: &Leader) -> bool {
        let own = self.settings();
        leader.id != own.id && leader.name == own.name && leader.term == self.own.term
    }

    /// Updates the place up to which the mirror is current.
    pub(super) fn look_at_place(&mut self) {
        let seq = self.journal.progress.seq;
        // If `differs`, the mirror is at no place of the journal: it holds records or kept writes that the journal
        // lacks.
        let lost = self.lost.since().is_some();
        let differs = self.own.seq > seq || lost || !self.cut_off.is_empty();
        if self.own_wins && differs && !self.records() {
            return;
        }
        let view = self.view();
        // The leader's term counts only once the mirror has the whole journal before that leader's first record.
        let whole = self.reading.loaded && seq >= view.seq();
        let leader = view.leader.as_ref().filter(|_| whole);
        let term = leader.map_or(self.place.term, |leader| leader.term);
        let epoch = self.lost.times;
        // A former leader's mirror still has the changes that the journal may lack.
        let own = view
            .leader
            .as_ref()
            .is_some_and(|of| of.id == self.settings().id);
        let seq = match self.follows() && own {
            true => seq.max(self.outgoing.last()),
            false => seq,
        };
        self.place = Place { epoch, term, seq };
    }

    /// Handles what computers have written into their entries among the members.
    pub(super) fn hear(&mut self, heard: &[Heard]) {
        let own = self.machine.settings();
        for heard in heard.iter().filter(|heard| heard.name == own.name) {
            self.namesake.sign = heard.sign_of_namesake(own);
        }
        let mut outdated = false;
        for heard in heard.iter().filter(|heard| heard.name != own.name) {
            self.lost.hear(heard);
            outdated |= self.chores.notifying.hear(heard);
        }
        if outdated && self.role == Role::Leading && !Mutant::LeavesOldNews.lives() {
            self.act(Action::TellAll);
        }
    }

    /// Delays the start if another computer may have this one's name.
    fn begin_watch_for_namesake(&mut self, now: Instant, view: &View) {
        let signs = self.signs_of_namesake(view);
        let watch = namesake::NamesakeWatch::new(now, self.settings().ttl, signs);
        if let (Some(until), Some(uri)) = (watch.hold(), watch.suspect()) {
            let uri = uri.to_owned();
            self.queue.start_by = self.queue.start_by.map(|_| until);
            self.tell(News::Suspect { uri, until });
        }
        self.namesake.watch = Some(watch);
    }

    /// Ends this member if another living computer has its name.
    pub(super) fn check_for_namesake(&mut self, now: Instant) {
        let view = self.view();
        let signs = self.signs_of_namesake(view);
        let watch = self.namesake.watch.as_ref();
        let living = watch.and_then(|watch| watch.living(now, &signs));
        let mut there = living.map(|sign| sign.uri.clone());
        if let Some(leader) = &view.leader {
            let own = self.machine.settings();
            // Only one process runs on a computer at a time, so this leader is another computer.
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

    /// The evidence in etcd of another computer with this one's name.
    fn signs_of_namesake(&self, view: &View) -> Vec<Sign> {
        let leader = namesake::sign_of_leader(self.settings(), view);
        let member = self.namesake.sign.clone();
        leader.into_iter().chain(member).collect()
    }
}
