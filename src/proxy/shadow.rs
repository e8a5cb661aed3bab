//! The mirror and its checkpoint under one lock: what the master knows, kept twice.
//!
//! The lock makes "recorded" and "applied" one step, and orders both against the moment at which a
//! new incarnation takes over: a reply of the old master that arrives after its state was taken for
//! the injection is not acknowledged, and the call travels again.

mod keeping;
mod words;

use std::{
    collections::HashSet,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Instant,
};

use tokio::sync::{Notify, watch};

use self::keeping::Whole;
use super::activity::{Activity, Noticed};
use super::stats::Stats;
use crate::{
    master::{self, Agreement, Answered, Master},
    record::{Checkpoint, Entry, Session},
    store::Store,
    xmlrpc::{Call, Reply},
};

/// Unregistrations that take nothing away are remembered beside so many others.
const OWED_IDLY: usize = 1000;

/// Memory that the answers to the reads in one multicall may take, in bytes. A few short reads of a large
/// state ask for any amount of it, and wait for the master instead.
const ANSWER_MOST: usize = 64 << 20;

/// The master that answered has been succeeded by another one, or what it showed by what the mirror has
/// taken since: it does not count, and must be asked again.
#[derive(Debug)]
pub struct Superseded;

/// What became of calls that the master answered.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Recorded {
    /// The journal's last record of them; none if nothing had to be recorded.
    pub seq: Option<u64>,
    /// Whether the mirror is no longer known to equal the master.
    pub doubtful: bool,
}

/// The mirror, the journal and what belongs to them.
pub struct Shadow {
    inner: Mutex<Inner>,
    stats: &'static Stats,
    durable: watch::Sender<u64>,
    /// The mirror's version in the last whole checkpoint that was attempted.
    attempted: watch::Sender<u64>,
    /// Wakes the keeper of the checkpoint.
    pub work: Notify,
    /// Wakes those who tell nodes the news.
    pub news: Notify,
}

struct Inner {
    mirror: Master,
    /// What getPid and getUri answer; no part of the state.
    identity: (i32, String),
    session: Session,
    /// None if no checkpoint could be opened: unprotected.
    store: Option<Store>,
    incarnation: u64,
    /// Changes with every change of the mirror.
    version: u64,
    whole: Whole,
    /// Unregistrations taken while the gate was shut: the same incarnation, should it come back,
    /// has not heard of them.
    owed: Vec<Call>,
    activity: Activity,
    diverged: HashSet<String>,
    frozen: bool,
    doubted: bool,
}

