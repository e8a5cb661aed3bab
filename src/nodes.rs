//! What is known of the nodes beyond their registrations, and the watch over it.

pub(crate) mod client;
pub(crate) mod health_check;
pub(crate) mod notifications;

use std::{
    collections::HashSet,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use tokio::sync::Notify;
use tracing::Instrument;

use self::{client::Sign, health_check::CheckResult, notifications::Notifications};
use crate::{
    gate::{self, State},
    health::{Repeats, Unreachable},
    ledger::{
        Ledger,
        activity::{Change, Notification, Owed},
    },
    master,
    status::{report::HealthCheck, stats::Stats},
    wait,
    write_queue::WriteQueue,
};

/// A node is asked for its process id this long after its last registration: starting nodes are busy.
const IDENTIFY_AFTER: Duration = Duration::from_secs(2);
/// How long the master must be away before rosrescue sends the notifications that it may not have sent. Most
/// masters that only closed an idle connection are back by then.
const OWED_AFTER: Duration = Duration::from_millis(50);

/// What is known of the nodes beyond their registrations.
pub struct Nodes {
    ledger: Arc<Ledger>,
    gate: gate::Rx,
    write_queue: WriteQueue,
    stats: &'static Stats,
    /// How long a node may take to answer.
    timeout: Duration,
    pub(super) notifications: Notifications,
    unreachable: Mutex<Unreachable>,
    /// Recoveries whose health check is not over.
    checks: AtomicUsize,
    /// Nodes that have not been asked yet, or have not answered yet.
    pub(super) unanswered: AtomicUsize,
    changed: Notify,
}

impl Nodes {
    /// `ledger` knows the nodes. `timeout`: how long one may take to answer.
    pub fn new(
        ledger: Arc<Ledger>,
        gate: gate::Rx,
        write_queue: WriteQueue,
        stats: &'static Stats,
        timeout: Duration,
    ) -> Self {
        Self {
            ledger,
            gate,
            write_queue,
            stats,
            timeout,
            notifications: Notifications::default(),
            unreachable: Mutex::default(),
            checks: AtomicUsize::new(0),
            unanswered: AtomicUsize::new(0),
            changed: Notify::new(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Unreachable> {
        self.unreachable
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    pub fn is_unreachable(&self, api: &str) -> bool {
        self.lock().contains(api)
    }

    /// The names of the nodes that are unreachable.
    pub fn unreachable(&self) -> Vec<String> {
        // Never hold both locks here.
        let unreachable = self.lock().clone();
        let mut names: Vec<String> = self.ledger.with_mirror(|mirror| {
            let nodes = mirror.nodes().filter(|(_, api)| unreachable.contains(api));
            nodes.map(|(name, _)| name.to_owned()).collect()
        });
        names.sort();
        names
    }

    /// The node at `api` did not answer.
    pub(super) fn mark_unreachable(&self, api: &str) {
        let now = Instant::now();
        if !self.lock().add(api, now) {
            return;
        }
        tracing::debug!(api, "a node does not answer");
        self.changed.notify_one();
        if self.update_notifying() {
            // The master may be about to notify this very node of recent changes, before all others.
            self.ledger
                .with_activity(|_, activity| activity.repeat_changes(now));
            self.ledger.outbox_changed.notify_one();
        }
    }

    /// The node at `api` has answered, or is gone. Returns whether it was unreachable.
    pub(super) fn clear(&self, api: &str) -> bool {
        let was = self.lock().remove(api);
        if was {
            self.update_notifying();
        }
        was
    }

    /// rosrescue notifies nodes beside the master while a node is unreachable, or a check is under way.
    /// Returns whether that begins now.
    fn update_notifying(&self) -> bool {
        // Nested locks, only here: otherwise an older result could be stored last.
        let unreachable = self.lock();
        let notifying = !unreachable.is_empty() || self.checks.load(Ordering::Relaxed) > 0;
        self.ledger
            .with_activity(|_, activity| activity.set_notifying(notifying))
            && notifying
    }

    /// rosrescue notifies nodes beside the master until the result is dropped: it is not known yet which
    /// nodes are unreachable.
    pub(super) fn begin_check(nodes: &Arc<Self>) -> CheckUnderWay {
        nodes.checks.fetch_add(1, Ordering::Relaxed);
        nodes.update_notifying();
        CheckUnderWay(nodes.clone())
    }
}

/// The health check of a recovery.
pub(super) struct CheckUnderWay(Arc<Nodes>);

impl Drop for CheckUnderWay {
    fn drop(&mut self) {
        self.0.checks.fetch_sub(1, Ordering::Relaxed);
        self.0.update_notifying();
    }
}

/// Watches the nodes as long as it is polled: sends notifications, asks unreachable nodes again, identifies
/// new nodes, and runs the regular health check.
pub(crate) async fn watch(nodes: Arc<Nodes>, reap_interval: Option<Duration>) {
    let mut reaping = reap_interval
        .map(|pause| tokio::time::interval_at(tokio::time::Instant::now() + pause, pause));
    let mut repeats = Repeats::<Change>::default();
    let mut gate = nodes.gate.clone();
    // When to send what the absent master may not have sent, and whether that is done.
    let (mut owed_at, mut owed_told) = (None, false);
    loop {
        let next = nodes.lock().next().map(Into::into);
        let new = nodes
            .ledger
            .with_activity(|_, activity| activity.next_unidentified());
        let identify_at = new.map(|since| (since + IDENTIFY_AFTER).into());
        tokio::select! {
            () = nodes.ledger.outbox_changed.notified() => empty_outbox(&nodes, &mut repeats),
            () = gate.changed() => match gate.look() {
                State::StandingIn if !owed_told => {
                    owed_at.get_or_insert_with(|| tokio::time::Instant::now() + OWED_AFTER);
                }
                State::Open { .. } => (owed_at, owed_told) = (None, false),
                _ => {}
            },
            () = wait::until(owed_at) => {
                (owed_at, owed_told) = (None, true);
                notify_owed(&nodes, Instant::now());
            }
            () = wait::until(next) => ask_unreachable(&nodes),
            () = wait::until(repeats.next().map(Into::into)) => {
                let unanswered = nodes.unanswered.load(Ordering::Relaxed) > 0;
                let holding_up = unanswered || !nodes.lock().is_empty();
                for change in repeats.due(Instant::now(), holding_up) {
                    tell(&nodes, change);
                }
            }
            // A new unreachable node may be due before the others.
            () = nodes.changed.notified() => {}
            () = wait::until(identify_at) => identify_new_nodes(&nodes),
            () = wait::tick(&mut reaping) => {
                if nodes.gate.is_open() {
                    let check = reap(nodes.clone());
                    tokio::spawn(check.instrument(tracing::debug_span!("health_check")));
                }
            }
        }
    }
}

fn empty_outbox(nodes: &Arc<Nodes>, repeats: &mut Repeats<Change>) {
    let outbox = nodes
        .ledger
        .with_activity(|_, activity| activity.take_outbox());
    for (api, call) in outbox.calls {
        notifications::send(nodes, &api, Notification::Call(call));
    }
    for displaced in outbox.displaced {
        notifications::shut_down(nodes, displaced);
    }
    for change in outbox.changes {
        repeats.changed(change, Instant::now());
    }
}

/// Sends the notifications that a master lost at `outage` may not have sent. Returns their topics.
pub(super) fn notify_owed(nodes: &Arc<Nodes>, outage: Instant) -> Vec<String> {
    let Owed {
        mut topics,
        params,
        displaced,
    } = nodes
        .ledger
        .with_activity(|_, activity| activity.take_owed(outage));
    topics.retain(|topic| notifications::notify_subscribers(nodes, topic));
    for (api, key) in params {
        notifications::send(nodes, &api, Notification::Param(key));
    }
    for displaced in displaced {
        notifications::shut_down(nodes, displaced);
    }
    topics
}

fn tell(nodes: &Arc<Nodes>, change: Change) {
    match change {
        Change::Param(api, key) => notifications::send(nodes, &api, Notification::Param(key)),
        Change::Topic(topic) => {
            notifications::notify_subscribers(nodes, &topic);
        }
    }
}

fn ask_unreachable(nodes: &Arc<Nodes>) {
    let registered = nodes.ledger.with_mirror(|mirror| {
        let apis = mirror.nodes().map(|(_, api)| api.to_owned());
        apis.collect::<HashSet<_>>()
    });
    let due = {
        let mut unreachable = nodes.lock();
        unreachable.retain(|api| registered.contains(api));
        unreachable.due(Instant::now())
    };
    nodes.update_notifying();
    for api in due {
        let nodes = nodes.clone();
        tokio::spawn(async move {
            let outcome = health_check::visit(&nodes, api).await;
            if outcome.sign != Sign::Silent {
                say(&outcome, "an unreachable node answers again");
            }
        });
    }
}

fn say(outcome: &CheckResult, what: &str) {
    let CheckResult {
        removed,
        reconciled,
        ..
    } = outcome;
    let names = &outcome.names;
    tracing::info!(?names, ?removed, ?reconciled, "{what}");
}

/// Asks newly registered nodes for their process ids. A different process id at the same port will mean a
/// different node.
fn identify_new_nodes(nodes: &Arc<Nodes>) {
    let Some(before) = Instant::now().checked_sub(IDENTIFY_AFTER) else {
        return;
    };
    let new = nodes.ledger.with_activity(|mirror, activity| {
        let new = activity.take_unidentified(before).into_iter();
        let new = new.filter_map(|name| {
            let api = mirror.api_of(&name)?.to_owned();
            let registered = activity.last_calls(&name).registered;
            Some((name, api, registered))
        });
        new.collect::<Vec<_>>()
    });
    for (name, api, registered) in new {
        let nodes = nodes.clone();
        tokio::spawn(async move {
            let permit = health_check::permit().await;
            let answer = client::ask_for(&api, &master::get_pid(), nodes.timeout).await;
            drop(permit);
            if let Some(pid) = answer.1.and_then(|pid| pid.as_int()) {
                nodes.ledger.with_activity(|_, activity| {
                    activity.remember_pid(&name, &api, registered, pid);
                });
            }
        });
    }
}

/// The regular health check.
async fn reap(nodes: Arc<Nodes>) {
    let HealthCheck {
        removed,
        reconciled,
        ..
    } = health_check::check_all(&nodes).await;
    if !removed.is_empty() || !reconciled.is_empty() {
        tracing::info!(?removed, ?reconciled, "health check");
    }
}
