//! Watches the nodes: notifies them, asks unreachable and new ones, and runs the regular health check. Keeps facts about
//! them that their registrations do not contain.

pub(crate) mod addresses;
pub(crate) mod client;
pub(crate) mod health_check;
mod identify;
pub(crate) mod liveness;
pub(crate) mod local;
pub(crate) mod notifications;
pub(crate) mod origin;
mod removed;
pub(crate) mod served;
mod visits;

use std::{
    collections::HashSet,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use rescue_core::{
    health::{Unreachable, port_of},
    order::{BesideMaster, Subject},
};
use tokio::sync::Notify;
use tracing::Instrument;

use self::{
    client::Reaction,
    health_check::CheckResult,
    identify::{IDENTIFY_AFTER, New},
    liveness::LivenessEvidence,
    local::LocalNodes,
    notifications::Notifications,
    removed::Removed,
    served::Served,
    visits::Visits,
};
use crate::{
    gate::{self, State},
    ledger::{
        Ledger,
        activity::NotifyingChange,
        owed::{Queued, Telling},
    },
    limit::rarely,
    resolver,
    status::{report::HealthCheck, stats::Stats},
    wait,
    write_queue::WriteQueue,
};

/// How long the master must be away before rosrescue sends the notifications that the master may not have sent. Most
/// masters that only closed an idle connection are back by then.
const OWED_AFTER: Duration = Duration::from_millis(50);

/// Pause between two health checks with `--reap all`.
const REAP_INTERVAL: Duration = Duration::from_secs(30);

/// Maximum number of nodes that are remembered because they do not answer `paramUpdate`.
const MUTE_MOST: usize = 1024;

/// What rosrescue knows of the nodes beyond their registrations.
pub struct Nodes {
    ledger: Arc<Ledger>,
    pub(crate) gate: gate::Rx,
    write_queue: WriteQueue,
    stats: &'static Stats,
    /// How long a node may take to answer.
    timeout: Duration,
    pub(super) notifications: Notifications,
    visits: Visits,
    liveness: LivenessEvidence,
    pub(crate) local: Arc<LocalNodes>,
    new: New,
    unreachable: Mutex<Unreachable>,
    /// Ports of nodes that answer other calls but not `paramUpdate`.
    mute: Mutex<HashSet<String>>,
    pub(crate) removed: Removed,
    /// Whether this computer is cut off from the other computers.
    alone: AtomicBool,
    served: Served,
    /// Number of recoveries whose health check is still running.
    checks: AtomicUsize,
    /// Number of questions of health checks that nodes have not answered yet.
    pub(super) unanswered: AtomicUsize,
    changed: Notify,
}

impl Nodes {
    /// Creates the state for the nodes of `ledger`. `timeout` is how long a node may take to
    /// answer. `served` are the hosts whose nodes use this rosrescue as their master. `local` are the nodes of this
    /// computer.
    pub(crate) fn new(
        ledger: Arc<Ledger>,
        write_queue: WriteQueue,
        stats: &'static Stats,
        timeout: Duration,
        served: Served,
        local: Arc<LocalNodes>,
    ) -> Self {
        Self {
            gate: ledger.gate(),
            ledger,
            write_queue,
            stats,
            timeout,
            notifications: Notifications::default(),
            visits: Visits::default(),
            liveness: LivenessEvidence::default(),
            local,
            new: New::default(),
            unreachable: Mutex::default(),
            mute: Mutex::default(),
            removed: Removed::default(),
            alone: AtomicBool::new(false),
            served,
            checks: AtomicUsize::new(0),
            unanswered: AtomicUsize::new(0),
            changed: Notify::new(),
        }
    }

    /// Sets whether this computer is cut off from the other computers.
    pub(crate) fn set_alone(&self, alone: bool) {
        self.alone.store(alone, Ordering::Relaxed);
    }

    /// Whether the node at `port` may be notified. At a loopback address of another computer's node, a stranger would get
    /// the notification. A computer that is cut off does not notify nodes of other computers,
    /// because the leader notifies those nodes.
    pub(super) async fn may_notify(&self, port: &str) -> bool {
        let may_notify = !self.alone.load(Ordering::Relaxed)
            || self.served.serves_host_of(port)
            || !resolver::is_elsewhere(port, self.timeout).await;
        may_notify && self.leads_to_node(port).await
    }

    fn lock(&self) -> MutexGuard<'_, Unreachable> {
        self.unreachable
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    pub fn is_unreachable(&self, port: &str) -> bool {
        self.lock().contains(port)
    }

    fn lock_mute(&self) -> MutexGuard<'_, HashSet<String>> {
        self.mute.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the node at `port` answers other calls but not `paramUpdate`.
    fn is_mute(&self, port: &str) -> bool {
        self.lock_mute().contains(port)
    }

    fn set_mute(&self, port: &str, is_mute: bool) {
        let mut mute = self.lock_mute();
        if !is_mute {
            mute.remove(port);
        } else if mute.len() < MUTE_MOST {
            mute.insert(port.to_owned());
        }
    }

    /// The names of the unreachable nodes, whose ports did not answer.
    pub fn unreachable(&self) -> Vec<String> {
        // The clone releases this lock before the ledger's lock is taken.
        let unreachable = self.lock().clone();
        let mut names: Vec<String> = self.ledger.with_mirror(|mirror| {
            let nodes = mirror.nodes();
            let nodes = nodes.filter(|(name, api)| {
                let from = mirror.registered_from(name);
                unreachable.contains(port_of(api))
                    && mirror.is_listed(name)
                    && self.local.reach(port_of(api), from).answer_counts()
            });
            nodes.map(|(name, _)| name.to_owned()).collect()
        });
        names.sort();
        names
    }

    /// Notes that the node at `port` did not answer a notification or, if `in_check` is true, a health check.
    pub(super) fn mark_unreachable(&self, port: &str, in_check: bool) {
        let now = Instant::now();
        let new = self.lock().add(port, now, in_check);
        // This node may have to be asked again before all other unreachable nodes.
        self.changed.notify_one();
        if !new {
            return;
        }
        tracing::debug!(port, "a node does not answer");
        if self.update_notifying() {
            // The master may call this node before it notifies other nodes of recent changes, and wait for its answer.
            self.ledger
                .with_activity(|_, activity| activity.repeat_changes(now));
            self.ledger.wake_nodes.notify_one();
        }
    }

    /// Notes that the node at `port` has answered or is gone. Returns whether it was unreachable.
    pub(super) fn clear(&self, port: &str) -> bool {
        let was = self.lock().remove(port);
        if was {
            self.update_notifying();
        }
        was
    }

    /// Decides whether rosrescue notifies nodes in addition to the master. It does so while a node is unreachable or
    /// the health check of a recovery runs. Returns whether it begins now.
    fn update_notifying(&self) -> bool {
        // Only here is the ledger's lock taken while this lock is held. Otherwise an older result could be stored last.
        let unreachable = self.lock();
        let notifying = !unreachable.is_empty() || self.checks.load(Ordering::Relaxed) > 0;
        self.ledger
            .with_activity(|_, activity| activity.set_notifying(notifying))
            && notifying
    }

    /// Makes rosrescue notify nodes in addition to the master until the result is dropped. Until the end of the health
    /// check it is unknown which nodes are unreachable and hold up the master's notifications.
    pub(super) fn begin_check(nodes: &Arc<Self>) -> CheckUnderWay {
        nodes.checks.fetch_add(1, Ordering::Relaxed);
        nodes.update_notifying();
        CheckUnderWay(nodes.clone())
    }
}

/// The health check of a recovery, until it ends. Until this value is dropped, rosrescue notifies nodes in addition to
/// the master.
pub(super) struct CheckUnderWay(Arc<Nodes>);

impl Drop for CheckUnderWay {
    fn drop(&mut self) {
        self.0.checks.fetch_sub(1, Ordering::Relaxed);
        self.0.update_notifying();
    }
}

/// Watches the nodes as long as it is polled: sends notifications, asks unreachable nodes again, identifies new nodes,
/// and runs the regular health check.
pub(crate) async fn watch(nodes: Arc<Nodes>) {
    let first_check = tokio::time::Instant::now() + REAP_INTERVAL;
    let mut reaping = nodes
        .local
        .is_regular_check_enabled()
        .then(|| tokio::time::interval_at(first_check, REAP_INTERVAL));
    let mut repeats = BesideMaster::<NotifyingChange>::default();
    let mut gate = nodes.gate.clone();
    // When to send the notifications that the absent master may not have sent, and whether they were sent.
    let (mut owed_at, mut owed_told) = (None, false);
    loop {
        let next = nodes.lock().next().map(Into::into);
        let new = nodes
            .ledger
            .with_activity(|_, activity| activity.next_unidentified());
        let tell_again_at = nodes.ledger.with_order(|order, _| order.next_repeat());
        let identify_at = new.map(|since| (since + IDENTIFY_AFTER).into());
        tokio::select! {
            () = nodes.ledger.wake_nodes.notified() => handle_unseen(&nodes, &mut repeats),
            () = wait::sleep_until(tell_again_at.map(Into::into)) => {
                nodes.ledger.with_order(|order, _| order.queue_due_repeats(Instant::now()));
                notifications::send_waiting(&nodes);
            }
            () = gate.changed() => match gate.observe() {
                State::StandingIn if !owed_told => {
                    owed_at.get_or_insert_with(|| tokio::time::Instant::now() + OWED_AFTER);
                }
                State::Open { .. } => (owed_at, owed_told) = (None, false),
                _ => {}
            },
            () = wait::sleep_until(owed_at) => {
                let now = Instant::now();
                let again = nodes.ledger.with_order(|order, _| order.master_is_away(now));
                (owed_at, owed_told) = (again.map(Into::into), again.is_none());
                if owed_told {
                    notify_owed(&nodes, now, Telling::Now);
                }
            }
            () = wait::sleep_until(next) => ask_unreachable(&nodes),
            () = wait::sleep_until(repeats.next().map(Into::into)) => {
                let unanswered = nodes.unanswered.load(Ordering::Relaxed) > 0;
                let holding_up = unanswered || !nodes.lock().is_empty();
                for change in repeats.take_due(Instant::now(), holding_up) {
                    notify_of_change(&nodes, change);
                }
            }
            () = nodes.changed.notified() => {}
            () = wait::sleep_until(identify_at) => identify::new_nodes(&nodes),
            () = wait::tick(&mut reaping) => {
                if nodes.gate.is_open() {
                    let check = reap(nodes.clone());
                    crate::task::spawn(check.instrument(tracing::debug_span!("health_check")));
                }
            }
        }
    }
}

fn handle_unseen(nodes: &Arc<Nodes>, repeats: &mut BesideMaster<NotifyingChange>) {
    let unseen = nodes
        .ledger
        .with_activity(|_, activity| activity.take_unseen());
    notifications::send_waiting(nodes);
    for displaced in unseen.displaced {
        notifications::shut_down(nodes, displaced);
    }
    for change in unseen.changes {
        repeats.changed(change, Instant::now());
    }
}

/// Sends the notifications that may not have been sent by the master that was lost at `outage`. Returns their topics.
/// Also begins to shut down nodes whose names other nodes have taken, if that master may have died before it asked them
/// to.
pub(super) fn notify_owed(nodes: &Arc<Nodes>, outage: Instant, telling: Telling) -> Vec<String> {
    let Queued { topics, displaced } = nodes.ledger.queue_owed(Instant::now(), outage, telling);
    for displaced in displaced {
        notifications::shut_down(nodes, displaced);
    }
    notifications::send_waiting(nodes);
    topics
}

/// Tells all subscribers the state: an earlier rosrescue of this session has ended, and may have owed them
/// notifications. Also begins to shut down nodes whose names other nodes have taken.
pub(crate) fn notify_after_restart(nodes: &Arc<Nodes>) {
    let now = Instant::now();
    nodes
        .ledger
        .with_activity(|mirror, activity| activity.notice_all(mirror, now));
    notify_owed(nodes, now, Telling::Now);
}

fn notify_of_change(nodes: &Arc<Nodes>, change: NotifyingChange) {
    match change {
        NotifyingChange::Param(api, key) => {
            notifications::notify_node(nodes, &api, Subject::Param(key.to_string()));
        }
        NotifyingChange::Topic(topic) => {
            notifications::notify_subscribers(nodes, &topic);
        }
    }
}

fn ask_unreachable(nodes: &Arc<Nodes>) {
    let registered = nodes.ledger.with_mirror(|mirror| {
        let ports = mirror.nodes().map(|(_, api)| port_of(api).to_owned());
        ports.collect::<HashSet<_>>()
    });
    let due = {
        let mut unreachable = nodes.lock();
        unreachable.retain(|port| registered.contains(port));
        unreachable.take_due(Instant::now())
    };
    nodes.update_notifying();
    for port in due {
        let nodes = nodes.clone();
        crate::task::spawn(async move {
            let outcome = health_check::begin_visit(&nodes, port, false).await;
            match outcome.sign {
                Reaction::Alive => log_visit(&outcome, "an unreachable node answers again"),
                Reaction::Dead if !outcome.removed.is_empty() => log_visit(
                    &outcome,
                    "unregistered a dead node: its port refuses connections",
                ),
                Reaction::Dead | Reaction::Silent => {}
            }
        });
    }
}

fn log_visit(outcome: &CheckResult, what: &str) {
    let CheckResult {
        removed,
        reconciled,
        ..
    } = outcome;
    let names = &outcome.names;
    rarely!(info, ?names, ?removed, ?reconciled, "{what}");
}

/// Runs the regular health check.
async fn reap(nodes: Arc<Nodes>) {
    let HealthCheck {
        removed,
        reconciled,
        ..
    } = health_check::check_all(&nodes).await;
    if !removed.is_empty() || !reconciled.is_empty() {
        rarely!(
            info,
            ?removed,
            ?reconciled,
            "the regular health check has corrected registrations in the master"
        );
    }
}
