//! Mirror and journal under one lock: a write is recorded and applied in one step.
//!
//! The lock also orders both against the takeover by a new incarnation: a reply of the old master that
//! arrives after the injection's state was taken is not acknowledged.

pub(crate) mod activity;
pub(crate) mod checkpointer;
mod durability;
mod injection;
mod pending;
mod summary;

use std::{
    collections::HashSet,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Instant,
};

use tokio::sync::{Notify, watch};

use self::activity::{Activity, Noticed};
use self::{durability::Whole, pending::PendingWrites};
use crate::{
    checkpoint::{
        format::{Entry, Session},
        store::Store,
    },
    cli::SyncPolicy,
    master::{Kind, Master, Method, Request},
    replay::{self, Answered, Token},
    status::stats::Stats,
    xmlrpc::Reply,
};

/// Most pending writes beside which unregistrations without effect on the mirror are kept.
const UNCHANGED_PENDING_MAX: usize = 1000;

/// Memory for the answers to the reads of one multicall, in bytes. A few short reads of a large state could
/// ask for any amount; larger ones wait for the master.
const ANSWER_MOST: usize = 64 << 20;

/// The answer does not count, and the master must be asked again: another incarnation has taken over, or the
/// mirror has changed since.
#[derive(Debug)]
pub struct Superseded;

/// The result of recording answered calls.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Recorded {
    /// The journal's last record of them; none if nothing had to be recorded.
    pub seq: Option<u64>,
    /// Whether the mirror is no longer known to equal the master.
    pub doubtful: bool,
}

/// The state that an injection starts from.
#[derive(Debug)]
pub struct Basis {
    pub mirror: Master,
    pub version: u64,
    /// Writes that the present incarnation may not have run.
    pub pending: Vec<Request>,
}

/// The mirror, the journal and their bookkeeping.
pub struct Ledger {
    inner: Mutex<Inner>,
    sync: SyncPolicy,
    stats: &'static Stats,
    durable: watch::Sender<u64>,
    /// The mirror's version in the last whole checkpoint that was attempted.
    attempted: watch::Sender<u64>,
    /// Wakes the checkpointer.
    pub work: Notify,
    /// Wakes the task that notifies nodes.
    pub outbox_changed: Notify,
}

struct Inner {
    mirror: Master,
    /// The answers to getPid and getUri; not a part of the state.
    identity: (i32, String),
    session: Session,
    /// None if no checkpoint could be opened: the state is unprotected.
    store: Option<Store>,
    /// Changes whenever the mirror changes.
    version: u64,
    whole: Whole,
    pending: PendingWrites,
    activity: Activity,
    diverged: HashSet<Method>,
    /// An injection is under way: the mirror must not change.
    injecting: bool,
    doubted: bool,
    /// The present incarnation may still run a batch whose reply is no longer awaited.
    abandoned: bool,
    /// The incarnation that was served last.
    served: Option<u64>,
}

