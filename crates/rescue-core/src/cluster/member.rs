//! Decides what one computer among several follows, adopts, answers, gives to the journal and merges, and when it
//! may have a master. Pure.
//!
//! [`Machine`] decides who leads, and is a part of this. The shell passes in what happened and when, and carries
//! out the returned actions in order. It decides nothing. The simulation in `cluster/tests` drives the same
//! [`Member`].

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use crate::{
    checkpoint::format::{Entry as JournalEntry, Record},
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

mod chores;
mod following;
mod giving;
mod leaving;
mod lost;
mod merging;
mod roles;
mod types;

use self::{chores::Chores, following::Reading, leaving::Release, lost::Lost, merging::Merging};
pub use self::{
    chores::SAYS_EVERY,
    roles::PROBES,
    types::{Action, Cause, Entry, Heard, Holds, Input, News, Own, Read, Said},
};

/// Pause before etcd is asked again for what it did not give.
const AGAIN: Duration = Duration::from_millis(200);
/// It is best to know what was before one claims; but not for longer.
const START_BY: Duration = Duration::from_secs(2);

/// What the journal holds, as far as this computer knows.
#[derive(Debug, Default)]
struct Journal {
    state: Master,
    progress: Progress,
    displaced: DisplacedLately,
}

impl Journal {
    /// Goes on by `records`.
    fn go_on(&mut self, now: Instant, records: &[Record]) {
        for record in records {
            if let JournalEntry::Call { call, .. } = &record.entry {
                let request = Request::from(call.clone());
                self.displaced.note(now, &self.state, &request);
                self.state.apply_telling(&request, &mut ());
            }
        }
    }
}

/// The leader's rosrescue is asked, now and then.
#[derive(Debug, Default)]
struct Probing {
    number: u64,
    under_way: bool,
    at: Option<Instant>,
}

/// Who led before, and how that ended.
#[derive(Debug, Default)]
struct Before {
    leader: Option<(String, Instant)>,
    released: bool,
}

/// Another computer of this name.
#[derive(Debug, Default)]
struct Namesake {
    /// The entry among the members is another one's.
    sign: Option<Sign>,
    /// Looks for one since etcd has been read.
    watch: Option<namesake::Watch>,
    /// This process has claimed with success.
    led: bool,
}

/// See the [module](self).
#[derive(Debug)]
pub struct Member {
    keys: Keys,
    machine: Machine,
    /// As the shell was told last.
    role: Role,
    standing: Standing,
    has_master: bool,
    own: Own,
    /// The ledger's state wins over the journal's if this computer leads next.
    own_wins: bool,
    lost: Lost,
    journal: Journal,
    reading: Reading,
    place: Place,
    outgoing: Outgoing,
    /// The last record that was answered, in this time that calls are recorded here.
    acknowledged: u64,
    cut_off: CutOff,
    merging: Merging,
    before: Before,
    namesake: Namesake,
    deciding: bool,
    probing: Probing,
    release: Release,
    chores: Chores,
    queue: Queue,
}

/// What is to be taken next, and what is to be done.
#[derive(Debug, Default)]
struct Queue {
    inputs: VecDeque<machine::Input>,
    actions: Vec<Action>,
    /// When the machine is started, even if etcd has not been read.
    start_by: Option<Instant>,
}

impl Member {
    /// One that has not begun. `left`: what an earlier process has answered alone. `id`: a name for what is sent
    /// of it to a leader, which nobody else uses.
    pub fn new(settings: Settings, keys: Keys, own: Own, left: CutOff, id: String) -> Self {
        let known = own.restored;
        Self {
            keys,
            machine: Machine::new(settings),
            role: Role::Joining,
            standing: Standing::Nobody { known },
            has_master: false,
            own,
            own_wins: false,
            lost: Lost::default(),
            journal: Journal::default(),
            reading: Reading::default(),
            place: Place::default(),
            outgoing: Outgoing::default(),
            acknowledged: 0,
            cut_off: left,
            merging: Merging::new(id),
            before: Before::default(),
            namesake: Namesake::default(),
            deciding: false,
            probing: Probing::default(),
            release: Release::default(),
            chores: Chores::default(),
            queue: Queue::default(),
        }
    }

    /// Takes an input at `now`. Returns the actions, in order.
    pub fn on(&mut self, now: Instant, input: Input) -> Vec<Action> {
        self.hear(input.heard());
        match input {
            Input::Begin => {
                self.queue.start_by = Some(now + START_BY);
                self.reading.load_by(now);
            }
            Input::Answer { number, answer } => {
                self.doubt_etcd(now, &answer);
                self.tell_machine(machine::Input::Answer { number, answer });
            }
            Input::Watched { view, entries, .. } => self.watched(now, view, entries),
            Input::WatchEnded => self.reading.ended(now),
            Input::Loaded(read) => self.loaded(now, read),
            Input::Recorded(changes) => self.recorded(changes),
            Input::AsState(state) => self.recorded_as_state(state),
            Input::Forwarded(calls) => self.cut_off.expect(calls),
            Input::Prepared(leads) => self.prepared(leads),
            Input::Decided { seq, goes_on } => {
                self.deciding = false;
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
            self.tend(now);
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

    /// What it is that decides who leads.
    pub fn machine(&self) -> &Machine {
        &self.machine
    }

    /// The role that was carried out last.
    pub fn role(&self) -> Role {
        self.role
    }

    pub fn settings(&self) -> &Settings {
        self.machine.settings()
    }

    /// What etcd showed last of the leader.
    pub fn view(&self) -> &View {
        let (seen, known) = (self.reading.view(), self.machine.view());
        match seen.revision > known.revision {
            true => seen,
            false => known,
        }
    }

    /// Who has the master, and where calls go.
    pub fn standing(&self) -> &Standing {
        &self.standing
    }

    /// How far the mirror holds the journal.
    pub fn place(&self) -> Place {
        self.place
    }

    /// The journal's last record that has been read.
    pub fn seq(&self) -> u64 {
        self.journal.progress.seq
    }

    /// Since when it is known that etcd has lost its data, until a computer leads again.
    pub fn etcd_lost(&self) -> Option<Instant> {
        self.lost.since()
    }

    /// The leader before has given up by itself.
    pub fn was_released(&self) -> bool {
        self.before.released
    }

    /// How many writes etcd does not have yet.
    pub fn uncommitted(&self) -> usize {
        match self.keeps() {
            true => self.cut_off.len(),
            false => self.outgoing.count(),
        }
    }

    /// What was answered alone, and has not reached a leader: the state before, and the writes.
    pub fn kept(&self) -> Option<(&Master, Vec<Request>)> {
        let base = self.cut_off.base()?;
        Some((base, self.cut_off.calls().cloned().collect()))
    }

    /// What this computer says of itself.
    pub fn says(&self) -> Said {
        let settings = self.settings();
        Said {
            uri: settings.uri.clone(),
            version: settings.version.clone(),
            role: self.machine.role().as_str().to_owned(),
            seq: self.seq(),
            boot: settings.boot.clone(),
            holds: self.lost.holds(),
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
        // First: the next request does not take them once more.
        for change in self.outgoing.committed(self.machine.committed()) {
            self.hold(now, change);
        }
        for action in actions {
            match action {
                machine::Action::Send { number, op } => self.send(number, op),
                machine::Action::CatchUp(seq) => self.reading.wanted = Some(seq),
                machine::Action::Become(role) => self.become_role(now, role),
                machine::Action::Acknowledge(seq) => {
                    self.acknowledged = seq;
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

    /// Whether this computer's calls are recorded here: it leads, or it is alone and serves.
    fn records(&self) -> bool {
        self.standing.records()
    }

    /// Whether the ledger holds what the journal does.
    fn follows(&self) -> bool {
        self.reading.loaded && !self.own_wins && !self.records()
    }

    /// Whether the mirror's answers hold: its state is not that of a session which may be over.
    fn knows(&self) -> bool {
        self.own.restored
            || self.reading.loaded && self.machine.session() == machine::Session::GoesOn
    }

    /// Whether what is answered now is kept for the leader.
    fn keeps(&self) -> bool {
        self.role == Role::Alone && self.settings().alone == WhenAlone::Serve
    }

    /// What follows from all that has happened.
    fn tend(&mut self, now: Instant) {
        self.tend_lost(now);
        self.tend_master();
        self.look_for_namesake(now);
        self.tend_standing();
        self.tend_probes(now);
        self.tend_merge(now);
        self.tend_chores(now);
    }
}
