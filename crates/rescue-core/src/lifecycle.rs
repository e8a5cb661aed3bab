//! Decides when to connect to, examine, probe, spawn and kill a master, and when the *gate* is open, which means that
//! calls pass to the master. Only during an injection, which restores the state in a master, `recovery::examine` shuts
//! the gate to writes by itself.
//!
//! This is a state machine without IO: the caller, `recovery`, passes in what happened and when, and carries out the
//! returned actions. The machine owns every deadline, so that each can be tested without waiting.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use self::evidence::{BUSY_LIMIT, Evidence, Sample, SilenceVerdict};

pub mod evidence;
mod open_calls;
mod patience;
mod types;

pub use open_calls::OpenCalls;
pub use patience::Patience;
pub use types::{Action, Cause, Input, Probing, Supervision};

/// How long a death counts towards a crash loop.
const DEATH_MEMORY: Duration = Duration::from_secs(60);
/// Number of deaths within [`DEATH_MEMORY`] up to which a new master is started at once.
const DEATHS_AT_ONCE: usize = 5;
/// The first pause in a crash loop. It doubles with each further death.
const FIRST_PAUSE: Duration = Duration::from_millis(500);
/// The longest pause in a crash loop.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);
/// A master that serves for this time ends the crash loop. The pauses before new masters continue while more than
/// [`DEATHS_AT_ONCE`] deaths are within [`DEATH_MEMORY`].
const CALM: Duration = Duration::from_secs(10);
/// A new master that has used this many times [`Probing::start_limit`] of processor time and does not listen counts as
/// hung.
const STARTS_AT_MOST: u32 = 10;
/// Pause between two samples of a master that starts slowly.
const SAMPLE_PAUSE: Duration = Duration::from_millis(500);
/// Pause before the next connection attempt if the server at the master's address is not a master.
const NOT_A_MASTER_PAUSE: Duration = Duration::from_secs(1);

/// What is being done with the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Nothing: not started yet, or stopped.
    Stopped,
    /// No master is connected.
    Seeking {
        /// Since when no master serves.
        since: Instant,
    },
    /// A master is connected. It is not yet known to have the mirror's state.
    Examining {
        /// Since when no master serves.
        since: Instant,
    },
    /// Calls pass to the master, or would if it was not late.
    Serving { since: Instant, lateness: Lateness },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lateness {
    InTime,
    /// The master is late, and the mirror answers in its place.
    Late,
    /// The late master gets the writes that the mirror has answered.
    CatchingUp,
}

/// Where the mirror's state comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum StateFrom {
    /// From nowhere yet: a master may be running, and its state has to be read.
    Nowhere,
    /// This is a new session with a new master, so the state is empty.
    NewMaster,
    /// From a checkpoint whose session continues.
    Checkpoint,
    /// From a master that has served.
    Master,
}

/// Whether an external master, which another program starts, has died.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum TheirDeath {
    #[default]
    No,
    /// It has closed its connection, and may have died.
    Suspected,
    /// It was counted as dead. Since then its port has not refused a connection, and no master was examined there.
    Counted,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Timer {
    Connect,
    Probe,
    Spawn,
}

/// Masters whose port another program took.
#[derive(Debug, Default)]
struct TakenPorts {
    /// Number of consecutive ones.
    count: usize,
    /// Whether the last of these masters still runs.
    last_runs: bool,
}

/// The state machine that decides what happens to the master.
#[derive(Debug)]
pub struct Lifecycle {
    supervision: Supervision,
    probing: Probing,
    phase: Phase,
    state_from: StateFrom,
    /// When the child, a master that rosrescue has started, began. For an orphan, a master left by an earlier
    /// rosrescue, when this rosrescue began. `None` if there is no child and no orphan.
    child: Option<Instant>,
    /// Times of the latest deaths, oldest first, none older than [`DEATH_MEMORY`].
    deaths: VecDeque<Instant>,
    total_deaths: u64,
    /// Whether there is a crash loop: more than [`DEATHS_AT_ONCE`] deaths within [`DEATH_MEMORY`], and no master has
    /// served for [`CALM`] since.
    crash_loop: bool,
    their_death: TheirDeath,
    missed: u32,
    /// The samples of a child that does not answer.
    evidence: Evidence,
    /// Number of consecutive failed spawns.
    failed_spawns: usize,
    taken_ports: TakenPorts,
    timer: Option<(Instant, Timer)>,
}

