//! Empties the write queue, one batch at a time.

use std::{
    collections::VecDeque,
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::sync::{mpsc, watch};
use tracing::Instrument;

use super::batch::{self, Batch, CallAnswer, Item};
use super::{
    Link, Signals, evict, merge,
    outdated::is_outdated,
    resync::ResyncSchedule,
    round_trip::{Received, RoundTripError, RoundTripResult, round_trip},
};
use crate::{
    gate::{self, State},
    ledger::{Ledger, Mark, delivery::Delivery},
    limit::rarely,
    master::{Effect, Master, Request, Write},
    order::Order,
    status::stats::Stats,
    upstream::{RawReply, inspect::InspectError, next::NextConnection},
    wait,
    xmlrpc::{self, Reply},
};

/// Pause before an unsent batch is retried while calls still pass to the master.
const RETRY_PAUSE: Duration = Duration::from_millis(20);
/// How long a batch may continue after calls no longer pass to the master, before the mirror answers it. A killed
/// master closes its connections within milliseconds. A master that only closed an idle connection still answers.
const GRACE: Duration = Duration::from_millis(5);

/// A batch on its way to the master. Without items, the master's state is being read.
struct InFlight {
    incarnation: u64,
    /// The mirror's version when the batch was sent.
    version: u64,
    items: Vec<Item>,
    /// Whether the mirror can answer all calls of the batch.
    answerable: bool,
    /// Whether the recovery has been told that the master is late with the batch.
    told_late: bool,
    /// Whether the mirror has answered the items and the master has not.
    late: bool,
    sent: tokio::time::Instant,
    done: Pin<Box<dyn Future<Output = RoundTripResult> + Send>>,
}

/// What wakes the worker of the queue.
struct Wakes {
    gate: gate::Rx,
    items: mpsc::Receiver<Item>,
    order_changed: watch::Receiver<()>,
    lease: watch::Receiver<Option<Instant>>,
    resync_interval: Option<Duration>,
}

/// The worker of the write queue.
pub(crate) struct Drain {
    pub(super) link: Link,
    wakes: Wakes,
    stats: &'static Stats,
    pub(super) queue: VecDeque<Item>,
    connection: Option<(u64, NextConnection)>,
    in_flight: Option<InFlight>,
    /// Until when the batch on its way to the master may continue, although calls no longer pass. Then the mirror
    /// answers it.
    grace: Option<tokio::time::Instant>,
    /// Whether the connection of a batch ended before its answer, and the recovery has not changed the gate ([`State`])
    /// since.
    lost: bool,
    signals: Arc<Signals>,
    /// When the master counts as late with the batch that it has not answered yet.
    late_at: Option<tokio::time::Instant>,
    /// Whether the batch that the master was late with has ended, although the recovery still waits for that
    /// ([`State::Late`]).
    late_over: bool,
    tell_sent: watch::Sender<Option<tokio::time::Instant>>,
    /// The number of the last master to which calls passed.
    incarnation: u64,
    resync: ResyncSchedule,
    retry_at: Option<tokio::time::Instant>,
    /// Latest time to retry calls that wait until other calls are answered.
    pub(super) held_until: Option<tokio::time::Instant>,
    /// Calls with an effect that the answer does not show: rosrescue does not understand the call or the answer, or the
    /// answer is a fault. Their answers wait until the mirror has been read from the master again and includes their
    /// effects.
    opaque: Opaque,
}

#[derive(Default)]
struct Opaque {
    incarnation: u64,
    answers: Vec<(Item, CallAnswer)>,
    mark: Mark,
}

impl Drain {
    pub(super) fn new(
        items: mpsc::Receiver<Item>,
        link: Link,
        gate: gate::Rx,
        stats: &'static Stats,
        resync_interval: Option<Duration>,
        signals: Arc<Signals>,
        tell_sent: watch::Sender<Option<tokio::time::Instant>>,
    ) -> Self {
        Self {
            held_until: None,
            wakes: Wakes {
                gate,
                items,
                order_changed: link.ledger.order_changed(),
                lease: link.ledger.lease.changed(),
                resync_interval,
            },
            link,
            stats,
            queue: VecDeque::new(),
            connection: None,
            in_flight: None,
            grace: None,
            lost: false,
            signals,
            late_at: None,
            late_over: false,
            tell_sent,
            incarnation: 0,
            resync: ResyncSchedule::default(),
            retry_at: None,
            opaque: Opaque::default(),
        }
    }

    /// Runs until every [`WriteQueue`](super::WriteQueue) is gone.
    pub(crate) async fn run(mut self) {
        let mut interval = self.wakes.resync_interval.map(tokio::time::interval);
        loop {
            let mut changed = false;
            tokio::select! {
                item = self.wakes.items.recv() => match item {
                    Some(item) => self.queue.push_back(item),
                    None => return,
                },
                () = self.wakes.gate.changed() => changed = true,
                done = wait::for_some(self.in_flight.as_mut().map(|batch| &mut batch.done)) => {
                    // A read that takes longer than the interval must leave time for calls.
                    if matches!(done.result, Ok(Received::Held(_))) && let Some(interval) = &mut interval {
                        interval.reset();
                    }
                    self.done(done);
                }
                () = wait::until(self.retry_at) => self.retry_at = None,
                () = wait::until(self.held_until) => {}
                // The ledger lives as long as this task.
                _ = self.wakes.order_changed.changed() => {}
                _ = self.wakes.lease.changed() => {}
                () = wait::until(self.grace) => {}
                () = wait::until(self.late_at) => {}
                () = wait::tick(&mut interval) => {
                    if self.in_flight.as_ref().is_none_or(|batch| !batch.items.is_empty()) {
                        self.resync.request();
                    }
                }
                () = wait::until(self.resync.wake_at()) => self.resync.wake(),
            }
            while let Ok(item) = self.wakes.items.try_recv() {
                self.queue.push_back(item);
            }
            // Drops calls that are answered or whose client has gone.
            self.queue.retain(|item| !item.is_dropped());
            // Checked on every wake-up: once seen, a change is not notified again.
            let (state, unseen) = self.wakes.gate.look_changed();
            if changed || unseen {
                (self.retry_at, self.lost) = (None, false);
            }
            self.late_over &= state == State::Late;
            match state {
                State::Elsewhere => self.send_elsewhere(),
                _ if !self.link.ledger.lease.is_held() => {}
                State::Open { incarnation } => self.send(incarnation),
                State::StandingIn => self.stand_in(),
                State::Late => self.stand_in_for_late(),
                State::Injecting | State::Unknown => self.grace = None,
            }
            self.late_at = self.late_at(state);
            self.tell_late();
            self.tell_sent
                .send_replace(self.in_flight.as_ref().map(|batch| batch.sent));
        }
    }

    /// When the mirror must answer in the master's place. `None` while the mirror is in doubt, or a call is under way
    /// that only a master can answer. Then only the probes find that the master hangs.
    fn late_at(&self, state: State) -> Option<tokio::time::Instant> {
        let batch = self
            .in_flight
            .as_ref()
            .filter(|batch| state.is_open() && batch.answerable && !batch.told_late)?;
        if batch.items.is_empty() && self.queue.is_empty() || self.link.ledger.is_doubted() {
            return None;
        }
        let mut patience = self.signals.patience.borrow().clone();
        let silent_since = self.link.upstream.silent_since();
        let late_at = patience.late_at(Instant::now(), batch.sent.into_std(), silent_since);
        Some(late_at.into())
    }

    /// Tells the recovery that the master is late, if it is.
    fn tell_late(&mut self) {
        if let Some(batch) = &mut self.in_flight
            && let Some(_) = self
                .late_at
                .take_if(|at| *at <= tokio::time::Instant::now())
        {
            batch.told_late = true;
            self.signals.is_late.notify_one();
        }
    }

    /// Sends the next batch, if none is in flight and there is something to send.
    fn send(&mut self, incarnation: u64) {
        self.grace = None;
        if let Some(batch) = self
            .in_flight
            .take_if(|batch| batch.incarnation != incarnation)
        {
            // The new master never got these calls.
            self.link.ledger.withdraw();
            self.take_back(batch.items);
        }
        if self.opaque.incarnation != incarnation {
            let opaque = std::mem::take(&mut self.opaque).answers;
            self.take_back(opaque.into_iter().map(|(item, _)| item).collect());
        }
        if std::mem::replace(&mut self.incarnation, incarnation) != incarnation {
            self.resync.reset();
        }
        if self.link.ledger.is_doubted() {
            self.resync.doubted();
        }
        if self.in_flight.is_some() || self.retry_at.is_some() || self.lost {
            return;
        }
        while let Some(own) = self.queue.front()
            && is_outdated(&self.link.ledger, own)
            && let Some(own) = self.queue.pop_front()
        {
            own.reply(CallAnswer::Close);
        }
        self.held_until = None;
        let inspects = self.resync.begin(tokio::time::Instant::now());
        let items = match inspects {
            true => Vec::new(),
            false => self.next_batch(),
        };
        if items.is_empty() && self.queue.is_empty() {
            // No call is left: the callers of lost calls have gone.
            self.link.ledger.release(Order::settled);
        }
        if items.is_empty() && !inspects {
            return;
        }
        let mut connection = self.connection.take();
        connection.take_if(|(of, next)| *of != incarnation || next.is_stale());
        let connection = connection.map(|(_, next)| next);
        self.stats.write_batches.count();
        let request = (!items.is_empty()).then(|| batch::outbound(&items));
        self.link.ledger.with_order(|order, _| {
            let tells = items.iter().flat_map(|item| item.concern().tells());
            let answers = items.iter().filter_map(|item| item.delivery.as_ref());
            order.sent(tells, answers.map(Delivery::number).collect());
        });
        if let [item] = items.as_slice()
            && let Some(call) = item.call.as_ref().filter(|_| item.raw.is_some())
        {
            self.link.ledger.record_ahead(call, item.origin);
        }
        let span = tracing::debug_span!("batch", incarnation, calls = items.len());
        let done = round_trip(self.link.clone(), incarnation, connection, request);
        self.in_flight = Some(InFlight {
            incarnation,
            version: self.link.ledger.version(),
            answerable: items.iter().all(Item::is_answerable),
            told_late: false,
            late: false,
            items,
            sent: tokio::time::Instant::now(),
            done: Box::pin(done.instrument(span)),
        });
    }

    fn done(&mut self, done: RoundTripResult) {
        let Some(InFlight {
            incarnation,
            version,
            items,
            late,
            sent,
            ..
        }) = self.in_flight.take()
        else {
            return;
        };
        self.connection = done.connection;
        if late {
            return self.late_done(done.result.map(|_| ()));
        }
        let connected = !matches!(done.result, Err(RoundTripError::Connect(_)));
        if items.is_empty() && connected {
            self.resync
                .ended(tokio::time::Instant::now(), sent.elapsed());
        }
        match done.result {
            Ok(Received::Held(state)) => self.resync(incarnation, version, *state),
            Ok(Received::Reply(raw)) => {
                let (took, calls) = (sent.elapsed(), items.len());
                let ledger = &self.link.ledger;
                ledger.with_order(|order, _| order.master_answered(took, calls));
                self.deliver(incarnation, items, raw);
            }
            Err(error) => self.failed(items, &error),
        }
        // A master that ran a lost batch may have notified nodes, and the mirror does not know yet of what.
        if !self.lost {
            self.link.ledger.release(Order::settled);
        }
    }

    /// Handles the end of a late batch: the master has answered what the mirror answered long ago,
    /// or never will.
    fn late_done(&mut self, result: Result<(), RoundTripError>) {
        self.late_over = true;
        match result {
            Ok(()) => {
                self.link.ledger.late_answered(Instant::now());
                self.signals.has_answered.notify_one();
            }
            Err(error) => {
                tracing::debug!(%error, "a late batch failed");
                self.link.ledger.abandon_batch();
                self.signals.lost.notify_one();
            }
        }
        self.link.ledger.release(Order::settled);
    }

    fn resync(&mut self, incarnation: u64, version: u64, state: Master) {
        let Ok(difference) = self.link.ledger.adopt_if(incarnation, version, state) else {
            // The gate was shut meanwhile, or the mirror has changed since.
            self.resync.request();
            return;
        };
        if !difference.is_empty() {
            rarely!(
                warn,
                ?difference,
                "the master's state differed from the mirror, which now follows it; if a client changed the master directly, set its ROS_MASTER_URI to rosrescue's address"
            );
        }
        self.answer_opaque();
    }

    fn answer_opaque(&mut self) {
        let Opaque { answers, mark, .. } = std::mem::take(&mut self.opaque);
        let mark = mark.max(self.link.ledger.mark());
        self.answer(mark, self.link.ledger.unwritten(), answers);
    }

    fn failed(&mut self, items: Vec<Item>, error: &RoundTripError) {
        tracing::debug!(%error, calls = items.len(), "a batch failed");
        let now = tokio::time::Instant::now();
        if items.is_empty() {
            self.retry_at = Some(now + RETRY_PAUSE);
            match error {
                RoundTripError::Connect(_) => self.resync.request(),
                _ => self.resync.failed(now),
            }
            if matches!(error, RoundTripError::Look(InspectError::NotAMaster(_))) {
                // The master lives but cannot be read, and clients need not wait for that.
                self.answer_opaque();
            }
            return;
        }
        self.link.ledger.withdraw();
        self.take_back(items);
        if error.may_have_run() {
            self.link.ledger.abandon_batch();
            // Whether the master ran the batch is known only when the master is back. Until then the mirror answers.
            self.lost = true;
            self.signals.lost.notify_one();
        } else {
            self.retry_at = Some(now + RETRY_PAUSE);
        }
    }

    pub(super) fn take_back(&mut self, items: Vec<Item>) {
        for mut item in items.into_iter().rev() {
            item.delivery = None;
            self.queue.push_front(item);
        }
    }

    /// Takes the next batch. A call that registers the port of another node is the first of its batch. The eviction,
    /// which unregisters that node, goes before it.
    fn next_batch(&mut self) -> Vec<Item> {
        let ledger = self.link.ledger.clone();
        let mut items = loop {
            let Batch { items, until } = ledger.with_order(|order, _| {
                let delivery = |number| Delivery::new(&ledger, number);
                batch::pack(&mut self.queue, order, Instant::now(), delivery)
            });
            self.held_until = until.map(Into::into);
            let any = !items.is_empty();
            let items: Vec<_> = items
                .into_iter()
                .filter_map(|item| merge::judged(&ledger, item))
                .collect();
            // If all these calls were answered without the master, the next ones are taken.
            if !any || !items.is_empty() {
                break items;
            }
        };
        let Some(first) = items.first_mut() else {
            return items;
        };
        let mut length = 1;
        if first.raw.is_some() && !first.way_made {
            if let Some(call) = first.call.as_deref()
                && let Some(eviction) = self.link.judge.judge(&ledger, call)
            {
                first.way_made = true;
                if let Some(eviction) = eviction {
                    let by = call.caller().unwrap_or_default().to_owned();
                    self.take_back(items);
                    return vec![evict::unregistration(eviction, by)];
                }
            } else {
                let calls = items.iter().map_while(|item| item.call.as_deref());
                let calls: Vec<_> = calls.collect();
                let judge = &self.link.judge;
                let apart = ledger.with_mirror(|mirror| judge.first_apart(mirror, &calls));
                length = apart.unwrap_or(items.len()).max(1);
            }
        }
        let rest = items.split_off(length);
        self.take_back(rest);
        items
    }

    /// Records what the master answered, then answers the clients.
    fn deliver(&mut self, incarnation: u64, items: Vec<Item>, raw: RawReply) {
        let reply = xmlrpc::decode_reply(&raw.body)
            .ok()
            .filter(|_| raw.status.is_success());
        let mut opaque = false;
        let replies = match (items.as_slice(), reply) {
            ([item], Some(reply)) => {
                opaque = item.call.is_none() && matches!(reply, Reply::Value(_));
                vec![reply]
            }
            // The reply cannot be decoded, so the effect is unknown and the master's state must be read. Reading does
            // not show parameter subscriptions, so these are recorded as the mirror predicts.
            ([item], None) if raw.status.is_success() => {
                opaque = true;
                let call = item.call.as_deref().filter(|call| subscribes_params(call));
                call.map(|call| self.link.ledger.predict(call))
                    .into_iter()
                    .collect()
            }
            ([_], None) => Vec::new(),
            (_, Some(reply)) => match batch::unpack(&reply, items.len()) {
                Some(replies) => replies,
                None => return self.undeliverable(items),
            },
            (_, None) => return self.undeliverable(items),
        };
        let answered: Vec<_> = items
            .iter()
            .zip(&replies)
            .filter_map(|(item, reply)| {
                Some((item.call.as_deref()?, reply, &item.source, item.origin))
            })
            .collect();
        let registered = answered.iter().any(|(call, ..)| registers(call));
        let Ok(recorded) = self
            .link
            .ledger
            .record(Instant::now(), incarnation, &answered)
        else {
            // The gate is about to open for another master.
            self.lost = true;
            self.link.ledger.withdraw();
            return self.take_back(items);
        };
        if registered {
            self.link.judge.registered();
        }
        // A multicall that is answered with a fault may have changed something before.
        opaque |= recorded.doubtful && matches!(replies.as_slice(), [Reply::Fault { .. }]);
        if opaque {
            self.link.ledger.doubt();
            // Answers may be waiting already: after a failed read of the state, calls are sent before the next read.
            self.opaque.incarnation = incarnation;
            self.opaque.mark = self.opaque.mark.max(recorded.mark);
            let answers = items
                .into_iter()
                .map(|item| (item, CallAnswer::Raw(raw.clone())));
            self.opaque.answers.extend(answers);
            return;
        }
        let answers = match items.len() {
            1 => items
                .into_iter()
                .map(|item| (item, CallAnswer::Raw(raw.clone())))
                .collect(),
            _ => items
                .into_iter()
                .zip(replies.into_iter().map(CallAnswer::Made))
                .collect(),
        };
        let ledger = &self.link.ledger;
        let version = recorded.is_ahead.then(|| ledger.unwritten()).flatten();
        self.answer(recorded.mark, version, answers);
    }

    /// Handles a batch whose reply is one answer instead of a result for each call.
    fn undeliverable(&mut self, items: Vec<Item>) {
        rarely!(
            warn,
            calls = items.len(),
            "the master did not answer each call of a multicall; callers retry, and the master's state is read again"
        );
        self.link.ledger.doubt();
        for item in items {
            item.reply(CallAnswer::Close);
        }
    }

    /// Answers the batch in flight, then the queue, from the mirror. Calls that only a master can
    /// answer wait.
    fn stand_in(&mut self) {
        let now = tokio::time::Instant::now();
        if self.in_flight.is_some() && now < *self.grace.get_or_insert(now + GRACE) {
            return;
        }
        self.grace = None;
        if self.in_flight.is_some() {
            self.link.ledger.abandon_batch();
        }
        // A master that comes back is examined only when this connection has ended, because only then can no call of
        // this connection still be running.
        self.connection = None;
        if let Some(batch) = self
            .in_flight
            .take()
            .filter(|batch| !batch.items.is_empty())
        {
            let calls: Vec<_> = batch.items.iter().map(Item::describe).collect();
            rarely!(
                info,
                ?calls,
                "these writes were in flight when the master went away; the mirror answers them"
            );
            self.take_back(batch.items);
        }
        let answerable = |(item, _): &mut (Item, CallAnswer)| item.is_answerable();
        let opaque = self.opaque.answers.extract_if(.., answerable);
        let opaque = opaque.map(|(item, _)| item).collect();
        self.take_back(opaque);
        self.answer_queue();
        self.link.ledger.withdraw();
        self.link.ledger.release(Order::settled);
    }

    /// Answers from the mirror the batch that the master is late with, then the queue. The batch continues. When the
    /// master has answered it, the recovery gives the master the writes that it missed.
    fn stand_in_for_late(&mut self) {
        self.grace = None;
        let ledger = self.link.ledger.clone();
        match &mut self.in_flight {
            Some(batch) if batch.late => {}
            Some(batch) => {
                batch.late = true;
                if batch.items.is_empty() {
                    // A read of the master's state was under way, and must be repeated.
                    self.resync.request();
                }
                let mut answers = Answers::default();
                let mut tells = Vec::new();
                for mut item in std::mem::take(&mut batch.items) {
                    item.delivery = None;
                    tells.extend_from_slice(item.concern().tells());
                    if let Some(item) = answers.add(&ledger, item) {
                        self.queue.push_front(item);
                    }
                }
                ledger.fall_behind(Instant::now(), tells);
                self.stats.calls_without_master.add(answers.count());
                self.answer(answers.mark, None, answers.made);
            }
            // The master has answered the batch just now.
            None if !self.late_over => {
                ledger.fall_behind(Instant::now(), Vec::new());
                self.late_done(Ok(()));
            }
            None => {}
        }
        self.answer_queue();
    }

    /// Answers the queue from the mirror. Calls that only a master can answer wait.
    fn answer_queue(&mut self) {
        let ledger = self.link.ledger.clone();
        let mut answers = Answers::default();
        for item in std::mem::take(&mut self.queue) {
            if is_outdated(&ledger, &item) {
                item.reply(CallAnswer::Close);
                continue;
            }
            let Some(item) = merge::judged(&ledger, item) else {
                continue;
            };
            if let Some(item) = answers.add(&ledger, item) {
                self.queue.push_back(item);
            }
        }
        self.stats.calls_without_master.add(answers.count());
        self.answer(answers.mark, None, answers.made);
    }

    /// Redirects all calls to the other computer that has the master.
    fn send_elsewhere(&mut self) {
        (self.grace, self.connection) = (None, None);
        let in_flight = self.in_flight.take().map(|batch| batch.items);
        self.link.ledger.withdraw();
        self.link.ledger.release(Order::settled);
        let opaque = std::mem::take(&mut self.opaque).answers;
        let items = in_flight.into_iter().flatten();
        let items = items.chain(opaque.into_iter().map(|(item, _)| item));
        for item in items.chain(self.queue.drain(..)) {
            item.reply(CallAnswer::Elsewhere);
        }
    }

    /// Sends answers once the effects of their calls are safe (see [`Ledger::durable`](crate::ledger::Ledger::durable))
    /// and a whole checkpoint includes this `version` of the mirror.
    fn answer(&self, mark: Mark, version: Option<u64>, answers: Vec<(Item, CallAnswer)>) {
        let mark = self.link.ledger.to_await(mark);
        let send = move |is_safe: bool| {
            for (item, answer) in answers {
                item.reply(match is_safe {
                    true => answer,
                    false => CallAnswer::Elsewhere,
                });
            }
        };
        if (mark, version) == (None, None) {
            return send(true);
        }
        let ledger = self.link.ledger.clone();
        crate::task::spawn(async move {
            let is_safe = match mark {
                Some(mark) => ledger.durable(mark).await,
                None => true,
            };
            if let Some(version) = version {
                ledger.attempted(version).await;
            }
            send(is_safe);
        });
    }
}

/// Answers from the mirror.
#[derive(Default)]
struct Answers {
    made: Vec<(Item, CallAnswer)>,
    /// Identifies the last record that these answers may have to wait for.
    mark: Mark,
}

impl Answers {
    /// Answers `item`, or returns it if only a master can answer it.
    fn add(&mut self, ledger: &Arc<Ledger>, mut item: Item) -> Option<Item> {
        let call = item.answerable();
        let answer = |call| {
            let (concern, source, origin) = (item.concern(), &item.source, item.origin);
            ledger.stand_in_for(Instant::now(), call, concern, source, origin)
        };
        let Some((reply, mark, delivery)) = call.and_then(answer) else {
            return Some(item);
        };
        item.delivery = delivery;
        self.mark = self.mark.max(mark);
        self.made.push((item, CallAnswer::Made(reply)));
        None
    }

    fn count(&self) -> u64 {
        self.made.len() as u64
    }
}

/// Whether `call`, or an entry of it, registers something for a node.
fn registers(call: &Request) -> bool {
    Write::all(call).any(|write| write.registrant().is_some())
}

/// Whether `call`, or an entry of it, subscribes to a parameter. The reply contains the parameter's
/// value.
fn subscribes_params(call: &Request) -> bool {
    Write::all(call).any(|write| matches!(write.effect, Effect::SubscribeParam { .. }))
}

#[cfg(test)]
mod tests;
