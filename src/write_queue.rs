//! The write queue sends writes to the master one batch at a time, so the journal's order is the
//! order in which the master ran them. Writes that arrive meanwhile form the next batch. While the master is away, the
//! mirror answers the queued writes in the same order.

pub(crate) mod batch;
mod dispatcher;
mod drain;
mod evict;
mod merge;
mod outdated;
pub(crate) mod parts;
mod resync;
mod round_trip;

use std::{sync::Arc, time::Duration};

use rescue_core::{
    checkpoint::format::Origin,
    cluster::merge::wire::{self, Ask},
    lifecycle::Patience,
};
use ros1_master::{
    master::Request,
    xmlrpc::{self, Reply, Value},
};
use tokio::{
    sync::{Notify, mpsc, watch},
    time::Instant,
};

use self::{
    batch::{CallAnswer, Item, MadeBy, Precondition},
    dispatcher::Dispatcher,
};
pub(crate) use self::{dispatcher::PATIENCE, drain::Drain, evict::MoveJudge};
use crate::{cli::Writes, ledger::Ledger, status::stats::Stats, upstream::Upstream};

/// Maximum number of calls in the channel from the clients to the task, which always empties it at once.
const CHANNEL: usize = 64;

/// The clients' handle to the queue.
#[derive(Clone, Debug)]
pub struct WriteQueue {
    items: mpsc::Sender<Item>,
    signals: Arc<Signals>,
    sent: watch::Receiver<Option<Instant>>,
}

impl WriteQueue {
    pub(crate) async fn submit(&self, item: Item) {
        // The task ends only when rosrescue stops. The answer's sender is dropped then.
        let _ = self.items.send(item).await;
    }

    /// When the batch that the master has not answered yet was sent. `None` without such a batch.
    pub(crate) fn unanswered_since(&self) -> Option<Instant> {
        *self.sent.borrow()
    }

    /// Makes a call for rosrescue itself, recorded like any other. `None` if there is no answer.
    pub async fn call(&self, call: Request) -> Option<Reply> {
        self.call_own(call, None).await
    }

    /// Like [`Self::call`], but drops the call if `condition` no longer holds when its turn comes.
    pub async fn call_if(&self, call: Request, condition: Precondition) -> Option<Reply> {
        self.call_own(call, Some(condition)).await
    }

    /// Makes the partition writes of the computer `origin` in `ask`. Leaves out those that conflict with changes by other
    /// computers. `None` if there is no answer.
    pub(crate) async fn merge(&self, ask: Ask, origin: Origin) -> Option<wire::MergeAnswer> {
        let (item, answered, judged) = merge::item(ask, origin);
        self.items.send(item).await.ok()?;
        let reply = match answered.await.ok()?.0 {
            CallAnswer::Made(reply) => reply,
            // A reply that cannot be decoded comes from a master that could not encode it.
            CallAnswer::Raw(raw) => {
                xmlrpc::decode_reply(&raw.body).unwrap_or(Reply::Value(Value::Nil))
            }
            CallAnswer::Close | CallAnswer::Elsewhere => return None,
        };
        Some(judged.answer(&reply))
    }

    async fn call_own(&self, call: Request, condition: Option<Precondition>) -> Option<Reply> {
        let made_by = MadeBy::Rosrescue(condition);
        let (item, answered) = Item::new(made_by, Some(Arc::new(call)));
        self.items.send(item).await.ok()?;
        match answered.await.ok()?.0 {
            CallAnswer::Made(reply) => Some(reply),
            CallAnswer::Raw(raw) => xmlrpc::decode_reply(&raw.body).ok(),
            CallAnswer::Close | CallAnswer::Elsewhere => None,
        }
    }

    /// Waits until a batch is lost: its connection ended before the answer. The master may have run the batch, and may
    /// be dead. Nothing is sent until the caller changes the gate, which says whether calls pass to the master.
    pub async fn batch_lost(&self) {
        self.signals.batch_lost.notified().await;
    }

    /// Waits until the master has left a write unanswered for as long as [`Patience`] says, and the mirror can answer
    /// all calls that the master has not answered.
    pub(crate) async fn late(&self) {
        self.signals.is_late.notified().await;
    }

    /// Waits until the late master has answered its outstanding calls.
    pub(crate) async fn late_answered(&self) {
        self.signals.has_answered.notified().await;
    }

    /// Notes that the master takes too long to answer a read.
    pub(crate) fn report_slow(&self) {
        self.signals.slow.notify_one();
    }

    /// Waits until the master takes too long to answer a call.
    pub(crate) async fn slow(&self) {
        self.signals.slow.notified().await;
    }
}

/// Signals between the task of the queue and the recovery.
#[derive(Debug)]
struct Signals {
    batch_lost: Notify,
    is_late: Notify,
    has_answered: Notify,
    /// Signals that the master takes too long to answer a call.
    slow: Notify,
}

/// Creates a write queue and its task. `resync_interval` is the pause between two comparisons of master and mirror;
/// `None` for never. `judge` judges calls that could make the master shut down an innocent node. `writes` says who
/// answers writes, and `patience` how long they wait for the master.
pub(crate) fn write_queue(
    link: Link,
    stats: &'static Stats,
    resync_interval: Option<Duration>,
    judge: Arc<dyn MoveJudge>,
    writes: Writes,
    patience: Patience,
) -> (WriteQueue, Drain) {
    let (items, rx) = mpsc::channel(CHANNEL);
    let signals = Arc::new(Signals {
        batch_lost: Notify::new(),
        is_late: Notify::new(),
        has_answered: Notify::new(),
        slow: Notify::new(),
    });
    let (tell_sent, sent) = watch::channel(None);
    let dispatcher = Dispatcher::new(link.ledger.clone(), judge, stats, writes, patience);
    let drain = Drain::new(
        dispatcher,
        rx,
        link,
        resync_interval,
        signals.clone(),
        tell_sent,
    );
    let queue = WriteQueue {
        items,
        signals,
        sent,
    };
    (queue, drain)
}

/// What a round trip to the master needs.
#[derive(Clone)]
pub(crate) struct Link {
    pub(crate) ledger: Arc<Ledger>,
    pub(crate) upstream: Arc<Upstream>,
}

#[cfg(test)]
mod tests;
