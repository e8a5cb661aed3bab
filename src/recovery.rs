//! Watches the master and brings it back: the shell around [`crate::lifecycle`].

pub mod examine;
pub mod master_process;
mod reporting;
mod stall_probe;
mod thread_exit;

use std::{
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Instant,
};

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use self::{
    examine::{Examination, ExamineError, Known, Prepared},
    master_process::MasterProcess,
};
use crate::status::report::{Outage, Outcome};
use crate::{
    gate::{State, Tx},
    lifecycle::{Action, Cause, Input, Lifecycle, Supervision},
    process::{self, ProcessError},
    proxy::Proxy,
    upstream::{
        ConnectError, Connection,
        pool::{VerifyError, connect_verified},
    },
    wait,
};

/// What a step under way ends in. Steps exclude one another.
enum Done {
    Connected(Connection),
    NotConnected(ConnectError),
    Examined(Connection, Result<Examination, ExamineError>),
    Probed(Result<Connection, VerifyError>),
}

type Step = Pin<Box<dyn Future<Output = Done> + Send>>;
type Ended = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Carries out what the lifecycle decides.
pub struct Driver {
    proxy: Arc<Proxy>,
    gate: Tx,
    lifecycle: Lifecycle,
    process: Option<MasterProcess>,
    connection: Option<Connection>,
    /// Resolves when the connection to the master ends.
    ended: Option<Ended>,
    /// Resolves when a thread of the master ends; told once of each master.
    thread_ended: Option<Ended>,
    step: Option<Step>,
    probe_deadline: Option<tokio::time::Instant>,
    prepared: Option<JoinHandle<Prepared>>,
    /// Whether the master is being brought to the mirror's state.
    injecting: Arc<AtomicBool>,
    outage: Outage,
    /// The incarnation that was served last.
    served: Option<u64>,
    /// The mirror is known to be a master's state, so that it may stand in.
    known: bool,
    /// The mirror comes from a checkpoint whose session goes on.
    restored: bool,
    said: Option<(String, Instant)>,
}

impl Driver {
    /// A driver for `proxy` and its gate. With `process` it starts masters itself. `restored`: the
    /// mirror comes from a checkpoint whose session goes on.
    pub fn new(
        proxy: Arc<Proxy>,
        gate: Tx,
        process: Option<MasterProcess>,
        restored: bool,
    ) -> Self {
        let supervision = match process {
            Some(_) => Supervision::Ours,
            None => Supervision::Theirs,
        };
        // A master of ours begins with nothing but what we give it; what an earlier one holds must be
        // seen.
        let begins = process.as_ref().is_some_and(|process| !process.is_left());
        Self {
            lifecycle: Lifecycle::new(supervision, proxy.config.probing),
            proxy,
            gate,
            process,
            connection: None,
            ended: None,
            thread_ended: None,
            step: None,
            probe_deadline: None,
            prepared: None,
            injecting: Arc::default(),
            outage: Outage::begin(Instant::now(), "start"),
            served: None,
            known: restored || begins,
            restored,
            said: None,
        }
    }

    /// Watches the master until `stop`. An error: no master can be started at all.
    pub async fn run(
        mut self,
        stop: CancellationToken,
    ) -> Result<Option<MasterProcess>, ProcessError> {
        if self.known {
            self.keep_shut();
        }
        let left = self.process.as_ref().is_some_and(MasterProcess::is_left);
        let mut input = Input::Start { left };
        loop {
            self.note_death(input);
            let actions = self.lifecycle.on(Instant::now(), input);
            self.proxy.board.set_deaths(self.lifecycle.deaths());
            for action in actions {
                tracing::debug!(?input, ?action, "lifecycle");
                self.carry_out(action)?;
            }
            if input == Input::Stop {
                return Ok(self.process);
            }
            input = match self.process.as_mut().and_then(MasterProcess::take_news) {
                Some(news) => news,
                None => self.next_input(&stop).await,
            };
        }
    }

    /// A master that dies while it is brought to the state had answered before.
    fn note_death(&mut self, input: Input) {
        let died = matches!(
            input,
            Input::ConnectionLost | Input::Exited | Input::Unreachable
        );
        if died && self.injecting.swap(false, Ordering::Relaxed) {
            tracing::warn!("the master died while it was brought to the mirror's state");
            self.lifecycle.answered();
        }
    }

