//! Carries out what the lifecycle of production decides, as `recovery::Driver` does, with the examination of production.

use std::{
    collections::HashSet,
    pin::Pin,
    sync::Mutex,
    task::{Context, Poll, Waker},
};

use rescue_core::{
    health::port_of,
    lifecycle::{Action, Cause, Input, Probing, Supervision},
    replay::{Inspection, Plan, Token},
};
use ros1_master::xmlrpc::Python;

use super::*;
use crate::{
    ledger::{durability::Mark, owed::Telling},
    recovery::{
        course::{Course, Step},
        examine::{Contact, Examination, ExamineError, Examiner},
    },
};

/// How long a probe may take, in microseconds.
const PROBE_TIMEOUT: u64 = 200_000;
/// How long a master may be silent while it is examined, in microseconds.
const SILENT_MOST: u64 = 3 * PROBE_TIMEOUT;
/// How long each step may take while a late master catches up, in microseconds.
const CATCH_UP_MOST: u64 = 1_000_000;
/// Pause between two questions whether calls of closed connections have ended, in microseconds.
const SETTLE_PAUSE: u64 = 5_000;
const PROBING: Probing = Probing {
    interval: Duration::from_secs(1),
    count: 3,
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
    /// The examination begins.
    Begins(u64),
    /// The master has not answered this question in time.
    Silent(u64, u64),
    /// The examination asks again whether calls of closed connections have ended.
    Settles(u64),
    ProbeAnswered(u64),
    ProbeMissed(u64),
    /// The notifications that a dead master may not have sent are due, and nobody serves.
    OwesInOutage,
    /// The health check after a recovery.
    Checks(Telling),
}

/// What an examination waits for.
enum Question {
    /// That calls of closed connections have ended.
    Settle,
    /// The answer to a call.
    Call(Request),
    /// The answer to an injection.
    Inject(Request),
    /// That the disk has this record.
    Disk(Mark),
}

/// The connection between an examination and the simulated master.
#[derive(Default)]
struct Line {
    now: Option<Instant>,
    /// The ports of nodes that have ended.
    dead: HashSet<String>,
    question: Option<Question>,
    answer: Option<Result<Reply, ExamineError>>,
}

/// The simulated master, for an examination.
struct SimulatedMaster(Arc<Mutex<Line>>);

impl SimulatedMaster {
    async fn ask(&self, question: Question) -> Result<Reply, ExamineError> {
        self.0.lock().unwrap().question = Some(question);
        std::future::poll_fn(|_| match self.0.lock().unwrap().answer.take() {
            Some(answer) => Poll::Ready(answer),
            None => Poll::Pending,
        })
        .await
    }
}

impl Contact for SimulatedMaster {
    async fn settle(&mut self) -> Result<(), ExamineError> {
        self.ask(Question::Settle).await.map(|_| ())
    }

    async fn read_first(&mut self, token: &Token) -> Result<Inspection, ExamineError> {
        let reply = self.call(Inspection::call(token)).await?;
        Ok(Inspection::decode(&reply, token).unwrap())
    }

    async fn read_second(
        &mut self,
        first: Inspection,
        previous: &Master,
    ) -> Result<Master, ExamineError> {
        let second = match first.second_call(previous) {
            Some(call) => Some(self.call(call).await?),
            None => None,
        };
        Ok(first.into_master(second.as_ref(), previous).unwrap())
    }

    async fn call(&mut self, call: Request) -> Result<Reply, ExamineError> {
        self.ask(Question::Call(call)).await
    }

    async fn inject(&mut self, plan: &Plan) -> Result<RawReply, ExamineError> {
        let call = Request::decode(plan.request()).unwrap();
        let reply = self.ask(Question::Inject(call)).await?;
        Ok(raw(&reply))
    }

    async fn wait_for_disk(&mut self, ledger: &Ledger, record: Mark) {
        if ledger.to_await(record).is_some() {
            let question = Question::Disk(record);
            self.ask(question).await.unwrap();
        }
    }

