//! The ledger: the mirror, which is a model of the master's whole state, and the journal of its changes, under one
//! lock. A write is applied to the mirror and passed to the journal in one step, and its answer waits until the journal
//! is [written](journal).
//!
//! The same lock orders writes and the start of a new incarnation, which is one life of a master process. So a reply of
//! the old master does not count if it arrives after the state for the new master was taken.

pub(crate) mod activity;
mod answers;
pub(crate) mod checkpointer;
pub(crate) mod delivery;
mod durability;
pub(crate) mod history;
mod injection;
pub(crate) mod journal;
pub(crate) mod late;
mod pending;
mod shared;
mod summary;

use std::{
    collections::HashSet,
    sync::{Mutex, MutexGuard, PoisonError, atomic::AtomicBool},
    time::Instant,
};

use tokio::sync::{Notify, watch};

use self::activity::{Activity, Noticed};
pub(crate) use self::durability::Mark;
use self::{
    durability::Whole,
    journal::Journal,
    late::LateState,
    pending::PendingWrites,
    shared::{Agreed, Shared},
};
use crate::{
    checkpoint::{
        format::{RecordContent, Session},
        store::Store,
    },
    cli::SyncPolicy,
    cluster::sharing::Source,
    health::port_of,
    master::{Master, Method, Request},
    order::Order,
    replay::{self, Answered, Token},
    status::stats::Stats,
    xmlrpc::Reply,
};

/// Refuses an outdated result: another incarnation (see [`Token`]) has begun, the mirror has changed since, or the
/// master is on another computer than the caller assumed.
#[derive(Debug)]
pub struct Superseded;

/// The result of recording answered calls.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Recorded {
    /// Identifies the last record of the calls, for [`Ledger::durable`].
    pub mark: Mark,
    /// Whether the mirror may differ from the master now.
    pub doubtful: bool,
}

/// What is needed to plan an injection, which brings a master to the mirror's state.
#[derive(Debug)]
pub struct Basis {
    pub mirror: Master,
    pub version: u64,
    /// Writes that the mirror has answered and the present master may not have run.
    pub pending: Vec<Request>,
}

/// Mirror, journal, and the state that keeps them consistent.
pub struct Ledger {
    inner: Mutex<Inner>,
    sync: SyncPolicy,
    stats: &'static Stats,
    /// Answers to calls up to this record need not wait for the disk.
    durable: watch::Sender<u64>,
    /// Whether a sync of the checkpoint takes longer than 5 s.
    sync_is_late: AtomicBool,
    /// Wakes the task that reports a silent disk.
    disk_silent: Notify,
    /// The last of this computer's records that the other computers have.
    agreed: watch::Sender<Agreed>,
    /// The time until which this computer may act as leader. See [`Ledger::set_lease`].
    lease: watch::Sender<Option<Instant>>,
    /// The mirror's version in the last complete checkpoint that was written or could not be written.
    attempted: watch::Sender<u64>,
    /// Wakes the checkpointer.
    pub work: Notify,
    /// Wakes the task that sends this computer's writes to the other computers.
    pub shared: Notify,
    /// Wakes the task that notifies nodes.
    pub outbox_changed: Notify,
    order_changed: watch::Sender<()>,
}

struct Inner {
    mirror: Master,
    /// The answers to `getPid` and `getUri`, which are not part of the state.
    identity: (i32, String),
    session: Session,
    /// `None` if no checkpoint could be opened. Then the state is unprotected.
    journal: Option<Journal>,
    shared: Shared,
    /// Changes whenever the mirror changes.
    version: u64,
    whole: Whole,
    pending: PendingWrites,
    activity: Activity,
    order: Order,
    diverged: HashSet<Method>,
    /// Whether a master is being brought to the mirror's state (an injection), so that the mirror must not change.
    injecting: bool,
    /// Whether the present master may differ from the mirror and must be read again.
    doubted: bool,
    /// Whether the present master may still run a batch whose reply is no longer awaited.
    abandoned: bool,
    /// The state that a late master will have once it has answered its outstanding calls.
    behind: Option<LateState>,
    /// The number of the last master to which calls have passed.
    served: Option<u64>,
    /// Whether the mirror comes from a checkpoint and has not been compared with a master yet. Then a living master may
    /// be newer than the mirror.
    unconfirmed: bool,
    /// Whether the session has changed and the change is not in the journal yet.
    session_unwritten: bool,
}

