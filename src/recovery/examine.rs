//! Brings a connected master to the mirror's state, or the mirror to the master's.

use std::{
    net::SocketAddr,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use rescue_core::{
    health::port_of,
    lifecycle::{Input, Probing, Supervision},
    replay::{
        self, Authority, Bears, Deviation, Inspection, KnownMaster, Plan, ROSOUT, Token, Treatment,
        withheld_run_id,
    },
};
use ros1_master::master::{self, Counts, Effect, Master, Request, Write};
use thiserror::Error;
use tokio::task::JoinHandle;

use crate::{
    gate::{State, Tx},
    ledger::{Basis, Ledger, late::CatchUp},
    limit::rarely,
    nodes::client::{self, Reaction},
    process::{self, listeners},
    status::{report::RecoveryOutcome, software, stats::Stats},
    upstream::{
        CallError, ConnectError, Connection, RawReply, Upstream,
        inspect::{self, InspectError},
        sentinel::Sentinel,
        sockets,
        verify::Verification,
    },
};

/// Time limit for an injection. 1,000 nodes take 0.3 s on a Xeon.
const INJECTION_LIMIT: Duration = Duration::from_secs(60);
/// Time limit for each step in which a late master catches up. Writes wait meanwhile.
const CATCH_UP_LIMIT: Duration = Duration::from_secs(1);
/// Longest time for rosout to show that it lives. Calls wait meanwhile.
const ROSOUT_LIMIT: Duration = Duration::from_millis(100);
/// Maximum number of rounds of comparing and repairing a master that differs from what was injected.
const ROUNDS: u32 = 3;
/// Time limit for calls of closed connections to end. A `setParam` of 60,000 keys takes some 10 s.
const SETTLE_LIMIT: Duration = Duration::from_secs(60);
/// Pause between two checks whether calls of closed connections have ended. No event reports their end.
const SETTLE_PAUSE: Duration = Duration::from_millis(5);

/// Why a master could not be examined.
#[derive(Debug, Error)]
#[non_exhaustive]
pub(crate) enum ExamineError {
    #[error("no answer within {limit:?}")]
    Silent { limit: Duration },
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// A call by rosrescue failed, or the server is not a master.
    #[error(transparent)]
    Look(#[from] InspectError),
}

impl From<CallError> for ExamineError {
    fn from(error: CallError) -> Self {
        Self::Look(error.into())
    }
}

impl ExamineError {
    /// The [`Input`] that reports this error to the lifecycle.
    pub(crate) fn as_input(&self) -> Input {
        match self {
            Self::Silent { .. }
            | Self::Connect(ConnectError::NoAddress { .. } | ConnectError::Unreachable { .. }) => {
                Input::Unreachable
            }
            Self::Look(InspectError::Call(
                CallError::NotSent(error) | CallError::MaybeSent(error),
            )) if !error.is_parse() => Input::ConnectionLost,
            Self::Connect(ConnectError::Refused { .. })
            | Self::Look(InspectError::Call(CallError::NotConnected(_))) => Input::ConnectionLost,
            Self::Look(_) => Input::NotAMaster,
        }
    }
}

/// The result of [`Examiner::examine`].
#[derive(Debug)]
pub(crate) struct Examination {
    /// How the master got its state.
    pub outcome: RecoveryOutcome,
    /// Process id of the master.
    pub pid: i32,
    /// HTTP version and Python version of the master, as text.
    pub speaks: String,
    /// How rosrescue makes sure that calls reach this master.
    pub verification: Verification,
    pub counts: Counts,
    /// Parts of the state that the master was not given, with the reasons.
    pub skipped: Vec<String>,
    /// Differences that remain after the last repair.
    pub mismatches: Vec<String>,
    /// Time it took to read the master.
    pub look: Duration,
    /// Time the injection took.
    pub injection: Duration,
}

/// The parameters of [`Examiner::examine`].
#[derive(Debug)]
pub(crate) struct Manner {
    pub known: KnownMaster,
    /// The call that gives an empty master the mirror's state, if it was prepared in advance.
    pub prepared: Option<JoinHandle<Prepared>>,
}

/// An *injection*: the call that gives a master the mirror's state.
#[derive(Debug)]
pub(crate) struct Prepared {
    /// The mirror's version and the next token when this injection was prepared. `None` if it was not prepared in
    /// advance.
    basis: Option<(u64, Token)>,
    plan: Plan,
    /// Whether this injection restores the mirror's complete state.
    complete: bool,
}

/// Prepares the injection into an empty master, in a thread of its own.
pub(crate) fn prepare(ledger: Arc<Ledger>) -> JoinHandle<Prepared> {
    crate::task::spawn_blocking(move || {
        let (version, target, token) = ledger.next();
        let plan = Plan::new(&target, &Master::default(), &token);
        Prepared {
            complete: plan.expected() == &target,
            basis: Some((version, token)),
            plan,
        }
    })
}

/// The state that a master must get, and the state that it has now.
struct Target {
    state: Master,
    found: Master,
    change: Change,
}

/// How a master is brought to a state.
enum Change {
    /// Add what the master lacks.
    Add,
    /// The master holds the state already, and only gets a new [`Token`] in place of this one.
    Renew(Token),
    /// Replace everything that the master holds, including this token.
    Replace(Token),
}

impl Change {
    fn plan(&self, state: &Master, found: &Master, token: &Token) -> Plan {
        match self {
            Self::Add => Plan::new(state, found, token),
            Self::Renew(before) => Plan::renew(found, before, token),
            Self::Replace(before) => Plan::replace(state, found, before, token),
        }
    }
}

/// Examines masters, and lets calls pass to one that holds the mirror's state.
#[derive(Clone)]
pub(crate) struct Examiner {
    pub ledger: Arc<Ledger>,
    pub upstream: Arc<Upstream>,
    pub gate: Tx,
    pub supervision: Supervision,
    /// How to tell a hung master from a slow one.
    pub probing: Probing,
    /// Longest time for the master to answer a probe.
    pub probe_timeout: Duration,
    /// The call that sets `/run_id` in the present master, if the master gets it later ([`withheld_run_id`]).
    pub run_id: Arc<Mutex<Option<Request>>>,
    pub stats: &'static Stats,
}

impl Examiner {
    /// The facts about the present master. `new` is the process id of a master that was just started and has not been
    /// called yet.
    pub(super) fn known(&self, new: Option<i32>) -> KnownMaster {
        match (self.ledger.has_served_present(), new) {
            (None, _) => KnownMaster::Nothing,
            (_, Some(pid)) => KnownMaster::New { pid },
            (Some(true), None) => KnownMaster::ServedIfPresent,
            (Some(false), None) => KnownMaster::InjectedIfPresent,
        }
    }

    pub(super) fn lock_run_id(&self) -> MutexGuard<'_, Option<Request>> {
        self.run_id.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the call that sets the run id that the present master has not been given.
    pub(super) fn take_run_id(&self) -> Option<Request> {
        self.lock_run_id().take()
    }

    /// Whether the present master has a run id. False if it does not answer.
    pub(super) async fn has_run_id(&self) -> bool {
        let asked = async {
            let mut connection = self.upstream.connect().await?;
            let reply = connection.call(&replay::has_run_id().into()).await?;
            Ok::<_, ExamineError>(reply)
        };
        let reply = within(self.probe_timeout, asked).await;
        reply.is_ok_and(|reply| replay::says_run_id(&reply))
    }

    /// Lets calls pass to the present master.
    pub(super) fn open_gate(&self) {
        let incarnation = self.ledger.serve();
        self.gate.set(State::Open { incarnation });
    }

    /// Examines the master that `sentinel` is connected to. If the sentinel is still open afterwards, the whole result
    /// concerns that one master.
    pub(crate) async fn examine(
        &self,
        sentinel: &Arc<Sentinel>,
        manner: Manner,
    ) -> Result<Examination, ExamineError> {
        let start = Instant::now();
        let connection = &mut self.while_alive(self.upstream.connect()).await?;
        let served = matches!(manner.known, KnownMaster::ServedIfPresent);
        let resumes =
            |first: &Inspection| served && first.bears() == Bears::Present && self.ledger.resume();
        let is_new = matches!(manner.known, KnownMaster::New { .. });
        let mut first = match manner.known {
            KnownMaster::New { pid } => Inspection::at_new(pid),
            _ => self.first_look(connection).await?,
        };
        let mut resumed = resumes(&first);
        if !is_new && !resumed {
            self.settle(sentinel.peer()).await?;
            self.ledger.settled();
            first = self.first_look(connection).await?;
            resumed = resumes(&first);
        }
        let mut examination = Examination {
            outcome: RecoveryOutcome::Resumed,
            pid: first.pid(),
            speaks: String::new(),
            verification: Verification::TokenFirst,
            counts: Counts::default(),
            skipped: Vec::new(),
            mismatches: Vec::new(),
            look: start.elapsed(),
            injection: Duration::ZERO,
        };
        if !resumed {
            let may_be_roscores = self.supervision == Supervision::Theirs
                && may_be_of_roscore(examination.pid, sentinel).await;
            self.inject(
                connection,
                first,
                manner,
                may_be_roscores,
                start,
                &mut examination,
            )
            .await?;
        }
        // All masters that rosrescue starts have the same version.
        if !is_new || self.ledger.with_mirror(Master::is_old).is_none() {
            let ask = Master::ask_if_old().into();
            let reply = self.while_alive(connection.call(&ask)).await?;
            self.ledger.set_old(Master::shows_old(&reply));
        }
        self.ledger.set_python(connection.python());
        let keeps_alive = connection.keeps_alive() != Some(false);
        examination.speaks = software::speaks(keeps_alive, connection.server());
        let sees_master =
            !keeps_alive && sentinel.is_local() && listens(examination.pid, sentinel.peer()).await;
        examination.verification = Verification::of(keeps_alive, sees_master, sentinel);
        examination.injection = start.elapsed().saturating_sub(examination.look);
        examination.counts = self.ledger.with_mirror(Master::counts);
        Ok(examination)
    }

    /// Brings a late master, which has answered by now, up to date with the writes that the mirror has answered.
    /// Returns whether the master then holds the mirror's state. If not, the master must be examined.
    pub(super) async fn catch_up(&self) -> Result<bool, ExamineError> {
        let connect = self.upstream.connect();
        let mut connection = within(CATCH_UP_LIMIT, connect).await?;
        // From here until the gate opens the mirror must not change, and writes wait.
        self.gate.set(State::Injecting);
        let missed = match self.ledger.begin_catch_up(Instant::now()) {
            None => return Ok(false),
            Some(CatchUp::Nothing) => return Ok(true),
            Some(CatchUp::Run(missed)) => *missed,
        };
        let (count, mirror) = (missed.writes.len(), &missed.mirror);
        let plan = tokio::task::block_in_place(|| {
            Plan::run(&missed.behind, missed.writes, &missed.before, &missed.token)
        });
        if plan.expected() != mirror {
            return Ok(false);
        }
        let reply = connection.predicted(plan.request().clone(), plan.answer());
        let raw = within(CATCH_UP_LIMIT, reply).await?;
        let verdict = verdict(&plan, &raw)?;
        tracing::debug!(
            writes = count,
            ?verdict,
            "the master has caught up with the mirror"
        );
        if verdict.is_ok() {
            self.ledger.delivered();
        }
        Ok(verdict.is_ok())
    }

    /// Waits until the master runs no more calls of closed connections. Before that, its state can still change.
    async fn settle(&self, master: SocketAddr) -> Result<(), ExamineError> {
        let settled = async {
            self.upstream.no_writers().await;
            while may_run_a_call(master).await {
                tokio::time::sleep(SETTLE_PAUSE).await;
            }
        };
        if tokio::time::timeout(SETTLE_LIMIT, settled).await.is_ok() {
            return Ok(());
        }
        match self.supervision {
            // rosrescue replaces this master, as it replaces a master that hangs.
            Supervision::Ours => Err(ExamineError::Silent {
                limit: SETTLE_LIMIT,
            }),
            Supervision::Theirs => {
                rarely!(
                    warn,
                    "the master may still be running calls of closed connections after {SETTLE_LIMIT:?}; changes that these calls still make may be lost. Restart the master if this happens again"
                );
                Ok(())
            }
        }
    }

    async fn inject(
        &self,
        connection: &mut Connection,
        first: Inspection,
        manner: Manner,
        may_be_roscores: bool,
        start: Instant,
        examination: &mut Examination,
    ) -> Result<(), ExamineError> {
        let (bears, empty) = (first.bears(), first.is_empty());
        tracing::debug!(?bears, empty, pid = first.pid(), "inspected");
        if let Bears::Later(number) = bears {
            self.ledger.catch_up(number);
        }
        let fresh = bears == Bears::Nothing && empty;
        let mut ready = match manner.prepared {
            Some(prepared) if fresh => prepared.await.ok(),
            _ => None,
        };
        let found = match fresh {
            true => Master::default(),
            false => {
                // If this master got the mirror's state, the mirror supplies what cannot be read back.
                let previous = match bears {
                    Bears::Nothing => Master::default(),
                    _ => self.ledger.may_hold(),
                };
                self.while_alive(inspect::second(first, connection, &previous))
                    .await?
            }
        };
        self.remove_dead_rosout(may_be_roscores, bears, &found)
            .await;
        examination.look = start.elapsed();
        // From here until the gate opens the mirror must not change, because the master is compared
        // with the mirror.
        self.gate.set(State::Injecting);
        let Basis {
            mut mirror,
            version,
            pending,
        } = self.ledger.begin_injection();
        let before = self.ledger.token();
        let treatment = replay::treatment(bears, manner.known, mirror.is_empty(), found.is_empty());
        let withheld = withheld_run_id(may_be_roscores, treatment, &mirror, &found);
        if let Some((remove, set)) = withheld {
            ready = None;
            mirror.apply(&remove);
            self.ledger.seed(&remove);
            *self.lock_run_id() = Some(set);
        }
        examination.outcome = match treatment {
            Treatment::Begin => RecoveryOutcome::Begun,
            Treatment::TakeOver => RecoveryOutcome::Adopted,
            Treatment::Inject | Treatment::Replace => RecoveryOutcome::Injected,
            Treatment::Reconcile(_) if manner.known == KnownMaster::Nothing => {
                RecoveryOutcome::Adopted
            }
            Treatment::Reconcile(Authority::PendingWrites) => RecoveryOutcome::Reconciled,
            Treatment::Reconcile(Authority::Mirror) => RecoveryOutcome::Injected,
        };
        let say_difference = |difference: &[String]| match manner.known {
            KnownMaster::Nothing => say_older(difference),
            _ => say_difference(difference),
        };
        let (state, change) = match treatment {
            Treatment::Begin | Treatment::TakeOver | Treatment::Inject => {
                (mirror.clone(), Change::Add)
            }
            Treatment::Replace => (mirror.clone(), Change::Replace(before)),
            Treatment::Reconcile(authority) => {
                let state = tokio::task::block_in_place(|| {
                    replay::reconcile(&mirror, &found, &pending, authority)
                });
                // A master does not tell which nodes subscribe to parameters.
                let hidden = |call: &Request| {
                    let hidden = |write: Write<'_>| {
                        matches!(
                            write.effect,
                            Effect::SubscribeParam { .. } | Effect::UnsubscribeParam { .. }
                        )
                    };
                    Write::of(call).is_some_and(hidden)
                };
                if state != found || pending.iter().any(hidden) {
                    (state, Change::Replace(before))
                } else if pending.is_empty() {
                    self.ledger.delivered();
                    say_difference(&self.ledger.adopt(found));
                    return Ok(());
                } else {
                    // Without a new token, a start with an older copy of the checkpoint would treat the writes as
                    // pending.
                    (state, Change::Renew(before))
                }
            }
        };
        if state != mirror {
            say_difference(&self.ledger.adopt(state.clone()));
        }
        if bears == Bears::Nothing {
            // This master has no token of ours, so the previous master is gone and sends no more notifications. A
            // master that was only late finishes its own.
            self.ledger.with_order(|order, _| order.master_is_gone());
        }
        let token = self.ledger.succeed();
        let target = Target {
            state,
            found,
            change,
        };
        let ready = ready.filter(|ready| ready.basis.as_ref() == Some(&(version, token.clone())));
        self.bring(connection, &target, &token, ready, examination)
            .await
    }

    /// Removes a rosout from the mirror that must not be restored in a master with this state, because it has ended.
    async fn remove_dead_rosout(&self, may_be_roscores: bool, bears: Bears, found: &Master) {
        let to_ask = |mirror: &Master| {
            let api = replay::rosout_to_ask(may_be_roscores, bears, mirror, found)?;
            Some(port_of(api).to_owned())
        };
        let Some(port) = self.ledger.with_mirror(to_ask) else {
            return;
        };
        if client::ask(&port, &master::get_pid(), ROSOUT_LIMIT).await == Reaction::Dead {
            for call in self
                .ledger
                .with_mirror(|mirror| mirror.unregister_calls(ROSOUT))
            {
                self.ledger.seed(&call);
            }
        }
    }

    /// Brings the master to `target`, reads it back, and sets `token` in it.
    async fn bring(
        &self,
        connection: &mut Connection,
        target: &Target,
        token: &Token,
        ready: Option<Prepared>,
        examination: &mut Examination,
    ) -> Result<(), ExamineError> {
        let Target {
            state,
            found,
            change,
        } = target;
        let mut next = ready.unwrap_or_else(|| {
            let plan = tokio::task::block_in_place(|| change.plan(state, found, token));
            Prepared {
                basis: None,
                complete: plan.expected() == state,
                plan,
            }
        });
        let mut before: Option<(Master, Master)> = None;
        for round in 1..=ROUNDS {
            let Prepared { plan, complete, .. } = next;
            tracing::debug!(round, bytes = plan.request().len(), complete, "injecting");
            let reply = connection.predicted(plan.request().clone(), plan.answer());
            let raw = self.while_alive(reply).await?;
            examination.skipped = plan.skipped().iter().map(ToString::to_string).collect();
            let Err(mut deviation) = verdict(&plan, &raw)? else {
                examination.mismatches.clear();
                if !complete || plan.expected().is_inexact() {
                    self.ledger.adopt(plan.expected().clone());
                }
                self.injected(&plan, change, round);
                // Freeing thousands of small allocations takes time, so another thread does it.
                crate::task::spawn_blocking(move || drop(plan));
                return Ok(());
            };
            // What the master holds now replaces what was expected, and the missing part is injected again.
            let first = self.first_look(connection).await?;
            if first.bears() != Bears::Present && deviation.failed.is_empty() {
                deviation.failed.push("the token is missing".to_owned());
            }
            let now = inspect::second(first, connection, plan.expected());
            let now = self.while_alive(now).await?;
            if deviation.failed.is_empty() {
                rarely!(
                    info,
                    round,
                    changed = ?deviation.changed,
                    "another program has changed the master while it got its state; the changes are kept"
                );
            } else {
                rarely!(
                    error,
                    round,
                    mismatches = ?deviation.failed,
                    "the master does not hold the state that it was given; giving it the missing part again; please report this line"
                );
            }
            examination.mismatches.clone_from(&deviation.failed);
            let (state, found) = before.as_ref().map_or((state, found), |(a, b)| (a, b));
            let (wanted, repair) = tokio::task::block_in_place(|| {
                let wanted = plan.remaining(state, found, &deviation, &now);
                let repair = Plan::repair(&wanted, &now, token);
                (wanted, repair)
            });
            let is_whole = deviation.failed.is_empty() && repair.expected() == &now;
            if is_whole || round == ROUNDS {
                self.ledger.adopt(now);
                self.injected(&plan, change, ROUNDS);
                return Ok(());
            }
            next = Prepared {
                basis: None,
                complete: false,
                plan: repair,
            };
            before = Some((wanted, now));
        }
        Ok(())
    }

    /// Notes that the master has got `plan` in this round, and that the mirror equals it.
    fn injected(&self, plan: &Plan, change: &Change, round: u32) {
        self.ledger.delivered();
        tracing::debug!(skipped = plan.skipped().len(), "injected");
        if !matches!(change, Change::Renew(_)) {
            self.stats.masters_restored.count();
        }
        if round > 1 {
            // Another program changes the master, and may have done so once more.
            self.ledger.doubt();
        }
    }

    async fn first_look(&self, connection: &mut Connection) -> Result<Inspection, ExamineError> {
        let mut first = self
            .while_alive(inspect::first(connection, &self.ledger.token()))
            .await?;
        if !connection.keeps_order() {
            self.ledger.with_mirror(|mirror| first.arrange_like(mirror));
        }
        Ok(first)
    }

    /// Waits for slow `work` while the master answers probes.
    async fn while_alive<T, E: Into<ExamineError>>(
        &self,
        work: impl Future<Output = Result<T, E>>,
    ) -> Result<T, ExamineError> {
        tokio::select! {
            done = within(INJECTION_LIMIT, work) => done,
            limit = self.silence() => Err(ExamineError::Silent { limit }),
        }
    }
}

/// Whether a master's reply is the one that `plan` predicts; if not, how it differs. Decodes the reply only if its
/// bytes differ from the prediction, because the reply is long and calls are waiting.
fn verdict(plan: &Plan, raw: &RawReply) -> Result<Result<(), Deviation>, ExamineError> {
    Ok(match raw.body == plan.answer() {
        true => Ok(()),
        false if raw.keeps_order() => plan.verify(&raw.decode()?),
        false => plan.verify_in_any_order(&raw.decode()?),
    })
}

/// Runs [`sockets::may_run_a_call`] in another thread: it takes 100 ms with 15,000 sockets, where a sandbox allows only
/// the table in /proc.
async fn may_run_a_call(master: SocketAddr) -> bool {
    let looked = crate::task::spawn_blocking(move || sockets::may_run_a_call(master));
    looked.await.unwrap_or(false)
}

/// Whether the process `pid` seems to listen at the port of `master`.
async fn listens(pid: i32, master: SocketAddr) -> bool {
    let look = move || u32::try_from(pid).is_ok_and(|pid| listeners::listens(pid, master.port()));
    crate::task::spawn_blocking(look).await.unwrap_or(false)
}

/// Whether a roscore, or a roslaunch, may have started the master `pid`. A master whose process is hidden, in a
/// container or on another computer, may be a roscore's.
async fn may_be_of_roscore(pid: i32, sentinel: &Sentinel) -> bool {
    let (local, master) = (sentinel.is_local(), sentinel.peer());
    let look = move || {
        let pid = u32::try_from(pid).ok().filter(|_| local)?;
        let sockets = sockets::accepting(&sockets::listening(), master);
        let open = listeners::open_sockets(pid);
        let is_master = sockets.iter().any(|socket| open.contains(socket));
        let parent = process::parent_of(pid).filter(|_| is_master)?;
        Some(process::runs(parent, "roscore") || process::runs(parent, "roslaunch"))
    };
    let seen = crate::task::spawn_blocking(look).await;
    seen.ok().flatten().unwrap_or(true)
}

/// Logs the differences between the master and the mirror.
fn say_difference(difference: &[String]) {
    if !difference.is_empty() {
        rarely!(
            warn,
            ?difference,
            "the master was changed directly, bypassing rosrescue, and the mirror now follows it; set ROS_MASTER_URI to rosrescue's address everywhere"
        );
    }
}

/// Logs the differences between a living master and the checkpoint.
fn say_older(difference: &[String]) {
    if !difference.is_empty() {
        rarely!(
            warn,
            ?difference,
            "the master's state is newer than the checkpoint, so it is kept; possible reasons: the disk was full, the checkpoint is an old copy, or the master was changed directly"
        );
    }
}

async fn within<T, E: Into<ExamineError>>(
    limit: Duration,
    work: impl Future<Output = Result<T, E>>,
) -> Result<T, ExamineError> {
    match tokio::time::timeout(limit, work).await {
        Ok(result) => result.map_err(Into::into),
        Err(_) => Err(ExamineError::Silent { limit }),
    }
}
