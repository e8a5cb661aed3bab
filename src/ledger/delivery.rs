//! Tracks answers on their way to nodes, and wakes the calls and notifications that wait for them. The rules are in
//! [`crate::order`].

use std::{sync::Arc, time::Instant};

use tokio::sync::watch;

use super::{Inner, Ledger};
use crate::{
    master::{Master, Request},
    order::{NextNotification, Order, heard_by_read},
};

/// An answer on its way to its caller. Drop this handle once the answer has been written or can no longer be written.
pub(crate) struct Delivery {
    /// `None` in simulations, which have their own time.
    ledger: Option<Arc<Ledger>>,
    number: u64,
}

impl std::fmt::Debug for Delivery {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Delivery").field(&self.number).finish()
    }
}

impl Delivery {
    /// Tracks the answer with this number in the [`Order`] of `ledger`. The handle must not be dropped under the
    /// ledger's lock.
    pub(crate) fn new(ledger: &Arc<Ledger>, number: u64) -> Self {
        let ledger = Some(ledger.clone());
        Self { ledger, number }
    }

    pub(crate) fn number(&self) -> u64 {
        self.number
    }

    /// Notes that the answer is ready to be written.
    pub(crate) fn ready(&self) {
        if let Some(ledger) = &self.ledger {
            ledger.lock().order.ready(Instant::now(), self.number);
        }
    }

    /// Returns the number and stops tracking the answer.
    #[cfg(test)]
    pub(crate) fn into_number(mut self) -> u64 {
        self.ledger = None;
        self.number
    }
}

impl Drop for Delivery {
    fn drop(&mut self) {
        if let Some(ledger) = &self.ledger {
            let awaited = ledger.lock().order.written(Instant::now(), self.number);
            ledger.report(awaited);
        }
    }
}

/// The read has to wait: the master may be notifying its caller of a change right now.
#[derive(Debug)]
pub(crate) struct MustWait;

impl Ledger {
    /// Runs `work` on the [`Order`] and the mirror.
    pub(crate) fn with_order<T>(&self, work: impl FnOnce(&mut Order, &Master) -> T) -> T {
        let mut inner = self.lock();
        let Inner { mirror, order, .. } = &mut *inner;
        let result = work(order, mirror);
        let repeats = order.has_new_repeat();
        drop(inner);
        if repeats {
            self.outbox_changed.notify_one();
        }
        result
    }

    /// Signals that a call or notification that [waits](Order) may be able to go on.
    pub(crate) fn order_changed(&self) -> watch::Receiver<()> {
        self.order_changed.subscribe()
    }

    fn report(&self, awaited: bool) {
        if awaited {
            self.order_changed.send_replace(());
        }
    }

    /// Begins the answer to `read`, so that later notifications of its caller wait for it. Returns `Ok(None)` if the
    /// answer shows nothing that nodes are notified of.
    pub(crate) fn begin_read(
        self: &Arc<Self>,
        now: Instant,
        read: Option<&Request>,
    ) -> Result<Option<Delivery>, MustWait> {
        let Some(read) = read else { return Ok(None) };
        let begun = self.with_order(|order, mirror| {
            let heard = heard_by_read(read, mirror);
            match order.read_must_wait(&heard) {
                true => Err(MustWait),
                false => Ok(order.begin(now, heard)),
            }
        });
        Ok(begun?.map(|number| Delivery::new(self, number)))
    }

    /// Like [`Self::begin_read`], but begins the answer even if the master may be notifying the caller right now.
    pub(crate) fn begin_read_now(self: &Arc<Self>, read: &Request) -> Option<Delivery> {
        let begun = self.with_order(|order, mirror| {
            let heard = heard_by_read(read, mirror);
            order.begin(Instant::now(), heard)
        });
        Some(Delivery::new(self, begun?))
    }

    /// Notes that the master has no unanswered calls left, or that the mirror has answered them.
    pub(crate) fn settled_calls(&self) {
        let awaited = self.lock().order.settled();
        self.report(awaited);
    }

    /// The next notification for the node at `port`, or how long to wait for it.
    pub(crate) fn next_notification(&self, port: &str) -> NextNotification {
        self.with_order(|order, mirror| order.next(Instant::now(), port, mirror))
    }

    /// Notes that the delivery of the notification with this number has ended, with or without success.
    pub(crate) fn notification_ended(&self, number: u64) {
        let awaited = self.lock().order.taken(number);
        self.report(awaited);
    }
}
