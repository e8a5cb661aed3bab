//! Brings a connected master to the mirror's state, or the mirror to the master's.

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use thiserror::Error;
use tokio::task::JoinHandle;

use super::{beside, report::Outcome, set_aside};
use crate::{
    lifecycle::{InFlight, Input, Trial},
    master::{CALLER_ID, Careful, Counts, FirstLook, Master, Plan},
    proxy::{
        Proxy,
        gate::{Keeper, StandIn, State},
        look::{self, LookError},
        upstream::{CallError, Connection},
    },
    xmlrpc::Call,
};

/// How long an injection may take. 1000 nodes take 0.3 s on a Xeon.
const INJECTION_LIMIT: Duration = Duration::from_secs(60);
/// A master that differs from what was injected is looked at and mended so often.
const ROUNDS: u32 = 3;

/// A master that could not be examined.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ExamineError {
    /// It does not answer.
    #[error("no answer within {limit:?}")]
    Silent {
        /// The deadline.
        limit: Duration,
    },
    /// A call of ours failed, or what answers is no master.
    #[error(transparent)]
    Look(#[from] LookError),
}

impl From<CallError> for ExamineError {
    fn from(error: CallError) -> Self {
        Self::Look(error.into())
    }
}

impl ExamineError {
    /// What it means for the lifecycle.
    pub fn as_input(&self) -> Input {
        match self {
            Self::Silent { .. } => Input::Unreachable,
            Self::Look(LookError::Call(
                CallError::NotSent(error) | CallError::MaybeSent(error),
            )) if !error.is_parse() => Input::ConnectionLost,
            Self::Look(_) => Input::NotAMaster,
        }
    }
}

/// What an examination came to.
#[derive(Debug)]
pub struct Examination {
    /// How the master came to hold the state.
    pub outcome: Outcome,
    /// The master's process id.
    pub pid: i32,
    /// What it holds.
    pub counts: Counts,
    /// What was not injected, and why.
    pub skipped: Vec<String>,
    /// What was set aside because each new master died of it.
    pub set_aside: Vec<String>,
    /// Where it differs nevertheless.
    pub mismatches: Vec<String>,
    /// How long the look took.
    pub look: Duration,
    /// How long the injection took.
    pub injection: Duration,
}

/// What the master is at; outlives the examination, which ends with the master.
#[derive(Clone, Debug, Default)]
pub struct Progress(Arc<Mutex<InFlight>>);