impl Ledger {
    /// A ledger of `mirror`, recorded in `store`. `pending`: writes that the incarnation of `session` may not
    /// have run. `sync`: when a record must be on the disk.
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
            store,
            version: 0,
            whole: Whole::default(),
            pending: PendingWrites::default(),
            activity: Activity::default(),
            diverged: HashSet::new(),
            injecting: false,
            doubted: false,
            abandoned: false,
            served: None,
        };
        inner.add_pending(pending);
        Self {
            inner: Mutex::new(inner),
            sync,
            stats,
            durable: watch::channel(0).0,
            attempted: watch::channel(0).0,
            work: Notify::new(),
            outbox_changed: Notify::new(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // No code under the lock can panic in the middle of a change.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn with_mirror<T>(&self, look: impl FnOnce(&Master) -> T) -> T {
        look(&self.lock().mirror)
    }

    /// The master's predicted answer to a read; none if it is a multicall that asks for too much.
    pub fn answer(&self, read: &Request) -> Option<Reply> {
        let mirror = &mut self.lock().mirror;
        let fits = mirror.fits(read, ANSWER_MOST);
        fits.then(|| mirror.apply_telling(read, &mut ()))
    }

    /// As [`Self::answer`], to a write of the Master API that changes nothing; none if it changes something.
    /// Nodes are notified as by a master. Returns the journal's last record too: the earlier write that made
    /// this one redundant may be as new as that.
    pub fn answer_if_unchanged(
        &self,
        now: Instant,
        write: &Request,
    ) -> Option<(Reply, Option<u64>)> {
        let mut inner = self.lock();
        // An unregistration may concern a registration that is still on its way to the master.
        let idle = !write.calls().into_iter().any(is_unregistration)
            && !inner.mirror.would_change(write)
            && inner.mirror.fits(write, ANSWER_MOST);
        idle.then(|| {
            let reply = inner.apply(now, write, Some(false), &self.outbox_changed);
            (reply, inner.last_seq())
        })
    }

    /// Sets the answers to getPid and getUri.
    pub fn set_identity(&self, pid: i32, uri: String) {
        self.lock().set_identity((pid, uri));
    }

    /// Sets the answer to getPid.
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
        self.work.notify_one();
    }

    /// The number of the present incarnation.
    pub fn incarnation(&self) -> u64 {
        self.lock().session.incarnation
    }

    /// The token of the present incarnation.
    pub fn token(&self) -> Token {
        self.lock().token()
    }

    /// Records and applies calls that the master of `incarnation` has answered, in the order in which it ran
    /// them.
    pub fn record(
        &self,
        now: Instant,
        incarnation: u64,
        batch: &[(&Request, &Reply)],
    ) -> Result<Recorded, Superseded> {
        let mut inner = self.lock();
        if inner.session.incarnation != incarnation || inner.injecting {
            return Err(Superseded);
        }
        let mut recorded = Recorded::default();
        let mut answered = Vec::with_capacity(batch.len());
        for (call, reply) in batch {
            let accepted = replay::accepted(&inner.mirror, call, reply);
            recorded.doubtful |= !accepted.certain;
            answered.extend(accepted.calls);
        }
        let writes =
            |of: &Answered<'_>| matches!(of.call.method(), Method::SetParam | Method::DeleteParam);
        let last_write = answered.iter().rposition(writes).unwrap_or_default();
        let mut entries = Vec::with_capacity(answered.len());
        for (index, answered) in answered.into_iter().enumerate() {
            let outcome = inner.apply(now, answered.call, None, &self.outbox_changed);
            if !answered.agrees(&outcome, index < last_write) {
                self.stats.divergences.count();
                inner.report_divergence(&answered, &outcome);
                recorded.doubtful = true;
                if !answered.executed {
                    // A refused call is in no journal.
                    inner.changed_unrecorded();
                }
            }
            if answered.executed {
                entries.push(Entry::call(answered.call.clone().into()));
            }
        }
        if !entries.is_empty() {
            self.stats.recorded.add(entries.len() as u64);
            recorded.seq = inner.append(&entries);
            drop(inner);
            self.work.notify_one();
        }
        Ok(recorded)
    }

    /// The master's predicted answer to this call.
    pub fn predict(&self, call: &Request) -> Reply {
        let mut model = self.with_mirror(Clone::clone);
        model.apply_telling(call, &mut ())
    }

    /// Records and applies a call of our own before there is a master.
    pub fn seed(&self, call: &Request) {
        let mut inner = self.lock();
        inner.apply(Instant::now(), call, None, &self.outbox_changed);
        inner.append(&[Entry::call(call.clone().into())]);
    }

    /// Answers a call of the Master API as an absent master would: records its changes as pending, applies
    /// them, and has nodes notified. Returns the journal's last record too: that of the call or, if it
    /// changes nothing, of what made it redundant.
    ///
    /// None during an injection, or if the call also reads too much: it has to wait.
    pub fn stand_in(&self, now: Instant, call: &Request) -> Option<(Reply, Option<u64>)> {
        let mut inner = self.lock();
        if inner.injecting || !inner.mirror.fits(call, ANSWER_MOST) {
            return None;
        }
        let changes = inner.mirror.would_change(call);
        let reply = inner.apply(now, call, Some(changes), &self.outbox_changed);
        let mut writes: Vec<&Request> = match reply {
            // The writes were applied; only the answer could not be encoded. A refused one is refused again.
            Reply::Fault { .. } => {
                let writes = call.calls().into_iter();
                writes.filter(|call| call.kind().mutates()).collect()
            }
            Reply::Value(_) => {
                let accepted = replay::accepted(&inner.mirror, call, &reply).calls;
                let executed = accepted.into_iter().filter(|of| of.executed);
                executed.map(|of| of.call).collect()
            }
        };
        if !changes {
            // The master may hold what the mirror lacks: a registration that it ran for a rosrescue that died
            // before the reply.
            let room = inner.pending.calls().len() < UNCHANGED_PENDING_MAX;
            writes.retain(|call| room && is_unregistration(call) && !inner.pending.contains(call));
        }
        if writes.is_empty() {
            return Some((reply, inner.last_seq()));
        }
        // Makes an inspection under way outdated: it could bring back what this call takes away.
        inner.version += u64::from(!changes);
        self.stats.recorded.add(writes.len() as u64);
        let entries = writes.iter().map(|&call| Entry::Call {
            call: call.clone().into(),
            pending: true,
        });
        let seq = inner.append(&entries.collect::<Vec<_>>());
        inner.add_pending(writes.into_iter().cloned());
        drop(inner);
        self.work.notify_one();
        Some((reply, seq))
    }

    /// Number of writes that the present incarnation may not have run.
    pub fn pending(&self) -> usize {
        self.lock().pending.calls().len()
    }

    /// Parameter subscriptions that the present incarnation may hold; they cannot be read from it.
    pub fn may_hold(&self) -> Master {
        let inner = self.lock();
        replay::may_hold(&inner.mirror, inner.pending.calls())
    }

    /// The present master may differ from the mirror and must be read again.
    pub fn doubt(&self) {
        self.lock().doubted = true;
    }

    /// Whether there was such a doubt. Clears it.
    pub fn take_doubt(&self) -> bool {
        std::mem::take(&mut self.lock().doubted)
    }

    /// The mirror's version: equal versions mean equal states.
    pub fn version(&self) -> u64 {
        self.lock().version
    }

    /// Sets the mirror to `state`, which the master holds. Returns the differences, in a few sentences
    /// without values.
    pub fn adopt(&self, state: Master) -> Vec<String> {
        let difference = self.lock().adopt(state);
        self.work.notify_one();
        difference
    }

    /// As [`Self::adopt`], if `state` was read from the master of `incarnation` when the mirror was at
    /// `version`.
    pub fn adopt_if(
        &self,
        incarnation: u64,
        version: u64,
        state: Master,
    ) -> Result<Vec<String>, Superseded> {
        let mut inner = self.lock();
        if inner.injecting || (inner.session.incarnation, inner.version) != (incarnation, version) {
            return Err(Superseded);
        }
        let difference = inner.adopt(state);
        drop(inner);
        self.work.notify_one();
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

/// Whether a call, other than a multicall, is an unregistration.
fn is_unregistration(call: &Request) -> bool {
    *call.method() != Method::Multicall && call.kind() == Kind::Unregister
}

impl Inner {
    /// Applies `call`. `standing_in`: whether it changes anything; none if a master notifies nodes of it.
    fn apply(
        &mut self,
        now: Instant,
        call: &Request,
        standing_in: Option<bool>,
        outbox_changed: &Notify,
    ) -> Reply {
        let mut noticed = Noticed::new(standing_in.is_some());
        noticed.displaced = self.activity.displaced_by(&self.mirror, call);
        let reply = self.mirror.apply_telling(call, &mut noticed);
        self.version += u64::from(standing_in.unwrap_or(true));
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
        if self.mirror == state {
            return Vec::new();
        }
        let difference = replay::difference(&self.mirror, &state);
        self.mirror = state;
        self.set_identity(self.identity.clone());
        self.version += 1;
        self.changed_unrecorded();
        difference
    }

    fn add_pending(&mut self, writes: impl IntoIterator<Item = Request>) {
        if self.pending.extend(writes).is_err() {
            // If the present incarnation comes back, the mirror's state replaces everything it holds.
            self.next_incarnation();
        }
    }

    fn next_incarnation(&mut self) {
        self.pending.clear();
        let seq = self.seq();
        self.update_session(|session| {
            session.incarnation += 1;
            session.delivered = seq;
        });
    }

    fn update_session(&mut self, change: impl FnOnce(&mut Session)) {
        change(&mut self.session);
        let entry = Entry::Session(self.session.clone());
        self.append(&[entry]);
    }

    fn token(&self) -> Token {
        Token::new(&self.session.mark, self.session.incarnation)
    }

    /// The mirror has changed without a journaled call: a whole checkpoint is due.
    fn changed_unrecorded(&mut self) {
        self.whole.unrecorded = self.version;
    }

    /// Number of the journal's last record.
    fn seq(&self) -> u64 {
        self.last_seq().unwrap_or_default()
    }

    /// The same; none without a journal.
    fn last_seq(&self) -> Option<u64> {
        self.store.as_ref().map(Store::seq)
    }

    /// Appends to the journal. A failure is kept by the store and does not fail the call.
    fn append(&mut self, entries: &[Entry]) -> Option<u64> {
        let store = self.store.as_mut()?;
        if entries.is_empty() {
            return None;
        }
        match store.append(entries) {
            Ok(seq) => Some(seq),
            Err(error) => {
                tracing::debug!(%error, "append");
                None
            }
        }
    }
}

#[cfg(test)]
mod tests;
