//! The write queue: writes go to the master one batch at a time, so the journal's order is the order in which
//! the master ran them. Writes that arrive meanwhile form the next batch. While the master is away the mirror
//! answers them, in the same order.

pub(crate) mod batch;
mod drain;
mod evict;
mod outdated;
pub(crate) mod parts;
mod resync;
mod round_trip;

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use tokio::{
    sync::{Notify, mpsc, oneshot, watch},
    time::Instant,
};

use self::batch::{Answer, Condition, Item};
pub(crate) use self::drain::Drain;
use crate::{
    gate,
    ledger::Ledger,
    master::Request,
    status::stats::Stats,
    upstream::{Head, Upstream},
    xmlrpc::{self, Reply},
};

/// Calls between the clients and the queue. The worker always empties it at once.
const CHANNEL: usize = 64;

/// The way into the queue.
#[derive(Clone, Debug)]
pub struct WriteQueue {
    items: mpsc::Sender<Item>,
    lost: Arc<Notify>,
    sent: watch::Receiver<Option<Instant>>,
}

impl WriteQueue {
    pub(crate) async fn submit(&self, item: Item) {
        // The worker ends only when rosrescue stops. The answer's sender is dropped then.
        let _ = self.items.send(item).await;
    }

    /// When the unanswered batch was sent, if there is one.
    pub(crate) fn unanswered_since(&self) -> Option<Instant> {
        *self.sent.borrow()
    }

    /// Makes a call of rosrescue's own, recorded like any other. None if there is no answer.
    pub async fn call(&self, call: Request) -> Option<Reply> {
        self.call_own(call, None).await
    }

    /// As [`Self::call`], but drops the call if `condition` no longer holds when it is due.
    pub async fn call_if(&self, call: Request, condition: Condition) -> Option<Reply> {
        self.call_own(call, Some(condition)).await
    }

    /// Makes a call of a client that has its answer already. None if there is no answer.
    pub(crate) async fn call_of_client(&self, call: Request) -> Option<Reply> {
        let body = xmlrpc::encode_call(&call.clone().into());
        self.answer_to(Some((Head::default(), body.into())), call, None)
            .await
    }

    async fn call_own(&self, call: Request, condition: Option<Condition>) -> Option<Reply> {
        self.answer_to(None, call, condition).await
    }

    async fn answer_to(
        &self,
        raw: Option<(Head, Bytes)>,
        call: Request,
        condition: Option<Condition>,
    ) -> Option<Reply> {
        let (answer, answered) = oneshot::channel();
        let item = Item {
            raw,
            call: Some(Arc::new(call)),
            answer,
            condition,
            way_made: false,
        };
        self.items.send(item).await.ok()?;
        match answered.await.ok()? {
            Answer::Made(reply) => Some(reply),
            Answer::Raw(raw) => xmlrpc::decode_reply(&raw.body).ok(),
            Answer::Close | Answer::Elsewhere => None,
        }
    }

    /// Returns when a batch was lost: the master may have run it, and may be dead. Nothing is sent until the
    /// gate has changed. Called by the gate's only writer.
    pub async fn lost(&self) {
        self.lost.notified().await;
    }
}

/// Makes a write queue and the worker to run. `resync_interval`: how often the master is compared with the
/// mirror, if at all. `evicts`: whether a node whose port another one registers is taken out.
pub(crate) fn write_queue(
    ledger: Arc<Ledger>,
    upstream: Arc<Upstream>,
    gate: gate::Rx,
    stats: &'static Stats,
    resync_interval: Option<Duration>,
    evicts: bool,
) -> (WriteQueue, Drain) {
    let (items, rx) = mpsc::channel(CHANNEL);
    let lost = Arc::new(Notify::new());
    let (tell_sent, sent) = watch::channel(None);
    let link = Link { ledger, upstream };
    let mut drain = Drain::new(
        rx,
        link,
        gate,
        stats,
        resync_interval,
        lost.clone(),
        tell_sent,
    );
    drain.evicts = evicts;
    (WriteQueue { items, lost, sent }, drain)
}

/// What a round trip needs.
#[derive(Clone)]
struct Link {
    ledger: Arc<Ledger>,
    upstream: Arc<Upstream>,
}
