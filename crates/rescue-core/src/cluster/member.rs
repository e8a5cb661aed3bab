//! Decides what one computer of several does: whom it follows, what its mirror holds, which calls it answers, what it
//! writes to the journal and merges, and when it may run a master. Pure.
//!
//! [`Machine`], a part of it, decides who leads. `app/cluster` passes in what happened and when, and carries out the
//! returned actions in order. It decides nothing, so the simulation in `cluster/tests` tests what production
//! decides.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use crate::{
    checkpoint::format::{Record, RecordContent as JournalEntry},
    cluster::{
        cut_off::CutOff,
        displaced::DisplacedLately,
        journal::{Keys, Progress},
        machine::{self, Machine, Role, Settings, View, WhenAlone},
        namesake::{self, Sign},
        outgoing::Outgoing,
        standing::{Place, Standing},
    },
    master::{Master, Request},
};

mod data_loss;
mod following;
mod leading;
mod notifying;
#[cfg(test)]
mod tests;
mod types;

use self::{
    data_loss::DataLoss,
    following::{Merging, Reading},
    notifying::Notifying,
};
pub use self::{
    leading::PROBES,
    types::{Action, Cause, Entry, Heard, Holds, Input, News, Own, Read, Said},
};

/// Pause before a failed read of etcd is retried.
const AGAIN: Duration = Duration::from_millis(200);
/// How long a start waits for etcd's journal before this computer may claim leadership without it.
const START_BY: Duration = Duration::from_secs(2);

/// The journal, as far as this computer has read it.
#[derive(Debug, Default)]
struct Journal {
    state: Master,
    progress: Progress,
    displaced: DisplacedLately,
    /// Whether this computer, if it leads next, keeps its ledger's state instead of this one.
    own_wins: bool,
}

impl Journal {
    /// Applies `records` to the journal's state. They follow the last record that was applied.
    fn apply(&mut self, now: Instant, records: &[Record]) {
        for record in records {
            if let JournalEntry::Call { call, label, .. } = &record.entry {
                let request = Request::from(call.clone());
                self.displaced.note(now, &self.state, &request);
                self.state.apply_telling(&request, &mut ());
                label.origin.note_in(&mut self.state, &request);
            }
        }
    }
}

/// What `app/cluster` knows once it has carried out the returned actions.
#[derive(Debug)]
struct Told {
    role: Role,
    standing: Standing,
    /// Whether this computer has a master, or starts one.
    has_master: bool,
}

/// The probes of the leader's rosrescue.
#[derive(Debug, Default)]
struct Probing {
    number: u64,
    under_way: bool,
    at: Option<Instant>,
}

/// The previous leader, and how its leadership ended.
#[derive(Debug, Default)]
struct Before {
    leader: Option<(String, Instant)>,
    released: bool,
    /// The term that the checkpoint was given last.
    term: u64,
}

/// Evidence of another computer with this one's name.
#[derive(Debug, Default)]
struct Namesake {
    /// Set if the member entry of this name belongs to another computer.
    sign: Option<Sign>,
    /// Looks for a living computer with this one's name. Set once etcd has been read.
    watch: Option<namesake::NamesakeWatch>,
    /// Whether this process has led.
    led: bool,
}

/// The state machine of one computer; see the [module](self).
#[derive(Debug)]
pub struct Member {
    keys: Keys,
    machine: Machine,
    told: Told,
    own: Own,
    data_loss: DataLoss,
    journal: Journal,
    reading: Reading,
    place: Place,
    outgoing: Outgoing,
    cut_off: CutOff,
    merging: Merging,
    before: Before,
    namesake: Namesake,
    probing: Probing,
    release: Release,
    chores: Chores,
    queue: Queue,
}

/// Inputs for the machine and actions for `app/cluster`, in order.
#[derive(Debug, Default)]
struct Queue {
    inputs: VecDeque<machine::Input>,
    actions: Vec<Action>,
    /// When the machine starts even if etcd has not been read. `None` once it has started.
    start_by: Option<Instant>,
}

impl Member {
    /// Creates a member that waits for [`Input::Begin`]. `left` holds the writes that an earlier process answered while
    /// it was cut off. `id` is the unique name under which such writes are sent to a leader.
    pub fn new(settings: Settings, keys: Keys, own: Own, left: CutOff, id: String) -> Self {
        let known = own.restored;
        Self {
            keys,
            machine: Machine::new(settings),
            told: Told {
                role: Role::Joining,
                standing: Standing::Nobody { known },
                has_master: false,
            },
            own,
            data_loss: DataLoss::default(),
            journal: Journal::default(),
            reading: Reading::default(),
            place: Place::default(),
            outgoing: Outgoing::default(),
            cut_off: left,
            merging: Merging::new(id),
            before: Before::default(),
            namesake: Namesake::default(),
            probing: Probing::default(),
            release: Release::default(),
            chores: Chores::default(),
            queue: Queue::default(),
        }
    }