impl Ledger {
    /// Creates a ledger of `mirror`, recorded in `store`. `pending` are writes that the last master of `session` may
    /// not have run. `sync` says when a record must be on the disk.
    pub fn new(
        mirror: Master,
        session: Session,
        pending: Vec<Request>,
        store: Option<Store>,
        sync: SyncPolicy,
        stats: &'static Stats,
    ) -> Self {
        let mut inner = Inner {
            mirror,
            identity: (-1, String::new()),
            session,
            journal: None,
            shared: Shared::Nobody,
            version: 0,
            whole: Whole::default(),
            pending: PendingWrites::default(),
            activity: Activity::default(),
            order: Order::default(),
            diverged: HashSet::new(),
            injecting: false,
            doubted: false,
            abandoned: false,
            behind: None,
            served: None,
            unconfirmed: false,
            session_unwritten: false,
        };
        inner.add_pending(pending);
        inner.pending.are_restored();
        let ledger = Self {
            inner: Mutex::new(inner),
            sync,
            stats,
            durable: watch::channel(0).0,
            sync_is_late: AtomicBool::new(false),
            disk_silent: Notify::new(),
            agreed: watch::channel(Agreed::default()).0,
            lease: watch::channel(None).0,
            attempted: watch::channel(0).0,
            work: Notify::new(),
            shared: Notify::new(),
            outbox_changed: Notify::new(),
            order_changed: watch::channel(()).0,
        };
        if let Some(store) = store {
            ledger.set_store(store);
        }
        ledger
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // No code under the lock can panic in the middle of a change.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn with_mirror<T>(&self, look: impl FnOnce(&Master) -> T) -> T {
        look(&self.lock().mirror)
    }

    /// Notes that the mirror comes from a checkpoint, which may be older than a living master.
    pub fn set_unconfirmed(&self) {
        self.lock().unconfirmed = true;
    }

    /// Sets the answers to `getPid` and `getUri`.
    pub fn set_identity(&self, pid: i32, uri: String) {
        self.lock().set_identity((pid, uri));
    }

    /// The answer to `getUri`: rosrescue's own address.
    pub fn uri(&self) -> String {
        self.lock().identity.1.clone()
    }

    /// Sets the answer to `getPid`.
    pub fn set_master_pid(&self, pid: i32) {
        let mut inner = self.lock();
        let (_, uri) = inner.identity.clone();
        inner.set_identity((pid, uri));
    }

    pub fn session(&self) -> Session {
        self.lock().session.clone()
    }

    pub fn update_session(&self, change: impl FnOnce(&mut Session)) {
        self.lock().update_session(change);
        self.write_soon();
        self.work.notify_one();
    }

    /// The number in the present master's [`Token`].
    pub fn incarnation(&self) -> u64 {
        self.lock().session.incarnation
    }

    /// The [`Token`] that identifies the present master.
    pub fn token(&self) -> Token {
        self.lock().token()
    }

    /// Like [`Self::record_from`], for calls that were made on this computer.
    #[cfg(test)]
    pub(crate) fn record(
        &self,
        now: Instant,
        incarnation: u64,
        batch: &[(&Request, &Reply)],
    ) -> Result<Recorded, Superseded> {
        let batch: Vec<_> = batch
            .iter()
            .map(|(call, reply)| (*call, *reply, &Source::Here))
            .collect();
        self.record_from(now, incarnation, &batch)
    }

