//! Writes that the mirror answers before the master has run them.

use std::{sync::Arc, time::Instant};

use rescue_core::{
    checkpoint::format::{Label, Origin, RecordContent},
    order::Concern,
};
use ros1_master::{
    master::{Effect, Request, Write, returnable},
    xmlrpc::{Reply, Value},
};

use super::{
    Ledger, Mark, Superseded, answers::ANSWER_MOST, delivery::Delivery, inner::Notifier,
    mutant::Mutant, note_possible_notifications, shared::Shared,
};
use crate::clock;

/// Maximum number of writes that the master has not run yet. Further ones wait for it.
const UNACKNOWLEDGED_MAX: usize = 1000;

/// A write that the mirror has answered first.
#[derive(Debug)]
pub(crate) struct AnsweredFirst {
    pub(crate) reply: Reply,
    /// Identifies the write's record, for which the answer must wait.
    pub(crate) mark: Mark,
    pub(crate) delivery: Option<Delivery>,
    /// The number of the write's record in the journal.
    pub(crate) seq: u64,
}

/// What the master has answered to a write that the mirror has answered first.
pub(crate) struct Acknowledged<'a> {
    pub(crate) seq: u64,
    pub(crate) concern: &'a Concern,
    pub(crate) predicted: &'a Reply,
    /// `None` if it is not known.
    pub(crate) reply: Option<&'a Reply>,
}

impl Ledger {
    /// Answers a write before the master has run it, and records it as pending. The master notifies nodes when it runs
    /// it. `None` if the master must run it first:
    ///
    /// * the mirror or the journal is in doubt, or nothing would keep the write if this process ended;
    /// * the master may refuse the write, would shut a node down, or may not be able to return a value;
    /// * the answer is about something of which the master may be notifying the caller right now;
    /// * too many writes wait for the master.
    pub(crate) fn answer_first(
        self: &Arc<Self>,
        now: Instant,
        call: &Request,
        concern: &Concern,
        origin: Origin,
    ) -> Option<AnsweredFirst> {
        let mut inner = self.lock();
        let write = Write::parse(call)?;
        let heard = concern.recipients();
        let is_certain = !inner.is_frozen()
            && !inner.doubted
            && !inner.is_unconfirmed()
            && !inner.outstanding.is_abandoned()
            && matches!(inner.shared, Shared::Single)
            && (inner.journal.as_ref().is_some_and(|it| it.protects())
                || Mutant::AnswersUnprotected.lives())
            && inner.pending.has_room_for(call, UNACKNOWLEDGED_MAX)
            && !inner.mirror.is_inexact()
            && inner.mirror.accepts(&write)
            && is_predictable(&write.effect)
            && inner.mirror.displaced_by(call).is_none()
            && inner.mirror.fits(call, ANSWER_MOST)
            && !inner.order.answer_must_wait(&inner.mirror, &heard);
        if !is_certain {
            return None;
        }
        // The answer is begun before the call is applied, because the call may notify its own caller.
        let number = inner.order.begin_answer(now, heard);
        let reply = inner.apply(now, call, Notifier::MasterLater, &self.wake_nodes);
        origin.note_in(&mut inner.mirror, call);
        let at = clock::wall_millis();
        self.stats.writes_recorded.count();
        inner.append(vec![RecordContent::Call {
            call: call.clone(),
            pending: true,
            label: Label { at, origin },
        }]);
        inner.add_pending([call.clone()]);
        let (mark, seq) = (inner.mark(), inner.seq);
        inner.order.answered_first(seq, concern.notified_subjects());
        drop(inner);
        self.recorded();
        Some(AnsweredFirst {
            reply,
            mark,
            delivery: number.map(|number| Delivery::new(self, number)),
            seq,
        })
    }

    /// Notes that the master whose token has the number `incarnation` has run these writes.
    pub(crate) fn acknowledge(
        &self,
        now: Instant,
        incarnation: u64,
        writes: &[Acknowledged<'_>],
    ) -> Result<(), Superseded> {
        let inner = &mut *self.lock();
        if inner.session.incarnation != incarnation || inner.is_frozen() {
            return Err(Superseded);
        }
        let mut awaited = false;
        for write in writes {
            let tells = write.concern.notified_subjects();
            awaited |= inner.order.acknowledged(write.seq, tells);
            note_possible_notifications(now, &mut inner.order, &inner.mirror, tells);
            inner.pending.acknowledge(write.seq);
            inner.acknowledged = write.seq;
            let reply = write.reply;
            if !reply.is_some_and(|reply| is_same_result(write.predicted, reply)) {
                self.stats.divergences.count();
                inner.doubted = true;
            }
        }
        if inner.order.has_new_repeat() {
            self.wake_nodes.notify_one();
        }
        if inner.pending.calls().is_empty() {
            self.all_acknowledged.send_replace(());
        }
        if awaited {
            self.order_changed.send_replace(());
        }
        Ok(())
    }

    /// Waits until the master has run all writes that the mirror has answered first.
    pub(crate) async fn all_acknowledged(&self) {
        let mut acknowledged = self.all_acknowledged.subscribe();
        while self.pending() > 0 {
            // This cannot fail: this owns the sender.
            let _ = acknowledged.changed().await;
        }
    }

    /// Notes that this master will not run the write as a call, because the state that a master gets has it.
    pub(crate) fn note_left_out(&self, seq: u64, concern: &Concern) {
        self.release(|order| order.acknowledged(seq, concern.notified_subjects()));
    }

    /// Tells the journal which pending writes the master has run, if it does not know it yet.
    pub(crate) fn record_acknowledged(&self) {
        let mut inner = self.lock();
        if !inner.note_acknowledged() {
            return;
        }
        inner.write_session();
        drop(inner);
        self.save();
    }
}

/// Whether the mirror surely knows what the master answers. A master accepts values that it cannot return.
fn is_predictable(effect: &Effect<'_>) -> bool {
    match effect {
        Effect::SetParam { value, .. } => returnable::is_readable(value),
        // The answer has the parameter's value.
        Effect::SubscribeParam { .. } => false,
        Effect::DeleteParam { .. }
        | Effect::RegisterPublisher { .. }
        | Effect::RegisterSubscriber { .. }
        | Effect::RegisterService { .. }
        | Effect::UnregisterPublisher { .. }
        | Effect::UnregisterSubscriber { .. }
        | Effect::UnregisterService { .. }
        | Effect::UnsubscribeParam { .. } => true,
    }
}

/// Whether two answers have the same code and value. The text between them may differ in a changed rosmaster.
fn is_same_result(one: &Reply, other: &Reply) -> bool {
    let parts = |reply: &Reply| match reply {
        Reply::Value(Value::Array(answer)) => match answer.as_slice() {
            [code, _, value] => Some((code.clone(), value.clone())),
            _ => None,
        },
        _ => None,
    };
    parts(one).is_some() && parts(one) == parts(other)
}
