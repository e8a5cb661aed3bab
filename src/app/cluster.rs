//! This computer as one of several: the shell around [`Machine`], which decides who leads.
//!
//! One task holds what the journal in etcd says, and brings the ledger there while another computer leads. While
//! this one has the master, it gives the ledger's changes to the journal.

mod background;
mod cut_off;
mod facts;
mod handover;
mod join;
mod merging;
mod outgoing;
mod reading;
mod roles;
mod survey;

use std::{
    collections::VecDeque,
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::{
    sync::{mpsc, watch},
    task::JoinSet,
};
use tokio_util::{sync::CancellationToken, task::AbortOnDropHandle};

pub(super) use self::join::{Given, join};
use self::{
    background::{Background, Trouble},
    cut_off::CutOff,
    facts::Known,
    handover::HANDOVER_LIMIT,
    outgoing::Outgoing,
};
use super::{RunError, duty::Duty};
use crate::{
    checkpoint::format::{Entry, Record},
    cluster::{
        displaced::DisplacedLately,
        etcd::{Change, Watch, WatchEnd},
        journal::Progress,
        machine::{Action, Answer, Input, Machine, Op, Role, Settings, View},
        namesake,
        replica::{Loaded, Replica, ReplicaError},
        way::{Place, Way},
    },
    limit::rarely,
    master::{Master, Request},
    process::ProcessError,
    recovery::master_process::MasterProcess,
    server::others::{Forwarded, Handover},
    upstream::peer::Peers,
    wait,
};

/// Pause before etcd is asked again for what it did not give.
const AGAIN: Duration = Duration::from_millis(200);

type Loading = Pin<Box<dyn Future<Output = Result<Loaded, ReplicaError>> + Send>>;
type Flag = Pin<Box<dyn Future<Output = bool> + Send>>;
type Deciding = Pin<Box<dyn Future<Output = Input> + Send>>;
type Merging = Pin<Box<dyn Future<Output = u64> + Send>>;

/// See the [module](self).
pub(super) struct Member {
    given: Given,
    settings: Settings,
    machine: Machine,
    replica: Replica,
    way: watch::Sender<Way>,
    /// Who leads, also while calls wait.
    leads: watch::Sender<Way>,
    peers: Arc<Peers>,
    /// Writes of this computer that a leader has not answered yet.
    forwarded: Arc<Forwarded>,
    /// How far the mirror holds the journal.
    followed: watch::Sender<Place>,
    handovers: mpsc::Receiver<Handover>,
    /// When the machine is started, even if etcd's state has not been read.
    start_by: Option<Instant>,
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
    /// How far the machine knows that it has been read.
    reported: u64,
    /// The journal's state, and how far it has been read.
    held: Master,
    displaced: DisplacedLately,
    progress: Progress,
    outgoing: Outgoing,
    duty: Option<Duty>,
    /// Processes that are being ended.
    endings: JoinSet<()>,
    cut_off: Option<CutOff>,
    /// The writes of the oldest time alone are being sent. Gives how many did not hold.
    merging: Option<Merging>,
    /// The ledger's state wins over the journal's if this computer leads next.
    ours: bool,
    /// Who led before, and when it was heard of last.
    before: Option<(String, Instant)>,
    /// It has given up leading by itself.
    was_released: bool,
    /// This process has claimed with success.
    led: bool,
    /// Where another computer of this name is.
    namesake: Option<String>,
    /// Looks for one since etcd's state has been read.
    namesakes: Option<namesake::Watch>,
    /// Whether the session in etcd continues, while that is found out.
    deciding: Option<Deciding>,
    probe: Option<Flag>,
    probe_at: Option<Instant>,
    /// Who waits for this computer to give up leading, and until when.
    released: Option<Handover>,
    release_by: Option<Instant>,
    /// rosrescue stops, and rosout first.
    ending_roscore: Option<Pin<Box<dyn Future<Output = ()> + Send>>>,
    trouble: Arc<Trouble>,
    known: Known,
    background: Background,
}

impl Member {
    /// Takes part until `stop`.
    ///
    /// # Errors
    ///
    /// If no master can be started, or another computer has the same name.
    pub(super) async fn run(
        mut self: Box<Self>,
        stop: CancellationToken,
    ) -> Result<Option<MasterProcess>, RunError> {
        self.try_endpoints();
        loop {
            while let Some(input) = self.inbox.pop_front() {
                self.take(input).await;
            }
            self.catch_up();
            self.tend().await;
            if !self.inbox.is_empty() {
                continue;
            }
            let end = match self.namesake.take() {
                Some(uri) => Some(Some(self.namesake_at(uri))),
                None => self.next(&stop).await,
            };
            if let Some(result) = end {
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
        self.given.context.ledger.set_lease(self.machine.lease(now));
        for action in actions {
            if !matches!(action, Action::Send { .. } | Action::Acknowledge(_)) {
                tracing::debug!(?action, "cluster");
            }
            self.carry_out(action).await;
        }
        for change in self.outgoing.committed(self.machine.committed()) {
            self.hold(change);
        }
    }

    async fn carry_out(&mut self, action: Action) {
        match action {
            Action::Send { number, op } => self.send(number, op),
            Action::CatchUp(seq) => self.wanted = Some(seq),
            Action::Become(role) => self.become_role(role).await,
            Action::Acknowledge(seq) => self.given.context.ledger.agree(seq),
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
        let parts = match (&entry, self.machine.term()) {
            (Some(_), Some(term)) => Some((term, self.outgoing.missing_parts(&replica.keys))),
            _ => None,
        };
        let run = async move {
            let run = async {
                if let Some((term, parts)) = parts.filter(|(_, parts)| !parts.is_empty()) {
                    replica.prepare(term, &parts).await?;
                }
                replica.run(&settings, &op, entry.as_ref()).await
            };
            match run.await {
                Ok(answer) => {
                    trouble.clear();
                    answer
                }
                Err(error) => {
                    trouble.set(&error);
                    Answer::Silence
                }
            }
        };
        self.requests.spawn(answered(number, run));
    }

    /// The next event; an end if there is one.
    async fn next(&mut self, stop: &CancellationToken) -> Option<Option<RunError>> {
        let stopping = self.release_by.is_some() && self.released.is_none();
        let wake = [
            self.machine.deadline(),
            self.load_at.filter(|_| self.loading.is_none()),
            self.probe_at.filter(|_| self.probe.is_none()),
            self.release_by,
            self.start_by,
            self.background.due(),
        ];
        let wake = wake.into_iter().flatten().min().map(Into::into);
        tokio::select! {
            biased;
            () = stop.cancelled(), if !stopping => return self.begin_stop(),
            error = failed(&mut self.duty) => return Some(Some(error.into())),
            Some(done) = self.requests.join_next() => self.inbox.extend(done),
            () = self.given.context.ledger.shared.notified() => self.take_changes().await,
            done = wait::for_some(self.outgoing.preparing.as_mut()) => self.prepared(done),
            changes = next_changes(&mut self.watch) => self.changed(changes),
            loaded = wait::for_some(self.loading.as_mut()) => {
                self.loading = None;
                self.have_loaded(loaded);
            }
            decided = wait::for_some(self.deciding.as_mut()) => {
                self.deciding = None;
                self.inbox.push_back(decided);
            }
            leads = wait::for_some(self.probe.as_mut()) => {
                self.probe = None;
                self.inbox.push_back(Input::Peer(leads));
            }
            Some(handover) = self.handovers.recv() => self.hand_over(handover),
            lost = wait::for_some(self.merging.as_mut()) => self.merged(lost).await,
            Some(done) = self.background.tasks.join_next() => self.done(done.ok().flatten()),
            Some(_) = self.endings.join_next() => {}
            () = wait::for_some(self.ending_roscore.as_mut()) => {
                self.ending_roscore = None;
                if self.machine.role() != Role::Leading {
                    return Some(None);
                }
                self.begin_release(String::new());
            }
            () = wait::until(wake) => {
                if self.release_by.is_some_and(|by| by <= Instant::now()) {
                    self.release_by = None;
                    match self.released.take() {
                        Some((_, tell)) => {
                            let why = format!("etcd did not answer within {HANDOVER_LIMIT:?}");
                            let _ = tell.send(Err(why));
                        }
                        None if stop.is_cancelled() => return Some(None),
                        None => {}
                    }
                }
                if self.start_by.is_some_and(|by| by <= Instant::now()) {
                    self.start();
                }
                self.inbox.push_back(Input::Wake);
            }
        }
        let stopped = stop.is_cancelled() && self.may_stop();
        stopped.then_some(None)
    }

    /// Brings the state that is held of the journal forward by `records`.
    fn hold_records(&mut self, records: &[Record]) {
        let now = Instant::now();
        for request in calls(records) {
            self.displaced.note(now, &self.held, &request);
            self.held.apply_telling(&request, &mut ());
        }
    }

    /// Says who leads. Calls of nodes wait as long as what was answered before them, alone, is on its way.
    fn set_way(&self, way: Way) {
        let leads = matches!(way, Way::Leader { .. } | Way::Here { term: Some(_) });
        let owes = self.cut_off.is_some();
        self.leads.send_replace(way.clone());
        let way = match leads && owes {
            true => Way::Nobody { known: true },
            false => way,
        };
        self.way.send_if_modified(|now| {
            let changes = *now != way;
            if changes {
                tracing::debug!(?way, "calls");
                *now = way;
            }
            changes
        });
    }
}

/// The answer of a request to etcd. The machine waits for each: one that panics is given up, as if etcd were silent.
async fn answered(number: u64, run: impl Future<Output = Answer> + Send + 'static) -> Input {
    let run = AbortOnDropHandle::new(tokio::spawn(run));
    let answer = run.await.unwrap_or_else(|error| {
        tracing::error!(%error, "a request to etcd was not finished; please report this line");
        Answer::Silence
    });
    Input::Answer { number, answer }
}

fn apply(state: &mut Master, records: &[Record]) {
    for request in calls(records) {
        state.apply_telling(&request, &mut ());
    }
}

fn calls(records: &[Record]) -> impl Iterator<Item = Request> {
    records.iter().filter_map(|record| match &record.entry {
        Entry::Call { call, .. } => Some(Request::from(call.clone())),
        Entry::Session(_) => None,
    })
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

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_request_that_panics_is_answered() {
        let answered = answered(7, async { panic!("on purpose") }).await;
        let expected = |input: &Input| {
            matches!(
                input,
                Input::Answer {
                    number: 7,
                    answer: Answer::Silence
                }
            )
        };
        assert!(expected(&answered), "{answered:?}");
    }
}
