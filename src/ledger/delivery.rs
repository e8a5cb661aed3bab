//! Tracks answers on their way to nodes, and wakes the calls and notifications that wait for them. The rules are in
//! [`rescue_core::order`].

use std::{sync::Arc, time::Instant};

use rescue_core::order::recipients_of_read;
use ros1_master::master::Request;

use super::Ledger;

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
    /// Tracks the answer with this number in the [`Order`](rescue_core::order::Order) of `ledger`. The handle must not be
    /// dropped under the ledger's lock.
    pub(crate) fn new(ledger: &Arc<Ledger>, number: u64) -> Self {
        let ledger = Some(ledger.clone());
        Self { ledger, number }
    }

    /// Begins the answer to `read`, so that later notifications of its caller wait for it. Returns `Ok(None)` if the
    /// answer shows nothing that nodes are notified of.
    pub(crate) fn of_read(
        ledger: &Arc<Ledger>,
        now: Instant,
        read: Option<&Request>,
    ) -> Result<Option<Self>, MustWait> {
        let Some(read) = read else { return Ok(None) };
        let begun = ledger.with_order(|order, mirror| {
            let heard = recipients_of_read(read, mirror);
            match order.read_must_wait(&heard) {
                true => Err(MustWait),
                false => Ok(order.begin_answer(now, heard)),
            }
        });
        Ok(begun?.map(|number| Self::new(ledger, number)))
    }

    /// Like [`Self::of_read`], but begins the answer even if the master may be notifying the caller right now.
    pub(crate) fn of_read_now(ledger: &Arc<Ledger>, read: &Request) -> Option<Self> {
        let begun = ledger.with_order(|order, mirror| {
            let heard = recipients_of_read(read, mirror);
            order.begin_answer(Instant::now(), heard)
        });
        Some(Self::new(ledger, begun?))
    }

    pub(crate) fn number(&self) -> u64 {
        self.number
    }

    /// Notes that the answer is ready to be written.
    pub(crate) fn ready(&self) {
        if let Some(ledger) = &self.ledger {
            ledger.release(|order| order.answer_ready(Instant::now(), self.number));
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
            ledger.release(|order| order.answer_written(Instant::now(), self.number));
        }
    }
}

/// The read has to wait: the master may be notifying its caller of a change right now.
#[derive(Debug)]
pub(crate) struct MustWait;
