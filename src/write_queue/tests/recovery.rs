//! Carries out what the lifecycle of production decides, as `recovery::Driver` and `recovery::examine` do.

use rescue_core::{
    lifecycle::{Action, Cause, Input, Lifecycle, Probing, Supervision},
    replay::{self, Bears, KnownMaster, Treatment},
};

use super::*;
use crate::ledger::{Basis, late::CatchUp, owed::Telling};

/// How long a probe may take, in microseconds.
const PROBE_TIMEOUT: u64 = 200_000;
/// How long a master may be silent while it is examined, in microseconds.
const SILENT_MOST: u64 = 3 * PROBE_TIMEOUT;
const PROBING: Probing = Probing {
    interval: Duration::from_secs(1),
    count: 3,
    patience: Duration::from_micros(PATIENCE),
    start_limit: Duration::from_secs(10),
};

/// Something that happens to the recovery. A step counts only if it is the last one that began.
#[derive(Clone, Copy, Debug)]
pub(super) enum Event {
    /// The connection to the master with this number has ended.
    ConnectionEnds(u64),
    /// The process of the master with this number has ended.
    Exits(u64),
    /// Another program has started a master.
    Started,
    /// A connection attempt has ended.
    Connects(u64),
    /// The master has been read.
    Inspects(u64),
    /// The master has got its state.
    Injects(u64),
    /// The master has been silent for too long while it was examined.
    Silent(u64),
    /// The late master has got the writes that it missed.
    CatchesUp(u64),
    ProbeAnswered(u64),
    ProbeMissed(u64),
    /// The notifications that a dead master may not have sent are due, and nobody serves.
    OwesInOutage,
    /// The health check after a recovery.
    Checks,
}

/// The recovery's part of the world.
pub(super) struct Recovery {
    pub(super) supervision: Supervision,
    lifecycle: Lifecycle,
    /// The last step that began. An earlier one has been dropped.
    step: u64,
    /// Whether the step is under way.
    is_busy: bool,
    /// The master that the connection belongs to.
    connected: Option<u64>,
    /// The last probe, if it is awaited.
    probe: Option<u64>,
    probes: u64,
    /// The state that the master gets at the end of the injection, unless it keeps its own.
    target: Option<Master>,
    writes: Vec<Request>,
    is_new: bool,
    /// When the mirror's own notifications are due in an outage.
    owed_told: bool,
}

impl Recovery {
    pub(super) fn new(supervision: Supervision) -> Self {
        Self {
            supervision,
            lifecycle: Lifecycle::new(supervision, PROBING),
            step: 0,
            is_busy: false,
            connected: None,
            probe: None,
            probes: 0,
            target: None,
            writes: Vec::new(),
            is_new: false,
            owed_told: false,
        }
    }

    pub(super) fn deadline(&self) -> Option<Instant> {
        self.lifecycle.deadline()
    }
}

impl World {
    /// Passes `input` to the lifecycle and carries out what follows.
    pub(super) fn recover(&mut self, input: Input) {
        self.print(|| format!("recovery: {input:?}"));
        if matches!(
            input,
            Input::ConnectionLost | Input::Exited | Input::Unreachable
        ) {
            if self.gate == State::Injecting {
                let now = self.instant();
                self.recovery.lifecycle.on(now, Input::Answered);
            }
            self.disconnect();
        }
        let now = self.instant();
        let actions = self.recovery.lifecycle.on(now, input);
        if matches!(input, Input::Start { .. }) {
            self.keep_shut();
        }
        if input == Input::LateAnswered {
            let patience = self.recovery.lifecycle.patience().clone();
            self.dispatch(super::Input::Patience(patience));
        }
        for action in actions {
            self.print(|| format!("recovery does {action:?}"));
            self.carry_out(action);
        }
    }

    pub(super) fn wake_recovery(&mut self) {
        if self
            .recovery
            .deadline()
            .is_some_and(|at| at <= self.instant())
        {
            self.recover(Input::Wake);
        }
    }

