//! Reads the journal, and keeps the ledger current while another computer leads.

use std::time::Instant;

use super::{AGAIN, Action, Member, MemberEntryChange, Read, WatchedEntry};
use crate::{
    checkpoint::format::Record,
    cluster::{
        journal::Progress,
        machine::{self, JournalSession, Leader, Role, View},
        mutant::Mutant,
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
    /// What etcd had shown when the read under way began.
    before: View,
    /// Whether the next read is to check the whole journal.
    check_due: bool,
    /// Whether the read under way checks the whole journal.
    checks: bool,
    /// Whether the watch has shown that keys of the journal are gone, and the journal has not been checked since. Until
    /// then nothing that etcd says counts.
    pub(super) is_doubtful: bool,
    /// When the next read is due.
    load_at: Option<Instant>,
    /// How many reads must still end until one has ended that began after [`Self::refresh`] was called.
    fresh: Option<u8>,
    watching: bool,
    /// The revision up to which the watch has delivered changes.
    watched: u64,
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

    /// Asks for a check whether the journal can be read from its beginning.
    pub(super) fn check_all(&mut self, now: Instant) {
        self.check_due = true;
        self.load_by(now);
    }

    /// Asks for a read of etcd that begins after `now`. What the watch delivers may be much older.
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

    fn ended(&mut self, now: Instant) {
        self.watching = false;
        self.load_at = Some(now + AGAIN);
    }

    /// Starts over with the keys in `view`, because etcd has lost its data.
    pub(super) fn forget(&mut self, view: &View) {
        (self.wanted, self.reported) = (None, 0);
        (self.watching, self.view) = (false, view.clone());
        (self.check_due, self.is_doubtful) = (false, false);
    }

    pub(super) fn view(&self) -> &View {
        &self.view
    }
}

impl Member {
    /// Has the journal read if the machine waits for more of it than has been read.
    pub(super) fn catch_up(&mut self, now: Instant) {
        let seq = self.journal.progress.seq;
        // A new journal may be shorter than the lost one whose end the machine waits for.
        let wanted = self.reading.wanted.map(|seq| seq.min(self.view().seq()));
        let news = wanted.is_some() || self.reading.reported != seq;
        let there = seq >= wanted.unwrap_or_default();
        if news && self.reading.loaded && !self.records() && there {
            (self.reading.wanted, self.reading.reported) = (None, seq);
            self.queue_input(machine::Input::Followed(seq));
        }
        if self.reading.loaded && seq >= self.view().seq() {
            self.decide(seq);
        }
        if !there && !self.reading.loading && self.reading.load_at.is_none() {
            self.reading.load_by(now);
        }
        if self.reading.due().is_some_and(|at| at <= now) {
            (self.reading.load_at, self.reading.loading) = (None, true);
            self.reading.before = self.view().clone();
            self.reading.checks = std::mem::take(&mut self.reading.check_due);
            let after = match self.reading.checks {
                true => Progress::default(),
                false => self.journal.progress,
            };
            self.act(Action::Load(after));
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
        if self.journal.own_wins || seq == 0 {
            let goes_on = true;
            return self.queue_input(machine::Input::Decided { seq, goes_on });
        }
        self.reading.deciding = true;
        let (state, closed) = (self.journal.state.clone(), self.before.released);
        self.act(Action::Decide { seq, state, closed });
    }

    /// Handles the keys `leader` and `alive` and the journal entries that the watch on etcd delivered.
    ///
    /// `deleted` is the number of the last journal entry that was deleted.
    pub(super) fn watched(
        &mut self,
        now: Instant,
        view: View,
        mut entries: Vec<(u64, WatchedEntry)>,
        deleted: Option<u64>,
    ) {
        if self.guards_journal() && deleted.is_some_and(|seq| seq > self.chores.replaced) {
            self.reading.check_all(now);
            self.reading.is_doubtful = true;
        }
        self.reading.watched = self.reading.watched.max(view.revision);
        let (known, origin) = (self.view().origin, view.origin);
        // What the watch delivers late is older than the answers to requests, and says nothing.
        if view.revision >= self.view().revision && self.doubts(now, &view) {
            // What was added to the lost journal before still counts.
            let is_other = ![0, known].contains(&origin);
            entries.retain(|(revision, _)| !is_other || *revision < origin);
            let next = self.journal.progress.seq + 1;
            // Others' entries must not count as the state on which this computer's own writes were made.
            self.outgoing.retain_own(&mut entries);
            if entries
                .first()
                .is_some_and(|(_, first)| first.begins_with(next))
            {
                self.take_entries(now, entries);
                // This computer's own entries need no merge.
                self.outgoing.committed(self.journal.progress.seq);
            }
            return;
        }
        // The watch may have begun before the journal.
        entries.retain(|(revision, _)| *revision > origin);
        if self.reading.is_doubtful {
            return;
        }
        // The keys first: if they depose this computer, its writes are kept, and count as older than the entries.
        self.see(now, view);
        if origin != self.view().origin {
            // A new journal has begun since.
            return;
        }
        self.take_entries(now, entries);
        self.discard_own_state();
    }

    /// Follows the journal with these entries, up to the first that does not continue it.
    fn take_entries(&mut self, now: Instant, entries: Vec<(u64, WatchedEntry)>) {
        let progress = &mut self.journal.progress;
        // All records at once, because each new state may take long.
        let mut records = Vec::new();
        for (_, entry) in entries {
            let new = match entry {
                WatchedEntry::Records { records, bytes } => progress.take(records, bytes).ok(),
                WatchedEntry::Apart(seq) if seq <= progress.seq => continue,
                WatchedEntry::Apart(_) => None,
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
    }

    /// Whether this computer must notice that keys of the journal are deleted: it leads, or may lead on.
    fn guards_journal(&self) -> bool {
        let leads = matches!(self.published.role, Role::Leading | Role::Alone);
        leads && self.machine.term().is_some() && !Mutant::TrustsDeletedKeys.lives()
    }

    /// Handles the end of the watch on etcd. It may have missed that keys were deleted.
    pub(super) fn watch_ended(&mut self, now: Instant) {
        self.reading.check_due |= self.guards_journal();
        self.reading.ended(now);
    }

    /// Passes what etcd shows of its keys `origin`, `leader` and `alive` to the machine, which decides who leads.
    fn see(&mut self, now: Instant, view: View) {
        if view.revision >= self.reading.view.revision {
            self.reading.view = view.clone();
        }
        self.discard_own_state();
        self.drive(now, machine::Input::View(view));
    }

    /// Gives up this computer's own state if another computer leads and its state is in the journal, or if the journal
    /// has more.
    fn discard_own_state(&mut self) {
        let leader = self.view().leader.as_ref();
        let other = leader.filter(|leader| leader.id != self.settings().id);
        let leads = other.is_some_and(|leader| !self.was_self(leader));
        let leads = leads && !self.journal.is_empty();
        // A request of this computer's earlier process may reach the journal after the first read.
        let has_more =
            !self.is_whole(self.journal.progress.seq) && self.data_loss.since().is_none();
        if self.journal.own_wins && (leads || has_more) {
            self.journal.own_wins = false;
            self.adopt();
        }
    }

    /// Whether the checkpoint holds all of a journal that ends with the record `seq`.
    fn is_whole(&self, seq: u64) -> bool {
        self.local.seq >= seq || Mutant::OwnDiskWins.lives()
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
            let seq = self.journal.progress.seq;
            self.act(Action::FollowState { seq, state });
        }
    }

    /// Handles a read of etcd. `None` if it failed.
    pub(super) fn loaded(&mut self, now: Instant, read: Option<Read>) {
        self.reading.loading = false;
        // A read that began before `refresh` was called does not count, whether it failed or not.
        let earlier = self.reading.fresh == Some(2);
        if earlier {
            self.reading.fresh = Some(1);
        }
        let checks = std::mem::take(&mut self.reading.checks);
        let Some(read) = read else {
            self.reading.load_at = Some(now + AGAIN);
            self.reading.check_due |= checks;
            return;
        };
        let before = std::mem::take(&mut self.reading.before);
        if self.is_late(&before, &read.view) {
            self.reading.load_at = Some(now);
            self.reading.check_due |= checks;
            return;
        }
        self.note_readable(read.view.origin, read.is_readable);
        if self.has_lost(&read.view, &before, read.is_readable) {
            return self.start_over(now, &read.view);
        }
        let Some(read) = self.usable(now, read, checks) else {
            return;
        };
        if !earlier {
            self.reading.fresh = self.reading.fresh.map(|_| 0);
        }
        // The watch waits for later revisions than it has delivered. In an older copy they are given out again, and the watch
        // would miss what is added until then.
        if !self.reading.watching || read.view.revision < self.reading.watched {
            (self.reading.watching, self.reading.watched) = (true, read.view.revision);
            self.act(Action::Watch(read.view.clone()));
        }
        match std::mem::replace(&mut self.reading.loaded, true) {
            false => self.take_first(now, read),
            true => self.take_later(now, read),
        }
        if checks && !self.records() {
            // A leader knows the records that a check has read. This one was deposed meanwhile, and the watch begins
            // after them.
            self.reading.load_by(now);
        }
        self.discard_own_state();
    }

    /// Whether a read that began when etcd had shown `before` says nothing: another journal has begun since, an older copy
    /// has replaced the one that was read, or its leader's key has been deleted. What was read of the earlier one is no
    /// loss.
    fn is_late(&self, before: &View, read: &View) -> bool {
        let known = self.view();
        let is_deleted = known.leader.is_none() && read.leader.is_some();
        let is_other = read.origin != known.origin || read.seq() > known.seq() || is_deleted;
        (before.revision..known.revision).contains(&read.revision) && is_other
    }

    /// What counts of a read that shows no loss. `None` if another read must follow first.
    fn usable(&mut self, now: Instant, mut read: Read, checks: bool) -> Option<Read> {
        // Without its origin, what can be read is left of a lost journal.
        if self.data_loss.is_remainder(&read.view) || read.view.origin == 0 {
            read = Read {
                view: read.view,
                ..Read::empty()
            };
        } else if !read.is_readable {
            // The leader of this journal repairs it.
            self.reading.load_at = Some(now + AGAIN);
            self.see(now, read.view);
            return None;
        } else if checks {
            // The records are known.
            (read.state, read.records) = (None, Vec::new());
            // If another check is due, the watch has shown something since this one began.
            self.reading.is_doubtful &= self.reading.check_due;
        }
        if self.reading.is_doubtful {
            self.reading.load_at = Some(now);
            return None;
        }
        Some(read)
    }

    /// Takes the first read since the start, or since a loss of etcd's data.
    fn take_first(&mut self, now: Instant, read: Read) {
        if self.namesake.watch.is_none() {
            self.begin_watch_for_namesake(now, &read.view);
        }
        // etcd's journal is the truth. The checkpoint counts only if it continues that journal in the same term.
        let leader = read.view.leader.as_ref();
        let whole = self.is_whole(read.view.seq());
        let own = leader.is_none_or(|leader| self.was_self(leader) && whole);
        // This computer may have begun the journal before this read.
        let is_empty = read.view.seq() == 0 && !self.records();
        self.journal.own_wins = own || is_empty || self.data_loss.since().is_some();
        // All of a journal that began after a loss is newer than what this computer kept. Comparing states would not show
        // a value that others have set and set back.
        let of_others = match self.data_loss.is_made_good_by(&read.view) {
            true => read.records.clone(),
            false => Vec::new(),
        };
        let Read {
            view,
            state,
            records,
            progress,
            ..
        } = read;
        let journal = &mut self.journal;
        let is_taken = match state {
            Some((state, displaced)) if progress.seq >= journal.progress.seq => {
                journal.state = state;
                journal.displaced.add(now, displaced);
                journal.apply(now, &records);
                journal.progress = progress;
                true
            }
            _ => {
                let new = journal.progress.take(records, 0);
                new.map(|new| journal.apply(now, &new)).is_ok()
            }
        };
        // Before the state is shown, because partition writes that conflict with others' changes are not part of it. A journal
        // without a state says nothing of what others have changed.
        if !journal.is_empty() {
            self.cut_off.note_difference(None, &journal.state);
            self.cut_off.note(&of_others);
        }
        if is_taken {
            self.adopt();
        }
        let watch = self.namesake.watch.as_ref();
        if watch.is_none_or(|of| of.is_over(now)) {
            self.start(now);
        }
        self.see(now, view);
    }

    /// Takes a read that continues an earlier one.
    fn take_later(&mut self, now: Instant, read: Read) {
        let Read {
            view,
            state,
            records,
            progress,
            ..
        } = read;
        self.see(now, view);
        let journal = &mut self.journal;
        if let Some((state, displaced)) = state
            && progress.seq >= journal.progress.seq
        {
            let before = std::mem::replace(&mut journal.state, state);
            // The first state of a new journal comes from the computer that held the most.
            let before = match journal.own_wins {
                true => &self.local.state,
                false => &before,
            };
            self.cut_off.note_difference(Some(before), &journal.state);
            self.cut_off.note(&records);
            journal.displaced.add(now, displaced);
            journal.apply(now, &records);
            journal.progress = progress;
            self.adopt();
        } else if let Ok(new) = journal.progress.take(records, 0) {
            self.follow(now, &new);
        }
    }

    /// Starts the machine, unless it has started already.
    pub(super) fn start(&mut self, now: Instant) {
        if self.queue.start_by.take().is_some() {
            self.drive(now, machine::Input::Start);
        }
    }

    /// Whether `leader` is an earlier process of this computer, and still in the term of the checkpoint.
    fn was_self(&self, leader: &Leader) -> bool {
        let own = self.settings();
        leader.id != own.id && leader.name == own.name && leader.term == self.local.term
    }

    /// Handles what computers have written into their entries among the members.
    pub(super) fn note_member_entries(&mut self, now: Instant, changes: &[MemberEntryChange]) {
        let mut outdated = false;
        for change in changes {
            let own = self.machine.settings();
            if change.name == own.name {
                self.namesake.sign = change.sign_of_namesake(own);
                continue;
            }
            self.note_holdings(now, change);
            outdated |= self.chores.notifying.note_entry(change);
        }
        if outdated && self.published.role == Role::Leading && !Mutant::LeavesOldNews.lives() {
            self.act(Action::NotifyAll);
        }
    }
}
