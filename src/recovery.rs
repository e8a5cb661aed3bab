//! Watches the master and restores it after a failure. Carries out what [`rescue_core::lifecycle`] decides.

pub(crate) mod course;
pub(crate) mod examine;
pub(crate) mod live_master;
pub(crate) mod master_process;
pub(crate) mod report_file;
mod reporting;
mod stall_probe;
mod thread_exit;

use std::{
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant},
};

use rescue_core::{
    lifecycle::{Action, Cause, Input, evidence::Sample},
    replay::{KnownMaster, RUN_ID_AFTER},
};
use tokio_util::sync::CancellationToken;
use tracing::Instrument;

use self::{
    course::{Course, Step},
    examine::{Examination, ExamineError, Examiner},
    live_master::Reach,
    master_process::MasterProcess,
    reporting::{LastMessage, Outage},
};
use crate::{
    gate::{self, State},
    ledger::history::Rescues,
    limit::{AlarmLimit, alarm, all_clear, rarely},
    nodes::{self, Nodes},
    process::{self, ProcessError, effort, listeners::PortHolder},
    status::{
        Board,
        report::{AWAY, RecoveryOutcome, STARTED},
    },
    upstream::{
        ConnectError, VerifyError,
        sentinel::Sentinel,
        verify::{self, Verification},
    },
    wait,
    write_queue::WriteQueue,
};

/// Pause between two questions whether a roscore has set its run id. A roscore does so within 0.1 s after its master
/// listens, if it gets enough CPU time.
const RUN_ID_PAUSE: Duration = Duration::from_millis(100);

/// Limits the log lines about the beginning and the end of a crash loop.
static CRASH_LOOP: AlarmLimit = AlarmLimit::new();

/// The result of a step of the recovery, such as connecting to the master or examining it. At most one step runs at a
/// time.
enum Done {
    Connected(Arc<Sentinel>),
    NotConnected(ConnectError),
    /// Another program listens at the port of the master that was just started, with its process id
    /// if known.
    PortTaken(Option<u32>),
    Examined(Arc<Sentinel>, Result<Examined, ExamineError>),
    Probed(Result<(), VerifyError>),
    CaughtUp(Arc<Sentinel>, Result<bool, ExamineError>),
}

/// An examined master.
struct Examined {
    examination: Examination,
    /// HTTP version and Python version of the master, as text.
    speaks: String,
    /// How rosrescue makes sure that calls reach this master.
    verification: Verification,
}

type Work = Pin<Box<dyn Future<Output = Done> + Send>>;
type Ended = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Carries out what the [lifecycle](rescue_core::lifecycle) decides: starts and watches the master, gives it its state, and
/// lets calls pass to it.
pub(crate) struct Driver {
    gate: gate::Rx,
    examiner: Examiner,
    reach: Reach,
    write_queue: WriteQueue,
    nodes: Arc<Nodes>,
    board: Arc<Board>,
    course: Course,
    process: Option<MasterProcess>,
    rescues: Rescues,
    /// Number of the rescue in which the present master was restored. Set until calls pass to that master.
    restored: Option<u64>,
    /// Why the last master could not be started.
    spawn_error: Option<ProcessError>,
    sentinel: Option<Arc<Sentinel>>,
    /// Completes when the [`Sentinel`]'s connection ends, which shows that the master has ended.
    ended: Option<Ended>,
    /// Completes when a thread of the master ends, which is an early sign of its death. Only the first such end of each
    /// master counts.
    thread_ended: Option<Ended>,
    work: Option<Work>,
    probe_deadline: Option<tokio::time::Instant>,
    /// Total delay of timers that fired late because this process had to wait for the processor.
    timers_late: Duration,
    outage: Outage,
    last_message: Option<LastMessage>,
}

impl Driver {
    /// Creates a driver that reaches masters with `reach`, examines them with `examiner`, and starts them with `process`.
    pub(crate) fn new(
        examiner: Examiner,
        reach: Reach,
        write_queue: WriteQueue,
        nodes: Arc<Nodes>,
        board: Arc<Board>,
        process: Option<MasterProcess>,
        rescues: Rescues,
    ) -> Self {
        Self {
            course: Course::new(reach.supervision, reach.probing),
            outage: Outage::begin(Instant::now(), STARTED, examiner.stats),
            gate: examiner.ledger.gate(),
            examiner,
            reach,
            write_queue,
            nodes,
            board,
            process,
            rescues,
            restored: None,
            spawn_error: None,
            sentinel: None,
            ended: None,
            thread_ended: None,
            work: None,
            probe_deadline: None,
            timers_late: Duration::ZERO,
            last_message: None,
        }
    }

