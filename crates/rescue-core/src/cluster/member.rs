//! Decides what one computer of several does: whom it follows, what its mirror holds, which calls it answers, what it
//! writes to the journal and merges, and when it may run a master. Pure.
//!
//! [`Machine`], a part of it, decides who leads. `app/cluster` passes in what happened and when, and carries out the
//! returned actions in order. It decides nothing, so the simulation in `cluster/tests` tests what production
//! decides.
//!
//! * `roles`: this computer's role changes, and it starts a master or gives it up; `release`: a handover or a stop.
//! * `routing`: where calls go, and how current the mirror is; `probes`: whether the leader's rosrescue answers.
//! * `following`: the journal as others write it; `journal_writes`: this computer's changes on their way there.
//! * `alone`: this computer is cut off, and keeps its nodes' writes; `merging`: it sends them to the leader.
//! * `data_loss`: etcd has lost data; `name_check`: another computer has this one's name.
//! * `notifying`: who has stopped notifying nodes; `chores`: member entry, snapshots, compaction.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use crate::{
    checkpoint::format::{Record, RecordContent},
    cluster::{
        cut_off::CutOff,
        displaced::DisplacedLately,
        journal::{Keys, Progress},
        machine::{self, Machine, Role, Settings, View, WhenAlone},
        outgoing::Outgoing,
        standing::{JournalPosition, Standing},
    },
};
use ros1_master::master::Master;

mod alone;
mod chores;
mod data_loss;
mod following;
mod journal_writes;
mod merging;
mod name_check;
mod notifying;
mod probes;
mod release;
mod roles;
mod routing;
#[cfg(test)]
mod tests;
mod types;

use self::{
    chores::Chores, data_loss::DataLoss, following::Reading, merging::Merging,
    name_check::Namesake, probes::Probing, release::Release,
};
pub use self::{
    chores::PUBLISH_EVERY,
    probes::PROBES,
    types::{
        Action, Cause, Evidence, ForwardedWrites, Holdings, Input, LocalCheckpoint, MemberEntry,
        MemberEntryChange, News, PartitionWrites, Read, WatchedEntry,
    },
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
    /// Whether no leader has written its state yet. Then the journal says nothing, not even that the state is empty.
    fn is_empty(&self) -> bool {
        self.progress.seq == 0
    }

    /// Applies `records` to the journal's state. They follow the last record that was applied.
    fn apply(&mut self, now: Instant, records: &[Record]) {
        for record in records {
            if let RecordContent::Call { call, label, .. } = &record.entry {
                self.displaced.note(now, &self.state, call);
                self.state.apply_telling(call, &mut ());
                label.origin.note_in(&mut self.state, call);
            }
        }
    }
}

/// What `app/cluster` knows once it has carried out the returned actions.
#[derive(Debug)]
struct LastPublished {
    role: Role,
    standing: Standing,
    /// Whether this computer has a master, or starts one.
    has_master: bool,
}

/// The previous leader, and how its leadership ended.
#[derive(Debug, Default)]
struct Before {
    leader: Option<(String, Instant)>,
    released: bool,
    /// The term that the checkpoint was given last, and the number of its journal.
    term: (u64, u64),
}