    /// Handles `input` at `now`, and returns the actions to carry out, in order.
    pub fn on(&mut self, now: Instant, input: Input) -> Vec<Action> {
        self.hear(now, input.heard());
        match input {
            Input::Begin => {
                self.queue.start_by = Some(now + START_BY);
                self.reading.load_by(now);
            }
            Input::Answer { number, answer } => {
                let answer = self.doubt_answer(now, answer);
                self.tell_machine(machine::Input::Answer { number, answer });
            }
            Input::Watched {
                view,
                entries,
                deleted,
                ..
            } => self.watched(now, view, entries, deleted),
            Input::WatchEnded => self.reading.ended(now),
            Input::Loaded(read) => self.loaded(now, read),
            Input::Recorded(changes) => self.recorded(changes),
            Input::AsState(state) => self.recorded_as_state(state),
            Input::Forwarded(calls) => self.cut_off.expect(calls),
            Input::Prepared(leads) => self.prepared(leads),
            Input::Decided { seq, goes_on } => {
                self.reading.deciding = false;
                self.tell_machine(machine::Input::Decided { seq, goes_on });
            }
            Input::Probed { number, leads } => self.probed(number, leads),
            Input::Merged { number, answer } => self.portion_answered(now, number, answer),
            Input::SnapshotWritten(written) => self.snapshot_written(now, written),
            Input::HandOver { to, refused } => self.hand_over(now, to, refused),
            Input::Stop => self.stop(now),
            Input::RosoutEnded => self.rosout_ended(),
            Input::Wake => self.woken(now),
        }
        loop {
            while let Some(input) = self.queue.inputs.pop_front() {
                self.drive(now, input);
            }
            self.catch_up(now);
            self.update(now);
            if self.queue.inputs.is_empty() {
                break;
            }
        }
        self.end_if_stopped();
        std::mem::take(&mut self.queue.actions)
    }

    /// When to pass in [`Input::Wake`]. Changes with every input.
    pub fn deadline(&self) -> Option<Instant> {
        [
            self.machine.deadline(),
            self.reading.due(),
            self.probing.at.filter(|_| !self.probing.under_way),
            self.release.by,
            self.queue.start_by,
            self.merging.due(),
            self.chores.due(),
        ]
        .into_iter()
        .flatten()
        .min()
    }

    /// The part that decides who leads.
    pub fn machine(&self) -> &Machine {
        &self.machine
    }

    /// The machine's role after the actions that were returned last.
    pub fn role(&self) -> Role {
        self.told.role
    }

    pub fn settings(&self) -> &Settings {
        self.machine.settings()
    }

    /// The keys `leader` and `alive` as etcd showed them last.
    pub fn view(&self) -> &View {
        let (seen, known) = (self.reading.view(), self.machine.view());
        match seen.revision > known.revision {
            true => seen,
            false => known,
        }
    }

    /// Who has the master, and where calls go.
    pub fn standing(&self) -> &Standing {
        &self.told.standing
    }

    /// The place in the journal up to which the mirror is current.
    pub fn place(&self) -> Place {
        self.place
    }

    /// The number of the last record that was read from the journal.
    pub fn seq(&self) -> u64 {
        self.journal.progress.seq
    }

    /// When this computer noticed that etcd has lost its data. `None` once a computer leads again.
    pub fn etcd_lost(&self) -> Option<Instant> {
        self.data_loss.since()
    }

    /// Whether the previous leader gave up leadership by itself.
    pub fn was_released(&self) -> bool {
        self.before.released
    }

    /// The number of writes that are not in etcd yet.
    pub fn uncommitted(&self) -> usize {
        match self.keeps() {
            true => self.cut_off.len(),
            false => self.outgoing.count(),
        }
    }

    /// The writes answered while cut off that have not reached a leader, with the state before them.
    pub fn kept(&self) -> Option<(&Master, Vec<Request>)> {
        let base = self.cut_off.base()?;
        Some((base, self.cut_off.calls().cloned().collect()))
    }

    /// This computer's entry among the members.
    pub fn says(&self) -> Said {
        let settings = self.settings();
        Said {
            uri: settings.uri.clone(),
            version: settings.version.clone(),
            role: self.machine.role().as_str().to_owned(),
            seq: self.seq(),
            boot: settings.boot.clone(),
            holds: self.data_loss.holds(),
            unreadable: self.data_loss.unreadable(),
            notifies: self
                .chores
                .notifying
                .says(&settings.id, !self.cut_off.is_empty()),
        }
    }