    /// Does what [`Self::start`] does, on a computer that gets the master from another computer. `cause` is the reason,
    /// for the report.
    pub(crate) fn take_over(&mut self, cause: &'static str) -> Vec<Step> {
        self.outage.cause = cause;
        self.start(true)
    }

    /// See [`Course::continues_session`].
    pub(crate) fn continues_session(&mut self) {
        self.course.continues_session();
    }

    /// Lets the mirror answer calls if the state is known, and returns the first steps of the recovery. `restored`
    /// says whether the mirror comes from a checkpoint whose session continues.
    pub(crate) fn start(&mut self, restored: bool) -> Vec<Step> {
        let left = self.process.as_ref().is_some_and(MasterProcess::is_orphan);
        let gate = self.gate.state();
        let input = Input::Start { left, restored };
        let mut steps = self.course.on(Instant::now(), gate, input);
        steps.retain(|step| match step {
            Step::Shut(gate) => {
                self.examiner.ledger.shut_gate(*gate);
                false
            }
            _ => true,
        });
        steps
    }

    /// Watches the master until `stop`. Begins with the steps that [`Self::start`] returned.
    ///
    /// # Errors
    ///
    /// If no master can be started.
    pub(crate) async fn run(
        mut self,
        mut steps: Vec<Step>,
        stop: CancellationToken,
    ) -> Result<Option<MasterProcess>, ProcessError> {
        // The first steps follow from no input.
        let mut input = None;
        loop {
            let mut next = None;
            for step in steps {
                let connects = matches!(step, Step::Act(Action::Connect));
                if (input, connects) == (Some(Input::Wake), true) {
                    tracing::trace!(?input, ?step, "recovery");
                } else {
                    tracing::debug!(?input, ?step, "recovery");
                }
                if matches!(step, Step::Act(Action::GiveUp))
                    && let Some(error) = self.spawn_error.take()
                {
                    return Err(error);
                }
                next = self.carry_out(step).await.or(next);
            }
            if matches!(input, Some(Input::SpawnFailed { .. }))
                && let Some(error) = self.spawn_error.take()
            {
                self.log_once(format!("cannot start a master; retrying: {error}"));
            }
            if input == Some(Input::Stop) {
                return Ok(self.process);
            }
            let now = match next {
                Some(input) => input,
                None => self.next_input(&stop).await,
            };
            self.sample_for(now).await;
            let gate = self.gate.state();
            steps = self.course.on(Instant::now(), gate, now);
            let deaths = self.course.lifecycle().deaths();
            self.board.update(|facts| facts.set_deaths(deaths));
            input = Some(now);
        }
    }

    /// Measures what the master's process does, if the lifecycle needs that to decide about `input`: it may have to
    /// tell a hung master from a slow one.
    async fn sample_for(&mut self, input: Input) {
        let process = self.process.as_ref();
        let pid = process.and_then(MasterProcess::pid);
        let lifecycle = self.course.lifecycle();
        if !lifecycle.needs_sample(Instant::now(), input) {
            return;
        }
        let look = move || (pid.and_then(effort::measure), effort::own_wait());
        let (master, own_wait) = crate::task::spawn_blocking(look).await.unwrap_or_default();
        self.course.observe(Sample {
            at: Instant::now(),
            master,
            own_wait: own_wait + self.timers_late,
        });
    }

    async fn next_input(&mut self, stop: &CancellationToken) -> Input {
        loop {
            let wake = self.course.lifecycle().deadline();
            let wake = wake.map(tokio::time::Instant::from_std);
            tokio::select! {
                biased;
                () = stop.cancelled() => return Input::Stop,
                () = wait::for_some(self.ended.as_mut()) => {
                    // A master that was late has served, and the death of one that gets the state has a line of its own.
                    if matches!(self.gate.state(), State::StandingIn | State::Unknown) {
                        let master = self.reach.upstream.address();
                        self.log_waiting(&format!("{master} closes the connection without a reason"), false);
                    }
                    return Input::ConnectionLost;
                }
                () = wait::for_some(self.thread_ended.as_mut()) => {
                    self.thread_ended = None;
                    return Input::ThreadEnded;
                }
                () = exited(&mut self.process) => return Input::Exited,
                done = wait::for_some(self.work.as_mut()) => {
                    self.work = None;
                    if let Some(input) = self.done(done) {
                        return input;
                    }
                }
                () = self.write_queue.batch_lost() => return Input::BatchLost,
                () = self.write_queue.late_answered() => return Input::LateAnswered,
                () = self.write_queue.late() => return Input::Late,
                () = self.write_queue.slow() => return Input::Slow,
                () = wait::sleep_until(self.probe_deadline) => {
                    let late = self.probe_deadline.take().map(|at| at.elapsed());
                    self.timers_late += late.unwrap_or_default();
                    return Input::ProbeMissed;
                }
                () = wait::sleep_until(wake) => return Input::Wake,
            }
        }
    }

