//! A computer of the simulation: the machine, and a shell that is as simple as it can be.

use std::time::{Duration, Instant};

use super::super::machine::{Commit, Machine, Role, Settings, WhenAlone};
use super::etcd::{Write, name};

/// Parameters that are written.
pub(super) const KEYS: usize = 6;
/// Most records of a beat. So small that beats are full now and then.
pub(super) const RECORDS_MAX: u64 = 20;

/// For each parameter, the call that wrote it last, and one more.
pub(super) type State = [usize; KEYS];

/// A record of this computer that may be in no journal.
#[derive(Clone, Copy, Debug)]
pub(super) struct Own {
    pub(super) write: Write,
    /// Who waits for the answer.
    pub(super) origin: usize,
}

pub(super) struct Computer {
    pub(super) machine: Machine,
    pub(super) up: bool,
    /// Counts its processes.
    pub(super) life: u64,
    /// It does nothing before this moment.
    pub(super) hangs_until: u64,
    /// It has not hung since.
    pub(super) undisturbed_since: u64,
    /// By how much its clock is too fast, in millionths.
    drift: i64,
    clock: Instant,
    /// The next wake-up; earlier ones are void.
    pub(super) wake: u64,
    // On the disk, as the checkpoint is:
    /// The state of the journal's first `followed` records,
    pub(super) base: State,
    pub(super) followed: u64,
    /// records after those,
    pub(super) own: Vec<Own>,
    /// of which so many were answered.
    pub(super) answered: usize,
    /// Answered calls that are in no journal, and the state when they began.
    pub(super) pending: Vec<Write>,
    pub(super) cut_off: State,
    // In memory:
    /// Calls of its nodes that wait.
    pub(super) waiting: Vec<Write>,
    pub(super) watch: u64,
    pub(super) watch_at: u64,
    pub(super) role: Role,
}

impl Computer {
    pub(super) fn new(index: usize, settings: &(Commit, WhenAlone, Duration), drift: i64) -> Self {
        Self {
            machine: machine(index, 0, settings),
            up: true,
            life: 0,
            hangs_until: 0,
            undisturbed_since: 0,
            drift,
            clock: Instant::now(),
            wake: 0,
            base: [0; KEYS],
            followed: 0,
            own: Vec::new(),
            answered: 0,
            pending: Vec::new(),
            cut_off: [0; KEYS],
            waiting: Vec::new(),
            watch: 0,
            watch_at: 0,
            role: Role::Joining,
        }
    }

    /// Starts it anew, after its end. What was on its way in its memory is lost, what was answered is not.
    pub(super) fn start(&mut self, index: usize, settings: &(Commit, WhenAlone, Duration)) {
        self.life += 1;
        self.up = true;
        self.hangs_until = 0;
        self.machine = machine(index, self.life, settings);
        self.role = Role::Joining;
        self.waiting.clear();
        self.hand_back(self.answered);
    }

    /// Its clock at a moment of the world, in microseconds.
    pub(super) fn local(&self, at: u64) -> Instant {
        let at = i128::from(at);
        let local = at + at * i128::from(self.drift) / 1_000_000;
        self.clock + Duration::from_micros(u64::try_from(local).unwrap())
    }

    /// The first moment of the world at which its clock shows `local`.
    pub(super) fn moment(&self, local: Instant) -> u64 {
        let local = local.duration_since(self.clock).as_nanos() as i128;
        let at = local * 1000 / i128::from(1_000_000 + self.drift) + 1;
        u64::try_from(at).unwrap()
    }

    /// The mirror: the journal, and what is not in it yet.
    pub(super) fn state(&self, key_of: impl Fn(Write) -> usize) -> State {
        let mut state = self.base;
        for own in &self.own {
            state[key_of(own.write)] = own.write + 1;
        }
        state
    }

    /// The journal holds all up to `seq`, and this computer does, too.
    pub(super) fn follow(&mut self, journal: &[Write], seq: u64, key_of: impl Fn(Write) -> usize) {
        for write in journal
            .iter()
            .take(seq as usize)
            .skip(self.followed as usize)
        {
            self.base[key_of(*write)] = write + 1;
        }
        self.followed = self.followed.max(seq);
    }

    /// Of the records after the journal's, `answered` become pending writes; the others wait again.
    pub(super) fn hand_back(&mut self, answered: usize) {
        if answered > 0 && self.pending.is_empty() {
            self.cut_off = self.base;
        }
        let own = std::mem::take(&mut self.own);
        self.pending
            .extend(own.iter().take(answered).map(|own| own.write));
        self.answered = 0;
    }
}

fn machine(index: usize, life: u64, settings: &(Commit, WhenAlone, Duration)) -> Machine {
    Machine::new(Settings {
        name: name(index),
        id: format!("{index} {life}"),
        uri: String::new(),
        boot: String::new(),
        version: String::new(),
        ttl: settings.2,
        commit: settings.0,
        alone: settings.1,
    })
}