    fn act(&mut self, action: Action) {
        self.queue.actions.push(action);
    }

    fn tell(&mut self, news: News) {
        self.act(Action::Tell(news));
    }

    fn tell_machine(&mut self, input: machine::Input) {
        self.queue.inputs.push_back(input);
    }

    /// Passes an input to the machine, and does what it decides.
    fn drive(&mut self, now: Instant, input: machine::Input) {
        let actions = self.machine.on(now, input);
        // Committed changes leave first, so that the next request does not send them again.
        for change in self.outgoing.committed(self.machine.committed()) {
            self.hold(now, change);
        }
        for action in actions {
            match action {
                machine::Action::Send { number, op } => self.send(number, op),
                machine::Action::CatchUp(seq) => self.reading.wanted = Some(seq),
                machine::Action::Become(role) => self.become_role(now, role),
                machine::Action::Acknowledge(seq) => {
                    self.outgoing.acknowledged = seq;
                    self.act(Action::Acknowledge(seq));
                }
                machine::Action::Yield {
                    committed,
                    acknowledged,
                } => self.give_back(committed, acknowledged),
                machine::Action::Released => self.released(),
            }
        }
    }

    /// Whether calls are recorded on this computer: it leads, or it is cut off and serves.
    fn records(&self) -> bool {
        self.told.standing.records()
    }

    /// Whether the ledger must hold the journal's state, because this computer does not record calls itself.
    fn follows(&self) -> bool {
        self.reading.loaded && !self.journal.own_wins && !self.records()
    }

    /// Whether the mirror may answer: its state is that of the session which continues.
    fn knows(&self) -> bool {
        self.own.restored
            || self.reading.loaded && self.machine.session() == machine::JournalSession::GoesOn
    }

    /// Whether writes answered now are kept for a later leader.
    fn keeps(&self) -> bool {
        self.told.role == Role::Alone && self.settings().alone == WhenAlone::Serve
    }

    /// Does what may be necessary after any input: runs or ends the master, probes the leader, sends kept writes, and
    /// so on.
    fn update(&mut self, now: Instant) {
        self.update_data_loss(now);
        self.update_master();
        self.check_for_namesake(now);
        self.update_standing();
        self.update_probes(now);
        self.update_merge(now);
        self.update_chores(now);
    }
}

/// How long a handover may take.
const HANDOVER_LIMIT: Duration = Duration::from_secs(5);
/// How long giving up leadership may take when rosrescue stops.
const STOP_LIMIT: Duration = Duration::from_secs(4);

/// Why leadership is given up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Why {
    #[default]
    No,
    /// A handover was requested, and its caller waits.
    Asked,
    /// rosrescue stops, and waits for rosout.
    EndingRosout,
    Stops,
}

/// How leadership is given up: for a handover, or because rosrescue stops.
#[derive(Debug, Default)]
struct Release {
    why: Why,
    /// The time limit of the handover or the stop.
    by: Option<Instant>,
}

impl Release {
    /// Whether writes wait for the next leader.
    fn is_begun(&self) -> bool {
        matches!(self.why, Why::Asked | Why::Stops)
    }
}

impl Member {
    fn stop(&mut self, now: Instant) {
        if self.told.has_master {
            self.release.why = Why::EndingRosout;
            self.release.by = Some(now + STOP_LIMIT);
            self.act(Action::EndRosout);
        } else {
            self.end();
        }
    }

    fn rosout_ended(&mut self) {
        match self.machine.role() {
            Role::Leading => self.begin_release(Why::Stops, String::new()),
            _ => self.end(),
        }
    }

    fn hand_over(&mut self, now: Instant, to: String, refused: Option<String>) {
        let refused = match self.machine.role() {
            Role::Leading if self.release.why != Why::No => {
                Some("a handover or a stop is already under way".to_owned())
            }
            Role::Leading => refused,
            _ => Some("this computer does not lead".to_owned()),
        };
        if let Some(why) = refused {
            return self.act(Action::HandedOver(Err(why)));
        }
        self.begin_release(Why::Asked, to);
        self.release.by = Some(now + HANDOVER_LIMIT);
    }

    /// Gives up leadership. From now on writes wait for the next leader.
    fn begin_release(&mut self, why: Why, to: String) {
        self.release.why = why;
        let term = self.machine.term().unwrap_or_default();
        self.stand_leading(term);
        self.tell_machine(machine::Input::HandOver(to));
    }

    /// Ends a handover: another computer may lead now.
    fn released(&mut self) {
        if self.release.why == Why::Asked {
            self.release = Release::default();
            self.act(Action::HandedOver(Ok(())));
        }
    }