    /// Carries out `step`. Returns its result if that is known at once.
    async fn carry_out(&mut self, step: Step) -> Option<Input> {
        match step {
            Step::Disconnect => self.disconnect(),
            Step::Shut(gate) => self.examiner.ledger.shut_gate(gate),
            Step::ExpectEarlier(until) => self.examiner.ledger.expect_earlier(until),
            Step::NotifyAll => nodes::notify_after_restart(&self.nodes),
            Step::ReportDeathWhileInjected => alarm!(
                warn,
                AWAY,
                "the master died while it was given the state; the next one gets it"
            ),
            Step::Act(action) => return self.act(action).await,
        }
        None
    }

    async fn act(&mut self, action: Action) -> Option<Input> {
        match action {
            Action::Connect => {
                // The injection is prepared again if the previous one has gone to a master that died meanwhile.
                let ledger = &self.examiner.ledger;
                let prepared = &self.examiner.prepared;
                prepared.begin(|| live_master::prepare(ledger.clone()));
                let upstream = self.reach.upstream.clone();
                let new = self.process.as_ref().and_then(MasterProcess::new_one);
                self.work = Some(Box::pin(async move {
                    let sentinel = match upstream.connect_sentinel().await {
                        Ok(sentinel) => Arc::new(sentinel),
                        Err(error) => return Done::NotConnected(error),
                    };
                    // This check comes before the first call, because another program at the port must not get the
                    // state.
                    match holder(new).await {
                        PortHolder::Stranger(pid) => Done::PortTaken(pid),
                        PortHolder::Master | PortHolder::Unknown => Done::Connected(sentinel),
                    }
                }));
            }
            Action::Examine => {
                let sentinel = self.sentinel.clone()?;
                let examiner = self.examiner.clone();
                let new = self.process.as_mut().and_then(MasterProcess::take_new);
                let known = examiner.known(new);
                let reach = self.reach.clone();
                let master = reach.upstream.address();
                let span = tracing::debug_span!("recovery", %master, cause = self.outage.cause);
                let examined = async move {
                    let examined = examine(&examiner, &reach, &sentinel, known).await;
                    Done::Examined(sentinel, examined)
                };
                self.work = Some(Box::pin(examined.instrument(span)));
            }
            Action::Probe => {
                // A late probe continues, and its answer counts when it arrives.
                self.probe_deadline = Some(tokio::time::Instant::now() + self.reach.probe_timeout);
                if self.work.is_none() && self.sentinel.is_some() {
                    let (upstream, ledger) =
                        (self.reach.upstream.clone(), self.examiner.ledger.clone());
                    self.work = Some(Box::pin(async move {
                        Done::Probed(verify::probe(&upstream, &ledger.token()).await)
                    }));
                }
            }
            Action::ShutGate(cause) => self.begin_outage(cause),
            Action::StandIn => {
                rarely!(
                    info,
                    "the master is slow to answer; rosrescue answers in its place until the master answers again"
                );
                self.examiner.ledger.shut_gate(State::Late);
            }
            Action::CatchUp => {
                self.probe_deadline = None;
                let sentinel = self.sentinel.clone()?;
                let (examiner, reach) = (self.examiner.clone(), self.reach.clone());
                self.work = Some(Box::pin(async move {
                    let caught_up = async {
                        let mut master = reach.to_catch_up(&sentinel).await?;
                        examiner.catch_up(&mut master).await
                    };
                    let caught_up = caught_up.await;
                    Done::CaughtUp(sentinel, caught_up)
                }));
            }
            Action::Spare(why) => rarely!(
                warn,
                why,
                "the master does not answer, but is not killed: there is no proof that it hangs"
            ),
            Action::OpenGate => self.open_gate(),
            Action::Spawn => return self.spawn().await,
            // The caller handles this action.
            Action::GiveUp => {}
            Action::Kill => {
                if let Some(process) = &mut self.process {
                    process.kill();
                }
            }
            Action::ReportCrashLoop(deaths) => {
                self.board.update(|facts| {
                    facts.crash_loop.get_or_insert_with(Instant::now);
                });
                let last_words = match &self.process {
                    Some(process) => Some(process.last_words().await),
                    None => None,
                };
                match last_words {
                    Some(last_words) => alarm!(
                        error,
                        CRASH_LOOP,
                        last_words,
                        "crash loop: the master has died {deaths} times within a minute; nodes keep running, rosrescue answers in its place and starts new masters after growing pauses. The master's last output and master.log say why it died"
                    ),
                    None => alarm!(
                        error,
                        CRASH_LOOP,
                        "crash loop: the master has died {deaths} times within a minute; nodes keep running, rosrescue answers in its place. The log of the program that starts the master says why it died"
                    ),
                }
            }
            Action::ReportCalm => {
                self.board.update(|facts| {
                    facts.crash_loop = None;
                    facts.calm_since = Some(Instant::now());
                });
                all_clear!(
                    info,
                    CRASH_LOOP,
                    "the crash loop is over: the master keeps running"
                );
            }
        }
        None
    }

