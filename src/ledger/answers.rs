//! The mirror's answers: predictions while there is a master, and answers in the master's place.

use std::{sync::Arc, time::Instant};

use rescue_core::{
    checkpoint::format::{Label, Origin, RecordContent},
    cluster::sharing::Source,
    order::Concern,
    replay,
};
use ros1_master::{
    master::{Kind, Master, Method, Request, is_success},
    xmlrpc::{Reply, Value},
};

use super::{Ledger, Mark, delivery::Delivery, inner::Notifier};
use crate::clock;

/// An unregistration that changes nothing in the mirror is added to the pending writes only while there are fewer than
/// this.
pub(super) const UNCHANGED_PENDING_MAX: usize = 1000;

/// Maximum memory for the answers to all reads of one multicall, in bytes. Without a limit, a few short reads of a
/// large state could need any amount. Larger multicalls wait for the master.
pub(super) const ANSWER_MOST: usize = 64 << 20;

/// Maximum memory for the answers to all reads of one multicall while there is a master, in bytes. Larger multicalls go
/// to the master.
const EXACT_ANSWER_MOST: usize = 1 << 20;

impl Ledger {
    /// The master's predicted answer to a read. `None` for a multicall with too large an answer.
    pub fn answer(&self, read: &Request) -> Option<Reply> {
        // A copy costs nothing, and reading it needs no lock.
        let mut mirror = self.with_mirror(Master::clone);
        let fits = mirror.fits(read, ANSWER_MOST);
        fits.then(|| mirror.apply_telling(read, &mut ()))
    }

    /// The result of a read, if the present master would answer with the same bytes. The result includes every
    /// acknowledged write.
    pub fn exact_answer(&self, read: &Request) -> Option<Value> {
        let inner = self.lock();
        let mut mirror = (!inner.doubted).then(|| inner.mirror.clone())?;
        drop(inner);
        let fits = mirror.fits(read, EXACT_ANSWER_MOST);
        fits.then(|| mirror.exact_answer(read))?
    }

    /// Like [`Self::answer`], for a write that changes nothing. Notifies nodes as a master would.
    ///
    /// Also returns the mark of the last record, which may be that of the earlier write that made this one redundant.
    /// `None` if the write changes something, or if the master may notify the caller of newer changes before the answer
    /// arrives.
    pub(crate) fn answer_if_unchanged(
        self: &Arc<Self>,
        now: Instant,
        write: &Request,
    ) -> Option<(Reply, Mark, Option<Delivery>)> {
        let concern = Concern::of_call(Some(write));
        let mut inner = self.lock();
        // Unregistrations are left out: they may concern a registration that the master has not run yet. With several
        // computers, so is a parameter that is set again: this is its last write, which the journal must have.
        let is_replicated = inner.is_replicated();
        let counts = |call| is_unregistration(call) || is_replicated && sets_parameter(call);
        let idle = !inner.doubted
            && !inner.is_unconfirmed()
            && !inner.is_elsewhere()
            && !write.calls().into_iter().any(counts)
            && !inner.mirror.would_change(write)
            && inner.mirror.fits(write, ANSWER_MOST);
        let heard = concern.recipients();
        if !idle || inner.order.read_must_wait(&heard) {
            return None;
        }
        let number = inner.order.begin_answer(now, heard);
        let reply = inner.apply(
            now,
            write,
            Notifier::Rosrescue { changes: false },
            &self.wake_nodes,
        );
        // The master refuses calls with its own messages.
        let refused = match &reply {
            Reply::Value(value) => is_refusal(value),
            Reply::Fault { .. } => true,
        };
        let mark = inner.mark();
        drop(inner);
        let delivery = number.map(|number| Delivery::new(self, number));
        (!refused).then_some((reply, mark, delivery))
    }

    /// The answer to a `subscribeParam` whose subscription already exists. A computer that does not lead may give it
    /// too: only the node can end its subscription, so the leader still has it.
    pub(crate) fn answer_if_subscribed(&self, call: &Request) -> Option<Reply> {
        let mirror = &mut self.lock().mirror;
        let there = *call.method() == Method::SubscribeParam
            && !mirror.would_change(call)
            && mirror.fits(call, ANSWER_MOST);
        let reply = there.then(|| mirror.apply_telling(call, &mut ()))?;
        is_success(&reply).then_some(reply)
    }

    /// The master's predicted answer to a call that changes the state. `None` for any other call, and for a multicall
    /// with too large an answer.
    pub(crate) fn answer_if_changing(&self, call: &Request) -> Option<Reply> {
        let mut model = {
            let mirror = &mut self.lock().mirror;
            let answers = mirror.would_change(call) && mirror.fits(call, ANSWER_MOST);
            answers.then(|| mirror.clone())?
        };
        Some(model.apply_telling(call, &mut ()))
    }

    /// The master's predicted answer to this call.
    pub fn predict(&self, call: &Request) -> Reply {
        let mut model = self.with_mirror(Clone::clone);
        model.apply_telling(call, &mut ())
    }

    /// Answers a call as an absent master would: applies it, records its changes as pending, and notifies nodes. Also
    /// returns the mark of the last record. That is this call's record, or if it changes nothing, the record that made
    /// it redundant.
    ///
    /// `None` while the mirror is frozen, if another computer has the master, or if the answers to the reads in a
    /// multicall are too large. Then the call has to wait.
    pub fn answer_from_mirror(&self, now: Instant, call: &Request) -> Option<(Reply, Mark)> {
        let concern = Concern::default();
        let (reply, mark, _) =
            self.answer_standing_in(now, call, &concern, &Source::Here, Origin::Rosrescue)?;
        Some((reply, mark))
    }

