//! A computer of the simulation: production's [`Member`], and the state that `app/cluster` holds for it.

use std::time::{Duration, Instant};

use super::world::ScheduleOptions;
use crate::cluster::{
    journal::Keys,
    machine::{Leader, Settings, View},
    member::{LocalCheckpoint, Member, PartitionWrites},
    merge::wire,
    sharing::{Sharing, Source},
    standing::{JournalPosition, Standing},
};
use ros1_master::master::{Master, Notice, Request};

/// A call that was run on this computer, and whose answer waits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Unanswered {
    pub(super) seq: u64,
    pub(super) call: usize,
    /// The computer whose node made the call.
    pub(super) origin: usize,
}

/// A computer, the number of its process, and the number of its request.
pub(super) type Asker = (usize, u64, u64);

/// The mirror, and the changes that the other computers must get.
#[derive(Debug, Default)]
pub(super) struct Ledger {
    pub(super) mirror: Master,
    pub(super) sharing: Option<Sharing>,
    pub(super) unanswered: Vec<Unanswered>,
    /// Merged portions whose answers wait until the journal has a record: that record, the asking computer, and the
    /// answer.
    pub(super) merges: Vec<(u64, Asker, wire::MergeAnswer)>,
    /// Counts the periods in which calls are recorded on this computer.
    pub(super) leadership: u64,
    pub(super) agreed: u64,
    pub(super) lease: Option<Instant>,
}

impl Ledger {
    /// The number of the last record. The mirror shows it, even if the journal lacks it.
    pub(super) fn last(&self) -> u64 {
        self.sharing.as_ref().map_or(0, Sharing::last)
    }

    pub(super) fn has_lease(&self, now: Instant) -> bool {
        self.lease.is_none_or(|until| now < until)
    }

    /// Runs a call, and records it. Returns the number of the record, for which the answer waits, and the notifications.
    /// `None` if another computer records calls.
    pub(super) fn run(&mut self, call: &Request, source: &Source) -> Option<(u64, Vec<Notice>)> {
        let sharing = self.sharing.as_mut()?;
        let mut notices = Vec::new();
        self.mirror.apply_telling(call, &mut notices);
        sharing.record(call, source);
        Some((sharing.last(), notices))
    }