    async fn is_dead(&mut self, port: &str) -> bool {
        self.0.lock().unwrap().dead.contains(port)
    }

    async fn may_be_of_roscore(&mut self, _: i32) -> bool {
        false
    }

    fn python(&self) -> Python {
        Python::default()
    }

    fn now(&self) -> Instant {
        self.0.lock().unwrap().now.unwrap()
    }
}

/// The end of a step.
enum Outcome {
    Examined(Result<Examination, ExamineError>),
    CaughtUp(Result<bool, ExamineError>),
}

/// The recovery's part of the world.
pub(super) struct Recovery {
    pub(super) supervision: Supervision,
    course: Course,
    examiner: Examiner,
    /// The last step that began. An earlier one has been dropped.
    step: u64,
    /// Whether a step without a future is under way.
    is_busy: bool,
    /// The examination that is under way.
    examination: Option<Pin<Box<dyn Future<Output = Outcome>>>>,
    line: Arc<Mutex<Line>>,
    /// Number of the last question of an examination.
    questions: u64,
    /// The record that an examination waits for, with the numbers of its step and question.
    awaits_disk: Option<(Mark, u64, u64)>,
    /// How long the examination waits for an answer, in microseconds.
    silent_most: u64,
    /// Whether the master has just been started by rosrescue, and has not been called yet.
    is_unused: bool,
    /// The master that the connection belongs to.
    connected: Option<u64>,
    /// The last probe, if it is awaited.
    probe: Option<u64>,
    probes: u64,
    /// When calls last ceased to pass to the master.
    outage: Instant,
    /// When the mirror's own notifications are due in an outage.
    owed_told: bool,
}

impl Recovery {
    pub(super) fn new(examiner: Examiner, supervision: Supervision, is_restored: bool) -> Self {
        let mut course = Course::new(supervision, PROBING);
        if is_restored {
            course.continues_session();
        }
        Self {
            supervision,
            course,
            examiner,
            step: 0,
            is_busy: false,
            examination: None,
            line: Arc::default(),
            questions: 0,
            awaits_disk: None,
            silent_most: SILENT_MOST,
            is_unused: false,
            connected: None,
            probe: None,
            probes: 0,
            outage: Instant::now(),
            owed_told: false,
        }
    }

    pub(super) fn set_gate(&self, state: State) {
        self.examiner.ledger.shut_gate(state);
    }

    /// A new connection for an examination.
    fn contact(&mut self) -> SimulatedMaster {
        self.line = Arc::default();
        SimulatedMaster(self.line.clone())
    }

    /// The numbers that the next process must not use again.
    pub(super) fn numbers(&self) -> (u64, u64, u64) {
        (self.step, self.questions, self.probes)
    }

    pub(super) fn go_on_from(&mut self, (step, questions, probes): (u64, u64, u64)) {
        (self.step, self.questions, self.probes) = (step + 1, questions + 1, probes + 1);
    }

    pub(super) fn deadline(&self) -> Option<Instant> {
        self.course.lifecycle().deadline()
    }
}

impl World {
    /// Passes `input` to the recovery and carries out what follows.
    pub(super) fn recover(&mut self, input: Input) {
        self.print(|| format!("recovery: {input:?}"));
        let now = self.instant();
        for step in self.recovery.course.on(now, self.gate(), input) {
            self.print(|| format!("recovery does {step:?}"));
            match step {
                Step::Disconnect => self.disconnect(),
                Step::Shut(gate) => self.shut(gate),
                Step::ExpectEarlier(until) => self.ledger.expect_earlier(until),
                Step::NotifyAll => self.notify_all(),
                Step::ReportDeathWhileInjected => self.injection_breaks(),
                Step::Act(action) => self.carry_out(action),
            }
        }
    }