impl Shadow {
    /// A shadow of `mirror`, recorded in `store`.
    pub fn new(
        mirror: Master,
        session: Session,
        store: Option<Store>,
        stats: &'static Stats,
    ) -> Self {
        let inner = Inner {
            mirror,
            identity: (-1, String::new()),
            session,
            store,
            incarnation: 0,
            version: 0,
            whole: Whole::default(),
            owed: Vec::new(),
            activity: Activity::default(),
            diverged: HashSet::new(),
            frozen: true,
            doubted: false,
        };
        Self {
            inner: Mutex::new(inner),
            stats,
            durable: watch::channel(0).0,
            attempted: watch::channel(0).0,
            work: Notify::new(),
            news: Notify::new(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // No code under the lock can panic half-way through a change that matters.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Looks at the mirror.
    pub fn with_mirror<T>(&self, look: impl FnOnce(&Master) -> T) -> T {
        look(&self.lock().mirror)
    }

    /// What the master would answer to a read; none if it is a multicall that asks for too much.
    pub fn answer(&self, read: &Call) -> Option<Reply> {
        let mirror = &mut self.lock().mirror;
        let fits = mirror.fits(read, ANSWER_MOST);
        fits.then(|| mirror.apply_telling(read, &mut ()))
    }

    /// Tells the mirror what getPid and getUri answer.
    pub fn set_identity(&self, pid: i32, uri: String) {
        let mut inner = self.lock();
        inner.mirror.set_identity(pid, uri.clone());
        inner.identity = (pid, uri);
    }

    /// The session as it is recorded.
    pub fn session(&self) -> Session {
        self.lock().session.clone()
    }

    /// Changes the session and records it.
    pub fn update_session(&self, change: impl FnOnce(&mut Session)) {
        let mut inner = self.lock();
        change(&mut inner.session);
        let entry = Entry::Session(inner.session.clone());
        inner.append(&[entry]);
        drop(inner);
        self.work.notify_one();
    }

    /// Records and applies calls that the master of `incarnation` has answered, in its order.
    pub fn record(
        &self,
        now: Instant,
        incarnation: u64,
        travelled: &[(&Call, &Reply)],
    ) -> Result<Recorded, Superseded> {
        let mut inner = self.lock();
        if inner.incarnation != incarnation {
            return Err(Superseded);
        }
        let mut recorded = Recorded::default();
        let mut answered = Vec::with_capacity(travelled.len());
        for (call, reply) in travelled {
            let accepted = master::accepted(&inner.mirror, call, reply);
            recorded.doubtful |= !accepted.certain;
            answered.extend(accepted.calls);
        }
        let writes = |of: &Answered| matches!(of.call.method.as_str(), "setParam" | "deleteParam");
        let last_write = answered.iter().rposition(writes).unwrap_or_default();
        let mut entries = Vec::with_capacity(answered.len());
        for (index, answered) in answered.into_iter().enumerate() {
            let outcome = inner.apply(now, &answered.call, &self.news);
            let agreement = answered.compare(&outcome, index < last_write);
            if agreement != Agreement::Same {
                self.stats.divergences.count();
                inner.report_divergence(&answered, &outcome);
            }
            if agreement == Agreement::Diverged {
                recorded.doubtful = true;
                if !answered.executed {
                    // What the master refused is in no journal.
                    inner.changed_unrecorded();
                }
            }
            if answered.executed {
                entries.push(Entry::call(answered.call));
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

    /// What the master would answer to these calls, one after the other.
    pub fn foretell<'a>(&self, calls: impl Iterator<Item = &'a Call>) -> Vec<Reply> {
        let mut model = self.with_mirror(Clone::clone);
        let answer = |call| model.apply_telling(call, &mut ());
        calls.map(answer).collect()
    }

    /// Records and applies a call of our own before there is any master.
    pub fn seed(&self, call: &Call) {
        let mut inner = self.lock();
        inner.apply(Instant::now(), call, &self.news);
        inner.append(&[Entry::call(call.clone())]);
    }

    /// Takes an unregistration while the gate is shut: records it, applies it, and answers as the
    /// master would. One that takes nothing away is not recorded, and is remembered within limits: it
    /// may be said without end. It may mean a registration whose reply was lost with an earlier
    /// rosrescue, and which the master that comes back has run.
    ///
    /// With the reply comes the journal's last record of it, if there is one. None while the mirror is
    /// frozen, or if the call reads too much besides: it has to wait for the master.
    pub fn unregister(&self, now: Instant, call: &Call) -> Option<(Reply, Option<u64>)> {
        let mut inner = self.lock();
        if inner.frozen || !inner.mirror.fits(call, ANSWER_MOST) {
            return None;
        }
        let before = inner.mirror.counts();
        let reply = inner.apply(now, call, &self.news);
        let idle = inner.mirror.counts() == before;
        if idle && (inner.owed.len() >= OWED_IDLY || inner.owed.contains(call)) {
            return Some((reply, None));
        }
        let accepted = master::accepted(&inner.mirror, call, &reply).calls;
        let accepted = accepted.into_iter().filter(|of| of.executed);
        let accepted: Vec<_> = accepted.map(|of| of.call).collect();
        let mut seq = None;
        if !idle {
            let entries: Vec<_> = accepted.iter().cloned().map(Entry::call).collect();
            seq = inner.append(&entries);
        }
        inner.owed.extend(accepted);
        drop(inner);
        self.work.notify_one();
        Some((reply, seq))
    }

    /// From now on, or no longer, the mirror takes no unregistration by itself. Frozen at first: it
    /// is thawed while the gate is shut, until the master that is examined is compared with it.
    pub fn set_frozen(&self, frozen: bool) {
        self.lock().frozen = frozen;
    }

    /// The present master may not be what the mirror is: it is to be read again.
    pub fn doubt(&self) {
        self.lock().doubted = true;
    }

    /// Whether there was such a doubt, once.
    pub fn take_doubt(&self) -> bool {
        std::mem::take(&mut self.lock().doubted)
    }

    /// A new incarnation takes over, to be brought to the mirror's state: replies of the old one no
    /// longer count.
    pub fn succeed(&self) {
        let mut inner = self.lock();
        inner.incarnation += 1;
        inner.owed.clear();
        // The new one is brought to the mirror's state, or the mirror to its.
        inner.doubted = false;
        inner.activity.forget_displaced();
    }

    /// The incarnation that replies must come from.
    pub fn incarnation(&self) -> u64 {
        self.lock().incarnation
    }

    /// Unregistrations that the present incarnation has not heard of.
    pub fn owed(&self) -> Vec<Call> {
        self.lock().owed.clone()
    }

    /// The first `count` of [`Self::owed`] have been sent.
    pub fn paid(&self, count: usize) {
        let mut inner = self.lock();
        let count = count.min(inner.owed.len());
        inner.owed.drain(..count);
    }

    /// The mirror's version: equal versions mean equal states.
    pub fn version(&self) -> u64 {
        self.lock().version
    }

    /// The master holds `state`: so does the mirror from now on. Answers in what it differed before,
    /// in a few sentences without values.
    pub fn adopt(&self, state: Master) -> Vec<String> {
        let difference = self.lock().adopt(state);
        self.work.notify_one();
        difference
    }

    /// As [`Self::adopt`], of what the master of `incarnation` held when the mirror was at `version`.
    pub fn adopt_if(
        &self,
        incarnation: u64,
        version: u64,
        state: Master,
    ) -> Result<Vec<String>, Superseded> {
        let mut inner = self.lock();
        if (inner.incarnation, inner.version) != (incarnation, version) {
            return Err(Superseded);
        }
        let difference = inner.adopt(state);
        drop(inner);
        self.work.notify_one();
        Ok(difference)
    }

    /// Works with the mirror and what calls did to it of late.
    pub fn with_activity<T>(&self, work: impl FnOnce(&Master, &mut Activity) -> T) -> T {
        let mut inner = self.lock();
        let Inner {
            mirror, activity, ..
        } = &mut *inner;
        work(mirror, activity)
    }

    /// Calls are parked: which of them take the name of a node at another address?
    pub fn note_parked<'a>(&self, calls: impl Iterator<Item = &'a Call>) {
        let mut inner = self.lock();
        let mut new = false;
        for call in calls {
            if let Some((node, api)) = inner.mirror.displaced_by(call) {
                new |= inner.activity.displace(node, api);
            }
        }
        if new {
            self.news.notify_one();
        }
    }

    /// What a checkpoint written now holds.
    pub fn checkpoint(&self) -> Checkpoint {
        self.lock().checkpoint()
    }
}

impl Inner {
    fn apply(&mut self, now: Instant, call: &Call, news: &Notify) -> Reply {
        let mut noticed = Noticed::default();
        let reply = self.mirror.apply_telling(call, &mut noticed);
        self.version += 1;
        let registered = |node: &str| self.mirror.api_of(node).is_some();
        if self.activity.applied(now, call, noticed, registered) {
            news.notify_one();
        }
        reply
    }

    fn adopt(&mut self, state: Master) -> Vec<String> {
        if self.mirror == state {
            return Vec::new();
        }
        let difference = master::difference(&self.mirror, &state);
        let (pid, uri) = self.identity.clone();
        self.mirror = state;
        self.mirror.set_identity(pid, uri);
        self.version += 1;
        self.changed_unrecorded();
        difference
    }

    /// The mirror has changed otherwise than by journaled calls: a whole checkpoint is due.
    fn changed_unrecorded(&mut self) {
        self.whole.unrecorded = self.version;
    }

    /// Appends to the journal; a failure is the store's to remember, and no call's to suffer.
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

    fn checkpoint(&self) -> Checkpoint {
        Checkpoint {
            seq: self.store.as_ref().map_or(0, Store::seq),
            session: self.session.clone(),
            snapshot: self.mirror.snapshot(),
            pending: Vec::new(),
        }
    }

    fn report_divergence(&mut self, answered: &Answered, mirror: &Reply) {
        let method = answered.call.method.as_str();
        if self.diverged.insert(method.to_owned()) {
            let [master, mirror] =
                [&answered.reply, mirror].map(|reply| words::in_short(method, reply));
            tracing::warn!(
                method,
                mirror,
                master,
                "the mirror's reply differs from the master's; the mirror is made anew from the \
                 master if their states can differ (said once for each method)"
            );
        }
    }
}

#[cfg(test)]
mod tests;