impl Lifecycle {
    /// Creates a state machine that waits for [`Input::Start`].
    pub fn new(supervision: Supervision, probing: Probing) -> Self {
        Self {
            supervision,
            probing,
            phase: Phase::Stopped,
            state_from: StateFrom::Nowhere,
            child: None,
            deaths: VecDeque::new(),
            total_deaths: 0,
            crash_loop: false,
            their_death: TheirDeath::No,
            missed: 0,
            evidence: Evidence::default(),
            failed_spawns: 0,
            taken_ports: TakenPorts::default(),
            timer: None,
        }
    }

    /// When to pass in [`Input::Wake`]. This time may change with every input.
    pub fn deadline(&self) -> Option<Instant> {
        let timer = self.timer.map(|(at, _)| at);
        timer.into_iter().chain(self.calm_at()).min()
    }

    /// When the crash loop ends, unless the master dies before that.
    fn calm_at(&self) -> Option<Instant> {
        match self.phase {
            Phase::Serving { since, .. } if self.crash_loop => Some(since + CALM),
            _ => None,
        }
    }

    /// Number of masters that died since the start.
    pub fn deaths(&self) -> u64 {
        self.total_deaths
    }

    /// Whether the mirror may answer while no calls pass to the master, because it is known to equal the state of a
    /// master.
    pub fn may_stand_in(&self) -> bool {
        self.state_from != StateFrom::Nowhere
    }

    /// Whether a master has served since the start.
    pub fn has_served(&self) -> bool {
        self.state_from == StateFrom::Master
    }

    /// Whether the decision about `input` needs a [`Sample`] of the child.
    pub fn needs_sample(&self, now: Instant, input: Input) -> bool {
        let sampled = self.evidence.last_at();
        let is_old = sampled.is_none_or(|at| now.duration_since(at) >= SAMPLE_PAUSE);
        self.child.is_some()
            && match input {
                Input::ProbeMissed | Input::Unreachable => true,
                Input::Refused => is_old && self.is_slow_to_start(now),
                Input::ConnectionLost => is_old && self.is_hopeless(now),
                _ => false,
            }
    }

    /// Adds a sample of the child, which shows whether the child hangs.
    pub fn observe(&mut self, sample: Sample) {
        self.evidence.add(sample);
    }

    /// Whether this is a new session in which no master has served yet.
    pub fn is_new_session(&self) -> bool {
        matches!(self.state_from, StateFrom::Nowhere | StateFrom::NewMaster)
    }

