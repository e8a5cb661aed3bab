//! A computer of the simulation: the member of production, and what the shell holds for it.

use std::time::{Duration, Instant};

use super::world::Plan;
use crate::{
    cluster::{
        cut_off::CutOff,
        journal::Keys,
        machine::Settings,
        member::{Member, Own},
        merge::wire,
        sharing::{Sharing, Source},
        standing::{Place, Standing},
    },
    master::{Master, Notice, Request},
};

/// A call that was run here, and whose answer waits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Unanswered {
    pub(super) seq: u64,
    /// It has changed something.
    pub(super) recorded: bool,
    pub(super) call: usize,
    /// The computer whose node made it.
    pub(super) origin: usize,
}

/// A computer, its process, and the number of what it asks.
pub(super) type Asker = (usize, u64, u64);

/// The mirror, and what of it is given to the others.
#[derive(Debug, Default)]
pub(super) struct Ledger {
    pub(super) mirror: Master,
    pub(super) sharing: Option<Sharing>,
    pub(super) unanswered: Vec<Unanswered>,
    /// Merged portions that wait for the journal up to a record: who has asked, and the answer.
    pub(super) merges: Vec<(u64, Asker, wire::MergeAnswer)>,
    /// Counts the times that calls are recorded here.
    pub(super) leadership: u64,
    pub(super) agreed: u64,
    pub(super) lease: Option<Instant>,
}

impl Ledger {
    pub(super) fn has_lease(&self, now: Instant) -> bool {
        self.lease.is_none_or(|until| now < until)
    }

    /// Runs a call, and records it if it changes anything. Returns the number of the record that its answer waits for,
    /// and what nodes are notified of; none if calls are recorded elsewhere.
    pub(super) fn run(
        &mut self,
        call: &Request,
        source: &Source,
    ) -> Option<(u64, bool, Vec<Notice>)> {
        let sharing = self.sharing.as_mut()?;
        let changes = self.mirror.would_change(call);
        let mut notices = Vec::new();
        self.mirror.apply_telling(call, &mut notices);
        if changes {
            sharing.record(call, source);
        }
        Some((sharing.last(), changes, notices))
    }

    /// Nothing is recorded any more. Returns the portions that are not answered.
    pub(super) fn leave(&mut self) -> Vec<(u64, Asker, wire::MergeAnswer)> {
        self.sharing = None;
        self.leadership += 1;
        self.agreed = 0;
        self.unanswered.clear();
        std::mem::take(&mut self.merges)
    }

    pub(super) fn lead(&mut self, seq: u64, held: &Master, state: Option<Master>) {
        if let Some(state) = state {
            self.mirror = state;
        }
        let mut sharing = Sharing::after(seq);
        if self.mirror != *held {
            sharing.record_state(&self.mirror);
        }
        self.sharing = Some(sharing);
        self.agreed = seq;
    }
}

/// What is on the disk.
#[derive(Clone, Debug, Default)]
pub(super) struct Disk {
    pub(super) own: Own,
    pub(super) kept: Option<(Master, Vec<Request>)>,
}

#[derive(Debug)]
pub(super) struct Computer {
    pub(super) name: String,
    pub(super) member: Member,
    pub(super) up: bool,
    /// It has ended because of another computer of its name.
    pub(super) refused: bool,
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
    pub(super) ledger: Ledger,
    pub(super) disk: Disk,
    /// As the disk was synced last.
    pub(super) synced: Disk,
    pub(super) synced_at: u64,
    /// The number of its master's process.
    pub(super) master: Option<u64>,
    pub(super) own_only: bool,
    /// How often it was cut off since it owed nothing.
    pub(super) times_alone: usize,
    /// How much of the journal it held when it was cut off, by its number and in the log.
    pub(super) cut: (u64, usize),
    pub(super) standing: Standing,
    /// Calls of its nodes that wait, and until when no answer to them is missed.
    pub(super) waiting: Vec<(usize, u64)>,
    /// The furthest place that a leader's answer told of.
    pub(super) told: Place,
    /// Whether there is a watch, its number, and what it has shown.
    pub(super) watching: bool,
    pub(super) watch: u64,
    pub(super) watch_at: u64,
    pub(super) watched: (u64, u64),
}

