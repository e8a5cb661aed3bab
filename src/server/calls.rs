//! Answers calls: from the master, or from the mirror.

use std::{
    net::SocketAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use thiserror::Error;
use tokio::sync::{Notify, oneshot};

use super::{
    admission,
    replies::{HttpReply, forwarded, made, no_shutdown, xml},
};
use crate::{
    gate::{self, State},
    ledger::Ledger,
    master::{Kind, Method, Request},
    status::stats::Stats,
    upstream::{Head, pool::Pool},
    write_queue::{
        WriteQueue,
        batch::{Answer, Item},
    },
};

/// The connection is closed without an answer. A node asks again after that, whereas an error that
/// we make up would cost it its registration, or its life.
#[derive(Debug, Error)]
#[error("closed without an answer: {0}")]
pub struct Closed(pub(super) &'static str);

/// A master that takes longer is answered for by the mirror, where that is exact. A rosmaster answers
/// in less than a millisecond, and behind a call that keeps its interpreter busy in some ten.
const PATIENCE: Duration = Duration::from_millis(100);
/// Why a multicall of reads is not answered while the master is away.
const UNANSWERABLE: &str = "so many answers at once are left to the master";

pub struct Calls {
    /// Whether they pass to the master.
    pub gate: gate::Rx,
    /// The mirror's answers.
    pub ledger: Arc<Ledger>,
    /// The way to the master for reads.
    pub pool: Arc<Pool>,
    /// The way to the master for writes.
    pub write_queue: WriteQueue,
    /// Notified when the master has not answered a call for longer than it should take.
    pub slow: Arc<Notify>,
    pub stats: &'static Stats,
    /// Our own address, which stands in replies for the master's.
    pub uri: String,
    /// How long a call waits that only a master can answer.
    pub hold: Duration,
}

impl Calls {
    /// Answers a call of `peer`; none if its body could not be decoded.
    pub async fn answer(
        &self,
        peer: SocketAddr,
        head: Head,
        body: Bytes,
        call: Option<Request>,
    ) -> Result<HttpReply, Closed> {
        let kind = call.as_ref().map_or(Kind::Mutate, Request::kind);
        match (&call, kind) {
            (Some(call), Kind::Identity)
                if *call.method() == Method::GetUri || !self.gate.is_open() =>
            {
                let reply = self.ledger.answer(call).ok_or(Closed(UNANSWERABLE))?;
                Ok(xml(&reply))
            }
            (_, Kind::Shutdown) if !admission::may_shut_down(peer.ip()) => {
                tracing::warn!(%peer, "refused to shut the master down for another computer");
                Ok(no_shutdown(
                    "shutdown is taken from the master's own computer only",
                ))
            }
            (Some(call), Kind::Shutdown) if admission::is_for_a_node(call) => {
                tracing::warn!(%peer, "refused to shut down for a node that is registered at our address");
                Ok(no_shutdown("this is the master, and no node"))
            }
            (_, Kind::Read | Kind::Identity | Kind::Unknown) => {
                self.read(head, body, call.as_ref(), kind).await
            }
            (_, Kind::Unregister | Kind::Mutate | Kind::Shutdown) => {
                self.write(head, body, call.map(Arc::new)).await
            }
        }
    }

    /// Forwards a read. While the master is away, fails or takes too long the mirror answers.
    async fn read(
        &self,
        head: Head,
        body: Bytes,
        call: Option<&Request>,
        kind: Kind,
    ) -> Result<HttpReply, Closed> {
        let from_mirror = || {
            let call = call.filter(|_| kind != Kind::Unknown)?;
            let reply = self.ledger.answer(call)?;
            self.stats.stood_in.count();
            Some(xml(&reply))
        };
        let mut gate = self.gate.clone();
        let mut hold = std::pin::pin!(tokio::time::sleep(self.hold));
        loop {
            match gate.look() {
                State::Open { incarnation } => {
                    let patience = self.patience();
                    if patience <= tokio::time::Instant::now()
                        && let Some(reply) = from_mirror()
                    {
                        return Ok(reply);
                    }
                    let mut forwarding = Box::pin({
                        let (pool, head, body) = (self.pool.clone(), head.clone(), body.clone());
                        async move { pool.forward(incarnation, &head, &body).await }
                    });
                    let reply = match tokio::time::timeout_at(patience, &mut forwarding).await {
                        Ok(reply) => reply,
                        Err(_) => {
                            self.slow.notify_one();
                            if let Some(reply) = from_mirror() {
                                // Its end tells that the master answers again.
                                let pool = self.pool.clone();
                                tokio::spawn(async move {
                                    let _stalled = pool.stalled();
                                    let _ = forwarding.await;
                                });
                                return Ok(reply);
                            }
                            forwarding.await
                        }
                    };
                    match reply {
                        Ok(raw) => return Ok(forwarded(&self.uri, call, raw)),
                        Err(error) => tracing::debug!(%error, "read"),
                    }
                    if let Some(reply) = from_mirror() {
                        return Ok(reply);
                    }
                }
                State::StandingIn | State::Injecting => {
                    if let Some(reply) = from_mirror() {
                        return Ok(reply);
                    }
                }
                State::Unknown => {}
            }
            tokio::select! {
                () = gate.changed() => {}
                () = &mut hold => {
                    self.stats.hold_expired.count();
                    return Err(Closed("the master did not come back in time, see --hold"));
                }
            }
        }
    }

    /// Queues a write. While the master is away the mirror answers it from there; during an injection and
    /// behind a master that takes too long, only if it changes nothing.
    async fn write(
        &self,
        head: Head,
        body: Bytes,
        call: Option<Arc<Request>>,
    ) -> Result<HttpReply, Closed> {
        if self.gate.state() == State::Injecting
            && let Some(reply) = self.answer_idle(call.as_deref()).await
        {
            return Ok(reply);
        }
        let (answer, mut answered) = oneshot::channel();
        let item = Item {
            raw: Some((head, body)),
            call: call.clone(),
            answer,
            condition: None,
        };
        self.write_queue.submit(item).await;
        let call = call.as_deref();
        let mut gate = self.gate.clone();
        let mut held = std::pin::pin!(async {
            let answerable = call.is_some_and(Request::is_answerable);
            loop {
                gate.shut_for(self.hold).await;
                // An injection ends by itself, and the mirror answers if it fails.
                if !answerable || gate.state() != State::Injecting {
                    return;
                }
            }
        });
        let mut patience = std::pin::pin!(tokio::time::sleep_until(self.patience()));
        let mut patient = true;
        loop {
            tokio::select! {
                answer = &mut answered => return match answer {
                    Ok(Answer::Raw(raw)) => Ok(forwarded(&self.uri, call, raw)),
                    Ok(Answer::Made(reply)) => Ok(made(&self.uri, call, &reply)),
                    Ok(Answer::Close) | Err(_) => Err(Closed("the master gave no answer")),
                },
                () = &mut held => {
                    self.stats.hold_expired.count();
                    return Err(Closed("the master did not come back in time, see --hold"));
                }
                () = &mut patience, if patient => {
                    if !self.gate.is_open() {
                        // It may open to a master that hangs.
                        patience.as_mut().reset(tokio::time::Instant::now() + PATIENCE);
                        continue;
                    }
                    patient = false;
                    self.slow.notify_one();
                    if let Some(reply) = self.answer_idle(call).await {
                        return Ok(reply);
                    }
                }
            }
        }
    }

    /// Until when the master may answer before the mirror does. One that keeps others waiting gets no fresh
    /// [`PATIENCE`].
    fn patience(&self) -> tokio::time::Instant {
        let now = tokio::time::Instant::now();
        if self.pool.is_stalled() {
            return now;
        }
        self.write_queue.unanswered_since().unwrap_or(now) + PATIENCE
    }

    /// The mirror's answer to a write that changes nothing; none if it does.
    async fn answer_idle(&self, call: Option<&Request>) -> Option<HttpReply> {
        let call = call.filter(|call| call.is_answerable())?;
        let (reply, seq) = self.ledger.answer_idle(Instant::now(), call)?;
        // What made it idle may not be on the disk yet.
        if let Some(seq) = self.ledger.to_await(seq) {
            self.ledger.durable(seq).await;
        }
        self.stats.stood_in.count();
        Some(xml(&reply))
    }
}
