//! Reads the journal, keeps the ledger current while another computer leads, and sends the writes that were answered
//! while cut off to the leader, except those that conflict with others' writes.

use std::{
    collections::BTreeSet,
    sync::Arc,
    time::{Duration, Instant},
};

use super::{AGAIN, Action, Entry, Heard, Member, News, Read};
use crate::{
    checkpoint::format::Record,
    cluster::{
        journal::Progress,
        machine::{self, JournalSession, Leader, Role, View},
        merge::{
            self, Changes, TELLER, parameter_of, weight,
            wire::{self, Ask, WriteOutcome},
        },
        mutant::Mutant,
        namesake::{self, Sign},
        standing::Place,
    },
    master::{Master, Method, Request, names},
    xmlrpc::Value,
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

    /// Asks for a check whether the journal can be read from its beginning.
    pub(super) fn check_all(&mut self, now: Instant) {
        self.check_due = true;
        self.load_by(now);
    }

    /// Asks for a read that begins after `now`. What the watch on etcd delivers may be much older.
    fn refresh(&mut self, now: Instant) {
        self.fresh = Some(1 + u8::from(self.loading));
        self.load_by(now);
    }

    /// Whether the read that [`Self::refresh`] asked for has ended.
    fn is_fresh(&self) -> bool {
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
        self.check_due = false;
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
            self.reading.before = self.view_to_continue();
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
            return self.tell_machine(machine::Input::Decided { seq, goes_on });
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
        entries: Vec<Entry>,
        deleted: Option<u64>,
    ) {
        // What the watch delivers late is older than the answers to requests, and says nothing.
        if view.revision >= self.view().revision && self.doubts(now, &view) {
            return;
        }
        let leads = self.told.role == Role::Leading && !Mutant::TrustsDeletedKeys.lives();
        if leads && deleted.is_some_and(|seq| seq > self.chores.replaced) {
            self.reading.check_all(now);
        }
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
        let leads = leads && !self.data_loss.waits_for(self.journal.progress);
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
        let checks = std::mem::take(&mut self.reading.checks);
        let Some(mut read) = read else {
            self.reading.load_at = Some(now + AGAIN);
            self.reading.check_due |= checks;
            return;
        };
        let before = std::mem::take(&mut self.reading.before);
        self.note_readable(read.view.origin, read.is_readable);
        if self.has_lost(&read.view, &before, read.is_readable) {
            return self.start_over(now, &read.view);
        }
        if self.data_loss.is_left(&read.view) {
            read = Read {
                view: read.view,
                ..Read::empty()
            };
        } else if !read.is_readable {
            // The leader of this journal repairs it.
            self.reading.load_at = Some(now + AGAIN);
            return self.see(now, read.view);
        } else if checks {
            // The records are known.
            (read.state, read.records) = (None, Vec::new());
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
            self.journal.own_wins = own || self.data_loss.since().is_some();
            // etcd is not new, so its keys may just have been deleted. Computers that hold the state say so now.
            if leader.is_none() && read.view.revision > 1 {
                self.machine.hold_claims(now + self.settings().ttl);
            }
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
            let before = match journal.own_wins {
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
        // Before the state is shown, because kept writes that conflict with others' changes are not part of it. After a
        // loss, what is left of the old journal says nothing of what others have changed.
        if first && !self.data_loss.waits_for(self.journal.progress) {
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
        let lost = self.data_loss.since().is_some();
        let differs = self.own.seq > seq || lost || !self.cut_off.is_empty();
        if self.journal.own_wins && differs && !self.records() {
            return;
        }
        let view = self.view();
        // The leader's term counts only once the mirror has the whole journal before that leader's first record.
        let whole = self.reading.loaded && seq >= view.seq();
        let leader = view.leader.as_ref().filter(|_| whole);
        let term = leader.map_or(self.place.term, |leader| leader.term);
        let epoch = self.data_loss.times;
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
    pub(super) fn hear(&mut self, now: Instant, heard: &[Heard]) {
        let mut outdated = false;
        for heard in heard {
            let own = self.machine.settings();
            if heard.name == own.name {
                self.namesake.sign = heard.sign_of_namesake(own);
                continue;
            }
            self.hear_of_loss(now, heard);
            outdated |= self.chores.notifying.hear(heard);
        }
        if outdated && self.told.role == Role::Leading && !Mutant::LeavesOldNews.lives() {
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
            } else if self.namesake.led && leader.name == own.name && !self.data_loss.is_left(view)
            {
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

/// Pause before a request that the leader did not answer is sent again.
const MERGE_AGAIN: Duration = Duration::from_millis(100);
/// How often the merge sets parameters again that others keep changing. The limit is low, because calls wait for the
/// end of the merge, and each change by others notifies the nodes, too.
const ROUNDS_MAX: u32 = 3;
/// The largest number of calls in one request to the leader ([`Ask`]). Other writes pass between two requests.
const CALLS_MOST: usize = 100;
/// The approximate size limit of one request to the leader ([`Ask`]), in bytes.
const BYTES_MOST: usize = 512 << 10;

#[derive(Debug, Default)]
enum Step {
    #[default]
    Idle,
    /// Waits until the journal has been read as it is now.
    Reading,
    /// Waits for the answer to this request, from the leader at this address and of this term, or from this computer.
    Asked(Ask, Option<(String, u64)>),
    /// Waits until this time, then sends this request again or, if there is none, decides again which of the remaining
    /// writes to send.
    Pause(Instant, Option<Ask>),
}

/// The state of sending the writes of the oldest period of being cut off to the leader.
#[derive(Debug)]
pub(super) struct Merging {
    /// The first part of the name under which this computer sends the writes that it answered while it was cut off. The
    /// second part is `periods`.
    id: String,
    /// For how many periods of being cut off all writes were sent before.
    periods: u64,
    step: Step,
    /// The number of the last request to the leader. Answers to earlier ones are ignored.
    asked: u64,
    /// The writes still to be sent. `None` until it is decided which of them conflict with others' changes.
    left: Option<Vec<Request>>,
    /// Parameters of which nodes here heard a value that was lost. These nodes must hear the present value.
    untold: BTreeSet<String>,
    /// Whether the present request to the leader sets the parameters in [`Self::untold`] again, instead of sending
    /// writes.
    telling: bool,
    /// How often a request that sets parameters again failed, because others changed one of them meanwhile.
    rounds: u32,
    /// Whether the leader has answered a request since this computer last read the journal. The mirror then lacks the
    /// writes of that request.
    unread: bool,
    /// The writes in `left` conflict with no change up to this record of the journal.
    judged: u64,
    sent: u64,
    lost: u64,
}

impl Merging {
    pub(super) fn new(id: String) -> Self {
        Self {
            id,
            periods: 0,
            step: Step::Idle,
            asked: 0,
            left: None,
            untold: BTreeSet::new(),
            telling: false,
            rounds: 0,
            unread: false,
            judged: 0,
            sent: 0,
            lost: 0,
        }
    }

    pub(super) fn due(&self) -> Option<Instant> {
        match self.step {
            Step::Pause(until, _) => Some(until),
            _ => None,
        }
    }

    fn id(&self) -> Arc<str> {
        format!("{} {}", self.id, self.periods).into()
    }
}

impl Member {
    /// The leader that takes writes answered while cut off: its address and term, or `Some(None)` for this computer.
    /// `None` if no leader is known.
    fn merges_to(&self) -> Option<Option<(String, u64)>> {
        match self.machine.role() {
            Role::Following if self.data_loss.since().is_some() => None,
            Role::Following if self.reading.wanted.is_none() && self.reading.loaded => {
                let (uri, term) = self.leader()?;
                Some(Some((uri.to_owned(), term)))
            }
            Role::Leading if self.records() => Some(None),
            _ => None,
        }
    }

    pub(super) fn update_merge(&mut self, now: Instant) {
        let to = self.merges_to();
        match &mut self.merging.step {
            Step::Idle => {
                if to.is_some() && !self.cut_off.is_empty() {
                    self.judge_again(now);
                }
            }
            Step::Reading => {
                if self.reading.is_fresh() {
                    self.judge(now);
                }
            }
            Step::Asked(ask, asked) => {
                // A leader that is gone never answers.
                if to.is_some_and(|to| to != *asked) {
                    self.merging.step = Step::Pause(now + MERGE_AGAIN, Some(ask.clone()));
                }
            }
            Step::Pause(until, ask) => {
                if *until <= now {
                    match ask.take() {
                        Some(ask) => self.ask(now, ask),
                        None => self.judge_again(now),
                    }
                }
            }
        }
    }

    fn judge_again(&mut self, now: Instant) {
        self.merging.step = Step::Reading;
        self.reading.refresh(now);
    }

    /// Decides which of the remaining writes conflict with others' changes, up to the journal's last record.
    fn judge(&mut self, now: Instant) {
        let Some(period) = self.cut_off.first_mut() else {
            self.merging.step = Step::Idle;
            return;
        };
        let left = self.merging.left.take();
        let left = left.unwrap_or_else(|| period.pending.calls().cloned().collect());
        if Mutant::MergesByState.lives() {
            period.changes = Changes::default();
            period
                .changes
                .note_difference(&period.base, &self.journal.state);
        }
        let merged = merge::merge(&period.changes, &self.journal.state, &left);
        let parameters = merged.lost.iter();
        let parameters = parameters.filter_map(|lost| parameter_of(&lost.call));
        self.merging.untold.extend(parameters.chain(merged.equal));
        let lost = merged.lost.iter();
        let lost = lost.map(|lost| (lost.call.clone(), lost.into())).collect();
        self.merging.left = Some(merged.send);
        self.merging.judged = self.journal.progress.seq;
        self.merging.unread = false;
        self.report(lost);
        self.next_portion(now);
    }

    fn next_portion(&mut self, now: Instant) {
        let untold = set_again(&self.journal.state, &self.merging.untold);
        let left = self.merging.left.as_deref().unwrap_or_default();
        self.merging.telling = left.is_empty();
        let left = if self.merging.telling { &untold } else { left };
        let calls: Vec<_> = left.iter().take(portion(left)).cloned().collect();
        if calls.is_empty() {
            match self.merging.unread {
                true => self.judge_again(now),
                false => self.merged(now),
            }
            return;
        }
        let ask = Ask {
            id: self.merging.id(),
            seq: self.merging.judged,
            calls,
        };
        self.ask(now, ask);
    }

    fn ask(&mut self, now: Instant, ask: Ask) {
        let Some(to) = self.merges_to() else {
            self.merging.step = Step::Pause(now + MERGE_AGAIN, Some(ask));
            return;
        };
        // Even without an answer, the journal may contain the calls, perhaps several times.
        self.cut_off.expect_in_all(&ask.calls);
        self.merging.step = Step::Asked(ask.clone(), to.clone());
        self.merging.asked += 1;
        let number = self.merging.asked;
        self.act(Action::Merge { number, ask, to });
    }

    /// Handles the answer to request `number` to the leader. `None` if the leader did not answer.
    pub(super) fn portion_answered(
        &mut self,
        now: Instant,
        number: u64,
        answer: Option<wire::MergeAnswer>,
    ) {
        let Step::Asked(ask, _) = &mut self.merging.step else {
            return;
        };
        if number != self.merging.asked {
            return;
        }
        let ask = ask.clone();
        match answer {
            None => self.merging.step = Step::Pause(now + MERGE_AGAIN, Some(ask)),
            Some(wire::MergeAnswer::Again) => {
                self.merging.step = Step::Pause(now + MERGE_AGAIN, None)
            }
            Some(wire::MergeAnswer::Done(outcomes)) => {
                self.merging.unread = true;
                if self.merging.telling {
                    return self.told(now, &ask, &outcomes);
                }
                if let Some(left) = &mut self.merging.left {
                    left.drain(..ask.calls.len().min(left.len()));
                }
                let lost_there = ask.calls.iter().zip(&outcomes);
                let lost_there =
                    lost_there.filter(|(_, of)| matches!(of, WriteOutcome::Lost { .. }));
                let lost_there = lost_there.filter_map(|(call, _)| parameter_of(call));
                self.merging.untold.extend(lost_there);
                self.report(ask.calls.into_iter().zip(outcomes).collect());
                self.next_portion(now);
            }
        }
    }

    /// Handles the answer to a request that set parameters again.
    fn told(&mut self, now: Instant, ask: &Ask, outcomes: &[WriteOutcome]) {
        let is_last = self.merging.rounds >= ROUNDS_MAX;
        let untold = &mut self.merging.untold;
        let before = untold.len();
        for (call, outcome) in ask.calls.iter().zip(outcomes) {
            // If others changed the parameter, nodes may have heard the new value before the lost one.
            if is_last || !matches!(outcome, WriteOutcome::Lost { .. }) {
                call.text(1).map(|key| untold.remove(key));
            }
        }
        match untold.len() + ask.calls.len() == before {
            true => self.next_portion(now),
            false => {
                self.merging.rounds += 1;
                self.merging.step = Step::Pause(now + MERGE_AGAIN, None);
            }
        }
    }

    fn report(&mut self, outcomes: Vec<(Request, WriteOutcome)>) {
        for (call, outcome) in &outcomes {
            self.merging.sent += u64::from(*outcome == WriteOutcome::Holds);
            self.merging.lost += u64::from(outcome.is_loss_of(call));
        }
        if !outcomes.is_empty() {
            self.act(Action::Report(outcomes));
        }
    }

    /// Finishes the oldest period of being cut off: all its writes have been sent.
    pub(super) fn merged(&mut self, now: Instant) {
        let (sent, lost) = (self.merging.sent, self.merging.lost);
        self.tell(News::Merged { sent, lost });
        self.merging = Merging {
            periods: self.merging.periods + 1,
            asked: self.merging.asked,
            ..Merging::new(std::mem::take(&mut self.merging.id))
        };
        self.cut_off.sent();
        self.chores.say_at(now);
        if !self.chores.keeps_file() {
            self.keep_all();
        }
        self.adopt();
        if let (Role::Leading, Some(term)) = (self.told.role, self.machine.term()) {
            self.stand_leading(term);
        }
        self.update_standing();
    }
}

/// Calls that set each of these parameters to its value in `state`, so that its subscribers are notified.
fn set_again(state: &Master, keys: &BTreeSet<String>) -> Vec<Request> {
    let values = keys.iter().filter_map(|key| {
        let parts: Vec<_> = names::parts(key).collect();
        Some((key, merge::value_at(state.params(), &parts)?))
    });
    let calls = values.map(|(key, value)| {
        let arguments = [Value::from(TELLER), key.as_str().into(), value.clone()];
        Request::new(Method::SetParam, arguments)
    });
    calls.collect()
}

/// How many of the calls fit into the next request to the leader.
fn portion(calls: &[Request]) -> usize {
    let (mut count, mut bytes) = (0, 0);
    for call in calls.iter().take(CALLS_MOST) {
        // The answer to a `subscribeParam` contains a value that the master may be unable to return.
        let is_alone = *call.method() == Method::SubscribeParam;
        bytes += weight(call);
        if count > 0 && (is_alone || bytes > BYTES_MOST) {
            break;
        }
        count += 1;
        if is_alone {
            break;
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calls_go_in_portions_and_none_is_left_out() {
        let set = |value: &str| Request::new(Method::SetParam, ["/n", "/k", value]);
        let subscribe = Request::new(Method::SubscribeParam, ["/n", "http://n:1/", "/k"]);
        let large = "x".repeat(BYTES_MOST);
        let mut calls = vec![set("1"); CALLS_MOST + 1];
        calls.extend([set(&large), set(&large), set("2"), subscribe, set("3")]);
        let mut lengths = Vec::new();
        let mut left = calls.as_slice();
        while !left.is_empty() {
            let count = portion(left);
            lengths.push(count);
            left = &left[count..];
        }
        assert_eq!(lengths, [CALLS_MOST, 1, 1, 1, 1, 1, 1]);
    }
}