fn member(name: &str, index: usize, life: u64, plan: &Plan, disk: &Disk) -> Member {
    let settings = Settings {
        name: name.to_owned(),
        id: format!("{index} {life}"),
        uri: uri(index),
        boot: String::new(),
        version: String::new(),
        ttl: plan.ttl,
        commit: plan.commit,
        alone: plan.alone,
    };
    let left = match &disk.kept {
        Some((base, calls)) => CutOff::left(base.clone(), calls.iter().cloned()),
        None => CutOff::default(),
    };
    let id = settings.id.clone();
    Member::new(settings, Keys::new("robot"), disk.own.clone(), left, id)
}

pub(super) fn uri(index: usize) -> String {
    format!("http://computer{index}:11311/")
}

impl Computer {
    pub(super) fn new(index: usize, plan: &Plan, drift: i64) -> Self {
        let name = match plan.twins && index == 1 {
            true => "computer0".to_owned(),
            false => format!("computer{index}"),
        };
        let disk = Disk::default();
        Self {
            member: member(&name, index, 0, plan, &disk),
            name,
            up: true,
            refused: false,
            life: 0,
            hangs_until: 0,
            undisturbed_since: 0,
            drift,
            clock: Instant::now() + Duration::from_secs(1),
            wake: 0,
            ledger: Ledger::default(),
            synced: disk.clone(),
            synced_at: 0,
            disk,
            master: None,
            own_only: false,
            times_alone: 0,
            cut: (0, 0),
            standing: Standing::Nobody { known: false },
            waiting: Vec::new(),
            told: Place::default(),
            watching: false,
            watch: 0,
            watch_at: 0,
            watched: (0, 0),
        }
    }

    /// Starts it anew, after its end. What was in its memory is lost.
    pub(super) fn start(&mut self, index: usize, plan: &Plan) {
        self.life += 1;
        self.up = true;
        self.hangs_until = 0;
        self.disk.own.restored = true;
        let own = &self.disk.own;
        self.told = Place {
            seq: 1,
            ..Place::default()
        };
        self.ledger = Ledger {
            mirror: own.state.clone(),
            leadership: self.ledger.leadership + 1,
            ..Ledger::default()
        };
        self.member = member(&self.name, index, self.life, plan, &self.disk);
        (self.master, self.own_only, self.watching) = (None, false, false);
        self.watch += 1;
        self.standing = Standing::Nobody { known: true };
        self.waiting.clear();
    }

    /// An answer of a leader tells of a place.
    pub(super) fn tell_of(&mut self, place: Place) {
        let epoch = self.member.place().epoch;
        self.told = self.told.max(Place { epoch, ..place });
    }

    /// Its clock at a moment of the world, in microseconds.
    pub(super) fn local(&self, at: u64) -> Instant {
        let at = i128::from(at);
        let local = at + at * i128::from(self.drift) / 1_000_000;
        self.clock + Duration::from_micros(u64::try_from(local).unwrap())
    }

    /// The first moment of the world at which its clock shows `local`.
    pub(super) fn moment(&self, local: Instant) -> u64 {
        let local = local.saturating_duration_since(self.clock).as_nanos() as i128;
        let at = local * 1000 / i128::from(1_000_000 + self.drift) + 1;
        u64::try_from(at).unwrap()
    }

    /// What the checkpoint holds now.
    pub(super) fn write_disk(&mut self) {
        let own = &mut self.disk.own;
        own.state = self.ledger.mirror.clone();
        if let Some(sharing) = &self.ledger.sharing {
            own.seq = sharing.last();
        }
    }
}