    /// Takes an input at `now`. Returns the actions, in order.
    ///
    /// ```
    /// use std::time::{Duration, Instant};
    /// use rescue_core::lifecycle::{Action, Cause, Input, Lifecycle, Probing, Supervision};
    ///
    /// let probing = Probing {
    ///     interval: Duration::from_secs(1),
    ///     count: 3,
    ///     start_limit: Duration::from_secs(30),
    /// };
    /// let mut lifecycle = Lifecycle::new(Supervision::Theirs, probing);
    /// let now = Instant::now();
    /// let start = Input::Start { left: false, restored: false };
    /// assert_eq!(lifecycle.on(now, start), [Action::Connect]);
    /// assert_eq!(lifecycle.on(now, Input::Connected), [Action::Examine]);
    /// assert_eq!(lifecycle.on(now, Input::Examined { new: true }), [Action::OpenGate]);
    /// let shut = Action::ShutGate(Cause::ConnectionLost);
    /// assert_eq!(lifecycle.on(now, Input::ConnectionLost), [shut, Action::Connect]);
    /// ```
    pub fn on(&mut self, now: Instant, input: Input) -> Vec<Action> {
        let is_examining = matches!(self.phase, Phase::Examining { .. });
        match input {
            Input::Start { left, restored } => self.start(now, left, restored),
            _ if self.phase == Phase::Stopped => Vec::new(),
            Input::Answered => {
                if self.their_death == TheirDeath::Counted {
                    self.their_death = TheirDeath::No;
                }
                Vec::new()
            }
            Input::Connected => {
                let since = self.away_since().unwrap_or(now);
                self.phase = Phase::Examining { since };
                self.timer = None;
                vec![Action::Examine]
            }
            Input::Refused => self.refused(now),
            Input::PortTaken => {
                self.taken_ports.count += 1;
                self.taken_ports.last_runs = true;
                self.give_up(now)
            }
            Input::Unreachable => self.unreachable(now),
            Input::NotAMaster if is_examining && self.is_hopeless(now) => self.give_up(now),
            // rosmaster closes connections that carry nothing for a few seconds, so a connection also ends if rosmaster
            // or rosrescue gets too little processor time.
            Input::ConnectionLost if is_examining && self.is_hopeless(now) => {
                self.give_up_if_hung(now, BUSY_LIMIT, true)
            }
            Input::NotAMaster => {
                self.seek(now);
                self.timer = Some((now + NOT_A_MASTER_PAUSE, Timer::Connect));
                Vec::new()
            }
            // The master died during the examination, or closes every connection. In both cases, wait before the next
            // connection.
            Input::ConnectionLost if is_examining => {
                let mut actions = self.connect_later(now, false);
                let before = std::mem::replace(&mut self.their_death, TheirDeath::Counted);
                if self.supervision == Supervision::Theirs && before != TheirDeath::Counted {
                    actions.extend(self.count_their_death(now));
                }
                actions
            }
            Input::Late | Input::LateAnswered | Input::CaughtUp | Input::NotCaughtUp => {
                self.late(now, input)
            }
            Input::ThreadEnded | Input::BatchLost | Input::Slow if !self.is_serving() => Vec::new(),
            Input::Slow => self.probe_now().into_iter().collect(),
            // If the master was killed, the other signs of its end follow within milliseconds. If it lives, the next
            // connection shows that.
            Input::ConnectionLost | Input::BatchLost | Input::ThreadEnded => {
                if self.supervision == Supervision::Theirs {
                    self.their_death = TheirDeath::Suspected;
                }
                let cause = match input {
                    Input::ThreadEnded => Cause::ThreadEnded,
                    _ => Cause::ConnectionLost,
                };
                self.lose_master(now, cause, vec![Action::Connect])
            }
            Input::Examined { new } => {
                let before = std::mem::take(&mut self.their_death);
                self.taken_ports.count = 0;
                self.state_from = StateFrom::Master;
                self.phase = Phase::Serving {
                    since: now,
                    lateness: Lateness::InTime,
                };
                self.note_answer(now);
                let report = match before == TheirDeath::Suspected && new {
                    true => self.count_their_death(now),
                    false => None,
                };
                std::iter::once(Action::OpenGate).chain(report).collect()
            }
            Input::ProbeAnswered => {
                self.note_answer(now);
                Vec::new()
            }
            Input::ProbeMissed => self.probe_missed(now),
            Input::Spawned => {
                self.evidence.clear();
                self.child = Some(now);
                self.failed_spawns = 0;
                self.phase = Phase::Seeking { since: now };
                vec![Action::Connect]
            }
            Input::SpawnFailed { pending: false } if self.is_new_session() => vec![Action::GiveUp],
            Input::SpawnFailed { .. } => {
                let pause = pause_after(self.failed_spawns).max(self.pause_before_spawn());
                self.failed_spawns += 1;
                self.timer = Some((now + pause, Timer::Spawn));
                Vec::new()
            }
            Input::Exited => {
                self.child = None;
                let spawn = match std::mem::take(&mut self.taken_ports.last_runs) {
                    true => self.spawn_elsewhere(now),
                    false => self.spawn(now),
                };
                self.lose_master(now, Cause::Exited, spawn)
            }
            Input::Wake if self.calm_at().is_some_and(|at| at <= now) => {
                self.crash_loop = false;
                vec![Action::ReportCalm]
            }
            Input::Wake => match self.timer.take() {
                Some((at, timer)) if at > now => {
                    self.timer = Some((at, timer));
                    Vec::new()
                }
                Some((_, Timer::Connect)) => vec![Action::Connect],
                Some((_, Timer::Probe)) => vec![Action::Probe],
                Some((_, Timer::Spawn)) => vec![Action::Spawn],
                None => Vec::new(),
            },
            Input::Stop => {
                self.phase = Phase::Stopped;
                self.timer = None;
                vec![Action::ShutGate(Cause::Stopping)]
            }
        }
    }

    fn start(&mut self, now: Instant, left: bool, restored: bool) -> Vec<Action> {
        self.seek(now);
        let is_new = self.supervision == Supervision::Ours && !left;
        self.state_from = match restored {
            true => StateFrom::Checkpoint,
            false if is_new => StateFrom::NewMaster,
            // The state of an orphan or of an external master.
            false => StateFrom::Nowhere,
        };
        if is_new {
            return vec![Action::Spawn];
        }
        self.child = left.then_some(now);
        vec![Action::Connect]
    }