/// The state machine of one computer; see the [module](self).
#[derive(Debug)]
pub struct Member {
    keys: Keys,
    machine: Machine,
    published: LastPublished,
    local: LocalCheckpoint,
    data_loss: DataLoss,
    journal: Journal,
    reading: Reading,
    position: JournalPosition,
    /// How much of a journal the ledger's state holds, even if etcd has lost that journal.
    held: Holdings,
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
    /// Creates a member that waits for [`Input::Begin`]. `left` holds the partition writes of an earlier process.
    /// `id` is the unique name under which partition writes are sent to a leader.
    pub fn new(
        settings: Settings,
        keys: Keys,
        local: LocalCheckpoint,
        left: Option<PartitionWrites>,
        id: String,
    ) -> Self {
        let known = local.restored;
        let known_to_hold = left.as_ref().map(|left| left.held).filter(|held| *held > 0);
        let held = Holdings {
            journal_number: local.journal_number,
            term: local.term,
            // The file may be of a journal before the checkpoint's.
            seq: known_to_hold.map_or(local.seq, |held| held.min(local.seq)),
        };
        let mut cut_off = left.map(CutOff::restored).unwrap_or_default();
        let mut machine = Machine::new(settings);
        machine.note_journal(local.journal_number);
        machine.note_term(local.term);
        cut_off.note_seen(&local.state);
        Self {
            keys,
            machine,
            published: LastPublished {
                role: Role::Joining,
                standing: Standing::NoLeader { known },
                has_master: false,
            },
            local,
            data_loss: DataLoss::default(),
            journal: Journal::default(),
            reading: Reading::default(),
            position: JournalPosition::default(),
            held,
            outgoing: Outgoing::default(),
            cut_off,
            merging: Merging::new(id.into()),
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
        self.note_member_entries(now, input.member_entries());
        match input {
            Input::Begin => {
                self.queue.start_by = Some(now + START_BY);
                self.reading.load_by(now);
            }
            Input::Answer { number, answer } => {
                let answer = self.doubt_answer(now, number, answer);
                self.queue_input(machine::Input::Answer { number, answer });
            }
            Input::Watched {
                view,
                entries,
                deleted,
                ..
            } => self.watched(now, view, entries, deleted),
            Input::WatchEnded => self.watch_ended(now),
            Input::Loaded(read) => self.loaded(now, read),
            Input::Recorded(changes) => self.recorded(changes),
            Input::AsState(state) => self.recorded_as_state(state),
            Input::Forwarded { base, writes } => self.serve_from(base, writes),
            Input::Prepared { number, leads } => self.prepared(number, leads),
            Input::Decided { seq, goes_on } => {
                self.reading.deciding = false;
                self.queue_input(machine::Input::Decided { seq, goes_on });
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
        self.published.role
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
        &self.published.standing
    }

    /// The position in the journal up to which the mirror is current.
    pub fn position(&self) -> JournalPosition {
        self.position
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
        match self.keeps_writes() {
            true => self.cut_off.len(),
            false => self.outgoing.count(),
        }
    }

    /// The partition writes that have not reached a leader.
    pub fn partition_writes(&self) -> Option<PartitionWrites> {
        Some(PartitionWrites {
            base: self.cut_off.base()?.clone(),
            held: self.held.seq,
            calls: self.cut_off.calls().cloned().collect(),
        })
    }

    /// This computer's entry among the members.
    pub fn member_entry(&self) -> MemberEntry {
        let settings = self.settings();
        MemberEntry {
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
                .marker(&settings.id, !self.cut_off.is_empty()),
        }
    }

    fn act(&mut self, action: Action) {
        self.queue.actions.push(action);
    }

    fn report_news(&mut self, news: News) {
        self.act(Action::Log(news));
    }

    fn queue_input(&mut self, input: machine::Input) {
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
                machine::Action::Send { number, op } => self.send(now, number, op),
                machine::Action::CatchUp(seq) => self.reading.wanted = Some(seq),
                machine::Action::Become(role) => self.become_role(now, role),
                machine::Action::Acknowledge(seq) => {
                    self.outgoing.acknowledged = seq;
                    self.act(Action::Acknowledge(seq));
                }
                machine::Action::HandBack {
                    committed,
                    acknowledged,
                } => self.give_back(committed, acknowledged),
                machine::Action::Released => self.released(),
            }
        }
    }

    /// Whether calls are recorded on this computer: it leads, or it is cut off and serves.
    fn records(&self) -> bool {
        self.published.standing.records()
    }

    /// Whether the ledger must hold the journal's state, because this computer does not record calls itself.
    fn follows(&self) -> bool {
        self.reading.loaded && !self.journal.own_wins && !self.records()
    }

    /// Whether the mirror may answer: its state is that of the session which continues.
    fn knows(&self) -> bool {
        self.local.restored
            || self.reading.loaded && self.machine.session() == machine::JournalSession::GoesOn
    }

    /// Whether writes answered now are kept for a later leader.
    fn keeps_writes(&self) -> bool {
        self.published.role == Role::Alone && self.settings().alone == WhenAlone::Serve
    }

    /// Does what may be necessary after any input: runs or ends the master, probes the leader, sends partition writes, and
    /// so on.
    fn update(&mut self, now: Instant) {
        self.update_data_loss(now);
        self.update_master();
        self.check_for_namesake(now);
        self.update_standing();
        self.update_probes(now);
        self.update_merge(now);
        self.update_release();
        self.update_chores(now);
    }
}
