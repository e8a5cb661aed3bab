//! Queued writes: how a batch becomes one request, and how its reply is unpacked.

use std::{collections::VecDeque, sync::Arc, time::Instant};

use bytes::Bytes;
use rescue_core::{
    checkpoint::format::Origin,
    cluster::sharing::Source,
    order::{BySubject, Concern, Order},
};
use ros1_master::{
    master::{Entry, Kind, Method, Request, entry_reply},
    xmlrpc::{Reply, Value},
};
use tokio::sync::oneshot;

use super::merge::Merge;
use crate::{
    ledger::{activity::LastCalls, delivery::Delivery, mutant::Mutant},
    upstream::{Head, RawReply},
};

/// Maximum number of calls in a batch. In a compact multicall the master needs some 40 µs per call, so a call waits a
/// few milliseconds at most.
pub(super) const CALLS_MAX: usize = 100;
/// Maximum size of the bodies of all calls in a batch, in bytes.
pub(super) const BYTES_MAX: usize = 1 << 20;

#[derive(Debug)]
pub(crate) enum CallAnswer {
    /// The master's reply as it came.
    Raw(RawReply),
    /// A reply that rosrescue must encode: the mirror's, or one result out of a batch.
    Made(Reply),
    /// No answer: the connection is closed, so that the client retries.
    Close,
    /// Another computer has the master and must get the call.
    Elsewhere,
}

/// A call in the write queue.
#[derive(Debug)]
pub(crate) struct Item {
    /// The call. `None` if the bytes could not be decoded.
    pub(super) call: Option<Arc<Request>>,
    pub(super) made_by: MadeBy,
    answer_to: AnswerTo,
    /// The topics, parameters and node names that the call concerns, for the order in which nodes hear of them.
    concern: Concern,
    /// Tracks the answer on its way to the caller. Set once the call is on its way to the master, or the mirror has
    /// answered it.
    pub(super) delivery: Option<Delivery>,
    /// Whether nodes whose port the call takes have been unregistered.
    pub(super) way_made: bool,
    pub(super) source: Source,
    /// The address from which the call came, for the log.
    pub(super) origin: Origin,
}

/// Who made a call, and what only such calls have.
#[derive(Debug)]
pub(super) enum MadeBy {
    Client {
        /// The client's bytes.
        request: (Head, Bytes),
        /// When the mirror answers the call if it changes nothing and the master has not answered. `None` if the mirror
        /// has been asked already.
        patience: Option<Instant>,
    },
    /// A computer that was cut off.
    CutOff {
        /// The writes that conflict with nothing.
        request: (Head, Bytes),
        merge: Merge,
    },
    /// rosrescue. The call is wanted as long as the condition holds.
    Rosrescue(Option<Precondition>),
    /// rosrescue, to unregister dead nodes before another call.
    Eviction(Evicted),
}

/// Where the master's answer goes.
#[derive(Debug)]
enum AnswerTo {
    Caller(Caller),
    /// The caller has got the mirror's answer before the master has run the call. The two are compared.
    Comparison(First),
    /// The caller has got the mirror's answer while the batch was in flight.
    Answered,
}

/// The mirror's answer to a call that the master must still run.
#[derive(Debug)]
pub(super) struct First {
    pub(super) reply: Reply,
    /// The number of the call's record in the journal.
    pub(super) seq: u64,
    /// When the call no longer waits for answers on their way to nodes. They are told the state again then.
    pub(super) latest: Instant,
}

/// Dead nodes that a call unregisters.
#[derive(Debug)]
pub(super) struct Evicted {
    pub(super) nodes: Vec<String>,
    /// The node that takes their names.
    pub(super) by: String,
}

/// A task that waits for the answer to a call.
#[derive(Debug)]
pub(super) struct Caller(oneshot::Sender<AnswerAndDelivery>);

impl Caller {
    pub(super) fn reply(self, answer: CallAnswer, delivery: Option<Delivery>) {
        let _ = self.0.send((answer, delivery));
    }
}

/// An answer, and the handle to drop when the caller has the answer.
pub(crate) type AnswerAndDelivery = (CallAnswer, Option<Delivery>);

/// A node and its last calls at the time when rosrescue decided to register or unregister something for it. The
/// condition fails if the node itself does the opposite meanwhile.
#[derive(Clone, Debug)]
pub struct Precondition {
    pub node: String,
    pub last_calls: LastCalls,
}

impl Precondition {
    /// Whether the condition holds for a call of this kind, given the node's last calls `now`.
    pub fn holds(&self, kind: Kind, now: LastCalls) -> bool {
        match kind {
            Kind::Unregister => self.last_calls.registered == now.registered,
            _ => self.last_calls.unregistered == now.unregistered,
        }
    }
}

impl Item {
    /// Creates an item for a client's call. Also returns the receiver of its answer.
    pub(crate) fn of_client(
        request: (Head, Bytes),
        call: Option<Arc<Request>>,
        patience: Option<Instant>,
    ) -> (Self, oneshot::Receiver<AnswerAndDelivery>) {
        Self::new(MadeBy::Client { request, patience }, call)
    }