    /// Handles what is said about a master that is late.
    fn late(&mut self, now: Instant, input: Input) -> Vec<Action> {
        let Phase::Serving { lateness, .. } = &mut self.phase else {
            return Vec::new();
        };
        match (*lateness, input) {
            (Lateness::InTime, Input::Late) => {
                *lateness = Lateness::Late;
                let probe = self.probe_now();
                [Action::StandIn].into_iter().chain(probe).collect()
            }
            (Lateness::Late, Input::LateAnswered) => {
                *lateness = Lateness::CatchingUp;
                self.timer = None;
                vec![Action::CatchUp]
            }
            (Lateness::CatchingUp, Input::CaughtUp) => {
                *lateness = Lateness::InTime;
                self.note_answer(now);
                vec![Action::OpenGate]
            }
            (Lateness::CatchingUp, Input::NotCaughtUp) => {
                self.lose_master(now, Cause::Late, vec![Action::Connect])
            }
            _ => Vec::new(),
        }
    }

    /// Whether calls pass to the master, or would if it was not late.
    fn is_serving(&self) -> bool {
        matches!(self.phase, Phase::Serving { .. })
    }

    /// Since when no master serves.
    fn away_since(&self) -> Option<Instant> {
        match self.phase {
            Phase::Seeking { since } | Phase::Examining { since } => Some(since),
            Phase::Serving { .. } | Phase::Stopped => None,
        }
    }

    /// Notes that the master has answered.
    fn note_answer(&mut self, now: Instant) {
        self.missed = 0;
        self.evidence.clear();
        self.timer = Some((now + self.probing.interval, Timer::Probe));
    }

    /// Probes now instead of at the next regular time, unless a probe is running.
    fn probe_now(&mut self) -> Option<Action> {
        let due = self.timer.take_if(|(_, timer)| *timer == Timer::Probe);
        due.map(|_| Action::Probe)
    }

    fn seek(&mut self, now: Instant) {
        let since = self.away_since().unwrap_or(now);
        self.phase = Phase::Seeking { since };
        self.timer = None;
    }

    /// Handles the loss of the master: lets no more calls pass to it, then takes the actions `then`.
    fn lose_master(&mut self, now: Instant, cause: Cause, then: Vec<Action>) -> Vec<Action> {
        let timer = self.timer;
        let was_serving = self.is_serving();
        self.seek(now);
        if cause == Cause::Exited {
            // `spawn` has already set a timer for the next master, which stays.
            self.timer = timer.filter(|(_, timer)| *timer == Timer::Spawn);
        }
        let shut = was_serving.then_some(Action::ShutGate(cause));
        shut.into_iter().chain(then).collect()
    }

    fn refused(&mut self, now: Instant) -> Vec<Action> {
        let before = std::mem::take(&mut self.their_death);
        if self.is_slow_to_start(now) {
            let limit = self.probing.start_limit.saturating_mul(STARTS_AT_MOST);
            return self.give_up_if_hung(now, limit, false);
        }
        let mut actions = self.connect_later(now, false);
        if before == TheirDeath::Suspected {
            // The process that closed the connection no longer listens.
            actions.extend(self.count_their_death(now));
        }
        actions
    }

    /// Whether the child has had more than [`Probing::start_limit`] to start listening. A rosmaster whose port was
    /// taken never listens and does not end.
    fn is_slow_to_start(&self, now: Instant) -> bool {
        let limit = self.probing.start_limit;
        self.child
            .is_some_and(|since| now.duration_since(since) > limit)
    }

    /// Whether the child has had more than [`Probing::start_limit`], and still no master answers at its port.
    fn is_hopeless(&self, now: Instant) -> bool {
        let since = self.away_since().filter(|_| self.child.is_some());
        since.is_some_and(|since| now.duration_since(since) > self.probing.start_limit)
    }

    /// Kills the silent child if it [hangs](Evidence::judge_silence). Connects again if it does not.
    fn give_up_if_hung(&mut self, now: Instant, busy_limit: Duration, far: bool) -> Vec<Action> {
        match self.evidence.judge_silence(busy_limit) {
            SilenceVerdict::Hung => self.give_up(now),
            verdict => {
                let actions = self.connect_later(now, far);
                actions.into_iter().chain(spare(verdict)).collect()
            }
        }
    }

    /// Kills the child, which hangs or cannot serve. Its end arrives as [`Input::Exited`], which starts the next
    /// master.
    fn give_up(&mut self, now: Instant) -> Vec<Action> {
        self.seek(now);
        vec![Action::Kill]
    }

