//! The health check: finds out which nodes are alive, whether they are the nodes that registered, and where the mirror
//! differs from what they report.
//!
//! It must not delay any call: a roscpp node that waits for its registration cannot answer rosrescue before that call
//! is done.

use std::{
    collections::{BTreeMap, BTreeSet, HashSet},
    net::SocketAddr,
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use tokio::task::JoinSet;

use super::{
    Nodes,
    client::{self, Interview, Reaction},
    notifications, origin,
};
use crate::status::report::HealthCheck;
use rescue_core::{
    health::{
        IdentityVerdict, Reach, Reconciliation, Refusal, RegisteredName, Registration, judge_node,
        judge_refusal, port_of,
    },
    replay::Token,
};
use ros1_master::{
    master::{self, CALLER_ID, Kind, Master, Method, Request, question},
    xmlrpc::{Reply, Value},
};
use tracing::Instrument;

use crate::{
    gate::State,
    ledger::{activity::LastCalls, owed::Telling},
    resolver,
    ros_env::MasterUri,
    task::boxed,
    write_queue::batch::{self, Precondition},
};

/// Pause before a node is asked again to confirm a removal.
const SECOND_QUESTION: Duration = Duration::from_millis(1200);
/// Maximum number of questions to a node whose answers keep changing.
const QUESTIONS: u32 = 4;
/// Number of nodes whose visits begin in one go. To begin one takes 20 µs, and calls wait meanwhile. If many begin before
/// the first ones go on, calls wait behind all of them.
const BEGUN_AT_ONCE: usize = 8;

/// The result of asking the nodes at one port.
#[derive(Debug)]
pub(crate) struct CheckResult {
    pub(crate) sign: Reaction,
    pub(crate) names: Vec<String>,
    pub(crate) removed: Vec<String>,
    pub(crate) reconciled: Vec<String>,
}

/// Completes a recovery from `outage`, in parallel with traffic: sends the missed notifications and asks all nodes.
/// `None` if the next recovery begins before all nodes were asked.
pub(crate) async fn after_recovery(
    nodes: Arc<Nodes>,
    outage: Instant,
    telling: Telling,
) -> Option<HealthCheck> {
    let under_way = Nodes::begin_check(&nodes);
    // Counts as an unanswered question until the nodes are asked.
    let waiting = Waiting::new(&nodes);
    let mut gate = nodes.gate.clone();
    gate.wait_for(|state| matches!(state, State::Open { .. }))
        .await;
    let start = Instant::now();
    let incarnation = nodes.ledger.incarnation();
    // Queued calls come first, because they are newer than a node's answers.
    barrier(&nodes).await;
    let mut notified = super::notify_owed(&nodes, outage, telling);
    notified.sort();
    let visits = begin_visits(&nodes).await;
    drop(waiting);
    let check = collect(visits).await;
    drop(under_way);
    (nodes.ledger.incarnation() == incarnation).then(|| HealthCheck {
        duration: start.elapsed(),
        notified,
        unreachable: nodes.unreachable(),
        ..check
    })
}

/// Waits until the writes that are queued now have been answered.
async fn barrier(nodes: &Nodes) {
    let last = Request::new(Method::GetPid, [CALLER_ID]);
    // The answer does not matter.
    nodes.write_queue.call(last).await;
}

/// Asks all nodes at the same time, with the limits of [`Visits`](super::visits::Visits).
pub(crate) async fn check_all(nodes: &Arc<Nodes>) -> HealthCheck {
    collect(begin_visits(nodes).await).await
}

async fn begin_visits(nodes: &Arc<Nodes>) -> JoinSet<CheckResult> {
    let mirror = nodes.ledger.with_mirror(Master::clone);
    let mut visits = JoinSet::new();
    let mut visited = HashSet::new();
    for (index, (name, api)) in mirror.nodes().enumerate() {
        if index % BEGUN_AT_ONCE == 0 {
            tokio::task::yield_now().await;
        }
        // The master cannot call addresses that rosrescue cannot call.
        let is_asked = !Token::is_ours(name) && MasterUri::parse(api).is_ok();
        if is_asked && visited.insert(port_of(api)) {
            visits.spawn(boxed(begin_visit(nodes, port_of(api).to_owned(), true)));
        }
    }
    visits
}

async fn collect(mut visits: JoinSet<CheckResult>) -> HealthCheck {
    let mut check = HealthCheck::default();
    while let Some(outcome) = visits.join_next().await {
        if let Ok(outcome) = outcome {
            check.removed.extend(outcome.removed);
            check.reconciled.extend(outcome.reconciled);
        }
    }
    check.removed.sort();
    check.reconciled.sort();
    check
}

/// Asks the node behind `port` until its answers tell, for each node name registered there, whether that node is alive
/// and its registrations are right.
///
/// Nodes whose port refuses connections are unregistered only if `in_check` is true, or if the port has already failed
/// a health check. A port that has only refused a notification keeps its nodes, as with a bare master.
pub(crate) fn begin_visit(
    nodes: &Arc<Nodes>,
    port: String,
    in_check: bool,
) -> impl Future<Output = CheckResult> + Send + 'static {
    let (nodes, waiting) = (nodes.clone(), Waiting::new(nodes));
    let span = tracing::debug_span!("visit", port);
    async move { visit(&nodes, &port, in_check, waiting).await }.instrument(span)
}