    fn woken(&mut self, now: Instant) {
        if self.release.by.is_some_and(|by| by <= now) {
            self.release.by = None;
            match self.release.why {
                // The request may still reach etcd, so writes keep waiting.
                Why::Asked => {
                    let why = format!("etcd did not answer within {HANDOVER_LIMIT:?}");
                    self.act(Action::HandedOver(Err(why)));
                }
                Why::EndingRosout | Why::Stops => self.end(),
                Why::No => {}
            }
        }
        if self.queue.start_by.is_some_and(|by| by <= now) {
            self.start(now);
        }
        self.tell_machine(machine::Input::Wake);
    }

    /// Finishes a stop as soon as this computer no longer leads.
    fn end_if_stopped(&mut self) {
        if self.release.why == Why::Stops && self.machine.role() != Role::Leading {
            self.end();
        }
    }

    fn end(&mut self) {
        self.act(Action::End);
    }
}

/// How often a computer updates its entry among the members.
pub const SAYS_EVERY: Duration = Duration::from_secs(5);
/// How often the leader compacts etcd, and the age from which revisions are dropped.
const FORGET: Duration = Duration::from_secs(300);
/// Pause after a snapshot that could not be written.
const SNAPSHOT_PAUSE: Duration = Duration::from_secs(5);

/// Periodic work: this computer's entry among the members, snapshots, and the compaction of etcd.
#[derive(Debug, Default)]
struct Chores {
    /// When to write this computer's entry among the members.
    say_at: Option<Instant>,
    /// Whether a snapshot is being written.
    snapshot: bool,
    /// The last record that a snapshot of this computer holds or will hold. Its entry and those before are deleted.
    replaced: u64,
    /// After a failed snapshot, when the next one may begin.
    snapshot_at: Option<Instant>,
    /// The revision up to which to compact etcd, and when.
    forget: Option<(Instant, u64)>,
    /// The record with which the journal has all writes that a lone leader kept in a file.
    kept_until: Option<u64>,
    /// What the entries among the members say about notifications.
    notifying: Notifying,
}

impl Chores {
    fn due(&self) -> Option<Instant> {
        let forget = self.forget.map(|(at, _)| at);
        [self.say_at, forget].into_iter().flatten().min()
    }

    /// Has this computer's entry among the members updated at `now`.
    fn say_at(&mut self, now: Instant) {
        self.say_at = Some(now);
    }

    /// Keeps the file of kept writes as it is until the journal has record `seq`. If the leader lost its power before,
    /// the writes would be lost without a report.
    fn keep_until(&mut self, seq: u64) {
        self.kept_until = Some(seq);
    }

    /// Whether the file of kept writes must stay as it is.
    fn keeps_file(&self) -> bool {
        self.kept_until.is_some()
    }
}

impl Member {
    /// Writes this computer's entry among the members and, if it leads, a snapshot, and compacts etcd, each when it is
    /// due.
    fn update_chores(&mut self, now: Instant) {
        // Before the watch for a namesake is over, the entry could overwrite that of another computer.
        let watch = self.namesake.watch.as_ref();
        let may_say = watch.is_some_and(|of| of.is_over(now));
        if self.chores.say_at.is_none_or(|at| at <= now) {
            self.chores.say_at = Some(now + SAYS_EVERY);
            if may_say {
                self.act(Action::Say);
            }
        }
        if let Some(seq) = self.chores.kept_until {
            let leads = self.machine.role() == Role::Leading;
            if !leads || self.journal.progress.seq >= seq {
                self.chores.kept_until = None;
                self.keep_all();
            }
        }
        let term = self.machine.term();
        let Some(term) = term.filter(|_| self.machine.role() == Role::Leading) else {
            self.chores.forget = None;
            return;
        };
        let is_early = self.chores.snapshot_at.is_some_and(|at| now < at);
        let progress = self.journal.progress;
        if !self.chores.snapshot && !is_early && progress.wants_snapshot() {
            self.chores.snapshot = true;
            self.chores.replaced = progress.seq;
            self.act(Action::WriteSnapshot {
                term,
                progress,
                state: self.journal.state.clone(),
                displaced: self.journal.displaced.at(now),
            });
        }
        let revision = self.view().revision;
        match self.chores.forget {
            Some((at, before)) if at <= now => {
                self.chores.forget = Some((now + FORGET, revision));
                self.act(Action::Forget(before));
            }
            None => self.chores.forget = Some((now + FORGET, revision)),
            Some(_) => {}
        }
    }

    fn snapshot_written(&mut self, now: Instant, written: Option<(Progress, usize)>) {
        self.chores.snapshot = false;
        match written {
            Some((then, bytes)) => self.journal.progress.snapshot_written(then, bytes),
            // A full etcd refuses at once, so the next attempt must wait.
            None => self.chores.snapshot_at = Some(now + SNAPSHOT_PAUSE),
        }
    }
}
