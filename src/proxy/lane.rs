//! The lane: mutating calls travel to the master one journey at a time, so that the journal's order
//! is the order in which the master ran them. Calls that queue up travel together.

mod overtaken;
mod runner;

use std::{sync::Arc, time::Duration};

use tokio::sync::{Semaphore, SemaphorePermit, mpsc, oneshot};

pub use self::runner::LaneRunner;
use super::{
    gate::Gate,
    journey::{Answer, LaneItem, Premise},
};
use crate::{
    master::Kind,
    xmlrpc::{self, Call, Reply},
};

/// Calls between the clients and the queue. The runner never lets them wait.
const CHANNEL: usize = 64;

/// The way into the lane.
#[derive(Clone, Debug)]
pub struct Lane {
    items: mpsc::Sender<LaneItem>,
    /// Places for calls that wait. Unregistrations have their own: they are answered even if all
    /// other places are taken.
    places: Arc<[Semaphore; 2]>,
}

impl Lane {
    /// A place for a call of this kind, to be held until it is answered or given up. None: all are
    /// taken and the gate is shut. While it is open, a place is waited for.
    pub(super) async fn place(&self, gate: &Gate, kind: Kind) -> Option<SemaphorePermit<'_>> {
        let [unregistrations, others] = &*self.places;
        let places = match kind {
            Kind::Unregister => unregistrations,
            _ => others,
        };
        if let Ok(place) = places.try_acquire() {
            return Some(place);
        }
        let mut gate = gate.clone();
        tokio::select! {
            place = places.acquire() => place.ok(),
            () = gate.shut_for(Duration::ZERO) => None,
        }
    }

    /// Puts a call in the queue.
    pub(super) async fn submit(&self, item: LaneItem) {
        // The runner is gone only when rosrescue stops; the answer's sender is dropped then.
        let _ = self.items.send(item).await;
    }

    /// Makes a call of rosrescue's own, recorded as any other. None if the master never answers.
    pub async fn call(&self, call: Call, kind: Kind) -> Option<Reply> {
        self.call_own(call, kind, None).await
    }

    /// As [`Self::call`]; the call is dropped, too, if `premise` no longer holds when it is to travel.
    pub async fn call_if(&self, call: Call, kind: Kind, premise: Premise) -> Option<Reply> {
        self.call_own(call, kind, Some(premise)).await
    }

    async fn call_own(&self, call: Call, kind: Kind, premise: Option<Premise>) -> Option<Reply> {
        let (answer, answered) = oneshot::channel();
        let mut item = LaneItem::new(None, Some(call), kind, answer);
        item.premise = premise;
        self.items.send(item).await.ok()?;
        match answered.await.ok()? {
            Answer::Made(reply) => Some(reply),
            Answer::Raw(raw) => xmlrpc::decode_reply(&raw.body).ok(),
            Answer::Close => None,
        }
    }
}

/// Makes a lane in which `max_parked` calls may wait, and as many unregistrations; the second part is to
/// be run.
pub fn lane(max_parked: usize) -> (Lane, LaneRunner) {
    // Without a place nobody could pass the open gate either.
    let max_parked = max_parked.max(1);
    let (tx, rx) = mpsc::channel(CHANNEL);
    let runner = LaneRunner::new(rx, max_parked);
    let places = Arc::new([max_parked, max_parked].map(Semaphore::new));
    (Lane { items: tx, places }, runner)
}