    /// Creates an item. Also returns the receiver of its answer.
    pub(super) fn new(
        made_by: MadeBy,
        call: Option<Arc<Request>>,
    ) -> (Self, oneshot::Receiver<AnswerAndDelivery>) {
        let (answer, answered) = oneshot::channel();
        let item = Self {
            concern: Concern::of_call(call.as_deref()),
            call,
            made_by,
            answer_to: AnswerTo::Caller(Caller(answer)),
            delivery: None,
            way_made: false,
            source: Source::Here,
            origin: Origin::Rosrescue,
        };
        (item, answered)
    }

    /// Sets from where the call came.
    pub(crate) fn came_from(mut self, source: Source, origin: Origin) -> Self {
        (self.source, self.origin) = (source, origin);
        self
    }

    /// The bytes to send. `None` for a call made by rosrescue.
    pub(super) fn request(&self) -> Option<&(Head, Bytes)> {
        match &self.made_by {
            MadeBy::Client { request, .. } | MadeBy::CutOff { request, .. } => Some(request),
            MadeBy::Rosrescue(_) | MadeBy::Eviction(_) => None,
        }
    }

    /// See [`MadeBy::Client`].
    pub(super) fn patience(&self) -> Option<Instant> {
        match &self.made_by {
            MadeBy::Client { patience, .. } => *patience,
            _ => None,
        }
    }

    pub(super) fn set_patience(&mut self, until: Option<Instant>) {
        if let MadeBy::Client { patience, .. } = &mut self.made_by {
            *patience = until;
        }
    }

    /// Whether the mirror can answer the call.
    pub(super) fn is_answerable(&self) -> bool {
        self.answerable().is_some()
    }

    /// The call, if the mirror can answer it. It cannot if rosmaster would refuse the path of the request.
    pub(super) fn answerable(&self) -> Option<&Request> {
        let call = self.call.as_deref().filter(|call| call.is_answerable())?;
        self.request()
            .is_none_or(|(head, _)| head.may_be_for_rpc())
            .then_some(call)
    }

    pub(super) fn concern(&self) -> &Concern {
        &self.concern
    }

    /// Treats the call as if no node were notified because of it.
    #[cfg(test)]
    pub(super) fn forget_concern(&mut self) {
        self.concern = Concern::default();
    }

    pub(super) fn reply(self, answer: CallAnswer) {
        self.log_eviction(&answer);
        if let AnswerTo::Caller(caller) = self.answer_to {
            caller.reply(answer, self.delivery);
        }
    }

    /// Takes the caller, who gets an answer before the master's.
    pub(super) fn take_caller(&mut self) -> Option<Caller> {
        match std::mem::replace(&mut self.answer_to, AnswerTo::Answered) {
            AnswerTo::Caller(caller) => Some(caller),
            other => {
                self.answer_to = other;
                None
            }
        }
    }

    /// Whether the answer is no longer awaited: the call is answered, or its client has disconnected.
    pub(super) fn is_dropped(&self) -> bool {
        let is_dropped = match &self.answer_to {
            AnswerTo::Caller(caller) => caller.0.is_closed(),
            AnswerTo::Comparison(_) => false,
            AnswerTo::Answered => true,
        };
        is_dropped && !matches!(self.made_by, MadeBy::Eviction(_))
    }

    /// The mirror's answer, if the caller has got it and the master must still run the call.
    pub(super) fn first(&self) -> Option<&First> {
        match &self.answer_to {
            AnswerTo::Comparison(first) => Some(first),
            _ => None,
        }
    }

    /// Notes that the caller has got the mirror's answer, and the master must still run the call.
    pub(super) fn set_first(&mut self, first: First) {
        self.set_patience(None);
        self.answer_to = AnswerTo::Comparison(first);
    }

    pub(super) fn is_answered_first(&self) -> bool {
        self.first().is_some()
    }

    /// Logs the nodes that the call has unregistered, if it is an eviction and `answer` answers it.
    pub(super) fn log_eviction(&self, answer: &CallAnswer) {
        if let MadeBy::Eviction(Evicted { nodes, by }) = &self.made_by
            && matches!(answer, CallAnswer::Raw(_) | CallAnswer::Made(_))
        {
            tracing::info!(
                ?nodes,
                by,
                "unregistered dead nodes: their names belong to other nodes now"
            );
        }
    }

    /// Whether the call must stay behind all calls that were queued before it. A call that cannot be decoded may change
    /// anything, and a call by rosrescue was decided from the effects of earlier calls.
    fn is_last(&self) -> bool {
        self.request().is_none() || self.call.is_none()
    }

    /// Method and caller id, for messages.
    pub(crate) fn describe(&self) -> String {
        let Some(call) = &self.call else {
            return "a request that rosrescue cannot decode".to_owned();
        };
        let caller_id = call.caller().unwrap_or("?");
        format!("{:.100} of {caller_id:.200}", call.method().name())
    }

