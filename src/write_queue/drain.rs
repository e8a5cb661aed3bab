//! Carries out what the [`Dispatcher`] decides: exchanges requests with the master, and gives callers their answers.

use std::{
    pin::{Pin, pin},
    sync::Arc,
    task::Poll,
    time::{Duration, Instant},
};

use bytes::Bytes;
use tokio::sync::{mpsc, watch};
use tracing::Instrument;

use super::{
    Link, Signals,
    batch::Item,
    dispatcher::{Action, Answers, Dispatcher, Input, Report, View},
    round_trip::{Received, RoundTripResult, round_trip},
};
use crate::{
    gate,
    upstream::{Head, next::NextConnection},
    wait,
};

/// The task of the write queue.
pub(crate) struct Drain {
    dispatcher: Dispatcher,
    link: Link,
    gate: gate::Rx,
    items: mpsc::Receiver<Item>,
    signals: Arc<Signals>,
    /// Pause between two comparisons of the master with the mirror. `None` for never.
    resync_interval: Option<Duration>,
    /// The connection for the next request, with the number of its master.
    connection: Option<(u64, NextConnection)>,
    /// The request in flight, which owns its connection.
    in_flight: Option<Pin<Box<dyn Future<Output = RoundTripResult> + Send>>>,
    tell_sent: watch::Sender<Option<tokio::time::Instant>>,
}

impl Drain {
    pub(super) fn new(
        dispatcher: Dispatcher,
        items: mpsc::Receiver<Item>,
        link: Link,
        resync_interval: Option<Duration>,
        signals: Arc<Signals>,
        tell_sent: watch::Sender<Option<tokio::time::Instant>>,
    ) -> Self {
        Self {
            dispatcher,
            gate: link.ledger.gate(),
            link,
            items,
            signals,
            resync_interval,
            connection: None,
            in_flight: None,
            tell_sent,
        }
    }

    /// Runs until every [`WriteQueue`](super::WriteQueue) is gone.
    pub(crate) async fn run(mut self) {
        let mut interval = self.resync_interval.map(tokio::time::interval);
        let mut order_changed = self.link.ledger.order_changed();
        let mut lease = self.link.ledger.lease.changed();
        let mut alarm = pin!(tokio::time::sleep(Duration::ZERO));
        let mut is_set = false;
        loop {
            // Each write has a deadline, and hardly any comes. An alarm that is too early costs less than two settings for
            // each write.
            if let Some(at) = self.dispatcher.deadline().map(Into::into)
                && (!is_set || at < alarm.deadline())
            {
                alarm.as_mut().reset(at);
                is_set = true;
            }
            let mut changed = false;
            let input = tokio::select! {
                // What has happened comes before the clock: on a busy computer, the master's answer and the end of its time
                // may both be there.
                biased;
                done = wait::for_some(self.in_flight.as_mut()) => {
                    self.in_flight = None;
                    self.connection = done.connection;
                    // A read that takes longer than the interval must leave time for calls.
                    if matches!(done.result, Ok(Received::Held(_))) && let Some(interval) = &mut interval {
                        interval.reset();
                    }
                    Input::Ended(done.result.map_err(|error| {
                        tracing::debug!(%error, "a request of the write queue failed");
                        error.failure()
                    }))
                }
                () = wait::tick(&mut interval) => Input::Compare,
                () = self.gate.changed() => {
                    changed = true;
                    Input::Wake
                }
                item = self.items.recv() => match item {
                    Some(item) => Input::Calls(self.with_others(item)),
                    None => return,
                },
                // The senders live as long as this task.
                _ = order_changed.changed() => Input::Wake,
                _ = lease.changed() => Input::Wake,
                () = alarm.as_mut(), if is_set => {
                    is_set = false;
                    Input::Wake
                }
            };
            // Checked on every wake-up: once seen, a change is not notified again.
            let (state, unseen) = self.gate.observe_change();
            let view = View {
                now: Instant::now(),
                gate: state,
                gate_changed: changed || unseen,
                leads: self.link.ledger.lease.is_held(),
                silent_since: self.link.upstream.silent_since(),
            };
            for action in self.dispatcher.on(&view, input) {
                if matches!(action, Action::Record { .. }) {
                    self.begin_request().await;
                }
                self.carry_out(action);
            }
            let sent = self.dispatcher.unanswered_since();
            self.tell_sent.send_replace(sent.map(Into::into));
        }
    }

    /// `item` and all other calls that have arrived, so that they can share a batch.
    fn with_others(&mut self, item: Item) -> Vec<Item> {
        let mut items = vec![item];
        while let Ok(item) = self.items.try_recv() {
            items.push(item);
        }
        items
    }

    fn carry_out(&mut self, action: Action) {
        match action {
            Action::Send {
                incarnation,
                request,
            } => self.exchange(incarnation, Some(request)),
            Action::Inspect { incarnation } => self.exchange(incarnation, None),
            Action::Record { call, origin } => {
                if self.link.ledger.record_ahead(&call, origin) {
                    self.link.ledger.write();
                }
            }
            Action::Disconnect => (self.in_flight, self.connection) = (None, None),
            Action::Answer(answers) => self.answer(answers),
            Action::Report(report) => match report {
                Report::Lost => self.signals.batch_lost.notify_one(),
                Report::Late => self.signals.is_late.notify_one(),
                Report::LateAnswered => self.signals.has_answered.notify_one(),
                Report::Slow => self.signals.slow.notify_one(),
            },
        }
    }

    /// Sends `request` to the master, or without one reads its state.
    fn exchange(&mut self, incarnation: u64, request: Option<(Head, Bytes)>) {
        let mut connection = self.connection.take();
        let upstream = &self.link.upstream;
        connection.take_if(|(of, next)| *of != incarnation || next.is_stale(upstream));
        let connection = connection.map(|(_, next)| next);
        let span = tracing::debug_span!("request", incarnation);
        let done = round_trip(self.link.clone(), incarnation, connection, request);
        self.in_flight = Some(Box::pin(done.instrument(span)));
    }

    /// Sends as much of the request in flight as can be sent without waiting. So the master works on it while the record
    /// is made, and before the disk's thread is woken.
    async fn begin_request(&mut self) {
        let Some(in_flight) = self.in_flight.as_mut() else {
            return;
        };
        let begun = std::future::poll_fn(|context| Poll::Ready(in_flight.as_mut().poll(context)));
        if let Poll::Ready(done) = begun.await {
            self.in_flight = Some(Box::pin(std::future::ready(done)));
        }
    }

    /// Gives the answers once the effects of their calls are safe.
    fn answer(&self, answers: Answers) {
        if (answers.mark, answers.version) == (None, None) {
            return answers.give(true);
        }
        let ledger = self.link.ledger.clone();
        crate::task::spawn(async move {
            let is_safe = match answers.mark {
                Some(mark) => ledger.durable(mark).await,
                None => true,
            };
            if let Some(version) = answers.version {
                ledger.attempted(version).await;
            }
            answers.give(is_safe);
        });
    }
}

#[cfg(test)]
mod tests;