    fn carry_out(&mut self, action: Action) {
        match action {
            Action::Connect => {
                self.disconnect();
                let time = 20 + self.dice.below(100);
                self.begin(time, Event::Connects);
            }
            Action::Examine => {
                let time = 300 + self.dice.below(3_000);
                self.begin(time, Event::Inspects);
            }
            Action::Probe => {
                self.recovery.probes += 1;
                let probe = self.recovery.probes;
                self.recovery.probe = Some(probe);
                self.then(PROBE_TIMEOUT, Event::ProbeMissed(probe));
                if !self.recovery.is_busy && self.master.is_some() {
                    let time = self.awake_in() + 200;
                    self.begin(time, Event::ProbeAnswered);
                }
            }
            Action::ShutGate(cause) => {
                self.keep_shut();
                if cause == Cause::Hung {
                    self.disconnect();
                    self.may_go_back = true;
                }
            }
            Action::StandIn => self.set_gate(State::Late),
            Action::CatchUp => {
                self.recovery.probe = None;
                self.set_gate(State::Injecting);
                let now = self.instant();
                match self.ledger.begin_catch_up(now) {
                    None => return self.recover(Input::NotCaughtUp),
                    Some(CatchUp::Nothing) => return self.recover(Input::CaughtUp),
                    Some(CatchUp::Run(missed)) => {
                        let held = self.master.as_ref().map(|master| &master.state);
                        if held.is_some_and(|held| *held != missed.behind) {
                            self.broken
                                .push("a late master is not where it should be".to_owned());
                        }
                        self.recovery.writes = missed.writes;
                    }
                }
                let time = self.awake_in() + 300 + self.dice.below(1_000);
                self.begin(time, Event::CatchesUp);
            }
            Action::OpenGate => {
                let incarnation = self.ledger.serve();
                self.recovery.owed_told = false;
                self.set_gate(State::Open { incarnation });
            }
            Action::Spawn => {
                self.start_master();
                self.recover(Input::Spawned);
            }
            Action::Kill => {
                self.disconnect();
                self.dies();
            }
            Action::Spare(_) | Action::GiveUp | Action::ReportCrashLoop(_) | Action::ReportCalm => {
            }
        }
    }

    /// How long the master still does nothing.
    fn awake_in(&self) -> u64 {
        let stopped = self.master.as_ref().map_or(0, |master| master.stopped);
        stopped.saturating_sub(self.now)
    }

    /// Begins a step, and drops the one that is under way.
    fn begin(&mut self, time: u64, event: impl FnOnce(u64) -> Event) {
        self.recovery.step += 1;
        self.recovery.is_busy = true;
        self.then(time, event(self.recovery.step));
    }

    fn then(&mut self, time: u64, event: Event) {
        self.after(time, super::Event::Recovery(event));
    }

    fn disconnect(&mut self) {
        if !self.gate.is_open() {
            self.keep_shut();
        }
        let recovery = &mut self.recovery;
        recovery.step += 1;
        (recovery.is_busy, recovery.connected, recovery.probe) = (false, None, None);
    }

    fn keep_shut(&mut self) {
        self.ledger.end_injection();
        self.set_gate(match self.recovery.lifecycle.may_stand_in() {
            true => State::StandingIn,
            false => State::Unknown,
        });
        if self.gate == State::StandingIn && !self.recovery.owed_told {
            self.then(OWED_AFTER, Event::OwesInOutage);
        }
    }

    pub(super) fn recovers(&mut self, event: Event) {
        let is_step = |world: &Self, step| world.recovery.step == step;
        match event {
            Event::ConnectionEnds(life) if self.recovery.connected == Some(life) => {
                self.recover(Input::ConnectionLost);
            }
            Event::Exits(life) if self.life == life && self.master.is_none() => {
                self.recover(Input::Exited);
            }
            Event::Started => self.start_master(),
            Event::Connects(step) if is_step(self, step) => {
                self.recovery.is_busy = false;
                let master = self.master.as_ref();
                if master.is_some_and(|master| master.listens <= self.now) {
                    self.recovery.connected = Some(self.life);
                    self.recover(Input::Connected);
                } else {
                    self.recover(Input::Refused);
                }
            }
            Event::Inspects(step) if is_step(self, step) => self.inspects(),
            Event::Injects(step) if is_step(self, step) && self.master.is_some() => {
                self.injects();
            }
            Event::Silent(step) if is_step(self, step) => {
                self.recovery.is_busy = false;
                self.recover(Input::Unreachable);
            }
            Event::CatchesUp(step) if is_step(self, step) && self.master.is_some() => {
                self.recovery.is_busy = false;
                for write in std::mem::take(&mut self.recovery.writes) {
                    self.run(&write);
                }
                self.ledger.delivered();
                let master = self.master.as_mut().unwrap();
                master.incarnation = Some(self.ledger.incarnation());
                self.caught_up += 1;
                self.recover(Input::CaughtUp);
            }
            Event::ProbeAnswered(step) if is_step(self, step) && self.master.is_some() => {
                self.recovery.is_busy = false;
                if self.awake_in() > 0 {
                    let time = self.awake_in() + 200;
                    return self.begin(time, Event::ProbeAnswered);
                }
                self.recovery.probe = None;
                self.recover(Input::ProbeAnswered);
            }
            Event::ProbeMissed(probe) if self.recovery.probe == Some(probe) => {
                self.recovery.probe = None;
                self.recover(Input::ProbeMissed);
            }
            Event::OwesInOutage if self.gate == State::StandingIn => {
                let now = self.instant();
                let again = self.ledger.with_order(|order, _| order.master_is_away(now));
                match again {
                    Some(at) => {
                        let wait = at.duration_since(now).as_micros();
                        let wait = u64::try_from(wait).unwrap() + 1;
                        self.then(wait, Event::OwesInOutage);
                    }
                    None => {
                        self.recovery.owed_told = true;
                        self.queue_owed(Telling::Now);
                    }
                }
            }
            Event::Checks if self.gate.is_open() => {
                let telling = match self.recovery.is_new {
                    true => Telling::Now,
                    false => {
                        self.ledger
                            .with_activity(|_, activity| activity.tell_again());
                        Telling::Twice
                    }
                };
                self.queue_owed(telling);
            }
            Event::Checks => self.then(1_000, Event::Checks),
            _ => {}
        }
    }