async fn visit(nodes: &Arc<Nodes>, port: &str, in_check: bool, waiting: Waiting) -> CheckResult {
    let mut waiting = Some(waiting);
    let mut outcome = CheckResult {
        sign: Reaction::Silent,
        names: Vec::new(),
        removed: Vec::new(),
        reconciled: Vec::new(),
    };
    let mut before = BTreeMap::new();
    let mut refused = None;
    for question in 0..QUESTIONS {
        if question > 0 {
            tokio::time::sleep(SECOND_QUESTION).await;
        }
        let admitted = nodes.visits.admit(port, nodes.timeout).await;
        let asked = Asked::registered_at(nodes, port, &nodes.reaches(port).await);
        if asked.is_empty() {
            nodes.clear(port);
            break;
        }
        let interview = match &admitted {
            Some(_) => client::interview(port, nodes.timeout).await,
            None => Interview::SILENT,
        };
        drop(admitted);
        outcome.sign = interview.sign;
        let names = asked.iter().flat_map(|asked| &asked.names);
        outcome.names = names.map(|name| name.node.clone()).collect();
        match interview.sign {
            Reaction::Silent => {
                nodes.mark_unreachable(port, in_check);
                break;
            }
            Reaction::Dead => {
                drop(waiting.take());
                let calls: Vec<_> = asked.iter().flat_map(Asked::calls).collect();
                let may_unregister =
                    nodes.gate.is_open() && (in_check || nodes.lock().has_failed_check(port));
                match judge_refusal(may_unregister, refused.as_ref(), &calls) {
                    Refusal::AskAgain if question + 1 < QUESTIONS => {
                        refused = Some(calls);
                        continue;
                    }
                    Refusal::Dead => outcome.removed = remove_all(nodes, asked).await,
                    _ => {}
                }
                if Asked::registered_at(nodes, port, &nodes.reaches(port).await).is_empty() {
                    nodes.clear(port);
                } else {
                    tracing::debug!(names = ?outcome.names, "a port refuses connections; its nodes stay registered");
                    nodes.mark_unreachable(port, in_check);
                }
                break;
            }
            Reaction::Alive => {
                refused = None;
                if nodes.clear(port) {
                    // Notifications to this node were held back until now.
                    notifications::notify_ports(nodes, &[port]);
                }
            }
        }
        drop(waiting.take());
        let mut found = BTreeMap::new();
        for asked in asked {
            let mut findings = asked.findings(nodes, &interview);
            if findings.has_missing() && !has_our_master(nodes, &asked.api).await {
                findings.forget_missing();
            }
            let before = before.remove(&asked.api).unwrap_or_default();
            findings.act(nodes, &asked.api, &before, &mut outcome).await;
            found.insert(asked.api, findings);
        }
        if found.values().all(Findings::is_settled) {
            break;
        }
        before = found;
    }
    outcome
}

/// Counts a question as unanswered while this value exists.
struct Waiting(Arc<Nodes>);