    pub(super) fn wake_recovery(&mut self) {
        if self.is_down {
            return;
        }
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
                let time = 20 + self.dice.below(100);
                self.begin(time, Event::Connects);
            }
            Action::Examine => {
                let examiner = self.recovery.examiner.clone();
                let is_unused = std::mem::take(&mut self.recovery.is_unused);
                let known = examiner.known(is_unused.then_some(1));
                let mut master = self.recovery.contact();
                self.examine(SILENT_MOST, async move {
                    Outcome::Examined(examiner.examine(&mut master, known).await)
                });
            }
            Action::Probe => {
                self.recovery.probes += 1;
                let probe = self.recovery.probes;
                self.recovery.probe = Some(probe);
                self.then(PROBE_TIMEOUT, Event::ProbeMissed(probe));
                let is_idle = !self.recovery.is_busy && self.recovery.examination.is_none();
                if is_idle && self.master.is_some() {
                    let time = self.awake_in() + 200;
                    self.begin(time, Event::ProbeAnswered);
                }
            }
            Action::ShutGate(cause) => {
                self.recovery.outage = self.instant();
                self.may_go_back |= cause == Cause::Hung;
            }
            Action::StandIn => self.set_gate(State::Late),
            Action::CatchUp => {
                self.recovery.probe = None;
                let examiner = self.recovery.examiner.clone();
                let mut master = self.recovery.contact();
                self.examine(CATCH_UP_MOST, async move {
                    Outcome::CaughtUp(examiner.catch_up(&mut master).await)
                });
            }
            Action::OpenGate => {
                self.ledger.open_gate();
                self.recovery.owed_told = false;
                self.injection_broke = false;
                self.bypassed_before_open = false;
            }
            Action::Spawn => {
                self.start_master();
                self.recovery.is_unused = true;
                self.recover(Input::Spawned);
            }
            Action::Kill => self.dies(),
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

    /// Begins an examination, and drops the step that is under way.
    fn examine(&mut self, silent_most: u64, examination: impl Future<Output = Outcome> + 'static) {
        let time = 20 + self.dice.below(200);
        self.begin(time, Event::Begins);
        let recovery = &mut self.recovery;
        recovery.is_busy = false;
        recovery.silent_most = silent_most;
        recovery.examination = Some(Box::pin(examination));
    }

    /// Lets the examination go on until it waits for the master, and asks the master.
    fn go_on(&mut self) {
        let now = self.instant();
        let left = self.left_apis();
        let dead = left.into_iter().map(port_of).map(str::to_owned).collect();
        let Some(examination) = &mut self.recovery.examination else {
            return;
        };
        {
            let mut line = self.recovery.line.lock().unwrap();
            (line.now, line.dead) = (Some(now), dead);
        }
        let context = &mut Context::from_waker(Waker::noop());
        if let Poll::Ready(outcome) = examination.as_mut().poll(context) {
            self.recovery.examination = None;
            return self.ends(outcome);
        }
        let question = self.recovery.line.lock().unwrap().question.take();
        let step = self.recovery.step;
        match question {
            Some(Question::Settle) => self.settles(step),
            Some(Question::Disk(record)) => {
                self.recovery.questions += 1;
                self.recovery.awaits_disk = Some((record, step, self.recovery.questions));
            }
            Some(Question::Call(call)) => self.ask_master(call, step, 200),
            Some(Question::Inject(call)) => self.ask_master(call, step, self.injection_most),
            None => {}
        }
    }

    /// Asks the master, which gets the call within `time_most` microseconds.
    fn ask_master(&mut self, call: Request, step: u64, time_most: u64) {
        self.recovery.questions += 1;
        let number = self.recovery.questions;
        if let Some(master) = &mut self.master {
            master.running += 1;
            let time = 20 + self.dice.below(time_most);
            let of = Asked::Examination(step, number);
            self.after(time, super::Event::MasterGets(self.life, of, Some(call)));
        }
        self.then(self.recovery.silent_most, Event::Silent(step, number));
    }

    fn settles(&mut self, step: u64) {
        match self
            .master
            .as_ref()
            .is_some_and(|master| master.running > 0)
        {
            true => self.then(SETTLE_PAUSE, Event::Settles(step)),
            false => {
                let nothing = Reply::Value(Value::Bool(true));
                self.answer_examination(step, self.recovery.questions, Ok(nothing));
            }
        }
    }