    /// Records and applies the calls in `batch`, which the master ran in this order and has answered. `incarnation` is
    /// the number in the [`Token`] of that master.
    pub(crate) fn record_from(
        &self,
        now: Instant,
        incarnation: u64,
        batch: &[(&Request, &Reply, &Source)],
    ) -> Result<Recorded, Superseded> {
        let mut inner = self.lock();
        if inner.session.incarnation != incarnation || inner.injecting || inner.is_elsewhere() {
            return Err(Superseded);
        }
        let mut recorded = Recorded::default();
        let mut answered = Vec::with_capacity(batch.len());
        for (call, reply, source) in batch {
            let accepted = replay::accepted(&inner.mirror, call, reply);
            recorded.doubtful |= !accepted.certain;
            answered.extend(accepted.calls.into_iter().map(|of| (of, *source)));
        }
        let writes = |(of, _): &(Answered<'_>, _)| {
            matches!(of.call.method(), Method::SetParam | Method::DeleteParam)
        };
        let last_write = answered.iter().rposition(writes).unwrap_or_default();
        let mut entries = Vec::with_capacity(answered.len());
        let mut sources = Vec::with_capacity(answered.len());
        let mut unrecorded = false;
        for (index, (answered, source)) in answered.into_iter().enumerate() {
            // An inexact mirror is known to differ from the master, which holds values that cannot be read from it.
            let is_inexact = inner.mirror.is_inexact();
            let outcome = inner.apply(now, answered.call, None, &self.outbox_changed);
            if !answered.agrees(&outcome, index < last_write) {
                if !is_inexact {
                    self.stats.divergences.count();
                    inner.report_divergence(&answered, &outcome);
                }
                recorded.doubtful = true;
                if !answered.executed {
                    // No journal has a record of a refused call.
                    unrecorded = true;
                }
            }
            if answered.executed {
                entries.push(RecordContent::call(answered.call.clone().into()));
                sources.push(source);
            }
        }
        inner.doubted |= recorded.doubtful;
        let has_entries = !entries.is_empty();
        if has_entries {
            self.stats.writes_recorded.add(entries.len() as u64);
            inner.append_from(entries, &sources);
        }
        if unrecorded {
            inner.changed_unrecorded();
        }
        if unrecorded || has_entries {
            recorded.mark = inner.mark();
            drop(inner);
            self.recorded();
        }
        Ok(recorded)
    }

    /// Records and applies a call made by rosrescue before there is a master.
    pub fn seed(&self, call: &Request) {
        let mut inner = self.lock();
        inner.apply(Instant::now(), call, None, &self.outbox_changed);
        inner.append(vec![RecordContent::call(call.clone().into())]);
        drop(inner);
        self.write_soon();
    }

    /// Wakes the tasks that write and replicate records.
    fn recorded(&self) {
        self.work.notify_one();
        self.shared.notify_one();
    }

    /// Number of writes that the mirror has answered and the present master may not have run.
    pub fn pending(&self) -> usize {
        self.lock().pending.calls().len()
    }

    /// The parameter subscriptions that the present master may hold. They follow from the mirror and the pending
    /// writes, because they cannot be read from a master.
    pub fn may_hold(&self) -> Master {
        let inner = self.lock();
        replay::may_hold(&inner.mirror, inner.pending.calls())
    }

    /// Notes that the present master may differ from the mirror and must be read again.
    pub fn doubt(&self) {
        let mut inner = self.lock();
        inner.doubted = true;
        // An inspection that is running may have read the master too early.
        inner.version += 1;
        drop(inner);
        // Wakes the write queue, which reads the master.
        self.order_changed.send_replace(());
    }

    /// Whether the present master may differ from the mirror.
    pub fn is_doubted(&self) -> bool {
        self.lock().doubted
    }

    /// The mirror's version. Equal versions mean equal states.
    pub fn version(&self) -> u64 {
        self.lock().version
    }

    /// Sets the mirror to `state`, which the master holds. Returns the differences as a few sentences without values.
    pub fn adopt(&self, state: Master) -> Vec<String> {
        let difference = self.lock().adopt(state);
        self.recorded();
        difference
    }

    /// Like [`Self::adopt`], but only if `state` was read from the present master, whose [`Token`] has the number
    /// `incarnation`, while the mirror was at `version`.
    pub fn adopt_if(
        &self,
        incarnation: u64,
        version: u64,
        state: Master,
    ) -> Result<Vec<String>, Superseded> {
        let mut inner = self.lock();
        if inner.injecting
            || inner.is_elsewhere()
            || (inner.session.incarnation, inner.version) != (incarnation, version)
        {
            return Err(Superseded);
        }
        let difference = inner.adopt(state);
        inner.doubted = false;
        drop(inner);
        self.recorded();
        Ok(difference)
    }

    /// Runs `work` on the mirror and the recent activity.
    pub fn with_activity<T>(&self, work: impl FnOnce(&Master, &mut Activity) -> T) -> T {
        let mut inner = self.lock();
        let Inner {
            mirror, activity, ..
        } = &mut *inner;
        work(mirror, activity)
    }
}

