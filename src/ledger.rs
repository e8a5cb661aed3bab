//! The ledger: the mirror, which is a model of the master's whole state, and the journal of its changes, under one
//! lock. A write is applied to the mirror and passed to the journal in one step, and its answer waits until the journal
//! is [written](disk_jobs).
//!
//! The same lock orders writes and the start of a new incarnation, which is one life of a master process. So a reply of
//! the old master does not count if it arrives after the state for the new master was taken.

pub(crate) mod activity;
mod answers;
pub(crate) mod checkpointer;
pub(crate) mod delivery;
pub(crate) mod disk_jobs;
mod divergences;
pub(crate) mod durability;
pub(crate) mod first;
pub(crate) mod history;
mod inner;
pub(crate) mod late;
pub(crate) mod mutant;
pub(crate) mod owed;
mod pending;
mod shared;

use std::{
    collections::BTreeSet,
    sync::{Arc, Mutex, MutexGuard, PoisonError, atomic::AtomicBool},
    time::Instant,
};

use checkpoint_store::Store;
use rescue_core::{
    checkpoint::format::{Announced, Label, Origin, PendingWrite, Record, RecordContent, Session},
    cluster::{
        merge::MergeVerdict,
        sharing::{Change, Sharing, Source},
    },
    order::{Order, Subject},
    replay::{self, Answered, Token},
};
use ros1_master::{
    master::{Master, Method, Request, Write},
    xmlrpc::{Python, Reply},
};
use tokio::sync::{Notify, watch};

use self::activity::Activity;
pub(crate) use self::durability::Mark;
use self::{
    inner::{Inner, Notifier, StateFrom},
    late::{CatchUp, LateState, Missed, Outstanding, notified_once},
    mutant::Mutant,
    shared::{Acknowledged, LeaderLease, Shared},
};
use crate::{
    cli::SyncPolicy,
    clock,
    gate::{self, State},
    status::stats::Stats,
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
    /// Whether the file holds a call that the master has not executed, so the answers wait for a complete checkpoint.
    pub is_ahead: bool,
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
    pub(crate) acknowledged: Acknowledged,
    pub(crate) lease: LeaderLease,
    /// The mirror's version in the last complete checkpoint that was written or could not be written.
    attempted: watch::Sender<u64>,
    /// Wakes the checkpointer.
    pub work: Notify,
    /// Wakes the task that sends this computer's writes to the other computers.
    pub shared: Notify,
    /// Wakes `nodes::watch`: a notification waits or is to be repeated, something is unseen, or a new node is to be
    /// identified.
    pub wake_nodes: Notify,
    order_changed: watch::Sender<()>,
    /// Signals that the master has run all writes that the mirror has answered first.
    all_acknowledged: watch::Sender<()>,
    /// Whether a simulation decides when the disk writes.
    #[cfg(test)]
    writes_by_hand: AtomicBool,
}