    /// Lets an examination go on that has waited for the disk.
    pub(super) fn disk_has_written(&mut self) {
        let waits = self.recovery.awaits_disk;
        if let Some((record, step, number)) = waits
            && self.ledger.to_await(record).is_none()
        {
            self.recovery.awaits_disk = None;
            let nothing = Reply::Value(Value::Bool(true));
            self.answer_examination(step, number, Ok(nothing));
        }
    }

    /// Answers the question `number` of an examination, if it still waits for that.
    pub(super) fn answer_examination(
        &mut self,
        step: u64,
        number: u64,
        answer: Result<Reply, ExamineError>,
    ) {
        if (self.recovery.step, self.recovery.questions) == (step, number) {
            self.recovery.questions += 1;
            self.recovery.line.lock().unwrap().answer = Some(answer);
            self.go_on();
        }
    }

    fn ends(&mut self, outcome: Outcome) {
        self.print(|| match &outcome {
            Outcome::Examined(Ok(examination)) => format!("examined: {:?}", examination.outcome),
            Outcome::Examined(Err(error)) => format!("not examined: {error}"),
            Outcome::CaughtUp(result) => format!("caught up: {result:?}"),
        });
        match outcome {
            Outcome::Examined(Ok(examination)) => {
                if !examination.mismatches.is_empty() {
                    let mistake = format!("mismatches: {:?}", examination.mismatches);
                    self.broken.push(mistake);
                }
                let outcome = examination.outcome;
                let news = self.recovery.course.examined(self.instant(), outcome);
                if news.all {
                    let now = self.instant();
                    self.ledger
                        .with_activity(|mirror, activity| activity.notice_all(mirror, now));
                }
                if let Some(telling) = news.telling {
                    let time = self.dice.below(20_000);
                    self.then(time, Event::Checks(telling));
                }
                let new = outcome.is_new();
                self.recover(Input::Examined { new });
            }
            Outcome::Examined(Err(error)) => self.recover(error.as_input()),
            Outcome::CaughtUp(Ok(true)) => {
                self.caught_up += 1;
                self.recover(Input::CaughtUp);
            }
            Outcome::CaughtUp(_) => self.recover(Input::NotCaughtUp),
        }
    }

    fn disconnect(&mut self) {
        let recovery = &mut self.recovery;
        recovery.step += 1;
        (recovery.is_busy, recovery.connected, recovery.probe) = (false, None, None);
        recovery.examination = None;
    }

    fn shut(&mut self, gate: State) {
        self.set_gate(gate);
        if gate == State::StandingIn && !self.recovery.owed_told {
            self.then(OWED_AFTER, Event::OwesInOutage);
        }
    }

    pub(super) fn recovers(&mut self, event: Event) {
        if self.is_down && !matches!(event, Event::Started) {
            return;
        }
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
            Event::Begins(step) if is_step(self, step) => self.go_on(),
            Event::Settles(step) if is_step(self, step) => self.settles(step),
            Event::Silent(step, number) => {
                let limit = Duration::from_micros(self.recovery.silent_most);
                self.answer_examination(step, number, Err(ExamineError::Silent { limit }));
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
            Event::OwesInOutage if self.gate() == State::StandingIn => {
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
                        self.ledger.queue_owed(now, now, Telling::Now);
                    }
                }
            }
            Event::Checks(telling) if self.gate().is_open() => {
                let (now, outage) = (self.instant(), self.recovery.outage);
                self.ledger.queue_owed(now, outage, telling);
            }
            Event::Checks(telling) => self.then(1_000, Event::Checks(telling)),
            _ => {}
        }
    }

    pub(super) fn start_master(&mut self) {
        self.life += 1;
        let listens = self.now + 1_000 + self.dice.below(60_000);
        self.master = Some(Process::new(listens));
    }

    /// As `nodes::notify_after_restart`.
    fn notify_all(&mut self) {
        let now = self.instant();
        self.ledger
            .with_activity(|mirror, activity| activity.notice_all(mirror, now));
        self.ledger.queue_owed(now, now, Telling::Now);
    }
}