    fn leave(&mut self) -> Vec<(u64, Asker, wire::MergeAnswer)> {
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

/// The content of a computer's disk.
#[derive(Clone, Debug, Default)]
pub(super) struct Disk {
    pub(super) own: LocalCheckpoint,
    pub(super) kept: Option<PartitionWrites>,
    /// The term of the leader whose state this is, if the journal lacked something of it.
    pub(super) early: Option<u64>,
}

#[derive(Debug)]
pub(super) struct Computer {
    pub(super) name: String,
    pub(super) member: Member,
    pub(super) up: bool,
    /// Whether rosrescue has ended because another computer has the same name.
    pub(super) refused: bool,
    /// Counts the processes of this computer.
    pub(super) life: u64,
    /// Whether this process has been told to stop.
    pub(super) stops: bool,
    /// The computer hangs until this time.
    pub(super) hangs_until: u64,
    /// The computer has not hung since this time.
    pub(super) undisturbed_since: u64,
    /// The computer may not have been able to do its part when etcd lost data before this time.
    pub(super) disturbed_until: u64,
    /// The origin of a journal of which the watch has shown this process that it can no longer be read.
    pub(super) seen_unreadable: u64,
    /// Whether this process has read etcd.
    pub(super) has_read: bool,
    /// Whether etcd had an older copy when this process read it first, and no new journal has begun since. The copy looks
    /// like any journal.
    pub(super) unaware: bool,
    /// Whether an older journal has gone on with a leader that did not know of the loss, and this process has not followed
    /// it yet. Answers of that leader may be newer than what this process shows.
    pub(super) follows_lost: bool,
    /// The term in which an earlier process led, if the mirror still has its state, and the journal lacked something of it.
    pub(super) restored_early: Option<u64>,
    /// By how much the computer's clock is too fast, in millionths.
    drift: i64,
    clock: Instant,
    /// When the next wake-up is due. Earlier wake-ups are ignored.
    pub(super) wake: u64,
    pub(super) ledger: Ledger,
    pub(super) disk: Disk,
    /// The disk's content when it was synced last.
    pub(super) synced: Disk,
    pub(super) synced_at: u64,
    /// The number of the master's process. `None` without a master.
    pub(super) master: Option<u64>,
    pub(super) own_only: bool,
    /// How often the computer was cut off, or noticed that etcd had lost data, since it last had no writes to send.
    pub(super) times_alone: usize,
    /// How much of the journal the computer held when it was cut off: as a record number, and as a place in the log.
    pub(super) cut: (u64, usize),
    pub(super) standing: Standing,
    /// Calls of the computer's nodes that wait. Each is sent again only after the time beside it.
    pub(super) waiting: Vec<(usize, u64)>,
    /// Calls that a leader has answered, with the position that its answers had shown by then.
    pub(super) answered: Vec<(JournalPosition, usize)>,
    /// The furthest position in the journal that a leader's answer has shown.
    pub(super) told: JournalPosition,
    /// The last position that it may have shown, if it led until its role changed last.
    pub(super) left: Option<JournalPosition>,
    /// The position in the journal up to which the mirror is current.
    pub(super) followed: JournalPosition,
    /// Whether there is a watch. Its number, time and last revision follow.
    pub(super) watching: bool,
    pub(super) watch: u64,
    pub(super) watch_at: u64,
    pub(super) watched: u64,
}

fn member(name: &str, index: usize, life: u64, plan: &ScheduleOptions, disk: &Disk) -> Member {
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
    let (own, left) = (disk.own.clone(), disk.kept.clone());
    let id = settings.id.clone();
    Member::new(settings, Keys::new("robot"), own, left, id)
}

pub(super) fn uri(index: usize) -> String {
    format!("http://computer{index}:11311/")
}

impl Computer {
    pub(super) fn new(index: usize, plan: &ScheduleOptions, drift: i64) -> Self {
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
            stops: false,
            hangs_until: 0,
            undisturbed_since: 0,
            disturbed_until: 0,
            seen_unreadable: 0,
            has_read: false,
            unaware: false,
            follows_lost: false,
            restored_early: None,
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
            standing: Standing::NoLeader { known: false },
            waiting: Vec::new(),
            answered: Vec::new(),
            told: JournalPosition::at_start(),
            left: None,
            followed: JournalPosition::default(),
            watching: false,
            watch: 0,
            watch_at: 0,
            watched: 0,
        }
    }

    /// Starts a new process. The memory of the previous one is lost.
    pub(super) fn start(&mut self, index: usize, plan: &ScheduleOptions) {
        self.life += 1;
        self.stops = false;
        self.seen_unreadable = 0;
        (self.has_read, self.unaware) = (false, false);
        self.follows_lost = false;
        self.restored_early = self.disk.early;
        self.up = true;
        self.hangs_until = 0;
        self.disk.own.restored = true;
        let own = &self.disk.own;
        (self.told, self.followed) = (JournalPosition::at_start(), JournalPosition::default());
        self.ledger = Ledger {
            mirror: own.state.clone(),
            leadership: self.ledger.leadership + 1,
            ..Ledger::default()
        };
        self.member = member(&self.name, index, self.life, plan, &self.disk);
        (self.master, self.own_only, self.watching) = (None, false, false);
        self.watch += 1;
        self.standing = Standing::NoLeader { known: true };
        self.waiting.clear();
        self.answered.clear();
    }

    /// Notes that this process reads etcd, which shows `view`. `is_old` says whether that is an older copy.
    pub(super) fn reads(&mut self, view: &View, is_old: bool) {
        let own = &self.disk.own;
        let kept = self.disk.kept.as_ref().map(|kept| kept.held);
        let held = kept
            .filter(|held| *held > 0)
            .map_or(own.seq, |held| held.min(own.seq));
        let follows = |leader: &Leader| leader.name != self.name && leader.term == own.term;
        // As production decides, but without its mutant.
        let has_more = view.leader.as_ref().is_some_and(follows)
            && view.journal_number == own.journal_number
            && view.seq() < held;
        self.unaware |= is_old && !self.has_read && !has_more;
    }

    /// Notes the position in the journal that a leader's answer shows.
    pub(super) fn tell_of(&mut self, position: JournalPosition) {
        let epoch = self.followed.epoch;
        self.told = self.told.max(JournalPosition { epoch, ..position });
    }

    /// Stops recording. Returns the merged portions that are not answered.
    pub(super) fn leave(&mut self, binds: bool) -> Vec<(u64, Asker, wire::MergeAnswer)> {
        let recorded = self.ledger.sharing.is_some().then(|| self.ledger.last());
        self.left = recorded.filter(|_| binds).map(|seq| JournalPosition {
            seq,
            ..self.followed
        });
        if let Some(left) = self.left {
            self.tell_of(left);
        }
        self.ledger.leave()
    }

    /// The computer's clock at a moment of the simulation, in microseconds.
    pub(super) fn local(&self, at: u64) -> Instant {
        let at = i128::from(at);
        let local = at + at * i128::from(self.drift) / 1_000_000;
        self.clock + Duration::from_micros(u64::try_from(local).unwrap())
    }

    /// The first moment of the simulation at which the computer's clock shows `local`.
    pub(super) fn moment(&self, local: Instant) -> u64 {
        let local = local.saturating_duration_since(self.clock).as_nanos() as i128;
        let at = local * 1000 / i128::from(1_000_000 + self.drift) + 1;
        u64::try_from(at).unwrap()
    }

    /// The term in which this process leads, if its mirror shows something that the journal lacks.
    pub(super) fn early(&self) -> Option<u64> {
        let machine = self.member.machine();
        let sharing = self.ledger.sharing.as_ref();
        let lacks = sharing.is_some_and(|of| of.last() > machine.committed());
        let is_early = lacks || self.member.uncommitted() > 0;
        is_early.then(|| machine.term().unwrap_or_default())
    }

    /// Has the mirror show the journal's state.
    pub(super) fn follow_state(&mut self, state: Master) {
        self.ledger.mirror = state;
        self.restored_early = None;
    }

    /// Writes the ledger's present state to the disk, unsynced.
    pub(super) fn write_disk(&mut self) {
        if self.ledger.sharing.is_some() {
            // What the journal lacks of the restored state is recorded now.
            self.restored_early = None;
        }
        self.disk.early = self.early().or(self.restored_early);
        let own = &mut self.disk.own;
        own.state = self.ledger.mirror.clone();
        own.seq = match &self.ledger.sharing {
            Some(sharing) => sharing.last(),
            None if self.member.seq() > 0 => self.member.seq(),
            None => own.seq,
        };
    }
}
