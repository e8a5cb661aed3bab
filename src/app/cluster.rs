//! Several computers: the shell around [`Machine`], which decides who leads.
//!
//! One task holds what the journal in etcd says, and brings the ledger there while another computer leads. While
//! this one has the master, it gives the ledger's changes to the journal.

mod background;
mod cut_off;
mod facts;
mod outgoing;
mod turns;

use std::{
    collections::VecDeque,
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant},
};

use hyper::header::HeaderValue;
use tokio::{
    sync::{mpsc, watch},
    task::JoinSet,
};
use tokio_util::sync::CancellationToken;

use self::{
    background::{Background, Trouble},
    cut_off::CutOff,
    facts::Known,
    outgoing::Outgoing,
};
use super::duty::{Duty, Post};
use crate::{
    checkpoint::{
        format::{Entry, Record},
        session::Restore,
    },
    cluster::{
        etcd::{Access, Change, Etcd, EtcdError, Options, Tls, Watch, WatchEnd},
        journal::{self, Keys, Manifest, Progress},
        machine::{
            ANSWER_LIMIT, Action, Answer, Commit, Input, Leader, Machine, Op, Role, Settings, View,
            WhenAlone,
        },
        replica::{Loaded, Replica, ReplicaError},
        way::Way,
    },
    config::{ClusterConfig, ClusterSync, WhenCutOff},
    limit::rarely,
    master::{Master, Request},
    process::{ProcessError, Rosmaster},
    recovery::master_process::MasterProcess,
    server::others::{Handover, Others},
    upstream::peer::Peers,
    wait,
};

/// Pause before etcd is asked again for what it did not give.
const AGAIN: Duration = Duration::from_millis(200);
/// How long a leader may take to give up leading.
const HANDOVER_LIMIT: Duration = Duration::from_secs(5);
/// The same when it stops.
const STOP_LIMIT: Duration = Duration::from_secs(2);

/// What a computer among several is given.
pub(super) struct Given {
    pub(super) config: ClusterConfig,
    pub(super) post: Post,
    pub(super) rosmaster: Rosmaster,
    pub(super) rosout: bool,
    /// Identifies this process.
    pub(super) instance: HeaderValue,
    pub(super) restore: Restore,
    /// Whether the mirror is from a checkpoint whose session continues.
    pub(super) restored: bool,
    /// Cancelled when calls are no longer taken.
    pub(super) halt: CancellationToken,
}

type Loading = Pin<Box<dyn Future<Output = Result<Loaded, ReplicaError>> + Send>>;
type Flag = Pin<Box<dyn Future<Output = bool> + Send>>;
type Merging = Pin<Box<dyn Future<Output = u64> + Send>>;

/// See the [module](self).
pub(super) struct Conductor {
    given: Given,
    settings: Settings,
    machine: Machine,
    replica: Replica,
    way: watch::Sender<Way>,
    peers: Arc<Peers>,
    handovers: mpsc::Receiver<Handover>,
    /// Inputs that are to be taken next.
    inbox: VecDeque<Input>,
    /// Requests of the machine.
    requests: JoinSet<Input>,
    view: View,
    watch: Option<Watch>,
    loading: Option<Loading>,
    load_at: Option<Instant>,
    /// Whether etcd's state has been read.
    loaded: bool,
    /// The machine waits for the journal up to here.
    wanted: Option<u64>,
    /// The journal's state, and how far it has been read.
    held: Master,
    progress: Progress,
    outgoing: Outgoing,
    duty: Option<Duty>,
    /// Processes that are being ended.
    endings: JoinSet<()>,
    cut_off: Option<CutOff>,
    /// Writes of an earlier time alone are being sent. Gives how many did not hold.
    merging: Option<Merging>,
    /// The ledger's state wins over the journal's if this computer leads next.
    ours: bool,
    /// Who led before, and when it was heard of last.
    before: Option<(String, Instant)>,
    /// It has given up leading by itself.
    was_released: bool,
    /// Another computer was seen leading, so the session goes on.
    seen_leading: bool,
    /// Whether the session in etcd goes on, while that is found out.
    deciding: Option<Flag>,
    /// What was decided, if it was necessary.
    goes_on: Option<bool>,
    probe: Option<Flag>,
    probe_at: Option<Instant>,
    /// Who waits for this computer to give up leading, and until when.
    released: Option<Handover>,
    release_by: Option<Instant>,
    trouble: Arc<Trouble>,
    known: Known,
    background: Background,
}