    async fn next_input(&mut self, stop: &CancellationToken) -> Input {
        loop {
            let wake = self
                .lifecycle
                .deadline()
                .map(tokio::time::Instant::from_std);
            tokio::select! {
                biased;
                () = stop.cancelled() => return Input::Stop,
                () = wait::for_some(self.ended.as_mut()) => {
                    if !matches!(self.gate.state(), State::Open { .. }) {
                        let master = self.proxy.upstream.address();
                        self.say_waiting(&format!("{master} closes the connection unasked"));
                    }
                    self.disconnect();
                    return Input::ConnectionLost;
                }
                () = wait::for_some(self.thread_ended.as_mut()) => {
                    self.thread_ended = None;
                    return Input::ThreadEnded;
                }
                () = exited(&mut self.process) => {
                    self.disconnect();
                    return Input::Exited;
                }
                done = wait::for_some(self.step.as_mut()) => {
                    self.step = None;
                    if let Some(input) = self.done(done) {
                        return input;
                    }
                }
                () = self.proxy.write_queue.lost() => return Input::BatchLost,
                () = self.proxy.slow.notified() => return Input::Slow,
                () = wait::until(self.probe_deadline) => {
                    self.probe_deadline = None;
                    return Input::ProbeMissed;
                }
                () = wait::until(wake) => return Input::Wake,
            }
        }
    }

    fn carry_out(&mut self, action: Action) -> Result<(), ProcessError> {
        match action {
            Action::Connect => {
                self.disconnect();
                // Whatever comes of it: the one before may have gone to a master that died then.
                let proxy = &self.proxy;
                self.prepared.get_or_insert_with(|| examine::prepare(proxy));
                let proxy = self.proxy.clone();
                self.step = Some(Box::pin(async move {
                    match proxy.upstream.connect().await {
                        Ok(connection) => Done::Connected(connection),
                        Err(error) => Done::NotConnected(error),
                    }
                }));
            }
            Action::Examine => {
                let Some(mut connection) = self.connection.take() else {
                    return Ok(());
                };
                let (proxy, gate) = (self.proxy.clone(), self.gate.clone());
                let new = self.process.as_mut().and_then(MasterProcess::take_new);
                let incarnation = self.proxy.ledger.incarnation();
                let manner = examine::Manner {
                    known: match (self.served, new) {
                        (None, _) => Known::Nothing,
                        (_, Some(pid)) => Known::New { pid },
                        (served, None) if served == Some(incarnation) => Known::ServedIfPresent,
                        _ => Known::InjectedIfPresent,
                    },
                    prepared: self.prepared.take(),
                    injecting: self.injecting.clone(),
                };
                self.step = Some(Box::pin(async move {
                    let examined = examine::examine(&proxy, &gate, &mut connection, manner);
                    let examined = examined.await;
                    Done::Examined(connection, examined)
                }));
            }
            Action::Probe => {
                // A probe that was missed goes on: its answer counts whenever it comes.
                self.probe_deadline =
                    Some(tokio::time::Instant::now() + self.proxy.config.probe_timeout);
                if self.step.is_none() {
                    let proxy = self.proxy.clone();
                    self.step = Some(Box::pin(async move {
                        let fresh = connect_verified(&proxy.upstream, &proxy.ledger.token()).await;
                        Done::Probed(fresh)
                    }));
                }
            }
            Action::ShutGate(cause) => self.shut_gate(cause),
            Action::OpenGate => self.open_gate(),
            Action::Spawn => self.spawn()?,
            Action::Kill => {
                self.disconnect();
                if let Some(process) = &self.process {
                    process.kill();
                }
            }
            Action::ReportCrashLoop(deaths) => {
                self.proxy.board.set_crash_loop(true);
                match self.process.as_ref().map(MasterProcess::last_words) {
                    Some(last_words) => tracing::error!(
                        deaths,
                        last_words,
                        "crash loop: the master has died {deaths} times within a minute; it is \
                         restarted with growing pauses"
                    ),
                    None => tracing::error!(
                        deaths,
                        "crash loop: the master has died {deaths} times within a minute; whoever \
                         starts it has its last words"
                    ),
                }
            }
            Action::ReportCalm => {
                self.proxy.board.set_crash_loop(false);
                tracing::info!("the crash loop is over: the master lives");
            }
        }
        Ok(())
    }