    /// Whether the call may share a batch with others. It may not if its reply contains a parameter's value, because a
    /// value that the master cannot return would spoil the whole reply.
    fn may_share(&self) -> bool {
        let shareable = |call: &Arc<Request>| {
            let shows = [Method::Multicall, Method::SubscribeParam].contains(call.method());
            !shows && call.kind().mutates()
        };
        let plain = self.request().is_none_or(|(head, _)| head.is_for_rpc());
        plain && self.call.as_ref().is_some_and(shareable)
    }

    fn weight(&self) -> usize {
        self.request().map_or(0, |(_, body)| body.len())
    }
}

/// The next batch to send.
#[derive(Debug, Default)]
pub(crate) struct Batch {
    pub(crate) items: Vec<Item>,
    /// When to look again at calls that were passed over. `None` if another event will wake the queue.
    pub(crate) until: Option<Instant>,
}

/// Takes the next batch from `queue`: one call, or several that may share a batch. Passes over calls that have to
/// [wait](Order::must_wait), and over later ones about the same topics, parameters or node names.
pub(crate) fn pack(
    queue: &mut VecDeque<Item>,
    order: &mut Order,
    now: Instant,
    delivery: impl Fn(u64) -> Delivery,
) -> Batch {
    let mut batch = Batch::default();
    let mut passed_over = BySubject::default();
    let (mut index, mut bytes) = (0, 0);
    while batch.items.len() < CALLS_MAX
        && let Some(item) = queue.get(index)
    {
        let fits = item.may_share() && bytes + item.weight() <= BYTES_MAX;
        if !batch.items.is_empty() && !fits {
            break;
        }
        let is_about_passed = || item.concern.subjects().any(|it| passed_over.has(it));
        let is_behind = index > 0 && (item.is_last() || is_about_passed());
        let mut wait = match is_behind {
            true => None,
            false => order.must_wait(now, &item.concern),
        };
        if let Some(First { latest, .. }) = item.first()
            && !Mutant::Overtakes.lives()
        {
            // The journal takes all writes before one that the master has run for run, so nothing overtakes this one.
            if wait.is_some() && now < *latest {
                let until = batch.until.into_iter().chain([*latest]);
                batch.until = until.min();
                break;
            }
            wait = None;
        }
        if is_behind || wait.is_some() {
            let until = wait.and_then(|wait| wait.until);
            batch.until = batch.until.into_iter().chain(until).min();
            if item.is_last() {
                break;
            }
            for subject in item.concern.subjects() {
                passed_over.add(subject, ());
            }
            index += 1;
            continue;
        }
        let is_alone = !item.may_share();
        let Some(mut item) = queue.remove(index) else {
            break;
        };
        bytes += item.weight();
        if !item.is_answered_first() {
            item.delivery = order
                .begin_answer(now, item.concern.recipients())
                .map(&delivery);
        }
        batch.items.push(item);
        if is_alone {
            break;
        }
    }
    batch
}

/// The request for `items`. For a single call, the client's own bytes.
pub(crate) fn outbound(items: &[Item]) -> (Head, Bytes) {
    if let [item] = items
        && let Some(request) = item.request()
    {
        return request.clone();
    }
    let calls = items.iter().filter_map(|item| item.call.as_deref());
    let body = match items {
        [
            Item {
                call: Some(call), ..
            },
        ] => call.encode(),
        _ => Request::multicall(calls.cloned()).encode(),
    };
    (Head::default(), Bytes::from(body))
}

/// The replies to the `count` calls of a batch. `None` if the master did not answer each call.
pub(crate) fn unpack(reply: &Reply, count: usize) -> Option<Vec<Reply>> {
    let Reply::Value(Value::Array(results)) = reply else {
        return None;
    };
    let replies: Vec<_> = results.iter().map(entry_reply).collect::<Option<_>>()?;
    (replies.len() == count).then_some(replies)
}

/// Whether the reply contains the master's address: `getUri`, alone or in a multicall.
pub(crate) fn asks_uri(call: &Request) -> bool {
    let mut calls = call.calls().into_iter();
    calls.any(|call| *call.method() == Method::GetUri)
}

/// Replaces the master's address by rosrescue's in replies to `getUri`, alone or in a multicall.
pub(crate) fn with_uri(call: &Request, mut reply: Reply, uri: &str) -> Reply {
    if let Reply::Value(value) = &mut reply {
        write_uri(call, value, uri);
    }
    reply
}

fn write_uri(call: &Request, value: &mut Value, uri: &str) {
    let Value::Array(values) = value else { return };
    if *call.method() == Method::GetUri
        && let [Value::Int(1), _, own @ Value::String(_)] = values.as_mut_slice()
    {
        *own = uri.into();
    }
    for (entry, result) in call.entries().iter().zip(values) {
        if let Entry::Request(call) = entry
            && let Value::Array(one) = result
            && let [value] = one.as_mut_slice()
        {
            write_uri(call, value, uri);
        }
    }
}

#[cfg(test)]
mod tests;