/// Where the other computers are asked, and the task to run.
pub(super) async fn join(given: Given) -> Result<(Others, Conductor), EtcdError> {
    let config = &given.config;
    let client = Etcd::new(&Options {
        endpoints: config.endpoints.clone(),
        access: Access {
            tls: Tls {
                ca: config.ca.clone(),
                cert: config.cert.clone(),
                key: config.key.clone(),
            },
            user: config.user.clone(),
        },
    })?;
    let settings = Settings {
        name: config.name.clone(),
        id: super::startup::kernel_id("/proc/sys/kernel/random/uuid"),
        uri: config.advertised.to_string(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        ttl: config.ttl,
        commit: match config.sync {
            ClusterSync::Always => Commit::Always,
            ClusterSync::Interval => Commit::Interval,
        },
        alone: match config.alone {
            WhenCutOff::Serve => WhenAlone::Serve,
            WhenCutOff::Refuse => WhenAlone::Refuse,
        },
    };
    let post = &given.post;
    post.ledger.leave();
    // One that an earlier process left may hold what others have changed since.
    given.rosmaster.left_behind(None);
    let known = given.restored;
    let (way, way_rx) = watch::channel(Way::Nobody { known });
    let (handovers_tx, handovers) = mpsc::channel(1);
    let peers = Arc::new(Peers::new(given.instance.clone(), post.probe_timeout));
    let others = Others {
        way: way_rx,
        peers: peers.clone(),
        handovers: handovers_tx,
    };
    let cut_off = CutOff::left(&post.checkpoint, given.restored).await;
    let conductor = Conductor {
        machine: Machine::new(settings.clone()),
        replica: Replica {
            client,
            keys: Keys::new(&config.robot),
            limit: ANSWER_LIMIT,
        },
        known: Known::new(&settings),
        trouble: Arc::default(),
        background: Background::default(),
        settings,
        given,
        way,
        peers,
        handovers,
        inbox: VecDeque::from([Input::Start(0)]),
        requests: JoinSet::new(),
        view: View::default(),
        watch: None,
        loading: None,
        load_at: Some(Instant::now()),
        loaded: false,
        wanted: None,
        held: Master::default(),
        progress: Progress::default(),
        outgoing: Outgoing::default(),
        duty: None,
        endings: JoinSet::new(),
        cut_off,
        merging: None,
        ours: true,
        before: None,
        was_released: false,
        seen_leading: false,
        deciding: None,
        goes_on: None,
        probe: None,
        probe_at: None,
        released: None,
        release_by: None,
    };
    Ok((others, conductor))
}

impl Conductor {
    /// Takes part until `stop`.
    ///
    /// # Errors
    ///
    /// If no master can be started.
    pub(super) async fn run(
        mut self: Box<Self>,
        stop: CancellationToken,
    ) -> Result<Option<MasterProcess>, ProcessError> {
        loop {
            while let Some(input) = self.inbox.pop_front() {
                self.take(input).await;
            }
            self.catch_up();
            self.tend();
            if !self.inbox.is_empty() {
                continue;
            }
            if let Some(result) = self.next(&stop).await {
                self.give_up_duty().await;
                self.given.halt.cancel();
                while self.endings.join_next().await.is_some() {}
                return result.map_or(Ok(None), Err);
            }
        }
    }

    async fn take(&mut self, input: Input) {
        let now = Instant::now();
        if !matches!(input, Input::Wake | Input::View(_) | Input::Followed(_)) {
            tracing::trace!(?input, "cluster");
        }
        let actions = self.machine.on(now, input);
        for action in actions {
            if !matches!(action, Action::Send { .. } | Action::Acknowledge(_)) {
                tracing::debug!(?action, "cluster");
            }
            self.carry_out(now, action).await;
        }
        for change in self.outgoing.committed(self.machine.committed()) {
            self.hold(change);
        }
    }

    async fn carry_out(&mut self, now: Instant, action: Action) {
        match action {
            Action::Send { number, op } => self.send(number, op),
            Action::CatchUp(seq) => self.wanted = Some(seq),
            Action::Become(role) => self.become_role(now, role).await,
            Action::Acknowledge(seq) => self.given.post.ledger.agree(seq),
            Action::Yield {
                committed,
                acknowledged,
            } => self.give_back(committed, acknowledged).await,
            Action::Released => {
                if let Some((_, tell)) = self.released.take() {
                    let _ = tell.send(Ok(self.settings.name.clone()));
                }
                self.release_by = None;
            }
        }
    }

    fn send(&mut self, number: u64, op: Op) {
        let entry = match &op {
            Op::Beat { seq, .. } => match self.outgoing.entry(&self.replica.keys, *seq) {
                Ok(entry) => entry,
                Err(error) => {
                    rarely!(error, %error, "the journal cannot be written; please report this line");
                    let answer = Answer::Silence;
                    return self.inbox.push_back(Input::Answer { number, answer });
                }
            },
            _ => None,
        };
        let (replica, settings) = (self.replica.clone(), self.settings.clone());
        let trouble = self.trouble.clone();
        self.requests.spawn(async move {
            let answer = match replica.run(&settings, &op, entry.as_ref()).await {
                Ok(answer) => {
                    trouble.clear();
                    answer
                }
                Err(error) => {
                    trouble.set(&error);
                    Answer::Silence
                }
            };
            Input::Answer { number, answer }
        });
    }

    /// Has the journal read if it is not known as far as it must be.
    fn catch_up(&mut self) {
        if let Some(wanted) = self.wanted
            && self.loaded
            && self.progress.seq >= wanted
            && !self.must_decide()
        {
            self.wanted = None;
            self.inbox.push_back(Input::Followed(self.progress.seq));
        }
        if self.wanted.is_some() && self.progress.seq < self.wanted.unwrap_or(0) {
            self.load_at.get_or_insert_with(Instant::now);
        }
        let due = self.load_at.is_some_and(|at| at <= Instant::now());
        if due && self.loading.is_none() {
            self.load_at = None;
            let (replica, known) = (self.replica.clone(), self.progress);
            self.loading = Some(Box::pin(async move { replica.load(known).await }));
        }
    }

    /// The next event; an end if there is one.
    async fn next(&mut self, stop: &CancellationToken) -> Option<Option<ProcessError>> {
        let stopping = self.release_by.is_some() && self.released.is_none();
        let wake = [
            self.machine.deadline(),
            self.load_at.filter(|_| self.loading.is_none()),
            self.probe_at.filter(|_| self.probe.is_none()),
            self.release_by,
            self.background.due(),
        ];
        let wake = wake.into_iter().flatten().min().map(Into::into);
        tokio::select! {
            biased;
            () = stop.cancelled(), if !stopping => return self.begin_stop(),
            error = failed(&mut self.duty) => return Some(Some(error)),
            Some(done) = self.requests.join_next() => match done {
                Ok(input) => self.inbox.push_back(input),
                Err(error) => tracing::error!(%error, "please report this"),
            },
            () = self.given.post.ledger.shared.notified() => self.take_changes(),
            done = wait::for_some(self.outgoing.preparing.as_mut()) => self.prepared(done),
            changes = next_changes(&mut self.watch) => self.changed(changes),
            loaded = wait::for_some(self.loading.as_mut()) => {
                self.loading = None;
                self.have_loaded(loaded);
            }
            goes_on = wait::for_some(self.deciding.as_mut()) => {
                self.deciding = None;
                self.goes_on = Some(goes_on);
            }
            leads = wait::for_some(self.probe.as_mut()) => {
                self.probe = None;
                self.inbox.push_back(Input::Peer(leads));
            }
            Some(handover) = self.handovers.recv() => self.hand_over(handover),
            lost = wait::for_some(self.merging.as_mut()) => self.merged(lost),
            Some(done) = self.background.tasks.join_next() => self.done(done.ok().flatten()),
            Some(_) = self.endings.join_next() => {}
            () = wait::until(wake) => {
                if self.release_by.is_some_and(|by| by <= Instant::now()) {
                    self.release_by = None;
                    match self.released.take() {
                        Some((_, tell)) => {
                            let _ = tell.send(Err("etcd did not answer in time".to_owned()));
                        }
                        None if stop.is_cancelled() => return Some(None),
                        None => {}
                    }
                }
                self.inbox.push_back(Input::Wake);
            }
        }
        let stopped = stop.is_cancelled() && self.duty_is_free();
        stopped.then_some(None)
    }

    /// Whether nobody waits for this computer to give up leading.
    fn duty_is_free(&self) -> bool {
        self.machine.role() != Role::Leading && self.inbox.is_empty()
    }

    fn begin_stop(&mut self) -> Option<Option<ProcessError>> {
        if self.machine.role() != Role::Leading {
            return Some(None);
        }
        self.release_by = Some(Instant::now() + STOP_LIMIT);
        self.begin_release(String::new());
        None
    }

    fn hand_over(&mut self, handover: Handover) {
        let (to, tell) = handover;
        let refused = match self.machine.role() {
            Role::Leading if self.released.is_some() => Some("it is being done already".to_owned()),
            Role::Leading => self.known.successor(&to).err(),
            _ => Some("this computer does not lead".to_owned()),
        };
        if let Some(why) = refused {
            let _ = tell.send(Err(why));
            return;
        }
        tracing::info!(to, "giving up leading, as asked");
        self.begin_release(to.clone());
        self.release_by = Some(Instant::now() + HANDOVER_LIMIT);
        self.released = Some((to, tell));
    }

    /// Calls that write wait from now on for whoever leads next.
    fn begin_release(&mut self, to: String) {
        self.set_way(Way::Nobody { known: true });
        self.inbox.push_back(Input::HandOver(to));
    }

    fn set_way(&self, way: Way) {
        self.way.send_if_modified(|now| {
            let changes = *now != way;
            if changes {
                tracing::debug!(?way, "calls");
                *now = way;
            }
            changes
        });
    }

    /// The journal has changed.
    fn changed(&mut self, changes: Result<Vec<Change>, WatchEnd>) {
        let changes = match changes {
            Ok(changes) => changes,
            Err(end) => {
                if let WatchEnd::Failed(error) = end {
                    self.trouble.set(&error.into());
                }
                self.watch = None;
                self.load_at = Some(Instant::now() + AGAIN);
                return;
            }
        };
        self.trouble.clear();
        let keys = self.replica.keys.clone();
        for change in &changes {
            if let Err(error) = change.absorb(&mut self.view, &keys) {
                self.trouble.set(&error.into());
            }
            self.known.member(&keys, &change.key, change.kv.as_ref());
        }
        self.look_at_view();
        for change in changes {
            let Some(kv) = change.kv.filter(|kv| keys.seq_of(&kv.key).is_some()) else {
                continue;
            };
            if keys.seq_of(&kv.key).is_some_and(|seq| seq <= self.progress.seq) {
                continue;
            }
            // What is large is read apart, and so is what does not follow.
            let records = match Manifest::read(&kv.value) {
                Some(_) => None,
                None => journal::records(&kv.key, &kv.value).ok(),
            };
            let new = records.and_then(|of| self.progress.take(of, kv.value.len()).ok());
            match new {
                Some(new) => self.follow(&new),
                None => {
                    self.load_at.get_or_insert_with(Instant::now);
                    break;
                }
            }
        }
    }

    fn look_at_view(&mut self) {
        let leader = self.view.leader.as_ref();
        let other = leader.filter(|leader| leader.id != self.settings.id);
        self.seen_leading |= self.known.look(&self.view) && other.is_some();
        let term = self.given.post.ledger.session().term;
        // An earlier process of this computer has led, and nobody since.
        let before = |leader: &Leader| leader.name == self.settings.name && leader.term == term;
        if self.ours && self.loaded && other.is_some_and(|leader| !before(leader)) {
            self.ours = false;
            self.adopt_held();
        }
        self.inbox.push_back(Input::View(self.view.clone()));
    }

    /// New records of the journal.
    fn follow(&mut self, records: &[Record]) {
        apply(&mut self.held, records);
        if self.follows() {
            // Only if this computer has the master by now.
            let _ = self.given.post.ledger.follow(records);
        }
        if !self.has_master() {
            self.inbox.push_back(Input::Followed(self.progress.seq));
        }
    }

    fn have_loaded(&mut self, loaded: Result<Loaded, ReplicaError>) {
        let loaded = match loaded {
            Ok(loaded) => loaded,
            Err(error) => {
                self.trouble.set(&error);
                self.load_at = Some(Instant::now() + AGAIN);
                return;
            }
        };
        self.trouble.clear();
        if self.watch.is_none() {
            let range = self.replica.keys.small();
            let client = &self.replica.client;
            self.watch = Some(client.watch(range, loaded.view.revision, self.settings.ttl));
        }
        if loaded.view.revision >= self.view.revision {
            self.view = loaded.view;
        }
        self.loaded = true;
        if let Some(checkpoint) = loaded.checkpoint
            && loaded.progress.seq >= self.progress.seq
        {
            match Master::from_snapshot(checkpoint.snapshot) {
                Ok(state) => self.held = state,
                Err(error) => {
                    tracing::error!(%error, "the state in etcd is no state of a master; please report this");
                    return;
                }
            }
            apply(&mut self.held, &loaded.records);
            self.progress = loaded.progress;
            self.adopt_held();
        } else if let Ok(new) = self.progress.take(loaded.records, 0) {
            self.follow(&new);
        }
        self.look_at_view();
        if !self.has_master() {
            self.inbox.push_back(Input::Followed(self.progress.seq));
        }
    }
}

fn apply(state: &mut Master, records: &[Record]) {
    for record in records {
        if let Entry::Call { call, .. } = &record.entry {
            state.apply_telling(&Request::from(call.clone()), &mut ());
        }
    }
}

async fn failed(duty: &mut Option<Duty>) -> ProcessError {
    match duty {
        Some(duty) => duty.failed().await,
        None => std::future::pending().await,
    }
}

async fn next_changes(watch: &mut Option<Watch>) -> Result<Vec<Change>, WatchEnd> {
    match watch {
        Some(watch) => watch.next().await,
        None => std::future::pending().await,
    }
}