    /// Like [`Self::answer_from_mirror`], for a client's call from `source`. `concern` says which topics, parameters and node
    /// names the call concerns. The answer counts as on its way to the client until the returned [`Delivery`] is
    /// dropped.
    pub(crate) fn answer_client_from_mirror(
        self: &Arc<Self>,
        now: Instant,
        call: &Request,
        concern: &Concern,
        source: &Source,
        origin: Origin,
    ) -> Option<(Reply, Mark, Option<Delivery>)> {
        let (reply, mark, number) = self.answer_standing_in(now, call, concern, source, origin)?;
        let delivery = number.map(|number| Delivery::new(self, number));
        Some((reply, mark, delivery))
    }

    fn answer_standing_in(
        &self,
        now: Instant,
        call: &Request,
        concern: &Concern,
        source: &Source,
        origin: Origin,
    ) -> Option<(Reply, Mark, Option<u64>)> {
        let mut inner = self.lock();
        if inner.is_frozen() || inner.is_elsewhere() || !inner.mirror.fits(call, ANSWER_MOST) {
            return None;
        }
        // The answer is begun before the call is applied, because the call may notify its own caller.
        let heard = concern.recipients();
        let number = inner.order.begin_answer(now, heard);
        let changes = inner.mirror.would_change(call);
        let before = call.ends_early().then(|| inner.mirror.clone());
        let reply = inner.apply(now, call, Notifier::Rosrescue { changes }, &self.wake_nodes);
        origin.note_in(&mut inner.mirror, call);
        let mut writes: Vec<&Request> = match reply {
            // The answer cannot be encoded, so it does not show which writes were accepted. All count as accepted,
            // because a master refuses a refused write again.
            Reply::Fault { .. } => {
                let writes = call.calls().into_iter();
                writes.filter(|call| call.kind().mutates()).collect()
            }
            Reply::Value(_) => {
                let before = before.as_ref().unwrap_or(&inner.mirror);
                let accepted = replay::accepted(before, call, &reply).calls;
                // A master that is newer than the mirror may hold parameters that the mirror lacks.
                let may_be_set = |call: &Request| {
                    inner.is_unconfirmed() && *call.method() == Method::DeleteParam
                };
                let counts = accepted
                    .into_iter()
                    .filter(|of| of.executed || may_be_set(of.call));
                counts.map(|of| of.call).collect()
            }
        };
        let mut set_again = Vec::new();
        if !changes {
            // A call that changes nothing still becomes pending, because the master may hold what the mirror lacks: a
            // registration that it ran for a rosrescue that died before the reply, or any state if the checkpoint is
            // older than the master. Parameter subscriptions are left out: they cannot be read from the master, and
            // loggers repeat them all the time.
            let room = inner.pending.calls().len() < UNCHANGED_PENDING_MAX;
            let unsure = |call: &Request| {
                is_unregistration(call)
                    || (inner.is_unconfirmed() && *call.method() != Method::SubscribeParam)
            };
            let is_pending =
                |call: &&Request| room && unsure(call) && !inner.pending.contains(call);
            (writes, set_again) = writes.into_iter().partition(is_pending);
            // With several computers, a parameter that is set again is the last write for the others, too.
            let is_replicated = inner.is_replicated();
            set_again.retain(|call| is_replicated && sets_parameter(call));
        }
        if writes.is_empty() && set_again.is_empty() {
            return Some((reply, inner.mark(), number));
        }
        // The new version outdates a running inspection, which could restore what this call removes.
        inner.version += u64::from(!changes && !writes.is_empty());
        let at = clock::wall_millis();
        let label = Label { at, origin };
        let again = set_again.into_iter();
        let again = again.map(|call| RecordContent::labelled(call.clone(), label));
        let pending = writes.iter().map(|&call| RecordContent::Call {
            call: call.clone(),
            pending: true,
            label,
        });
        // The pending writes have the last numbers.
        let entries: Vec<_> = again.chain(pending).collect();
        self.stats.writes_recorded.add(entries.len() as u64);
        let sources = vec![source; entries.len()];
        inner.append_from(entries, &sources);
        // The journal holds a call that was on its way to the master twice, which changes nothing.
        inner.take_ahead(call);
        let mark = inner.mark();
        inner.add_pending(writes.into_iter().cloned());
        drop(inner);
        self.recorded();
        Some((reply, mark, number))
    }
}

/// Whether a call is an unregistration. Multicalls are not.
fn is_unregistration(call: &Request) -> bool {
    *call.method() != Method::Multicall && call.kind() == Kind::Unregister
}

/// Whether a call, which is no multicall, sets a parameter.
fn sets_parameter(call: &Request) -> bool {
    *call.method() == Method::SetParam
}

/// Whether the master refuses a call, or any call of a multicall, with this answer.
fn is_refusal(answer: &Value) -> bool {
    match answer.as_array() {
        Some([Value::Int(code), ..]) => *code != 1,
        Some(results) => results.iter().any(is_refusal),
        // The fault of a call of a multicall.
        None => true,
    }
}