    fn done(&mut self, done: Done) -> Option<Input> {
        match done {
            Done::Connected(sentinel) => {
                self.outage.port_open(Instant::now());
                self.watch(sentinel);
                Some(Input::Connected)
            }
            Done::PortTaken(by) => {
                if let Some(process) = &mut self.process {
                    process.port_taken(by);
                }
                Some(Input::PortTaken)
            }
            Done::NotConnected(error) => {
                let may_be_absent = matches!(error, ConnectError::Refused { .. });
                self.log_waiting(&error.to_string(), may_be_absent);
                Some(match error {
                    ConnectError::Refused { .. } => Input::Refused,
                    ConnectError::NoAddress { .. } | ConnectError::Unreachable { .. } => {
                        Input::Unreachable
                    }
                })
            }
            // The data that was read and written may belong to two different masters.
            Done::Examined(sentinel, Ok(_)) if !sentinel.is_open() => Some(Input::ConnectionLost),
            Done::Examined(sentinel, Ok(examined)) => {
                let Examined {
                    examination,
                    speaks,
                    verification,
                } = examined;
                let outcome = examination.outcome;
                if outcome != RecoveryOutcome::Resumed {
                    self.thread_ended = thread_of(&sentinel, examination.pid);
                }
                self.reach.upstream.set_verification(Some(verification));
                self.report(examination, speaks);
                Some(Input::Examined {
                    new: outcome.is_new(),
                })
            }
            Done::Examined(_, Err(error)) => {
                let master = self.reach.upstream.address();
                let input = error.as_input();
                if input == Input::NotAMaster {
                    self.log_once(format!(
                        "what answers at {master} is not a ROS master: {error}. Correct --master"
                    ));
                } else {
                    self.log_once(format!(
                        "could not read or restore the master at {master}; retrying: {error}"
                    ));
                }
                Some(input)
            }
            Done::CaughtUp(sentinel, Ok(true)) if sentinel.is_open() => Some(Input::CaughtUp),
            Done::CaughtUp(_, result) => {
                tracing::debug!(?result, "the master must be examined");
                Some(Input::NotCaughtUp)
            }
            // Another incarnation answers, although the connection to the previous one is still
            // open.
            Done::Probed(Err(VerifyError::OtherIncarnation)) => Some(Input::ConnectionLost),
            // There was no answer. If the master has just died, the older connection will end and show that.
            Done::Probed(Err(_)) => None,
            Done::Probed(Ok(())) => {
                self.probe_deadline = None;
                Some(Input::ProbeAnswered)
            }
        }
    }

    /// Keeps `sentinel` to notice the master's end.
    fn watch(&mut self, sentinel: Arc<Sentinel>) {
        let (upstream, renewal) = (self.reach.upstream.clone(), self.reach.renewal);
        self.ended = Some(Box::pin(sentinel.clone().watch(upstream, renewal)));
        self.sentinel = Some(sentinel);
    }

    fn disconnect(&mut self) {
        self.reach.upstream.set_verification(None);
        self.sentinel = None;
        self.ended = None;
        self.work = None;
        self.probe_deadline = None;
    }