    fn done(&mut self, done: Done) -> Option<Input> {
        match done {
            Done::Connected(connection) => {
                self.outage.port_open(Instant::now());
                self.watch(connection);
                Some(Input::Connected)
            }
            Done::NotConnected(error) => {
                self.say_waiting(&error.to_string());
                Some(match error {
                    ConnectError::Refused { .. } => Input::Refused,
                    ConnectError::Unreachable { .. } => Input::Unreachable,
                })
            }
            Done::Examined(connection, Ok(examination)) => {
                let outcome = examination.outcome;
                if outcome == Outcome::Resumed {
                    // Somebody may have written past us.
                    self.proxy.ledger.doubt();
                } else {
                    self.thread_ended = thread_of(&connection, examination.pid);
                }
                self.connection = Some(connection);
                self.injecting.store(false, Ordering::Relaxed);
                self.report(examination);
                Some(Input::Examined {
                    new: outcome.is_new(),
                })
            }
            Done::Examined(_, Err(error)) => {
                self.disconnect();
                let master = self.proxy.upstream.address();
                let input = error.as_input();
                if input == Input::NotAMaster {
                    self.say(format!(
                        "what answers at {master} is not a ROS master: {error}"
                    ));
                } else {
                    self.say(format!(
                        "the master at {master} could not be examined: {error}"
                    ));
                }
                Some(input)
            }
            // Another incarnation is there, and nobody has closed the connection to the one before.
            Done::Probed(Err(VerifyError::OtherIncarnation)) => {
                self.disconnect();
                Some(Input::ConnectionLost)
            }
            // Missed. If the master has just died, the connection before tells of it.
            Done::Probed(Err(_)) => None,
            Done::Probed(Ok(fresh)) => {
                self.probe_deadline = None;
                self.watch(fresh);
                Some(Input::ProbeAnswered)
            }
        }
    }

    /// Keeps `connection` as the sentinel. It is renewed with each probe, because the kernel closes
    /// the descriptors of a dying process one by one, the newest first, and a master has one for
    /// each node that it has ever called.
    fn watch(&mut self, connection: Connection) {
        self.ended = Some(Box::pin(connection.ended()));
        self.connection = Some(connection);
    }

    fn disconnect(&mut self) {
        // An injection that was under way has failed.
        if !matches!(self.gate.state(), State::Open { .. }) {
            self.keep_shut();
        }
        self.connection = None;
        self.ended = None;
        self.step = None;
        self.probe_deadline = None;
    }

    /// Lets nothing pass; the mirror stands in if it is known.
    fn keep_shut(&self) {
        self.proxy.ledger.end_injection();
        self.gate.set(match self.known {
            true => State::StandingIn,
            false => State::Unknown,
        });
    }

    fn shut_gate(&mut self, cause: Cause) {
        self.keep_shut();
        self.outage = Outage::begin(Instant::now(), cause.as_str());
        if cause == Cause::Stopping {
            return;
        }
        if cause == Cause::Hung {
            self.disconnect();
        }
        tracing::warn!(cause = cause.as_str(), "standing in for the master");
        self.proxy.board.set_open(false);
        // What was prepared before is of another time.
        self.prepared = None;
    }

    fn open_gate(&mut self) {
        self.known = true;
        self.said = None;
        self.proxy.ledger.end_injection();
        let incarnation = self.proxy.ledger.incarnation();
        self.served = Some(incarnation);
        self.gate.set(State::Open { incarnation });
        self.proxy.board.set_open(true);
    }

    /// Whether a session begins that no master has served yet.
    fn begins(&self) -> bool {
        self.served.is_none() && !self.restored
    }

    fn spawn(&mut self) -> Result<(), ProcessError> {
        // There is nothing to protect yet: better to say what is wrong than to try for ever.
        let is_fatal = self.begins() && self.proxy.ledger.pending() == 0;
        let Some(process) = &mut self.process else {
            return Ok(());
        };
        match process.spawn(&self.proxy) {
            Ok(()) => Ok(()),
            Err(error) if is_fatal => Err(error),
            Err(error) => {
                process.report_failure();
                self.say(format!("cannot start a master: {error}"));
                Ok(())
            }
        }
    }
}

/// The end of a thread of the master `pid`, if it is on this computer and the kernel can tell.
fn thread_of(connection: &Connection, pid: i32) -> Option<Ended> {
    let is_master = |pid| connection.is_local() && process::runs(pid, "rosmaster");
    u32::try_from(pid).ok().filter(|pid| is_master(*pid))?;
    let ended = thread_exit::of(pid).ok()?;
    Some(Box::pin(ended))
}

async fn exited(process: &mut Option<MasterProcess>) {
    match process {
        Some(process) => process.exited().await,
        None => std::future::pending().await,
    }
}