    /// The master has been read, and gets the mirror's state if it does not hold it.
    fn inspects(&mut self) {
        self.recovery.is_busy = false;
        let wait = self.awake_in();
        let Some(master) = &self.master else { return };
        let bears = match master.incarnation {
            None => Bears::Nothing,
            Some(number) if number == self.ledger.incarnation() => Bears::Present,
            Some(number) if number < self.ledger.incarnation() => Bears::Earlier,
            Some(number) => Bears::Later(number),
        };
        let (found, running) = (master.state.clone(), master.running);
        let known = match (self.ledger.has_served_present(), bears) {
            (_, Bears::Nothing) => KnownMaster::New { pid: 1 },
            (None, _) => KnownMaster::Nothing,
            (Some(true), _) => KnownMaster::ServedIfPresent,
            (Some(false), _) => KnownMaster::InjectedIfPresent,
        };
        if wait > 0 {
            return self.wait_silently(wait, Event::Inspects);
        }
        let serves = known == KnownMaster::ServedIfPresent && bears == Bears::Present;
        if serves && self.ledger.resume() {
            self.ledger.doubt();
            return self.is_examined(false);
        }
        if running > 0 {
            // Calls of closed connections still run.
            return self.begin(5_000, Event::Inspects);
        }
        self.ledger.settled();
        self.set_gate(State::Injecting);
        if let Bears::Later(number) = bears {
            self.ledger.catch_up(number);
        }
        let Basis {
            mirror, pending, ..
        } = self.ledger.begin_injection();
        let treatment = replay::treatment(bears, known, mirror.is_empty(), found.is_empty());
        let (state, replaces) = match treatment {
            Treatment::Reconcile(authority) => {
                let state = replay::reconcile(&mirror, &found, &pending, authority);
                let replaces = state != found;
                if !replaces && pending.is_empty() {
                    self.ledger.delivered();
                    self.ledger.adopt(found);
                    return self.is_examined(false);
                }
                (state, replaces)
            }
            _ => (mirror.clone(), true),
        };
        if state != mirror {
            self.ledger.adopt(state.clone());
        }
        if bears == Bears::Nothing {
            self.ledger.with_order(|order, _| order.master_is_gone());
        }
        self.ledger.succeed();
        self.recovery.is_new = bears == Bears::Nothing;
        self.recovery.target = replaces.then_some(state);
        let time = 300 + self.dice.below(5_000);
        self.begin(time, Event::Injects);
    }

    fn injects(&mut self) {
        let wait = self.awake_in();
        if wait > 0 {
            return self.wait_silently(wait, Event::Injects);
        }
        self.recovery.is_busy = false;
        let incarnation = self.ledger.incarnation();
        let master = self.master.as_mut().unwrap();
        if let Some(state) = self.recovery.target.take() {
            master.state = state;
        }
        master.incarnation = Some(incarnation);
        self.ledger.delivered();
        self.is_examined(self.recovery.is_new);
    }

    /// Waits for a master that does nothing for `time`, or gives up.
    fn wait_silently(&mut self, time: u64, then: impl FnOnce(u64) -> Event) {
        match time < SILENT_MOST {
            true => self.begin(time + 100, then),
            false => self.begin(SILENT_MOST, Event::Silent),
        }
    }

    pub(super) fn start_master(&mut self) {
        self.life += 1;
        let listens = self.now + 1_000 + self.dice.below(60_000);
        self.master = Some(Process::new(listens));
    }

    fn is_examined(&mut self, new: bool) {
        self.recovery.is_new = new;
        self.recover(Input::Examined { new });
        let time = self.dice.below(20_000);
        self.then(time, Event::Checks);
    }

    /// Queues owed notifications, as `nodes::notify_owed` does.
    fn queue_owed(&mut self, telling: Telling) {
        let now = self.instant();
        self.ledger.queue_owed(now, now, telling);
    }
}