    /// Notes that calls have ceased to pass to the master, and reports it.
    fn begin_outage(&mut self, cause: Cause) {
        self.outage = Outage::begin(Instant::now(), cause.as_str(), self.examiner.stats);
        if cause == Cause::Stopping {
            return;
        }
        let starts = matches!(cause, Cause::Exited | Cause::ThreadEnded) && self.process.is_some();
        self.board.update(|facts| facts.starts_master = starts);
        let cause = cause.as_str();
        match self.process {
            Some(_) if !starts => alarm!(
                warn,
                AWAY,
                cause,
                "the master is away: nodes keep running, rosrescue answers in its place"
            ),
            Some(_) => alarm!(
                warn,
                AWAY,
                cause,
                "the master is away: nodes keep running, rosrescue answers in its place and starts a new one"
            ),
            None => alarm!(
                warn,
                AWAY,
                cause,
                "the master is away: nodes keep running, rosrescue answers in its place. Start the master if nothing else does"
            ),
        }
        // The prepared injection is out of date.
        self.examiner.prepared.forget();
    }

    fn open_gate(&mut self) {
        self.last_message = None;
        self.examiner.prepared.forget();
        self.examiner.ledger.open_gate();
        self.set_run_id_later();
        if let Some(number) = self.restored.take() {
            self.rescues.keep_rescue(number, Instant::now());
        }
    }

    /// Sets the run id that the present master has not been given, as soon as a roscore has set its own, or after
    /// [`RUN_ID_AFTER`].
    fn set_run_id_later(&self) {
        if self.examiner.lock_run_id().is_none() {
            return;
        }
        let (examiner, reach) = (self.examiner.clone(), self.reach.clone());
        let write_queue = self.write_queue.clone();
        let incarnation = examiner.ledger.incarnation();
        crate::task::spawn(async move {
            let until = Instant::now() + RUN_ID_AFTER;
            while Instant::now() < until && !reach.has_run_id().await {
                tokio::time::sleep(RUN_ID_PAUSE).await;
            }
            // The next master gets the run id in the same way.
            if examiner.ledger.incarnation() == incarnation
                && let Some(set) = examiner.take_run_id()
            {
                write_queue.call(set).await;
            }
        });
    }

    async fn spawn(&mut self) -> Option<Input> {
        self.board.update(|facts| facts.starts_master = true);
        let (ledger, upstream) = (&self.examiner.ledger, &self.reach.upstream);
        match self.process.as_mut()?.spawn(ledger, upstream).await {
            Ok(()) => Some(Input::Spawned),
            Err(error) => {
                let pending = ledger.pending() > 0;
                self.spawn_error = Some(error);
                Some(Input::SpawnFailed { pending })
            }
        }
    }
}

/// Examines the master that `sentinel` is connected to.
async fn examine(
    examiner: &Examiner,
    reach: &Reach,
    sentinel: &Arc<Sentinel>,
    known: KnownMaster,
) -> Result<Examined, ExamineError> {
    let mut master = reach.to_examine(sentinel).await?;
    let examination = examiner.examine(&mut master, known).await?;
    Ok(Examined {
        speaks: master.speaks(),
        verification: master.verification(examination.pid).await,
        examination,
    })
}

/// Completes when a thread of the master `pid` ends. `None` if the master runs on another computer. Never completes if
/// the kernel cannot watch threads.
fn thread_of(sentinel: &Sentinel, pid: i32) -> Option<Ended> {
    let id = u32::try_from(pid).ok().filter(|_| sentinel.is_local())?;
    Some(Box::pin(async move {
        // The check blocks, because reading the command line needs the lock of the master's memory.
        let watched = crate::task::spawn_blocking(move || process::runs(id, "rosmaster")).await;
        if let (Ok(true), Ok(ended)) = (watched, thread_exit::watch(pid)) {
            ended.await;
        } else {
            std::future::pending().await
        }
    }))
}

/// Finds the process that listens at the port of a new master. Does not block the runtime.
async fn holder(new: Option<(u32, u16, bool)>) -> PortHolder {
    let Some((pid, port, own)) = new else {
        return PortHolder::Unknown;
    };
    let look = crate::task::spawn_blocking(move || PortHolder::find(pid, port, own));
    look.await.unwrap_or(PortHolder::Unknown)
}

async fn exited(process: &mut Option<MasterProcess>) {
    match process {
        Some(process) => process.exited().await,
        None => std::future::pending().await,
    }
}
