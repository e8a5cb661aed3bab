//! Decides how a master gets the mirror's state, or the mirror the master's. Reaches the master only through a
//! [`Contact`]: in production a connection, in the simulation of the write queue a simulated master.

use std::{
    collections::BTreeSet,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use rescue_core::{
    health::port_of,
    lifecycle::Input,
    replay::{
        self, Authority, Deviation, Inspection, KnownMaster, Plan, ROSOUT, Token, TokenState,
        Treatment, withheld_run_id,
    },
};
use ros1_master::{
    master::{Counts, Master, Request, Write, WriteTarget},
    xmlrpc::{Python, Reply},
};
use thiserror::Error;
use tokio::task::JoinHandle;

use crate::{
    gate::State,
    ledger::{Basis, Ledger, durability::Mark, late::CatchUp, mutant::Mutant},
    limit::rarely,
    status::{report::RecoveryOutcome, stats::Stats},
    task::DeferredDrop,
    upstream::{CallError, ConnectError, RawReply, inspect::InspectError},
};

/// Maximum number of rounds of comparing and repairing a master that differs from what was injected.
const ROUNDS: u32 = 3;

/// Maximum number of injections after the first one of a recovery. The last one, or the first one that gives the master
/// no more than [`FROZEN_MOST`] writes, lets writes wait, so that the gate can open afterwards.
const UPDATES: u32 = 4;
/// Maximum number of writes for which others wait while the master gets them. It needs some 40 µs for each.
const FROZEN_MOST: usize = 50;

/// Maximum number of addresses that are asked whether a node listens there, because calls wait meanwhile.
const ASKED_MOST: usize = 32;

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
    Inspect(#[from] InspectError),
}

impl From<CallError> for ExamineError {
    fn from(error: CallError) -> Self {
        Self::Inspect(error.into())
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
            Self::Inspect(InspectError::Call(
                CallError::NotSent(error) | CallError::MaybeSent(error),
            )) if !error.is_parse() => Input::ConnectionLost,
            Self::Connect(ConnectError::Refused { .. })
            | Self::Inspect(InspectError::Call(CallError::NotConnected(_))) => {
                Input::ConnectionLost
            }
            Self::Inspect(_) => Input::NotAMaster,
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
    pub counts: Counts,
    /// Parts of the state that the master was not given, with the reasons.
    pub skipped: Vec<String>,
    /// Differences that remain after the last repair.
    pub mismatches: Vec<String>,
    /// Time it took to read the master.
    pub inspection: Duration,
    /// Time the injection took.
    pub injection: Duration,
}

/// The injection that is prepared in another thread while the master is away. Only the examination of an empty master
/// takes it: the first connection after a death may still be to the dying master.
#[derive(Clone, Debug, Default)]
pub(crate) struct InAdvance(Arc<Mutex<Option<JoinHandle<Prepared>>>>);

impl InAdvance {
    /// Begins the preparation with `begin`, unless there is one.
    pub(super) fn begin(&self, begin: impl FnOnce() -> JoinHandle<Prepared>) {
        self.lock().get_or_insert_with(begin);
    }

    /// Drops the preparation. Its thread may go on, but nobody uses the result.
    pub(super) fn forget(&self) {
        *self.lock() = None;
    }

    /// Waits until the injection is prepared, and takes it.
    async fn take(&self) -> Option<Prepared> {
        let prepared = self.lock().take();
        prepared?.await.ok()
    }

    fn lock(&self) -> MutexGuard<'_, Option<JoinHandle<Prepared>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// An injection that is ready to be sent.
#[derive(Debug)]
pub(crate) struct Prepared {
    /// The mirror's version and the next token when this injection was prepared. `None` if it was not prepared in
    /// advance.
    basis: Option<(u64, Token)>,
    plan: DeferredDrop<Plan>,
    /// Whether this injection restores the mirror's whole state.
    complete: bool,
}

impl Prepared {
    /// Prepares the injection of the mirror's present state into an empty master. Takes long for a large state.
    pub(super) fn in_advance(ledger: &Ledger) -> Self {
        let (version, target, token) = ledger.next();
        let plan = Plan::new(&target, &Master::default(), &token);
        Self {
            complete: plan.expected() == &target,
            basis: Some((version, token)),
            plan: plan.into(),
        }
    }
}

/// What an examination asks of a master, and of the processes around it. Each request fails if the master does not
/// answer in time.
pub(crate) trait Contact: Send {
    /// Waits until the master runs no more calls of closed connections. Before that, its state can still change.
    fn settle(&mut self) -> impl Future<Output = Result<(), ExamineError>> + Send;

    /// Makes the first of the two requests that read the master, and compares its token with `token`.
    fn read_first(
        &mut self,
        token: &Token,
    ) -> impl Future<Output = Result<Inspection, ExamineError>> + Send;

    /// Makes the second request, and returns the master's state. `previous` has what cannot be read.
    fn read_second(
        &mut self,
        first: Inspection,
        previous: &Master,
    ) -> impl Future<Output = Result<Master, ExamineError>> + Send;

    /// Makes a call.
    fn call(&mut self, call: Request) -> impl Future<Output = Result<Reply, ExamineError>> + Send;

    /// Sends the multicall of `plan`.
    fn inject(
        &mut self,
        plan: &Plan,
    ) -> impl Future<Output = Result<RawReply, ExamineError>> + Send;

    /// Waits until the disk has this record. Does not wait for a disk that fails or hangs.
    fn wait_for_disk(&mut self, ledger: &Ledger, record: Mark) -> impl Future<Output = ()> + Send;

    /// Whether no process listens at the local `port` of a node.
    fn is_dead(&mut self, port: &str) -> impl Future<Output = bool> + Send;

    /// Whether a roscore may have started the master, whose process id is `pid`.
    fn may_be_of_roscore(&mut self, pid: i32) -> impl Future<Output = bool> + Send;

    /// The version of Python on which the master runs, according to its last answer.
    fn python(&self) -> Python;

    /// The present time.
    fn now(&self) -> Instant;
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
    /// The master was given the state that it has now, and this token. Change what differs.
    Update(Token),
}

impl Change {
    fn plan(&self, state: &Master, found: &Master, token: &Token) -> Plan {
        match self {
            Self::Add => Plan::new(state, found, token),
            Self::Renew(before) => Plan::renew(found, before, token),
            Self::Replace(before) => Plan::replace(state, found, before, token),
            Self::Update(before) => Plan::update(state, found, before, token),
        }
    }
}

/// What a report calls the treatment of a master of which this was known.
fn outcome(treatment: Treatment, known: KnownMaster) -> RecoveryOutcome {
    match treatment {
        Treatment::Begin => RecoveryOutcome::Begun,
        Treatment::Adopt => RecoveryOutcome::Adopted,
        Treatment::Inject | Treatment::Replace => RecoveryOutcome::Injected,
        Treatment::Reconcile(_) if known == KnownMaster::Nothing => RecoveryOutcome::Adopted,
        Treatment::Reconcile(Authority::PendingWrites) => RecoveryOutcome::Reconciled,
        Treatment::Reconcile(Authority::Mirror) => RecoveryOutcome::Injected,
    }
}

/// Examines masters, and lets calls pass to one that holds the mirror's state.
#[derive(Clone)]
pub(crate) struct Examiner {
    pub ledger: Arc<Ledger>,
    /// The injection into an empty master, if it is prepared in advance.
    pub prepared: InAdvance,
    /// The call that sets `/run_id` in the present master, if the master gets it later ([`withheld_run_id`]).
    pub run_id: Arc<Mutex<Option<Request>>>,
    pub stats: &'static Stats,
}

impl Examiner {
    /// The facts about the present master. `new` is the process id of a master that was just started and has not been
    /// called yet.
    pub(crate) fn known(&self, new: Option<i32>) -> KnownMaster {
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

    /// Examines the master that `master` reaches, and brings it to the mirror's state, or the mirror to its state.
    pub(crate) async fn examine(
        &self,
        master: &mut impl Contact,
        known: KnownMaster,
    ) -> Result<Examination, ExamineError> {
        let start = master.now();
        let served = matches!(known, KnownMaster::ServedIfPresent);
        let resumes = |first: &Inspection| {
            let token = self.ledger.token();
            served && first.bears() == TokenState::Present && self.ledger.resume(&token)
        };
        let is_new = matches!(known, KnownMaster::New { .. });
        let mut first = match known {
            KnownMaster::New { pid } => Inspection::at_new(pid),
            _ => self.read_first(master).await?,
        };
        let mut resumed = resumes(&first);
        if !is_new && !resumed {
            if !Mutant::ReadsBeforeRun.lives() {
                master.settle().await?;
            }
            self.ledger.settled();
            first = self.read_first(master).await?;
            resumed = resumes(&first);
        }
        let mut examination = Examination {
            outcome: RecoveryOutcome::Resumed,
            pid: first.pid(),
            counts: Counts::default(),
            skipped: Vec::new(),
            mismatches: Vec::new(),
            inspection: master.now() - start,
            injection: Duration::ZERO,
        };
        if resumed {
            // Another program may have written to the master directly.
            self.ledger.doubt();
        } else {
            let may_be_roscores = master.may_be_of_roscore(examination.pid).await;
            self.treat(
                master,
                first,
                known,
                may_be_roscores,
                start,
                &mut examination,
            )
            .await?;
        }
        // All masters that rosrescue starts have the same version.
        if !is_new || self.ledger.with_mirror(Master::is_old).is_none() {
            let reply = master.call(Master::ask_if_old()).await?;
            self.ledger.set_old(Master::shows_old(&reply));
        }
        self.ledger.set_python(master.python());
        examination.injection = (master.now() - start).saturating_sub(examination.inspection);
        examination.counts = self.ledger.with_mirror(Master::counts);
        Ok(examination)
    }

    /// Brings a late master, which has answered by now, up to date with the writes that the mirror has answered.
    /// Returns whether the master has run them, and holds the mirror's state except for parameters that another program
    /// has set meanwhile. If not, the master must be examined.
    pub(crate) async fn catch_up(&self, master: &mut impl Contact) -> Result<bool, ExamineError> {
        let mut missed = match self.ledger.begin_catch_up() {
            None => return Ok(false),
            Some(CatchUp::Nothing) => return Ok(true),
            Some(CatchUp::Run(missed)) => *missed,
        };
        let writes = std::mem::take(&mut missed.writes);
        let count = writes.len();
        let plan = tokio::task::block_in_place(|| {
            Plan::run(&missed.behind, writes, &missed.before, &missed.token)
        });
        if *plan.expected() != missed.mirror {
            return Ok(false);
        }
        let Some(announced) = self.ledger.announce_missed(master.now(), &missed) else {
            return Ok(false);
        };
        master.wait_for_disk(&self.ledger, announced).await;
        let raw = master.inject(&plan).await?;
        let verdict = verdict(&plan, &raw)?;
        tracing::debug!(writes = count, ?verdict, "the master has caught up");
        if let Err(deviation) = verdict {
            let is_param = deviation.failed.is_empty() && !deviation.beyond_params;
            // Its registrations prove that this is not another master, which lacks the state before the missed writes.
            let is_same = is_param && missed.behind.nodes().next().is_some();
            if !is_same || Mutant::UndoesDirectChange.lives() {
                return Ok(false);
            }
            // Another program has set a parameter directly. An inspection will show it, and the mirror follows it.
            self.ledger.doubt();
        }
        self.ledger.delivered();
        Ok(true)
    }

    /// Reads the rest of a master that the first request has shown, and gives it the mirror's state, or the mirror its
    /// state.
    async fn treat(
        &self,
        master: &mut impl Contact,
        first: Inspection,
        known: KnownMaster,
        may_be_roscores: bool,
        start: Instant,
        examination: &mut Examination,
    ) -> Result<(), ExamineError> {
        let (bears, empty) = (first.bears(), first.is_empty());
        tracing::debug!(?bears, empty, pid = first.pid(), "inspected");
        if let TokenState::Later(number) = bears {
            self.ledger.note_later_master(number);
        }
        let fresh = bears == TokenState::Nothing && empty;
        let mut ready = match fresh {
            true => self.prepared.take().await,
            false => None,
        };
        let found = match fresh {
            true => Master::default(),
            false => {
                // If this master got the mirror's state, the mirror supplies what cannot be read back.
                let previous = match bears {
                    TokenState::Nothing => Master::default(),
                    _ => self.ledger.may_hold(),
                };
                master.read_second(first, &previous).await?
            }
        };
        self.remove_dead_rosout(master, may_be_roscores, bears, &found)
            .await;
        let ended = self.ended(master, bears, &found).await?;
        examination.inspection = master.now() - start;
        let is_away = self.ledger.gate().state() == State::StandingIn;
        // The master is compared with the mirror, so the mirror must not change for a moment.
        let Basis {
            mut mirror,
            version,
            pending,
        } = self.ledger.begin_injection();
        let pending = replay::without_ended(pending, &ended);
        let before = self.ledger.token();
        let treatment = replay::treatment(bears, known, mirror.is_empty(), found.is_empty());
        let withheld = withheld_run_id(may_be_roscores, treatment, &mirror, &found);
        if let Some((remove, set)) = withheld {
            ready = None;
            mirror.apply(&remove);
            self.ledger.seed(&remove);
            *self.lock_run_id() = Some(set);
        }
        examination.outcome = outcome(treatment, known);
        let report = |difference: &[String]| match known {
            KnownMaster::Nothing => log_newer_master(difference),
            _ => log_difference(difference),
        };
        let (state, change) = match treatment {
            Treatment::Begin | Treatment::Adopt | Treatment::Inject => {
                (mirror.clone(), Change::Add)
            }
            Treatment::Replace => (mirror.clone(), Change::Replace(before)),
            Treatment::Reconcile(authority) => {
                let state = tokio::task::block_in_place(|| {
                    replay::reconcile(&mirror, &found, &pending, authority)
                });
                // A master does not tell which nodes subscribe to parameters.
                let hidden = |call: &Request| {
                    let write = Write::parse(call);
                    write.is_some_and(|write| write.target() == WriteTarget::ParamSubscriber)
                };
                if state != found || pending.iter().any(hidden) {
                    (state, Change::Replace(before))
                } else if pending.is_empty() {
                    self.ledger.delivered();
                    report(&self.ledger.adopt(found));
                    return Ok(());
                } else {
                    // Without a new token, a start with an older copy of the checkpoint would treat the writes as
                    // pending.
                    (state, Change::Renew(before))
                }
            }
        };
        if state != mirror {
            report(&self.ledger.adopt(state.clone()));
        }
        if bears == TokenState::Nothing {
            // This master has no token of ours, so the previous master is gone and sends no more notifications. A
            // master that was only late finishes its own.
            self.ledger.with_order(|order, _| order.master_is_gone());
        }
        let (token, announced) = self.ledger.succeed();
        if is_away {
            self.ledger.shut_gate(State::Injecting);
        }
        master.wait_for_disk(&self.ledger, announced).await;
        let target = DeferredDrop::from(Target {
            state,
            found,
            change,
        });
        let ready = ready.filter(|ready| ready.basis.as_ref() == Some(&(version, token.clone())));
        let held = self
            .bring(master, &target, &token, ready, examination)
            .await?;
        self.stats
            .masters_restored
            .add(u64::from(!matches!(target.change, Change::Renew(_))));
        self.update(master, held, token, examination).await
    }

    /// Gives a master that holds the state `held` and has the token `token` what the mirror has answered since it was
    /// given that, until nothing is missing.
    async fn update(
        &self,
        master: &mut impl Contact,
        mut held: Master,
        mut token: Token,
        examination: &mut Examination,
    ) -> Result<(), ExamineError> {
        let mut updates = 0;
        while !self.ledger.resume(&token) && !Mutant::LeavesBehind.lives() {
            updates += 1;
            let is_short = self.ledger.pending() <= FROZEN_MOST || updates >= UPDATES;
            let Basis { mirror, .. } = self.ledger.begin_injection();
            let (next, announced) = self.ledger.succeed();
            if !is_short {
                self.ledger.shut_gate(State::Injecting);
            }
            master.wait_for_disk(&self.ledger, announced).await;
            let target = DeferredDrop::from(Target {
                state: mirror,
                found: held,
                change: Change::Update(token),
            });
            let skipped = std::mem::take(&mut examination.skipped);
            held = self
                .bring(master, &target, &next, None, examination)
                .await?;
            examination.skipped.splice(0..0, skipped);
            token = next;
        }
        tracing::debug!(updates, "the master holds the mirror's state");
        self.ledger.delivered();
        Ok(())
    }

    /// Removes a rosout from the mirror that must not be restored in a master with this state, because it has ended.
    async fn remove_dead_rosout(
        &self,
        master: &mut impl Contact,
        may_be_roscores: bool,
        bears: TokenState,
        found: &Master,
    ) {
        let to_ask = |mirror: &Master| {
            let api = replay::rosout_to_ask(may_be_roscores, bears, mirror, found)?;
            Some(port_of(api).to_owned())
        };
        let Some(port) = self.ledger.with_mirror(to_ask) else {
            return;
        };
        if master.is_dead(&port).await {
            for call in self
                .ledger
                .with_mirror(|mirror| mirror.unregister_calls(ROSOUT))
            {
                self.ledger.seed(&call);
            }
        }
    }

    /// The addresses of ended nodes that pending writes would register again in a master with the state `found`, although
    /// it has these nodes elsewhere: they have started again, and only the master was told.
    ///
    /// If another node has the address where the master has such a node, the pending write is newer than that.
    async fn ended(
        &self,
        master: &mut impl Contact,
        bears: TokenState,
        found: &Master,
    ) -> Result<BTreeSet<String>, ExamineError> {
        let mut ended = BTreeSet::new();
        if bears == TokenState::Nothing || Mutant::ReturnsEndedNodes.lives() {
            return Ok(ended);
        }
        let pending = self.ledger.pending_registrants();
        let is_taken = |node: &str, at: &str| {
            let pending = pending.iter().map(|(other, api)| (&**other, &**api));
            found
                .nodes()
                .chain(pending)
                .any(|(other, api)| other != node && api == at)
        };
        let mut elsewhere = BTreeSet::new();
        let mut hidden = Vec::new();
        for (node, api) in &pending {
            match found.api_of(node) {
                Some(now) if now == api || is_taken(node, now) => {}
                Some(_) => {
                    elsewhere.insert(api);
                }
                None => hidden.push((node, api)),
            }
        }
        // No inspection shows nodes that only subscribe to parameters.
        if !hidden.is_empty() {
            let call = Inspection::ask_addresses(hidden.iter().map(|(node, _)| node.as_str()));
            let reply = master.call(call).await?;
            let now = Inspection::read_addresses(&reply);
            for ((node, api), now) in hidden.into_iter().zip(now) {
                if now.is_some_and(|now| now != *api && !is_taken(node, &now)) {
                    elsewhere.insert(api);
                }
            }
        }
        for api in elsewhere.into_iter().take(ASKED_MOST) {
            if master.is_dead(port_of(api)).await {
                ended.insert(api.clone());
            }
        }
        Ok(ended)
    }

    /// Brings the master to `target`, makes sure of that, and sets `token` in it. Returns the state that the master
    /// holds then.
    async fn bring(
        &self,
        master: &mut impl Contact,
        target: &Target,
        token: &Token,
        ready: Option<Prepared>,
        examination: &mut Examination,
    ) -> Result<Master, ExamineError> {
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
                plan: plan.into(),
            }
        });
        let mut before: Option<(Master, Master)> = None;
        let mut round = 0;
        loop {
            round += 1;
            let Prepared { plan, complete, .. } = next;
            tracing::debug!(round, bytes = plan.request().len(), complete, "injecting");
            let raw = master.inject(&plan).await?;
            examination.skipped = plan.skipped().iter().map(ToString::to_string).collect();
            let Err(mut deviation) = verdict(&plan, &raw)? else {
                examination.mismatches.clear();
                let held = plan.expected().clone();
                if !complete || held.is_inexact() {
                    self.ledger.rebase(token, held.clone());
                }
                self.injected(&plan, round);
                return Ok(held);
            };
            // What the master holds now replaces what was expected, and the missing part is injected again.
            let first = self.read_first(master).await?;
            if first.bears() != TokenState::Present && deviation.failed.is_empty() {
                deviation.failed.push("the token is missing".to_owned());
            }
            let now = master.read_second(first, plan.expected()).await?;
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
                self.ledger.rebase(token, now.clone());
                self.injected(&plan, ROUNDS);
                return Ok(now);
            }
            next = Prepared {
                basis: None,
                complete: false,
                plan: repair.into(),
            };
            before = Some((wanted, now));
        }
    }

    /// Notes that the master has got `plan` in this round.
    fn injected(&self, plan: &Plan, round: u32) {
        tracing::debug!(skipped = plan.skipped().len(), "injected");
        if round > 1 {
            // Another program changes the master, and may have done so once more.
            self.ledger.doubt();
        }
    }

    async fn read_first(&self, master: &mut impl Contact) -> Result<Inspection, ExamineError> {
        let mut first = master.read_first(&self.ledger.token()).await?;
        if !master.python().keeps_order() {
            self.ledger.with_mirror(|mirror| first.arrange_like(mirror));
        }
        Ok(first)
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

/// Logs the differences between the master and the mirror.
fn log_difference(difference: &[String]) {
    if !difference.is_empty() {
        rarely!(
            warn,
            ?difference,
            "the master was changed directly, bypassing rosrescue, and the mirror now follows it; set ROS_MASTER_URI to rosrescue's address everywhere"
        );
    }
}

/// Logs the differences between a living master and the checkpoint.
fn log_newer_master(difference: &[String]) {
    if !difference.is_empty() {
        rarely!(
            warn,
            ?difference,
            "the master's state is newer than the checkpoint, so it is kept; possible reasons: the disk was full, the checkpoint is an old copy, or the master was changed directly"
        );
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    #[tokio::test]
    async fn an_injection_is_prepared_again_only_after_an_examination_has_taken_it() {
        let begun = Cell::new(0);
        let in_advance = InAdvance::default();
        let begin = || {
            in_advance.begin(|| {
                begun.set(begun.get() + 1);
                crate::task::spawn_blocking(|| Prepared {
                    basis: None,
                    plan: Plan::new(&Master::default(), &Master::default(), &Token::new("s", 1))
                        .into(),
                    complete: true,
                })
            });
        };
        begin();
        // The first connection was to the dying master, whose examination takes nothing.
        begin();
        assert_eq!(begun.get(), 1);
        assert!(in_advance.take().await.is_some());
        begin();
        assert_eq!(begun.get(), 2);
        in_advance.forget();
        assert!(in_advance.take().await.is_none());
    }
}