impl Progress {
    fn set(&self, at: InFlight) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = at;
    }

    /// What it was at; nothing from now on.
    pub fn take(&self) -> InFlight {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// How an examination is to go.
#[derive(Debug)]
pub struct Manner {
    /// What is known of the master.
    pub known: Known,
    /// The injection into an empty master, made ready.
    pub prepared: Option<JoinHandle<Prepared>>,
    /// How to inject carefully, if that is to be done.
    pub trial: Option<Trial>,
    /// Where to say what the master is at.
    pub progress: Progress,
}

/// An injection into an empty master, made ready while the new master starts.
#[derive(Debug)]
pub struct Prepared {
    version: u64,
    plan: Plan,
    /// Whether such a master holds exactly what the mirror holds.
    complete: bool,
}

impl Prepared {
    fn new(proxy: &Proxy, version: u64, target: &Master, found: &Master) -> Self {
        let plan = Plan::new(target, found, &proxy.mark);
        Self {
            version,
            complete: plan.expected() == target,
            plan,
        }
    }
}

/// Makes an injection ready beside everything else.
pub fn prepare(proxy: &Arc<Proxy>) -> JoinHandle<Prepared> {
    let proxy = proxy.clone();
    tokio::task::spawn_blocking(move || {
        let version = proxy.shadow.version();
        let target = proxy.shadow.with_mirror(Clone::clone);
        Prepared::new(&proxy, version, &target, &Master::default())
    })
}

/// What is known of a master before it is examined.
#[derive(Clone, Copy, Debug)]
pub enum Known {
    /// Nothing.
    Nothing,
    /// If it bears the mark, this process has served it before.
    ServedIfMarked,
    /// If it bears the mark, it has been injected, and nobody has seen it answer.
    InjectedIfMarked,
    /// This process has just started it, as the successor of one that it served, on a loopback port
    /// that was free: it is empty. That saves a look, and reading back would show if it were not.
    New {
        /// Its process id.
        pid: i32,
    },
}

/// Examines the master behind `connection`.
pub async fn examine(
    proxy: &Arc<Proxy>,
    keeper: &Keeper,
    connection: &mut Connection,
    manner: Manner,
) -> Result<Examination, ExamineError> {
    let start = Instant::now();
    let mut first = match manner.known {
        Known::New { pid } => FirstLook::at_new(pid),
        Known::Nothing | Known::ServedIfMarked | Known::InjectedIfMarked => {
            first_look(proxy, connection).await?
        }
    };
    // From here to the open gate the mirror must not change: the master is compared with it.
    proxy.shadow.set_frozen(true);
    if keeper.state() == State::Shut(StandIn::Unregistrations) {
        keeper.set(State::Shut(StandIn::Reads));
    }
    // What bears the mark has heard our calls before, however little it holds by now.
    if (first.marked() || !first.is_empty()) && pay_owed(proxy, connection).await? {
        first = first_look(proxy, connection).await?;
    }
    let mut examination = Examination {
        outcome: Outcome::Resumed,
        pid: first.pid(),
        counts: Counts::default(),
        skipped: Vec::new(),
        set_aside: Vec::new(),
        mismatches: Vec::new(),
        look: start.elapsed(),
        injection: Duration::ZERO,
    };
    if !first.marked() {
        inject(proxy, connection, first, manner, start, &mut examination).await?;
    } else if !matches!(manner.known, Known::ServedIfMarked) {
        let previous = proxy.shadow.with_mirror(Clone::clone);
        let held = second_look(proxy, first, connection, &previous).await?;
        proxy.shadow.succeed();
        let difference = proxy.shadow.adopt(held);
        if !difference.is_empty() {
            tracing::info!(
                ?difference,
                "the master went on without us; the mirror follows it"
            );
        }
        examination.outcome = match manner.known {
            Known::Nothing => Outcome::Adopted,
            _ => Outcome::Injected,
        };
        examination.look = start.elapsed();
    }
    examination.injection = start.elapsed().saturating_sub(examination.look);
    examination.counts = proxy.shadow.with_mirror(Master::counts);
    Ok(examination)
}

/// Tells the master of the unregistrations that were taken while it did not answer. Answers whether
/// there were any.
async fn pay_owed(proxy: &Proxy, connection: &mut Connection) -> Result<bool, ExamineError> {
    let owed = proxy.shadow.owed();
    if owed.is_empty() {
        return Ok(false);
    }
    let count = owed.len();
    while_alive(proxy, connection.call(&Call::multicall(owed))).await?;
    proxy.shadow.paid(count);
    Ok(true)
}

async fn inject(
    proxy: &Arc<Proxy>,
    connection: &mut Connection,
    first: FirstLook,
    manner: Manner,
    start: Instant,
    examination: &mut Examination,
) -> Result<(), ExamineError> {
    proxy.shadow.succeed();
    let target = || proxy.shadow.with_mirror(Clone::clone);
    let empty = first.is_empty();
    let ready = match manner.prepared {
        Some(prepared) if empty => prepared.await.ok(),
        _ => None,
    };
    let found = match empty {
        true => Master::default(),
        false => second_look(proxy, first, connection, &Master::default()).await?,
    };
    examination.look = start.elapsed();
    // Nothing of ours to bring: a running system is taken over.
    let takes_over = !found.is_empty() && proxy.shadow.with_mirror(Master::is_empty);
    examination.outcome = if takes_over {
        Outcome::Adopted
    } else if proxy.shadow.with_mirror(Master::is_empty) {
        Outcome::Begun
    } else {
        Outcome::Injected
    };
    if let Some(trial) = &manner.trial {
        let progress = &manner.progress;
        return inject_carefully(
            proxy,
            connection,
            found,
            trial,
            progress,
            start,
            examination,
        )
        .await;
    }
    let version = proxy.shadow.version();
    let mut next = ready
        .filter(|ready| ready.version == version)
        .unwrap_or_else(|| Prepared::new(proxy, version, &target(), &found));
    for round in 1..=ROUNDS {
        let Prepared { plan, complete, .. } = next;
        manner.progress.set(InFlight::Whole);
        let reply = connection.foretold(plan.request().clone(), plan.answer());
        let raw = while_alive(proxy, reply).await?;
        manner.progress.take();
        examination.skipped = plan.skipped().iter().map(ToString::to_string).collect();
        // The reply is long, and everybody waits: it is decoded only if it differs from the
        // predicted one at all.
        let verdict = match raw.body == plan.answer() {
            true => Ok(()),
            false => plan.verify(&raw.decode()?),
        };
        let Err(mismatches) = verdict else {
            examination.mismatches.clear();
            if !complete {
                proxy.shadow.adopt(plan.expected().clone());
            }
            proxy.stats.injections.count();
            // Thousands of small pieces, freed beside traffic.
            tokio::task::spawn_blocking(move || drop(plan));
            return Ok(());
        };
        examination.mismatches = mismatches.iter().map(ToString::to_string).collect();
        tracing::error!(
            round,
            mismatches = ?examination.mismatches,
            "the master differs from what was injected"
        );
        // The truth of the master wins over what we expected of it; the rest is tried again.
        let first = first_look(proxy, connection).await?;
        let found = second_look(proxy, first, connection, plan.expected()).await?;
        next = Prepared::new(proxy, version, &target(), &found);
        if round == ROUNDS {
            proxy.shadow.adopt(found);
        }
    }
    Ok(())
}

/// Injects entry by entry, because masters have died of it.
async fn inject_carefully(
    proxy: &Arc<Proxy>,
    connection: &mut Connection,
    mut found: Master,
    trial: &Trial,
    progress: &Progress,
    start: Instant,
    examination: &mut Examination,
) -> Result<(), ExamineError> {
    let target = proxy.shadow.with_mirror(Clone::clone);
    let tested = trial.tested.as_ref().map(|(call, _)| call);
    for round in 1..=ROUNDS {
        progress.set(InFlight::NoRecord);
        let plan = Careful::new(&target, &found, &proxy.mark, &trial.left_out, tested);
        examination.skipped = plan.skipped().iter().map(ToString::to_string).collect();
        examination.mismatches.clear();
        let mut index = 0;
        for step in plan.steps() {
            if step.tested
                && let Some((_, age)) = trial.tested
            {
                outlive(proxy, connection, start, age).await?;
            }
            if step.record {
                progress.set(InFlight::Record {
                    call: step.call.clone(),
                    index,
                    age: start.elapsed(),
                });
                index += 1;
            }
            let reply = while_alive(proxy, connection.call(&step.call)).await?;
            progress.set(InFlight::NoRecord);
            if reply != step.predicted {
                let text = format!("{} was answered otherwise than predicted", step.call.method);
                examination.mismatches.push(text);
            }
        }
        if examination.mismatches.is_empty() {
            progress.take();
            // Only now is it known that the rest is harmless.
            examination.set_aside = set_aside::set_aside(proxy, plan.left_out());
            if plan.expected() != &target {
                proxy.shadow.adopt(plan.expected().clone());
            }
            proxy.stats.injections.count();
            return Ok(());
        }
        tracing::error!(
            round,
            mismatches = ?examination.mismatches,
            "the master differs from what was injected"
        );
        let first = first_look(proxy, connection).await?;
        found = second_look(proxy, first, connection, plan.expected()).await?;
    }
    progress.take();
    proxy.shadow.adopt(found);
    Ok(())
}

/// Waits until the master is of this `age`, and keeps it from closing an idle connection.
async fn outlive(
    proxy: &Proxy,
    connection: &mut Connection,
    start: Instant,
    age: Duration,
) -> Result<(), ExamineError> {
    let sign_of_life = Call::new("getPid", vec![CALLER_ID.into()]);
    while let Some(rest) = age
        .checked_sub(start.elapsed())
        .filter(|rest| !rest.is_zero())
    {
        tokio::time::sleep(rest.min(Duration::from_millis(500))).await;
        while_alive(proxy, connection.call(&sign_of_life)).await?;
    }
    Ok(())
}

async fn first_look(proxy: &Proxy, connection: &mut Connection) -> Result<FirstLook, ExamineError> {
    let limit = proxy.config.probe_timeout * proxy.config.probing.count;
    within(limit, look::first(connection, &proxy.mark)).await
}

async fn second_look(
    proxy: &Proxy,
    first: FirstLook,
    connection: &mut Connection,
    previous: &Master,
) -> Result<Master, ExamineError> {
    while_alive(proxy, look::second(first, connection, previous)).await
}

/// Waits for what may take long, as long as the master shows signs of life.
async fn while_alive<T, E: Into<ExamineError>>(
    proxy: &Proxy,
    work: impl Future<Output = Result<T, E>>,
) -> Result<T, ExamineError> {
    tokio::select! {
        done = within(INJECTION_LIMIT, work) => done,
        limit = beside::silence(proxy) => Err(ExamineError::Silent { limit }),
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