impl Waiting {
    fn new(nodes: &Arc<Nodes>) -> Self {
        nodes.unanswered.fetch_add(1, Ordering::Relaxed);
        Self(nodes.clone())
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        self.0.unanswered.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The node names registered at an address when the node there was asked, each with the numbers of its last
/// registration and unregistration.
#[derive(Default)]
struct Asked {
    api: String,
    names: Vec<RegisteredName>,
    unregistered: Vec<u64>,
    /// Names about which a refused connection proves nothing.
    doubtful: BTreeSet<String>,
}

/// What a node's answers mean for the names at its address.
#[derive(Default)]
struct Findings {
    others: Vec<RegisteredName>,
    reconciliations: Vec<(Precondition, IdentityVerdict, Reconciliation)>,
}

impl Asked {
    /// The names registered at this port, for each address that has it. `reaches` says what the address proves about
    /// each name. Names about which it proves nothing at all are left out.
    fn registered_at(nodes: &Nodes, port: &str, reaches: &BTreeMap<String, Reach>) -> Vec<Self> {
        nodes.ledger.with_activity(|mirror, activity| {
            let mut all = BTreeMap::<_, Self>::new();
            for (node, api) in mirror.nodes_at(port) {
                let reach = reaches.get(node);
                let Some(reach) = reach.filter(|reach| reach.answer_counts()) else {
                    continue;
                };
                // All that is left of it is a service that another node has taken over, which nothing ends.
                if mirror.unregister_calls(node).is_empty() {
                    continue;
                }
                let pid = activity.pid_of(node, api);
                let last_calls = activity.last_calls(node);
                let asked = all.entry(api).or_insert_with(|| Self {
                    api: api.to_owned(),
                    ..Self::default()
                });
                asked.names.push(RegisteredName {
                    node: node.to_owned(),
                    known_pid: pid.map(|(pid, _)| pid),
                    registered_since: pid.is_some_and(|(_, since)| since),
                    registered: last_calls.registered,
                });
                asked.unregistered.push(last_calls.unregistered);
                if !reach.refusal_proves(pid.is_some()) {
                    asked.doubtful.insert(node.to_owned());
                }
            }
            all.into_values().collect()
        })
    }

    /// Each name with the numbers of its last registration and unregistration.
    fn calls(&self) -> impl Iterator<Item = (String, LastCalls)> {
        let calls = self.names.iter().zip(&self.unregistered);
        calls.map(|(name, unregistered)| {
            let last_calls = LastCalls {
                registered: name.registered,
                unregistered: *unregistered,
            };
            (name.node.clone(), last_calls)
        })
    }

    /// What the answers in `interview` mean for the names that have registered nothing since the node was asked.
    fn findings(&self, nodes: &Nodes, interview: &Interview) -> Findings {
        let api = self.api.as_str();
        let Interview { pid, claims, .. } = interview;
        let mut findings = Findings::default();
        nodes.ledger.with_activity(|mirror, activity| {
            let verdicts = judge_node(mirror, &self.names, *pid, claims.as_ref());
            let judged = self.names.iter().zip(&self.unregistered).zip(verdicts);
            for ((name, unregistered), verdict) in judged {
                let last_calls = activity.last_calls(&name.node);
                if mirror.api_of(&name.node) != Some(api)
                    || last_calls.registered != name.registered
                {
                    continue;
                }
                if verdict == IdentityVerdict::Another {
                    findings.others.push(name.clone());
                    continue;
                }
                if let Some(pid) = *pid {
                    activity.remember_pid(&name.node, api, name.registered, pid);
                }
                // If the answer could fit several names, none of them is reconciled.
                let sure = verdict == IdentityVerdict::Itself || self.names.len() == 1;
                if let Some(claims) = claims
                    && sure
                    && last_calls.unregistered == *unregistered
                {
                    let mut reconciliation = Reconciliation::new(mirror, &name.node, claims);
                    let had = |one: &Registration| {
                        activity.has_lost(&name.node, api, one.publishes, &one.topic)
                    };
                    reconciliation.missing.retain(had);
                    let condition = Precondition {
                        node: name.node.clone(),
                        last_calls,
                    };
                    findings
                        .reconciliations
                        .push((condition, verdict, reconciliation));
                }
            }
        });
        findings
    }
}

/// Whether the node at `api` names this rosrescue as its master. If not, the node may have registered its topics at
/// another master. False for roscpp nodes, which do not tell their master.
async fn has_our_master(nodes: &Nodes, api: &str) -> bool {
    let limit = nodes.timeout;
    let Some(_admitted) = nodes.visits.admit(port_of(api), limit).await else {
        return false;
    };
    let (_, named) = client::call_for_value(api, &question("getMasterUri"), limit).await;
    let text = named.as_ref().and_then(Value::as_str).unwrap_or_default();
    let own = MasterUri::parse(&nodes.ledger.uri());
    let (Ok(named), Ok(own)) = (MasterUri::parse(text), own) else {
        return false;
    };
    let addresses = async |of| {
        let found = origin::addresses(of, limit).await.unwrap_or_default();
        found.iter().map(SocketAddr::ip).collect::<Vec<_>>()
    };
    let named_at = addresses(text).await;
    let mut at = addresses(api).await.into_iter();
    let node_is_here = at.any(resolver::is_own);
    named.names(&own, &named_at, node_is_here, resolver::is_own)
}

impl Findings {
    fn has_missing(&self) -> bool {
        let mut reconciliations = self.reconciliations.iter();
        reconciliations.any(|(_, _, reconciliation)| !reconciliation.missing.is_empty())
    }

    fn forget_missing(&mut self) {
        for (_, _, reconciliation) in &mut self.reconciliations {
            reconciliation.missing.clear();
        }
    }

    fn is_settled(&self) -> bool {
        let mut reconciliations = self.reconciliations.iter();
        self.others.is_empty()
            && reconciliations.all(|(_, _, reconciliation)| reconciliation.is_empty())
    }

    /// Carries out the findings that are certain. A removal is certain only if it is also among the findings of the
    /// previous question, `before`. Removals come first, because a registration that rosrescue makes for a node counts
    /// as the node's own, and voids the other findings about that node.
    async fn act(&self, nodes: &Nodes, api: &str, before: &Self, outcome: &mut CheckResult) {
        for name in &self.others {
            let mut earlier = before.others.iter();
            let again =
                earlier.any(|found| found.node == name.node && found.registered == name.registered);
            let same = |last_calls: LastCalls| last_calls.registered == name.registered;
            if again && remove(nodes, &name.node, api, same).await == Removal::Node {
                outcome.removed.push(name.node.clone());
            }
        }
        for (condition, verdict, reconciliation) in &self.reconciliations {
            let node = &condition.node;
            let mut found = before.reconciliations.iter();
            let found = found.find(|(found, _, _)| found.node == *node);
            let confirmed = |list: fn(&Reconciliation) -> &Vec<Registration>,
                             one: &Registration| {
                found.is_some_and(|(_, _, reconciliation)| {
                    list(reconciliation).iter().any(|it| it.is_same(one))
                })
            };
            let certain = *verdict == IdentityVerdict::Itself;
            for one in &reconciliation.extra {
                if confirmed(|reconciliation| &reconciliation.extra, one) {
                    let call = one.unregister(node, api);
                    reconcile(nodes, one, condition, call, outcome).await;
                }
            }
            for one in &reconciliation.missing {
                if certain || confirmed(|reconciliation| &reconciliation.missing, one) {
                    let call = one.register(node, api);
                    reconcile(nodes, one, condition, call, outcome).await;
                }
            }
        }
    }
}

/// Makes a call for a node, unless the node itself makes the opposite call first.
async fn reconcile(
    nodes: &Nodes,
    one: &Registration,
    condition: &Precondition,
    call: Request,
    outcome: &mut CheckResult,
) {
    // A multicall is never put into a batch. In a batch, the node could register at a new address just before this
    // call. This call would then take the node's name away.
    let kind = call.kind();
    let alone = Request::multicall([call]);
    let reply = nodes.write_queue.call_if(alone, condition.clone()).await;
    let Some(reply) = reply else { return };
    if is_done(&reply) {
        let sign = if kind == Kind::Mutate { '+' } else { '-' };
        outcome
            .reconciled
            .push(format!("{sign} {}", one.describe(&condition.node)));
    }
}

/// Whether the only entry of a multicall succeeded. The master may refuse the type that a node reports.
fn is_done(reply: &Reply) -> bool {
    let replies = batch::unpack(reply, 1).unwrap_or_default();
    replies.iter().any(master::is_success)
}

/// Unregisters the nodes of `asked`, because their port refuses connections, except those about which that proves
/// nothing. Returns the unregistered names.
async fn remove_all(nodes: &Arc<Nodes>, asked: Vec<Asked>) -> Vec<String> {
    let mut removals = JoinSet::new();
    for asked in asked {
        let dead = asked
            .calls()
            .filter(|(node, _)| !asked.doubtful.contains(node));
        for (node, before) in dead {
            let (nodes, api) = (nodes.clone(), asked.api.clone());
            removals.spawn(async move {
                let same = |last_calls| last_calls == before && nodes.gate.is_open();
                let removal = remove(&nodes, &node, &api, same).await;
                (removal == Removal::Node).then_some(node)
            });
        }
    }
    removals.join_all().await.into_iter().flatten().collect()
}

/// What [`remove`] has unregistered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Removal {
    Nothing,
    /// What a node has left behind that stopped cleanly. No report names it.
    Remains,
    Node,
}

/// Unregisters a node as the node itself would. Does nothing if the node has come back since it was asked: its address
/// has changed, or `same` rejects its last calls.
pub(super) async fn remove(
    nodes: &Nodes,
    node: &str,
    api: &str,
    same: impl Fn(LastCalls) -> bool,
) -> Removal {
    // Lets the node's queued calls run first.
    barrier(nodes).await;
    let found = nodes.ledger.with_activity(|mirror, activity| {
        let last_calls = activity.last_calls(node);
        let same = mirror.api_of(node) == Some(api) && same(last_calls);
        same.then(|| {
            (
                mirror.unregister_calls(node),
                mirror.is_listed(node),
                last_calls,
            )
        })
    });
    let Some((calls, is_listed, last_calls)) = found else {
        return Removal::Nothing;
    };
    if calls.is_empty() {
        return Removal::Remains;
    }
    let condition = Precondition {
        node: node.to_owned(),
        last_calls,
    };
    let call = Request::multicall(calls);
    let reply = nodes.write_queue.call_if(call, condition).await;
    match (reply, is_listed) {
        (None, _) => Removal::Nothing,
        (Some(_), false) => Removal::Remains,
        (Some(_), true) => {
            nodes.removed.add(node, Instant::now());
            Removal::Node
        }
    }
}