impl Ledger {
    /// Creates a ledger of `mirror`, recorded in `store`. `pending` are writes that the last master of `session` may
    /// not have run. `sync` says when a record must be on the disk.
    pub fn new(
        mirror: Master,
        session: Session,
        pending: Vec<PendingWrite>,
        store: Option<Store>,
        sync: SyncPolicy,
        stats: &'static Stats,
    ) -> Self {
        let ledger = Self {
            inner: Mutex::new(Inner::new(mirror, session, pending)),
            sync,
            stats,
            durable: watch::channel(0).0,
            sync_is_late: AtomicBool::new(false),
            disk_silent: Notify::new(),
            acknowledged: Acknowledged::new(),
            lease: LeaderLease::new(),
            attempted: watch::channel(0).0,
            work: Notify::new(),
            shared: Notify::new(),
            wake_nodes: Notify::new(),
            order_changed: watch::channel(()).0,
            all_acknowledged: watch::channel(()).0,
            #[cfg(test)]
            writes_by_hand: AtomicBool::default(),
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
        self.lock().state_from = StateFrom::Checkpoint;
    }

    /// Sets the answers to `getPid` and `getUri`.
    pub fn set_identity(&self, pid: i32, uri: String) {
        self.lock().mirror.set_identity(pid, uri);
    }

    /// The answer to `getUri`: rosrescue's own address.
    pub fn uri(&self) -> String {
        self.lock().mirror.uri().to_owned()
    }

    /// Sets the answer to `getPid`.
    pub fn set_master_pid(&self, pid: i32) {
        let mirror = &mut self.lock().mirror;
        let uri = mirror.uri().to_owned();
        mirror.set_identity(pid, uri);
    }

    pub fn session(&self) -> Session {
        self.lock().session.clone()
    }

    pub fn update_session(&self, change: impl FnOnce(&mut Session)) {
        self.lock().update_session(change);
        self.save();
    }

    /// The number in the present master's [`Token`].
    pub fn incarnation(&self) -> u64 {
        self.lock().session.incarnation
    }

    /// The [`Token`] that identifies the present master.
    pub fn token(&self) -> Token {
        self.lock().token()
    }

    /// Like [`Self::record`], for calls whose source is this computer and whose origin is rosrescue.
    #[cfg(test)]
    pub(crate) fn record_here(
        &self,
        now: Instant,
        incarnation: u64,
        batch: &[(&Request, &Reply)],
    ) -> Result<Recorded, Superseded> {
        let batch: Vec<_> = batch
            .iter()
            .map(|(call, reply)| (*call, *reply, &Source::Here, Origin::Rosrescue))
            .collect();
        self.record(now, incarnation, &batch)
    }

    /// Records and applies the calls in `batch`, which the master ran in this order and has answered. `incarnation` is
    /// the number in the [`Token`] of that master.
    pub(crate) fn record(
        &self,
        now: Instant,
        incarnation: u64,
        batch: &[(&Request, &Reply, &Source, Origin)],
    ) -> Result<Recorded, Superseded> {
        let mut inner = self.lock();
        if inner.session.incarnation != incarnation || inner.is_frozen() || inner.is_elsewhere() {
            return Err(Superseded);
        }
        let mut recorded = Recorded::default();
        let mut answered = Vec::with_capacity(batch.len());
        for (call, reply, source, origin) in batch {
            let accepted = replay::accepted(&inner.mirror, call, reply);
            recorded.doubtful |= !accepted.certain;
            answered.extend(accepted.calls.into_iter().map(|of| (of, *source, *origin)));
        }
        let writes = |(of, ..): &(Answered<'_>, &Source, Origin)| {
            matches!(of.call.method(), Method::SetParam | Method::DeleteParam)
        };
        let last_write = answered.iter().rposition(writes).unwrap_or_default();
        let mut entries = Vec::with_capacity(answered.len());
        let mut sources = Vec::with_capacity(answered.len());
        let (mut unrecorded, mut has_record) = (false, false);
        let at = clock::wall_millis();
        for (index, (answered, source, origin)) in answered.into_iter().enumerate() {
            let is_recorded = inner.take_ahead(answered.call);
            has_record |= is_recorded;
            // The journal must not keep a call that the master has refused.
            recorded.is_ahead |= is_recorded && !answered.executed;
            // An inexact mirror is known to differ from the master, which holds values that cannot be read from it.
            let is_inexact = inner.mirror.is_inexact();
            let outcome = inner.apply(now, answered.call, Notifier::Master, &self.wake_nodes);
            origin.note_in(&mut inner.mirror, answered.call);
            let agrees = answered.agrees(&outcome, index < last_write);
            if !agrees && !inner.diverged.knows_words(&answered, &outcome) {
                if !is_inexact {
                    self.stats.divergences.count();
                    inner.diverged.report(&answered, &outcome);
                }
                recorded.doubtful = true;
                if !answered.executed {
                    // No journal has a record of a refused call.
                    unrecorded = true;
                }
            }
            if answered.executed && !is_recorded {
                let call = answered.call.clone();
                entries.push(RecordContent::labelled(call, Label { at, origin }));
                sources.push(source);
            }
        }
        inner.doubted |= recorded.doubtful;
        let is_new = !entries.is_empty();
        if is_new {
            // Otherwise the next process would let the master run pending writes after these calls.
            inner.note_acknowledged();
            has_record = true;
            self.stats.writes_recorded.add(entries.len() as u64);
            inner.append_from(entries, &sources);
        }
        // The answer does not show what became of the call.
        recorded.is_ahead |= inner.withdraw();
        unrecorded |= recorded.is_ahead;
        if unrecorded {
            inner.changed_unrecorded();
        }
        if unrecorded || has_record {
            recorded.mark = inner.mark();
            drop(inner);
            // Before each answer, the disk syncs once. `record_ahead` has had it do so.
            if is_new || unrecorded || self.sync != SyncPolicy::Always {
                self.recorded();
            }
        }
        Ok(recorded)
    }

    /// Adds `call` to the journal before the master has answered it, so that the disk and the master work at the same
    /// time. Does nothing unless the master surely accepts the call, and with several computers, whose journal holds
    /// only answered calls. Returns whether the call was added. Then the caller must call [`Self::write`], and pass the
    /// answer to [`Self::record`] or call [`Self::withdraw`].
    pub(crate) fn record_ahead(&self, call: &Arc<Request>, origin: Origin) -> bool {
        let mut inner = self.lock();
        let is_certain = !inner.is_frozen()
            && !inner.doubted
            && matches!(inner.shared, Shared::Single)
            && inner.journal.is_some()
            && Write::parse(call).is_some_and(|write| inner.mirror.accepts(&write));
        if !is_certain {
            return false;
        }
        let at = clock::wall_millis();
        let entry = RecordContent::labelled(Request::clone(call), Label { at, origin });
        self.stats.writes_recorded.count();
        // Otherwise the next process would let the master run pending writes after this call.
        inner.note_acknowledged();
        inner.append(vec![entry]);
        inner.ahead = Some(call.clone());
        drop(inner);
        if self.sync == SyncPolicy::Always {
            self.work.notify_one();
        }
        true
    }

    /// Notes that no answer of the master to the call of [`Self::record_ahead`] will be recorded. A complete checkpoint
    /// removes the call from the journal.
    pub(crate) fn withdraw(&self) {
        if self.lock().withdraw() {
            self.work.notify_one();
        }
    }

    /// Records and applies a call made by rosrescue before there is a master.
    pub fn seed(&self, call: &Request) {
        let mut inner = self.lock();
        inner.apply(Instant::now(), call, Notifier::Master, &self.wake_nodes);
        let (at, origin) = (clock::wall_millis(), Origin::Rosrescue);
        let label = Label { at, origin };
        inner.append(vec![RecordContent::labelled(call.clone(), label)]);
        drop(inner);
        self.save();
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

    /// The nodes that pending writes register, each with its address.
    pub fn pending_registrants(&self) -> BTreeSet<(String, String)> {
        replay::registrants(self.lock().pending.calls())
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

    /// Sets the mirror to `state`, which the master with the token `held` holds, and applies to it the writes that the
    /// mirror has answered since the injection to this master. Changes nothing if there were too many to keep them.
    pub fn rebase(&self, held: &Token, mut state: Master) {
        let mut inner = self.lock();
        if inner.token() != *held {
            return;
        }
        if !Mutant::ForgetsAnswered.lives() {
            for call in inner.pending.calls() {
                state.apply_telling(call, &mut ());
            }
        }
        inner.adopt(state);
        drop(inner);
        self.recorded();
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
        if inner.is_frozen()
            || inner.is_elsewhere()
            // The master has not run these when it was read.
            || !inner.pending.calls().is_empty() && !Mutant::ReadsTooEarly.lives()
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

    /// Notes that another computer has the master, or may have it. From now on only the records given to
    /// [`Self::follow`] are recorded. Calls whose records the other computers lack are not acknowledged. No node is
    /// notified, because the other computer does that.
    ///
    /// Returns the number of the last record that the mirror shows, if this computer had the master.
    pub fn leave(&self) -> Option<u64> {
        let mut inner = self.lock();
        let last = inner.shared.last();
        // The file holds these records all the same.
        inner.session.cluster_seq = inner.cluster_seq();
        inner.shared = Shared::Elsewhere;
        inner.order.forget_notifications();
        drop(inner);
        self.acknowledged.note_deposed();
        last.map(|last| last.seq)
    }

    /// The number of the last record that the mirror shows. The other computers may not have it yet.
    pub(crate) fn last_shared(&self) -> u64 {
        self.lock().shared.last().map_or(0, |last| last.seq)
    }

    /// Notes that this computer has the master. The other computers get its records, numbered after `seq`. `held` is
    /// the state that the others hold. If this computer's state differs, the others get the whole state.
    pub fn lead(&self, seq: u64, held: &Master) {
        let mut inner = self.lock();
        inner.note_followed(seq);
        let times_led = self.acknowledged.times_led();
        let sharing = Sharing::after(seq);
        inner.shared = Shared::Here { times_led, sharing };
        if inner.mirror != *held {
            inner.share_state();
        }
        drop(inner);
        // The other computers have these records. A write that changes nothing waits only for the last of them.
        self.acknowledged.reach(seq);
        self.shared.notify_one();
    }

    /// Takes the changes that the other computers have not got yet.
    pub(crate) fn take_changes(&self) -> Vec<Change> {
        match &mut self.lock().shared {
            Shared::Here { sharing, .. } => sharing.take(),
            _ => Vec::new(),
        }
    }

    /// Like [`Self::take_changes`], but takes the changes as a single one: the state that they have led to. `None` if
    /// this computer does not have the master.
    pub(crate) fn take_as_state(&self) -> Option<Change> {
        let inner = &mut *self.lock();
        match &mut inner.shared {
            Shared::Here { sharing, .. } => Some(sharing.take_as_state(&inner.mirror)),
            _ => None,
        }
    }

    /// Decides for each of another computer's partition writes `calls` whether it conflicts with a change after record `seq`.
    /// That computer sends them under the name `merge`, so changes of this name are no conflict. `None` if this computer does
    /// not lead, or no longer knows all changes after `seq`.
    pub(crate) fn merge_verdicts(
        &self,
        seq: u64,
        merge: &str,
        calls: &[&Request],
    ) -> Option<Vec<MergeVerdict>> {
        let inner = self.lock();
        match &inner.shared {
            Shared::Here { sharing, .. } => {
                sharing.merge_verdicts(&inner.mirror, seq, merge, calls)
            }
            _ => None,
        }
    }

    /// Applies and records the records of the computer that has the master.
    ///
    /// # Errors
    ///
    /// If this computer has the master itself.
    pub fn follow(&self, records: &[Record]) -> Result<(), Superseded> {
        let mut inner = self.lock();
        if !inner.is_elsewhere() {
            return Err(Superseded);
        }
        let (Some(first), Some(last)) = (records.first(), records.last()) else {
            return Ok(());
        };
        inner.note_followed(first.seq.saturating_sub(1));
        let entries: Vec<RecordContent> =
            records.iter().map(|record| record.entry.clone()).collect();
        for entry in &entries {
            if let RecordContent::Call { call, label, .. } = entry {
                inner.mirror.apply_telling(call, &mut ());
                label.origin.note_in(&mut inner.mirror, call);
                inner.version += 1;
            }
        }
        inner.append(entries);
        // The file counts these by itself.
        inner.session.cluster_seq = last.seq;
        drop(inner);
        self.save();
        Ok(())
    }

    /// Replaces the state by that of the computer that has the master, after record `seq` of etcd's journal.
    ///
    /// # Errors
    ///
    /// If this computer has the master itself.
    pub fn follow_state(&self, seq: u64, state: Master) -> Result<(), Superseded> {
        let mut inner = self.lock();
        if !inner.is_elsewhere() {
            return Err(Superseded);
        }
        inner.note_followed(seq);
        // Until the next complete checkpoint, the file lacks this state.
        inner.session_unwritten = true;
        inner.pending.clear();
        inner.activity = Default::default();
        inner.note_equal();
        inner.adopt(state);
        drop(inner);
        self.work.notify_one();
        Ok(())
    }

    /// Notes that the mirror already has the state after record `seq` of etcd's journal.
    pub(crate) fn note_followed(&self, seq: u64) {
        let mut inner = self.lock();
        inner.note_followed(seq);
        inner.write_session();
        drop(inner);
        self.save();
    }

    /// The [gate], which tells whether calls pass to the master.
    pub fn gate(&self) -> gate::Rx {
        self.lock().gate.subscribe()
    }

    /// Sets the gate, so that the mirror may change again. [`Self::open_gate`] sets [`State::Open`], and
    /// [`Self::begin_injection`], [`Self::resume`] and [`Self::begin_catch_up`] set [`State::Frozen`].
    pub fn shut_gate(&self, state: State) {
        self.lock().gate.set(state);
    }

    /// Freezes the mirror for an injection, until the gate is set again. Returns the state from which the injection is
    /// planned.
    pub fn begin_injection(&self) -> Basis {
        let inner = self.lock();
        inner.gate.set(State::Frozen);
        Basis {
            mirror: inner.mirror.clone(),
            version: inner.version,
            pending: inner.pending.calls().to_vec(),
        }
    }

    /// Sets the version of Python on which the present master runs.
    pub fn set_python(&self, python: Python) {
        self.lock().mirror.set_python(python);
    }

    /// Sets whether the present master is old: see [`Master::set_old`].
    pub fn set_old(&self, old: Option<bool>) {
        self.lock().mirror.set_old(old);
    }

    /// The mirror's version and state, and the [`Token`] for the next master.
    pub fn next(&self) -> (u64, Master, Token) {
        let inner = self.lock();
        (inner.version, inner.mirror.clone(), inner.next_token())
    }

    /// Notes that the checkpoint is older than the master, whose [`Token`] has this `number`. A master has run the
    /// checkpoint's pending writes, unless an earlier process announced that it gives the master the state before them.
    pub fn note_later_master(&self, number: u64) {
        let mut inner = self.lock();
        let announced = inner.session.announced.take();
        let ran = match announced.filter(|announced| number <= announced.incarnation) {
            Some(Announced { incarnation, at }) if number == incarnation => {
                inner.pending.acknowledge(at);
                at
            }
            // An earlier injection to this master was announced, too. What it held is unknown.
            Some(_) => 0,
            None => inner.pending.forget_restored(),
        };
        inner.session.delivered = inner.session.delivered.max(ran);
        inner.session.incarnation = number;
        inner.session_unwritten = true;
    }

    /// Begins the next incarnation (see [`Token`]), whose master is about to get the mirror's state, so that replies of
    /// the previous one no longer count. Returns the new token, and the record that must be on the disk before the
    /// master gets anything.
    ///
    /// That record announces the injection. The new token's number is recorded once the master has it.
    pub fn succeed(&self) -> (Token, Mark) {
        let mut inner = self.lock();
        let announced = inner.announce();
        // The injection makes both sides equal, so no doubt remains.
        inner.note_equal();
        let token = inner.token();
        drop(inner);
        self.save();
        (token, announced)
    }

    /// Notes that the present master holds the mirror's state, so no write is pending.
    pub fn delivered(&self) {
        let mut inner = self.lock();
        if !inner.pending.calls().is_empty() || inner.acknowledged > 0 {
            inner.pending.clear();
            inner.acknowledged = 0;
            inner.session.delivered = inner.seq;
            inner.session_unwritten = true;
        }
        inner.write_session();
        drop(inner);
        self.save();
    }

    /// Lets calls pass to the present master. Returns the number in its [`Token`].
    pub fn open_gate(&self) -> u64 {
        let mut inner = self.lock();
        inner.order.lateness_is_over();
        let incarnation = inner.session.incarnation;
        inner.state_from = StateFrom::Master { incarnation };
        inner.gate.set(State::Open { incarnation });
        incarnation
    }

    /// Whether calls have passed to the present master. `None` if calls have never passed to a master.
    pub fn has_served_present(&self) -> Option<bool> {
        let inner = self.lock();
        match inner.state_from {
            StateFrom::Master { incarnation } => Some(incarnation == inner.session.incarnation),
            StateFrom::ThisProcess | StateFrom::Checkpoint => None,
        }
    }

    /// Notes that the connection to the present master ended before the answer to a batch. The master may still run
    /// that batch.
    pub fn abandon_batch(&self) {
        let mut inner = self.lock();
        inner.outstanding = Outstanding::Abandoned;
        inner.order.lateness_is_over();
    }

    /// Notes that the present master can no longer be running a batch of an ended connection.
    pub fn settled(&self) {
        self.lock().outstanding = Outstanding::Awaited;
    }

    /// Whether the present master, which has the token `held`, can go on unchanged: that is the latest one, no write is
    /// pending, and it runs no batch of an ended connection. If so, freezes the mirror as [`Self::begin_injection`] does.
    pub fn resume(&self, held: &Token) -> bool {
        let inner = self.lock();
        let whole = inner.token() == *held
            && inner.pending.calls().is_empty()
            && !inner.outstanding.is_abandoned();
        if whole {
            inner.gate.set(State::Frozen);
        }
        whole
    }

    /// Notes that the mirror has answered the calls that the present master is late with. `tells`
    /// are the topics, parameters and node names about which these calls may make the master notify nodes. `is_exact` says
    /// whether the mirror has answered no later calls: otherwise the master must be examined when it answers.
    pub(crate) fn fall_behind(&self, now: Instant, tells: Vec<Subject>, is_exact: bool) {
        let mut inner = self.lock();
        if inner.outstanding.is_abandoned() {
            return;
        }
        inner.order.master_is_late(now);
        inner.outstanding = Outstanding::Late(Box::new(LateState {
            is_exact,
            state: inner.mirror.clone(),
            ran: inner.pending.calls().len(),
            tells,
            answered: false,
        }));
    }

    /// Notes that the late master has answered its outstanding calls. It may notify nodes of the changes by these calls
    /// only now.
    pub(crate) fn late_answered(&self, now: Instant) {
        let mut inner = self.lock();
        let Inner {
            outstanding: Outstanding::Late(late),
            mirror,
            order,
            ..
        } = &mut *inner
        else {
            return;
        };
        late.answered = true;
        order.late_answered(now);
        note_possible_notifications(now, order, mirror, &late.tells);
        drop(inner);
        self.wake_nodes.notify_one();
    }

    /// Decides what the present master needs after it was late and has answered. Freezes the mirror
    /// as [`Self::begin_injection`] does.
    ///
    /// `None` if the master must be examined instead: it has not answered, its state is in doubt, a node would have to
    /// shut down, or a node would be notified twice of one topic or parameter and could get the older value last.
    pub(crate) fn begin_catch_up(&self) -> Option<CatchUp> {
        let mut inner = self.lock();
        inner.gate.set(State::Frozen);
        let late = inner.outstanding.take_late();
        let late = late.filter(|late| late.answered && late.is_exact)?;
        if inner.doubted || inner.mirror.is_inexact() {
            return None;
        }
        if inner.pending.calls().is_empty() {
            return Some(CatchUp::Nothing);
        }
        let writes = inner.pending.calls().get(late.ran..)?.to_vec();
        let notified = notified_once(&late, &writes)?;
        Some(CatchUp::Run(Box::new(Missed {
            behind: late.state,
            writes,
            notified,
            mirror: inner.mirror.clone(),
            before: inner.token(),
            token: inner.next_token(),
        })))
    }

    /// Begins the incarnation of [`Missed::token`], like [`Self::succeed`]: the late master is about to run the writes
    /// that it has missed, and to notify nodes of them.
    ///
    /// `None` if another incarnation has begun meanwhile.
    pub(crate) fn announce_missed(&self, now: Instant, missed: &Missed) -> Option<Mark> {
        let mut inner = self.lock();
        if inner.next_token() != missed.token {
            return None;
        }
        let announced = inner.announce();
        for (subject, nodes) in &missed.notified {
            inner.order.master_notifies(now, subject, *nodes);
        }
        drop(inner);
        self.save();
        Some(announced)
    }

    /// Runs `work` on the [`Order`] and the mirror.
    pub(crate) fn with_order<T>(&self, work: impl FnOnce(&mut Order, &Master) -> T) -> T {
        let mut inner = self.lock();
        let Inner { mirror, order, .. } = &mut *inner;
        let result = work(order, mirror);
        let repeats = order.has_new_repeat();
        drop(inner);
        if repeats {
            self.wake_nodes.notify_one();
        }
        result
    }

    /// Signals that a call or notification that [waits](Order) may be able to go on.
    pub(crate) fn order_changed(&self) -> watch::Receiver<()> {
        self.order_changed.subscribe()
    }

    /// Runs `work` on the [`Order`]. If it returns true, wakes the calls and notifications that wait.
    pub(crate) fn release(&self, work: impl FnOnce(&mut Order) -> bool) {
        if self.with_order(|order, _| work(order)) {
            self.order_changed.send_replace(());
        }
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

/// Notes that the master may begin to notify nodes about `tells`.
fn note_possible_notifications(
    now: Instant,
    order: &mut Order,
    mirror: &Master,
    tells: &[Subject],
) {
    for subject in tells {
        let nodes = match subject {
            Subject::Topic(topic) => mirror.subscribers_of(topic).len(),
            Subject::Param(_) => 1,
            Subject::Name(_) => continue,
        };
        order.master_may_notify(now, subject, nodes);
    }
}

#[cfg(test)]
mod tests;
