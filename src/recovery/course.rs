//! Decides what a recovery does around the [lifecycle](rescue_core::lifecycle): when the connection to a master is given
//! up, what the gate shows while no calls pass, and when nodes get what an earlier process may have owed them.
//!
//! Production ([`Driver`](super::Driver)) and the simulation of the write queue carry out the steps.

use std::time::{Duration, Instant};

use rescue_core::lifecycle::{
    Action, Cause, Input, Lifecycle, Probing, Supervision, evidence::Sample,
};

use crate::{
    gate::State,
    ledger::owed::{BACKLOG, Telling},
    status::report::RecoveryOutcome,
};

/// How long after a living master was found the nodes may wait for what an earlier process owed them. The health check
/// sends it after [`BACKLOG`], and needs some time itself.
const NEWS_WITHIN: Duration = BACKLOG.saturating_mul(2);

/// The notifications that an earlier rosrescue of this session may have owed to nodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum News {
    Owed,
    /// A living master has been found, and the health check sends them before this time. If that master is lost before,
    /// they are still owed.
    Expected(Instant),
    /// Sent by this rosrescue before any master.
    SentFirst,
    /// There were none, or a master has been found since.
    Sent,
}

/// What the recovery does next.
#[derive(Debug)]
pub(crate) enum Step {
    /// Drop the connection to the master, and what is under way on it.
    Disconnect,
    /// Set the gate, which ends an injection that is in progress.
    Shut(State),
    /// Expect notifications of an earlier process until this time.
    ExpectEarlier(Instant),
    /// Notify all nodes of the present state, because no master is sending them an older one.
    NotifyAll,
    /// Report that a master died after the gate was shut for its injection, and before it opened.
    ReportDeathWhileInjected,
    /// Carry out this action of the lifecycle. [`Action::StandIn`] and [`Action::OpenGate`] set the gate, too.
    Act(Action),
}

/// What nodes are told after a master was examined.
#[derive(Debug)]
pub(crate) struct NewsAfter {
    /// Whether all that the mirror knows counts as just changed: after a restart of rosrescue, the latest changes before
    /// the outage are unknown.
    pub all: bool,
    /// Whether and how often the health check sends what may be owed.
    pub telling: Option<Telling>,
}

/// The course of a recovery; see the [module](self).
#[derive(Debug)]
pub(crate) struct Course {
    lifecycle: Lifecycle,
    news: News,
    /// Whether a living master was killed since the last one was examined. Until then it may have sent old notifications.
    has_killed: bool,
}

impl Course {
    pub(crate) fn new(supervision: Supervision, probing: Probing) -> Self {
        Self {
            lifecycle: Lifecycle::new(supervision, probing),
            news: News::Sent,
            has_killed: false,
        }
    }

    pub(crate) fn lifecycle(&self) -> &Lifecycle {
        &self.lifecycle
    }

    /// Notes what the master's process does; see [`Lifecycle::observe`].
    pub(crate) fn observe(&mut self, sample: Sample) {
        self.lifecycle.observe(sample);
    }

    /// Notes that an earlier rosrescue of this session has ended. If there is no master, the nodes get the notifications
    /// that it may have owed them. Otherwise the health check after the recovery sends these.
    pub(crate) fn continues_session(&mut self) {
        self.news = News::Owed;
    }

    /// Handles `input`, while the gate is in the state `gate`. Returns the steps to carry out, in order.
    pub(crate) fn on(&mut self, now: Instant, gate: State, input: Input) -> Vec<Step> {
        let mut steps = Steps {
            gate,
            steps: Vec::new(),
        };
        if matches!(input, Input::Refused | Input::Unreachable) {
            self.send_news(now, &mut steps);
        }
        if ends_contact(input) {
            if gate.is_injecting() && input != Input::NotAMaster {
                steps.add(Step::ReportDeathWhileInjected);
                // It had answered before.
                self.lifecycle.on(now, Input::Answered);
            }
            self.disconnect(&mut steps);
        }
        let actions = self.lifecycle.on(now, input);
        if matches!(input, Input::Start { .. }) {
            self.shut(&mut steps);
            if self.news == News::Owed {
                steps.add(Step::ExpectEarlier(now + BACKLOG));
            }
        }
        for action in actions {
            match action {
                Action::Connect => self.disconnect(&mut steps),
                Action::Kill => {
                    self.has_killed = true;
                    self.disconnect(&mut steps);
                }
                Action::Spawn => self.send_news(now, &mut steps),
                Action::ShutGate(_) => self.shut(&mut steps),
                Action::StandIn => steps.gate = State::Late,
                _ => {}
            }
            steps.add(Step::Act(action));
            if action == Action::ShutGate(Cause::Hung) {
                self.disconnect(&mut steps);
            }
        }
        steps.steps
    }

    /// Notes that a master was examined at `now` with this `outcome`. Returns what nodes are told.
    pub(crate) fn examined(&mut self, now: Instant, outcome: RecoveryOutcome) -> NewsAfter {
        let news = self.news;
        self.news = match (news, outcome) {
            (News::Owed, RecoveryOutcome::Adopted) => News::Expected(now + NEWS_WITHIN),
            _ => News::Sent,
        };
        let has_killed = std::mem::take(&mut self.has_killed);
        let sent = news == News::SentFirst && outcome == RecoveryOutcome::Injected;
        NewsAfter {
            all: !self.lifecycle.has_served() && !sent,
            telling: Telling::after(outcome, news == News::Owed || has_killed),
        }
    }

    fn send_news(&mut self, now: Instant, steps: &mut Steps) {
        let is_owed = match self.news {
            News::Owed => true,
            News::Expected(by) => now < by,
            News::SentFirst | News::Sent => false,
        };
        if is_owed {
            self.news = News::SentFirst;
            steps.add(Step::NotifyAll);
        }
    }

    fn disconnect(&self, steps: &mut Steps) {
        // An injection in progress has failed.
        if !steps.gate.is_open() {
            self.shut(steps);
        }
        steps.add(Step::Disconnect);
    }

    /// Lets no calls pass to the master. The mirror answers them if the state is known; otherwise they wait.
    fn shut(&self, steps: &mut Steps) {
        steps.add(Step::Shut(match self.lifecycle.may_stand_in() {
            true => State::StandingIn,
            false => State::Unknown,
        }));
    }
}

/// The steps so far, and the gate after them.
struct Steps {
    gate: State,
    steps: Vec<Step>,
}

impl Steps {
    fn add(&mut self, step: Step) {
        if let Step::Shut(gate) = step {
            self.gate = gate;
        }
        self.steps.push(step);
    }
}

/// Whether `input` says that the master has ended or cannot be used.
fn ends_contact(input: Input) -> bool {
    matches!(
        input,
        Input::ConnectionLost
            | Input::Exited
            | Input::Unreachable
            | Input::NotAMaster
            | Input::PortTaken
    )
}