    fn unreachable(&mut self, now: Instant) -> Vec<Action> {
        match self.supervision {
            Supervision::Ours if matches!(self.phase, Phase::Examining { .. }) => {
                let actions = self.give_up_if_hung(now, BUSY_LIMIT, true);
                if actions.contains(&Action::Kill) {
                    self.timer = Some((now + FIRST_PAUSE, Timer::Connect));
                }
                actions
            }
            // The master does not even accept connections: it is stopped, and its backlog is full.
            _ if self.is_hopeless(now) => self.give_up_if_hung(now, BUSY_LIMIT, true),
            _ => self.connect_later(now, true),
        }
    }

    fn connect_later(&mut self, now: Instant, far: bool) -> Vec<Action> {
        self.seek(now);
        let waited = self
            .away_since()
            .map_or(Duration::ZERO, |since| now.duration_since(since));
        self.timer = Some((now + pause_before_connect(waited, far), Timer::Connect));
        Vec::new()
    }

    fn probe_missed(&mut self, now: Instant) -> Vec<Action> {
        self.missed += 1;
        if self.missed < self.probing.count {
            return vec![Action::Probe];
        }
        let then = match self.supervision {
            Supervision::Ours => match self.evidence.judge_silence(BUSY_LIMIT) {
                SilenceVerdict::Hung => vec![Action::Kill],
                verdict => spare(verdict).into_iter().collect(),
            },
            Supervision::Theirs => Vec::new(),
        };
        let actions = self.lose_master(now, Cause::Hung, then);
        // The end of a killed master arrives as [`Input::Exited`].
        self.timer = Some((now + FIRST_PAUSE, Timer::Connect));
        actions
    }

    /// Starts the next master after a child has died.
    fn spawn(&mut self, now: Instant) -> Vec<Action> {
        self.count_death(now);
        let pause = self.pause_before_spawn();
        if pause.is_zero() {
            self.timer = None;
            return vec![Action::Spawn];
        }
        self.timer = Some((now + pause, Timer::Spawn));
        vec![Action::ReportCrashLoop(self.deaths.len())]
    }

    /// Handles the end of a child that never got its port. It does not count as a death.
    fn spawn_elsewhere(&mut self, now: Instant) -> Vec<Action> {
        match self.taken_ports.count.checked_sub(DEATHS_AT_ONCE + 1) {
            None => vec![Action::Spawn],
            Some(further) => {
                self.timer = Some((now + pause_after(further), Timer::Spawn));
                Vec::new()
            }
        }
    }

    /// Counts the death of a master that another program starts. rosrescue cannot slow down that program's restarts,
    /// but reports a crash loop once.
    fn count_their_death(&mut self, now: Instant) -> Option<Action> {
        let said = self.crash_loop;
        self.count_death(now);
        (self.crash_loop && !said).then_some(Action::ReportCrashLoop(self.deaths.len()))
    }

    fn count_death(&mut self, now: Instant) {
        self.total_deaths += 1;
        self.deaths.push_back(now);
        while self
            .deaths
            .front()
            .is_some_and(|at| now.duration_since(*at) > DEATH_MEMORY)
        {
            self.deaths.pop_front();
        }
        self.crash_loop |= self.deaths.len() > DEATHS_AT_ONCE;
    }

    fn pause_before_spawn(&self) -> Duration {
        let further = self.deaths.len().checked_sub(DEATHS_AT_ONCE + 1);
        further.map_or(Duration::ZERO, pause_after)
    }
}

/// Reports why a master is not killed.
fn spare(verdict: SilenceVerdict) -> Option<Action> {
    match verdict {
        SilenceVerdict::Unproved(why) => Some(Action::Spare(why)),
        SilenceVerdict::Hung | SilenceVerdict::Unknown => None,
    }
}

/// The pause after the first failure and `further` failures.
fn pause_after(further: usize) -> Duration {
    let doublings = u32::try_from(further).unwrap_or(u32::MAX).min(16);
    (FIRST_PAUSE * 2_u32.pow(doublings)).min(LONGEST_PAUSE)
}

/// The pause before the next connection attempt. It is short at first, because a restart may take only milliseconds,
/// and longer later. A refused attempt on the same computer costs some 20 µs. `far` means that connecting itself has
/// waited for an answer.
fn pause_before_connect(waited: Duration, far: bool) -> Duration {
    let pause = match waited.as_millis() {
        0..2_000 => Duration::from_millis(1),
        2_000..30_000 => Duration::from_millis(20),
        _ => Duration::from_millis(200),
    };
    if far {
        pause.max(Duration::from_millis(200))
    } else {
        pause
    }
}

#[cfg(test)]
mod tests;