impl Inner {
    /// Applies `call` to the mirror. `standing_in` is `None` if a master notifies the nodes. Otherwise rosrescue must
    /// notify them, and the value says whether `call` changes the mirror.
    fn apply(
        &mut self,
        now: Instant,
        call: &Request,
        standing_in: Option<bool>,
        outbox_changed: &Notify,
    ) -> Reply {
        let mut noticed = Noticed::new(standing_in.is_some());
        noticed.displaced = self.activity.displaced_by(&self.mirror, call);
        self.activity.note_lost(&self.mirror, call);
        let reply = self.mirror.apply_telling(call, &mut noticed);
        self.version += u64::from(standing_in.unwrap_or(true));
        match noticed.take_calls() {
            Some(calls) => {
                for (api, subject, call) in calls {
                    self.order.notify(port_of(&api), subject, call);
                    outbox_changed.notify_one();
                }
            }
            None => {
                for (subject, nodes) in noticed.subjects() {
                    self.order.told_by_master(now, &subject, nodes);
                }
                if self.order.has_new_repeat() {
                    outbox_changed.notify_one();
                }
            }
        }
        let registered = |node: &str| self.mirror.api_of(node).is_some();
        if self.activity.applied(now, call, noticed, registered) {
            outbox_changed.notify_one();
        }
        reply
    }

    fn set_identity(&mut self, identity: (i32, String)) {
        self.mirror.set_identity(identity.0, identity.1.clone());
        self.identity = identity;
    }

    fn adopt(&mut self, state: Master) -> Vec<String> {
        let mut difference = Vec::new();
        let differs = self.mirror != state;
        if differs {
            difference = replay::difference(&self.mirror, &state);
            self.version += 1;
        }
        let (python, old) = (self.mirror.python(), self.mirror.is_old());
        // An equal `state` replaces the mirror too, because the new one may be known more exactly.
        self.mirror = state;
        self.mirror.set_python(python);
        self.mirror.set_old(old);
        if differs {
            self.changed_unrecorded();
        }
        self.set_identity(self.identity.clone());
        difference
    }

    fn add_pending(&mut self, writes: impl IntoIterator<Item = Request>) {
        if self.pending.extend(writes).is_err() {
            // If the present master answers again, it gets the mirror's whole state.
            self.raise_incarnation();
            self.write_session();
        }
    }

    fn raise_incarnation(&mut self) {
        self.behind = None;
        self.pending.clear();
        self.session.incarnation += 1;
        self.session.delivered = self.seq();
        self.session_unwritten = true;
    }

    fn update_session(&mut self, change: impl FnOnce(&mut Session)) {
        change(&mut self.session);
        self.session_unwritten = true;
        self.write_session();
    }

    fn write_session(&mut self) {
        if std::mem::take(&mut self.session_unwritten) {
            // While a complete checkpoint is due, the file lacks changes that have no record.
            self.session.cluster_seq = match self.whole.is_due() {
                true => 0,
                false => self.cluster_seq(),
            };
            let entry = RecordContent::Session(self.session.clone());
            self.append(vec![entry]);
        }
    }

    fn token(&self) -> Token {
        Token::new(&self.session.mark, self.session.incarnation)
    }

    /// Notes that the mirror has changed without a record. The next complete checkpoint is due.
    fn changed_unrecorded(&mut self) {
        self.whole.unrecorded = self.version;
        self.share_state();
    }

    /// Number of the journal's last record.
    fn seq(&self) -> u64 {
        self.last_seq().unwrap_or_default()
    }

    /// Number of the journal's last record. `None` without a journal.
    fn last_seq(&self) -> Option<u64> {
        self.journal.as_ref().map(Journal::seq)
    }

    /// Identifies the last record, so that an answer can wait for it.
    fn mark(&self) -> Mark {
        Mark {
            disk: self.last_seq(),
            shared: self.shared.last(),
        }
    }

    /// Passes `entries` to the journal. A failure is kept in the store, and does not fail the call.
    fn append(&mut self, entries: Vec<RecordContent>) {
        self.append_from(entries, &[]);
    }

    /// Like [`Self::append`], with the source of each call. Missing sources stand for this computer.
    fn append_from(&mut self, entries: Vec<RecordContent>, sources: &[&Source]) {
        // The session's record comes first, because it names the incarnation of the following entries.
        self.write_session();
        self.share(&entries, sources);
        if let Some(journal) = self.journal.as_mut().filter(|_| !entries.is_empty()) {
            journal.append(entries);
        }
    }
}

#[cfg(test)]
mod tests;
