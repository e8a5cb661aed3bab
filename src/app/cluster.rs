//! Runs this computer as one of several: passes events to [`Member`], which decides, and carries out its actions.

mod facts;
mod join;
mod partition_writes;
mod report;
mod survey;
mod trouble;

use std::{
    collections::VecDeque,
    net::IpAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use rescue_core::{
    checkpoint::{
        format::{self, Checkpoint, Origin},
        session::{self, Decision, RestorePolicy, SessionEvidence},
    },
    cluster::{
        journal::{self, JournalError, Keys, Manifest, Put},
        machine::{EtcdAnswer, Op, Settings, View},
        member::{
            Action, Evidence, Input, Member, MemberEntry, MemberEntryChange, PROBES, Read,
            WatchedEntry,
        },
        merge::wire::{self, Ask},
        standing::{JournalPosition, Standing},
    },
};
use ros1_master::{master::Master, xmlrpc};
use tokio::{
    sync::{mpsc, oneshot, watch},
    task::{JoinSet, block_in_place},
};
use tokio_util::{sync::CancellationToken, task::AbortOnDropHandle};

pub(super) use self::join::{ClusterSetup, join};
use self::{facts::ComputerFacts, partition_writes::PartitionWritesFile, trouble::Trouble};
use super::{RunError, life, master_duties::MasterDuties};
use crate::{
    cluster::{
        etcd::{self, Etcd, KeyChange, Kv, Watch, WatchEnd},
        replica::{LoadedState, Replica, ReplicaError},
    },
    gate::State,
    guardian::handover,
    limit::rarely,
    nodes::notifications,
    process::ProcessError,
    recovery::master_process::MasterProcess,
    ros_env::MasterUri,
    server::others::{self, Forwarded, Handover, Shown},
    status::cluster_facts::MemberFacts,
    task::boxed,
    upstream::{Head, peer::Peers},
    wait,
    write_queue::WriteQueue,
};

/// Time limit of one request to etcd that is sent in the background.
const LIMIT: Duration = Duration::from_secs(5);
/// Pause before a large write is retried.
const AGAIN: Duration = Duration::from_millis(200);

/// Maximum number of messages from etcd's watch that become one input.
const WATCHED_MOST: usize = 64;

/// Tasks whose results become inputs of the [`Member`].
type Work = JoinSet<Input>;

/// Passes events to this computer's [`Member`], and carries out its actions.
pub(super) struct ClusterDriver {
    setup: ClusterSetup,
    member: Member,
    replica: Replica,
    standing: watch::Sender<Standing>,
    /// The position in the journal up to which the mirror is current.
    position: watch::Sender<JournalPosition>,
    shown: Arc<Shown>,
    peers: Arc<Peers>,
    /// Writes of this computer that a leader has not answered yet.
    forwarded: Arc<Forwarded>,
    handovers: mpsc::Receiver<Handover>,
    /// The caller that waits for a handover.
    handover: Option<oneshot::Sender<Result<String, String>>>,
    /// Inputs to pass to the [`Member`] before any new ones.
    inbox: VecDeque<Input>,
    work: Work,
    /// Background tasks without a result.
    beside: JoinSet<()>,
    watch: Option<Watching>,
    /// The keys `leader` and `alive` as the watch on etcd delivered them.
    watched: View,
    duties: Option<MasterDuties>,
    /// Processes that are being stopped.
    endings: JoinSet<()>,
    partition_writes: PartitionWritesFile,
    trouble: Arc<Trouble>,
    facts: ComputerFacts,
}

impl ClusterDriver {
    /// Runs until `stop`.
    ///
    /// # Errors
    ///
    /// If no master can be started, or another computer has the same name.
    pub(super) async fn run(
        mut self: Box<Self>,
        stop: CancellationToken,
    ) -> Result<Option<MasterProcess>, RunError> {
        self.beside
            .spawn(survey::try_endpoints(self.replica.clone()));
        let mut stopped = false;
        let mut input = Input::Begin;
        let result = loop {
            if let Some(end) = self.take(input).await {
                break end;
            }
            input = match self.inbox.pop_front() {
                Some(input) => input,
                None => tokio::select! {
                    biased;
                    () = stop.cancelled(), if !stopped => {
                        stopped = true;
                        Input::Stop
                    }
                    next = self.next() => match next {
                        Ok(input) => input,
                        Err(error) => break Err(error.into()),
                    },
                },
            };
        };
        self.setup.context.ledger.leave();
        self.end_master().await;
        self.setup.context.ledger.shut_gate(State::Elsewhere);
        self.setup.halt.cancel();
        while self.endings.join_next().await.is_some() {}
        result.map(|()| None)
    }

    /// Passes an input to the member, and carries out its actions. Returns the result when the member ends.
    async fn take(&mut self, input: Input) -> Option<Result<(), RunError>> {
        let now = Instant::now();
        if !matches!(input, Input::Wake | Input::Watched { .. }) {
            tracing::trace!(?input, "cluster");
        }
        let seq = self.last_seq();
        for change in input.member_entries() {
            self.facts.note_member_entry(change, seq);
        }
        let actions = self.member.on(now, input);
        // A limit holds from now on. Without one, this computer is cut off, and the actions say first whom it may notify.
        let lease = self.member.machine().lease(now);
        if lease.is_some() {
            self.setup.context.ledger.lease.set(lease);
        }
        for action in actions {
            match action {
                Action::End => return Some(Ok(())),
                Action::EndForNamesake(uri) => return Some(Err(self.namesake_at(uri))),
                action => self.carry_out(action).await,
            }
        }
        if lease.is_none() {
            self.setup.context.ledger.lease.set(None);
        }
        // The file is beside the checkpoint. A disk that is silent would delay every write here.
        if self.partition_writes.must_be_replaced()
            && self.setup.context.ledger.unprotected().is_none()
            && let Some(writes) = self.member.partition_writes()
        {
            let path = &self.setup.context.checkpoint;
            self.partition_writes.replace(path, writes).await;
        }
        let position = self.member.position();
        self.position
            .send_if_modified(|before| std::mem::replace(before, position) != position);
        self.show();
        None
    }

    async fn carry_out(&mut self, action: Action) {
        let context = &self.setup.context;
        let ledger = &context.ledger;
        match action {
            Action::Send {
                number,
                op,
                entry,
                term,
                parts,
                requires,
            } => {
                self.send(number, op, entry, requires, (term, parts));
            }
            Action::Load(known) => {
                let replica = self.replica.clone();
                let trouble = self.trouble.clone();
                self.spawn(Input::Loaded(None), async move {
                    let loaded = trouble.note_result(replica.load(known).await);
                    Input::Loaded(loaded.and_then(|loaded| read(&replica.keys, loaded)))
                });
            }
            Action::Watch(view) => {
                if view.leader.is_none() {
                    self.beside.spawn(survey::warn_of_typo(
                        self.replica.clone(),
                        self.setup.config.robot.clone(),
                    ));
                }
                let keys = &self.replica.keys;
                let ttl = self.member.settings().ttl;
                let watch = self.replica.client.watch(keys.small(), view.revision, ttl);
                let watch = watch.with_deletions(keys.values());
                self.watch = Some(Watching::new(watch, self.trouble.clone()));
                self.watched = view;
            }
            Action::Prepare {
                number,
                term,
                parts,
            } => {
                let replica = self.replica.clone();
                let unknown = Input::Prepared {
                    number,
                    leads: None,
                };
                self.spawn(unknown, async move {
                    let prepared = replica.prepare(term, &parts).await;
                    if let Err(error) = &prepared {
                        rarely!(warn, %error, "a large write is not in etcd yet; retrying");
                        tokio::time::sleep(AGAIN).await;
                    }
                    Input::Prepared {
                        number,
                        leads: prepared.ok(),
                    }
                });
            }
            Action::Decide { seq, state, closed } => {
                let evidence = SessionEvidence {
                    same_boot: self.setup.restored,
                    closed,
                    node_alive: false,
                    restarted: handover::continues(),
                };
                let goes_on = true;
                let otherwise = Input::Decided { seq, goes_on };
                self.spawn(otherwise, decide(seq, state, self.setup.restore, evidence));
            }
            Action::PublishStanding(standing) => {
                tracing::debug!(?standing, "this computer's standing has changed");
                self.standing.send_replace(standing);
            }
            Action::StopRecording { binds } => {
                if let Some(seq) = ledger.leave().filter(|_| binds) {
                    let led = *self.position.borrow();
                    self.shown.raise(JournalPosition { seq, ..led });
                }
            }
            Action::StartRecording { seq, held, state } => {
                if let Some(state) = state {
                    // This fails only if this computer already has the master.
                    let _ = ledger.follow_state(seq, state);
                }
                ledger.lead(seq, &held);
            }
            Action::Follow(records) => drop(ledger.follow(&records)),
            Action::FollowState { seq, state } => {
                match ledger.with_mirror(|mirror| *mirror == state) {
                    true => ledger.note_followed(seq),
                    false => drop(ledger.follow_state(seq, state)),
                }
            }
            Action::Acknowledge(seq) => ledger.acknowledged.reach(seq),
            Action::TakeAsState => {
                let state = ledger.take_as_state();
                self.inbox.push_front(Input::AsState(state));
            }
            Action::CollectForwarded { base } => {
                let writes = self.forwarded.writes(self.member.position());
                self.inbox.push_front(Input::Forwarded { base, writes });
            }
            Action::ShutDownDisplaced(nodes) => {
                ledger.with_activity(|_, activity| activity.restore_displaced(nodes));
            }
            Action::NotifyAll => notifications::notify_all(&context.nodes),
            Action::StoreTerm {
                term,
                journal_number,
                seq,
            } => {
                ledger.update_session(|session| {
                    (session.term, session.cluster_journal) = (term, journal_number);
                    // If this computer records calls, the ledger counts itself.
                    session.cluster_seq = seq;
                });
            }
            Action::BeginMaster(cause) => {
                let process = MasterProcess::new(self.setup.rosmaster.clone(), None);
                let cause = report::cause(cause);
                self.duties = Some(context.begin(process, Some(self.setup.rosout), cause));
            }
            Action::EndMaster => self.end_master().await,
            Action::AnswerFromMirror => ledger.shut_gate(State::StandingIn),
            Action::AnswerNothing => ledger.shut_gate(State::Elsewhere),
            Action::NotifyOwnOnly(own_only) => context.nodes.set_alone(own_only),
            Action::ReplacePartitionWrites(writes) => {
                self.partition_writes
                    .replace(&context.checkpoint, writes)
                    .await;
            }
            Action::AddPartitionWrites(calls) => self.partition_writes.add(calls).await,
            Action::DeletePartitionWrites => {
                self.partition_writes.remove(&context.checkpoint).await
            }
            Action::Merge { number, ask, to } => {
                let (peers, queue) = (self.peers.clone(), context.write_queue.clone());
                let own = others::own_address(&self.member.settings().uri);
                let answer = None;
                let otherwise = Input::Merged { number, answer };
                self.spawn(otherwise, async move {
                    let answer = merge(ask, to, peers, queue, own).await;
                    Input::Merged { number, answer }
                });
            }
            Action::Report(outcomes) => report::report(&self.setup.hide, outcomes),
            Action::Probe { number, uri, term } => {
                let leads = false;
                let otherwise = Input::Probed { number, leads };
                let pause = self.member.settings().ttl / PROBES;
                let peer = MasterUri::parse(&uri)
                    .ok()
                    .map(|uri| self.peers.peer_at(&uri));
                self.spawn(otherwise, async move {
                    let asked = async { peer?.leads(term).await.then_some(()) };
                    let leads = tokio::time::timeout(pause, asked).await;
                    let leads = matches!(leads, Ok(Some(())));
                    Input::Probed { number, leads }
                });
            }
            Action::PublishMemberEntry(entry) => {
                let put = self.member_put(&entry);
                self.beside
                    .spawn(publish_member_entry(self.replica.client.clone(), put));
            }
            Action::WriteSnapshot {
                term,
                progress,
                state,
                displaced,
            } => {
                let replica = self.replica.clone();
                let seq = progress.seq;
                // With a large state, this takes longer than calls and heartbeats may wait.
                let encode = move || {
                    let checkpoint = Checkpoint {
                        seq,
                        snapshot: state.snapshot(),
                        displaced,
                        ..Checkpoint::default()
                    };
                    format::encode_checkpoint(&checkpoint, 1).map_err(JournalError::Encode)
                };
                self.spawn(Input::SnapshotWritten(None), async move {
                    let written = async {
                        let encoded = block_in_place(encode)?;
                        let leads = replica.write_snapshot(term, seq, &encoded.bytes).await?;
                        Ok::<_, ReplicaError>(leads.then_some((progress, encoded.bytes.len())))
                    };
                    Input::SnapshotWritten(written.await.unwrap_or_else(|error| {
                        rarely!(warn, %error, "the snapshot in etcd could not be written; retrying");
                        None
                    }))
                });
            }
            Action::CompactEtcd(revision) => {
                let client = self.replica.client.clone();
                self.beside.spawn(async move {
                    if let Err(error) = client.compact(revision, LIMIT).await {
                        tracing::debug!(%error, "could not compact etcd");
                    }
                });
            }
            Action::HandedOver(result) => {
                let name = self.member.settings().name.clone();
                if let Some(tell) = self.handover.take() {
                    let _ = tell.send(result.map(|()| name));
                }
            }
            Action::EndRosout => {
                let ended = self.duties.as_mut().map(MasterDuties::end_roscore);
                self.spawn(Input::RosoutEnded, async move {
                    if let Some(ended) = ended {
                        ended.await;
                    }
                    Input::RosoutEnded
                });
            }
            Action::Log(news) => self.log_news(news),
            Action::End | Action::EndForNamesake(_) => {}
        }
    }

    /// Starts `work`. If it panics, its result is `otherwise`, because the member waits for every result.
    fn spawn(&mut self, otherwise: Input, work: impl Future<Output = Input> + Send + 'static) {
        self.work.spawn(boxed(answered(otherwise, work)));
    }

    /// This computer's entry among the members, as it is in etcd.
    fn member_put(&self, entry: &MemberEntry) -> Put {
        Put {
            key: self.replica.keys.member(&self.member.settings().name),
            value: serde_json::to_vec(entry).unwrap_or_default(),
        }
    }

    fn send(
        &mut self,
        number: u64,
        op: Op,
        entry: Option<Put>,
        requires: Option<Evidence>,
        (term, parts): (u64, Vec<Put>),
    ) {
        let (replica, settings) = (self.replica.clone(), self.member.settings().clone());
        let trouble = self.trouble.clone();
        let answer = EtcdAnswer::Silence;
        let otherwise = Input::Answer { number, answer };
        self.spawn(otherwise, async move {
            let run = async {
                if !parts.is_empty() {
                    replica.prepare(term, &parts).await?;
                }
                let (entry, requires) = (entry.as_ref(), requires.as_ref());
                replica.run(&settings, &op, entry, requires).await
            };
            let answer = trouble
                .note_result(run.await)
                .unwrap_or(EtcdAnswer::Silence);
            Input::Answer { number, answer }
        });
    }

    /// Waits for the next input of the [`Member`].
    async fn next(&mut self) -> Result<Input, ProcessError> {
        let wake = self.member.deadline();
        // Inputs may be ready all the time, so this thread's other tasks get a turn here.
        tokio::task::yield_now().await;
        loop {
            tokio::select! {
                biased;
                error = failed(&mut self.duties) => return Err(error),
                Some(Ok(done)) = self.work.join_next() => return Ok(done),
                () = self.setup.context.ledger.shared.notified() => {
                    return Ok(Input::Recorded(self.setup.context.ledger.take_changes()));
                }
                changes = next_changes(&mut self.watch) => return Ok(self.changed(changes)),
                Some((to, tell)) = self.handovers.recv() => match self.handover {
                    // Only one handover runs at a time.
                    Some(_) => drop(tell.send(Err("a handover is already under way".to_owned()))),
                    None => {
                        self.handover = Some(tell);
                        let refused = self.facts.successor(&to).err();
                        return Ok(Input::HandOver { to, refused });
                    }
                },
                Some(_) = self.beside.join_next() => {}
                Some(_) = self.endings.join_next() => {}
                () = wait::sleep_until(wake.map(Into::into)) => return Ok(Input::Wake),
            }
        }
    }

    async fn end_master(&mut self) {
        if let Some(duties) = self.duties.take() {
            let ending = duties.stop_and_kill_master().await;
            self.endings.spawn(ending);
        }
    }

    /// Turns what the watch on etcd delivered, or its end, into an input for the [`Member`].
    fn changed(&mut self, changes: Option<Vec<KeyChange>>) -> Input {
        let Some(changes) = changes else {
            self.watch = None;
            return Input::WatchEnded;
        };
        let keys = self.replica.keys.clone();
        let (mut entries, mut members, mut deleted) = (Vec::new(), Vec::new(), None);
        for change in changes {
            if change.kv.is_none() {
                deleted = deleted.max(keys.record_of(&change.key));
            }
            if keys.values().contains(&change.key) {
                // It may arrive before earlier changes, so it says nothing about the revision.
                continue;
            }
            if let Err(error) = etcd::absorb(&change, &mut self.watched, &keys) {
                self.trouble.set(&error.into());
            }
            members.extend(member_entry(
                &keys,
                &change.key,
                change.revision,
                change.kv.as_ref(),
            ));
            let seq = keys.seq_of(&change.key);
            if let (Some(kv), Some(seq)) = (change.kv, seq) {
                entries.push((change.revision, entry(seq, &kv)));
            }
        }
        let view = self.watched.clone();
        Input::Watched {
            view,
            entries,
            deleted,
            members,
        }
    }

    /// The error of a computer whose name is taken.
    fn namesake_at(&self, uri: String) -> RunError {
        let Settings { name, uri: own, .. } = self.member.settings();
        let name = name.clone();
        match uri == *own {
            true => RunError::Double { name, uri },
            false => RunError::Namesake {
                name,
                uri,
                own: own.clone(),
            },
        }
    }
}

/// Converts what was read from etcd for the [`Member`]. `None` if the state in etcd is invalid.
fn read(keys: &Keys, loaded: LoadedState) -> Option<Read> {
    let members = loaded.members.iter();
    let members = members.filter_map(|kv| member_entry(keys, &kv.key, kv.revision, Some(kv)));
    let members = members.collect();
    let state = match loaded.checkpoint {
        None => None,
        Some(checkpoint) => match Master::from_snapshot(checkpoint.snapshot) {
            Ok(state) => Some((state, checkpoint.displaced)),
            Err(error) => {
                tracing::error!(%error, "the state in etcd is invalid; please report this");
                return None;
            }
        },
    };
    if let Some(error) = &loaded.damage {
        rarely!(error, %error, "the journal in etcd is damaged; the state of a living computer will replace it");
    }
    Some(Read {
        view: loaded.view,
        is_readable: loaded.damage.is_none(),
        state,
        records: loaded.records,
        progress: loaded.progress,
        members,
    })
}

/// The member entry at `key`, if `key` belongs to a member.
fn member_entry(
    keys: &Keys,
    key: &str,
    revision: u64,
    kv: Option<&Kv>,
) -> Option<MemberEntryChange> {
    let name = key.strip_prefix(&keys.member(""))?.to_owned();
    let entry = kv.and_then(|kv| serde_json::from_slice(&kv.value).ok());
    Some(MemberEntryChange {
        name,
        entry,
        revision,
    })
}

/// The journal entry that ends with record `seq`.
fn entry(seq: u64, kv: &Kv) -> WatchedEntry {
    let bytes = kv.value.len();
    match (
        Manifest::read(&kv.value),
        journal::decode_records(&kv.key, &kv.value),
    ) {
        (None, Ok(records)) => WatchedEntry::Records { records, bytes },
        _ => WatchedEntry::Apart(seq),
    }
}

/// Finds out whether the session in etcd continues.
async fn decide(
    seq: u64,
    state: Master,
    restore: RestorePolicy,
    evidence: SessionEvidence,
) -> Input {
    let node_alive = session::depends_on_nodes(restore, evidence)
        && life::any_alive(&state, evidence.same_boot).await;
    let evidence = SessionEvidence {
        node_alive,
        ..evidence
    };
    let goes_on = match session::decide(restore, evidence) {
        Decision::Restore(why) => {
            tracing::info!(why, "the session in etcd continues: {}", state.counts());
            true
        }
        Decision::Fresh(why) => {
            tracing::info!(why, "a new session begins; the one in etcd is over");
            false
        }
    };
    Input::Decided { seq, goes_on }
}

/// Sends partition writes to the leader. `to` is its address and term, or `None` if this
/// computer leads.
async fn merge(
    ask: Ask,
    to: Option<(String, u64)>,
    peers: Arc<Peers>,
    queue: WriteQueue,
    own: IpAddr,
) -> Option<wire::MergeAnswer> {
    let Some((uri, term)) = to else {
        return queue.merge(ask, Origin::At(own)).await;
    };
    let uri = MasterUri::parse(&uri).ok()?;
    let leader = peers.peer_at(&uri);
    let body = Bytes::from(ask.to_request().encode());
    let raw = leader.forward(term, &Head::default(), &body).await.ok()?;
    let reply = xmlrpc::decode_reply(&raw.body).ok()?;
    wire::MergeAnswer::read(&reply, ask.calls.len())
}

/// Writes this computer's entry among the members to etcd.
async fn publish_member_entry(client: Etcd, put: Put) {
    let published = async {
        let lease = client.grant(MemberFacts::AWAY_AFTER, LIMIT).await?;
        client.put_with_lease(&put, lease, LIMIT).await
    };
    if let Err(error) = published.await {
        tracing::debug!(%error, "could not write this computer's member entry");
    }
}

/// The result of `work`, or `otherwise` if it panics, because the member waits for every result.
async fn answered(otherwise: Input, work: impl Future<Output = Input> + Send + 'static) -> Input {
    let work = AbortOnDropHandle::new(tokio::spawn(work));
    work.await.unwrap_or_else(|error| {
        tracing::error!(%error, "a task for the cluster panicked; please report this line");
        otherwise
    })
}

async fn failed(duties: &mut Option<MasterDuties>) -> ProcessError {
    match duties {
        Some(duties) => duties.failed().await,
        None => std::future::pending().await,
    }
}

/// A watch on etcd, read by a separate task: all changes that arrive while the member works become one input.
struct Watching {
    changes: mpsc::Receiver<Vec<KeyChange>>,
    _task: AbortOnDropHandle<()>,
}

impl Watching {
    fn new(mut watch: Watch, trouble: Arc<Trouble>) -> Self {
        let (sender, changes) = mpsc::channel(WATCHED_MOST);
        let task = tokio::spawn(async move {
            loop {
                match watch.next().await {
                    Ok(changes) => {
                        trouble.clear();
                        if sender.send(changes).await.is_err() {
                            return;
                        }
                    }
                    Err(WatchEnd::Failed(error)) => return trouble.set(&error.into()),
                    Err(WatchEnd::Compacted) => return,
                }
            }
        });
        let _task = AbortOnDropHandle::new(task);
        Self { changes, _task }
    }
}

/// All changes that have arrived. `None` if the watch has ended. Cancel safe.
async fn next_changes(watch: &mut Option<Watching>) -> Option<Vec<KeyChange>> {
    let Some(watch) = watch else {
        return std::future::pending().await;
    };
    let mut changes = Vec::new();
    let count = watch.changes.recv_many(&mut changes, WATCHED_MOST).await;
    (count > 0).then(|| changes.into_iter().flatten().collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_arrived_while_the_member_worked_is_one_input() {
        let (sender, changes) = mpsc::channel(WATCHED_MOST);
        let _task = AbortOnDropHandle::new(tokio::spawn(async {}));
        let mut watch = Some(Watching { changes, _task });
        let change = |revision| KeyChange {
            key: String::new(),
            revision,
            kv: None,
        };
        let all = [1, 2, 3].map(change);
        for change in all.clone() {
            sender.send(vec![change]).await.unwrap();
        }
        drop(sender);
        assert_eq!(next_changes(&mut watch).await.as_deref(), Some(&all[..]));
        assert_eq!(next_changes(&mut watch).await, None);
    }

    #[tokio::test]
    async fn work_that_panics_is_answered() {
        let answer = EtcdAnswer::Silence;
        let otherwise = Input::Answer { number: 7, answer };
        let answered = answered(otherwise, async { panic!("on purpose") }).await;
        let expected = matches!(
            answered,
            Input::Answer {
                number: 7,
                answer: EtcdAnswer::Silence
            }
        );
        assert!(expected, "{answered:?}");
    }
}
