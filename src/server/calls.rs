//! Answers calls: from the master, or from the mirror.

use std::{
    net::SocketAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use thiserror::Error;
use tokio::sync::{Mutex, Notify, oneshot};

use super::{
    admission,
    others::Others,
    replies::{HttpReply, encoded, forwarded, made, no_shutdown, xml},
};
use crate::{
    cli::Reads,
    gate::{self, State},
    ledger::Ledger,
    limit::rarely,
    master::{Kind, Method, Request},
    status::stats::Stats,
    upstream::{Head, pool::Pool},
    write_queue::{
        WriteQueue,
        batch::{self, Answer, Item},
        parts::Parts,
    },
    xmlrpc::{self, ListWriter, Reply, Value},
};

/// The connection is closed without an answer. A node retries after that. An error made up by rosrescue would
/// cost it its registration, or end the node.
#[derive(Debug, Error)]
#[error("closed without an answer: {0}")]
pub(crate) struct Closed(pub(super) &'static str);

/// After this time the mirror answers for the master, where the mirror is exact. A rosmaster answers within a
/// millisecond, and within some ten behind a call that keeps its interpreter busy.
pub(super) const PATIENCE: Duration = Duration::from_millis(100);
/// Values that take a millisecond to encode, in bytes of memory.
const LARGE: usize = 64 << 10;
/// Largest answer that is kept, in bytes.
const KEPT_MOST: usize = 16 << 20;
/// Why a write is not answered.
const UNANSWERED: &str = "the master gave no answer";
/// Why a call that only a master can answer is not answered.
pub(super) const NOT_IN_TIME: &str = "the master did not come back in time, see --hold";
/// Why a multicall of reads is not answered while the master is away.
const UNANSWERABLE: &str = "so many answers at once are left to the master";

/// Why a call is not answered here.
#[derive(Debug)]
pub(super) enum Unanswered {
    Closed(Closed),
    /// Another computer has the master.
    Elsewhere,
}

impl From<Closed> for Unanswered {
    fn from(closed: Closed) -> Self {
        Self::Closed(closed)
    }
}

impl From<Unanswered> for Closed {
    fn from(unanswered: Unanswered) -> Self {
        match unanswered {
            Unanswered::Closed(closed) => closed,
            Unanswered::Elsewhere => Self("another computer has the master"),
        }
    }
}

pub struct Calls {
    /// Whether calls pass to the master.
    pub gate: gate::Rx,
    pub ledger: Arc<Ledger>,
    /// Who answers reads while there is a master.
    pub reads: Reads,
    /// The last large answer of the mirror.
    pub last_large: Mutex<Option<LargeAnswer>>,
    /// Connections for reads.
    pub pool: Arc<Pool>,
    pub write_queue: WriteQueue,
    /// Notified when the master takes too long to answer a call.
    pub slow: Arc<Notify>,
    pub stats: &'static Stats,
    /// Our own address. Replaces the master's in replies.
    pub uri: String,
    /// How long a call waits if only a master can answer it.
    pub hold: Duration,
    /// None without other computers.
    pub(crate) others: Option<Others>,
}

/// An answer of the mirror, and its encoding.
pub struct LargeAnswer {
    value: Value,
    text: Bytes,
}

/// The refusal of a `shutdown` that is not for the master, or not from its own computer.
fn refuse_shutdown(peer: SocketAddr, call: Option<&Request>) -> Option<HttpReply> {
    let call = call.filter(|call| call.kind() == Kind::Shutdown)?;
    if !admission::may_shut_down(peer.ip()) {
        rarely!(warn, %peer, "refused to shut the master down for another computer");
        return Some(no_shutdown(
            "shutdown is taken from the master's own computer only",
        ));
    }
    if admission::is_for_a_node(call) {
        rarely!(warn, %peer, "refused to shut down for a node that is registered at our address");
        return Some(no_shutdown("this is the master, and no node"));
    }
    None
}

impl Calls {
    /// Answers a call of `peer`. `call` is none if its body could not be decoded.
    pub(crate) async fn answer(
        &self,
        peer: SocketAddr,
        head: Head,
        body: Bytes,
        call: Option<Request>,
    ) -> Result<HttpReply, Closed> {
        if let Some(refusal) = refuse_shutdown(peer, call.as_ref()) {
            return Ok(refusal);
        }
        match &self.others {
            None => Ok(self.answer_here(head, body, call).await?),
            Some(others) => others.answer(self, head, body, call).await,
        }
    }

    /// As [`Self::answer`], if this computer has the master.
    pub(super) async fn answer_here(
        &self,
        head: Head,
        body: Bytes,
        call: Option<Request>,
    ) -> Result<HttpReply, Unanswered> {
        let kind = call.as_ref().map_or(Kind::Mutate, Request::kind);
        match (&call, kind) {
            (Some(call), Kind::Identity)
                if *call.method() == Method::GetUri || !self.gate.is_open() =>
            {
                Ok(self.identity(call)?)
            }
            (_, Kind::Read | Kind::Identity | Kind::Unknown) => {
                self.read(head, body, call.as_ref(), kind).await
            }
            (_, Kind::Unregister | Kind::Mutate | Kind::Shutdown) => {
                self.write(head, body, call).await
            }
        }
    }

    /// The answer to a getPid or a getUri while there is no master, and always to a getUri.
    pub(super) fn identity(&self, call: &Request) -> Result<HttpReply, Closed> {
        let reply = self.ledger.answer(call).ok_or(Closed(UNANSWERABLE))?;
        Ok(xml(&reply))
    }

    /// The mirror's answer to a read while there is a master; none if the master's may differ.
    async fn exact_answer(&self, call: Option<&Request>) -> Option<HttpReply> {
        let read = call.filter(|_| self.reads == Reads::Mirror)?;
        let answer = || self.ledger.exact_answer(read).map(Reply::Value);
        let reply = self.encode(answer).await?;
        self.stats.calls_from_mirror.count();
        Some(reply)
    }

    /// The mirror's answer to a read instead of that of a master that is away, or late.
    pub(super) async fn stand_in(&self, call: Option<&Request>) -> Option<HttpReply> {
        let read = call?;
        let reply = self.encode(|| self.ledger.answer(read)).await?;
        self.stats.calls_without_master.count();
        Some(reply)
    }

    /// Encodes what `answer` gives. None if a master cannot marshal it.
    ///
    /// What takes milliseconds is encoded outside of the runtime, one answer at a time. Equal answers in a row
    /// share one encoding; values are shared, so comparing them is quick.
    async fn encode(&self, answer: impl Fn() -> Option<Reply>) -> Option<HttpReply> {
        let value = match answer()? {
            Reply::Value(value) => value,
            fault @ Reply::Fault { .. } => return Some(xml(&fault)),
        };
        if !value.is_larger_than(LARGE) {
            return Some(encoded(xmlrpc::encode_result(&value).ok()?));
        }
        // A call that waits holds no copy.
        drop(value);
        let mut last = self.last_large.lock().await;
        let value = match answer()? {
            Reply::Value(value) => value,
            fault @ Reply::Fault { .. } => return Some(xml(&fault)),
        };
        let encode = move |last: Option<LargeAnswer>| match last {
            Some(last) if last.value == value => Some(last),
            _ => {
                let text = xmlrpc::encode_result(&value).ok()?.into();
                Some(LargeAnswer { value, text })
            }
        };
        let before = last.take();
        let encoding = tokio::task::spawn_blocking(move || encode(before));
        let answer = encoding.await.ok()??;
        let text = answer.text.clone();
        *last = Some(answer).filter(|answer| answer.text.len() <= KEPT_MOST);
        Some(encoded(text))
    }

    /// Answers a read from the mirror, or forwards it. The mirror answers while the master is away, fails or
    /// takes too long.
    async fn read(
        &self,
        head: Head,
        body: Bytes,
        call: Option<&Request>,
        kind: Kind,
    ) -> Result<HttpReply, Unanswered> {
        let known = call.filter(|_| kind != Kind::Unknown);
        let mut gate = self.gate.clone();
        let mut hold = std::pin::pin!(tokio::time::sleep(self.hold));
        loop {
            match gate.look() {
                State::Open { incarnation } => {
                    if let Some(reply) = self.exact_answer(call).await {
                        return Ok(reply);
                    }
                    let patience = self.patience();
                    // A mirror in doubt waits for the probes' verdict on the master.
                    let known_now = known.filter(|_| !self.ledger.is_doubted());
                    if patience <= tokio::time::Instant::now()
                        && let Some(reply) = self.stand_in(known_now).await
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
                            if let Some(reply) = self.stand_in(known_now).await {
                                // When this read ends, the master answers again.
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
                    if let Some(reply) = self.stand_in(known).await {
                        return Ok(reply);
                    }
                }
                State::StandingIn | State::Injecting => {
                    if let Some(reply) = self.stand_in(known).await {
                        return Ok(reply);
                    }
                }
                State::Unknown => {}
                State::Elsewhere => return Err(Unanswered::Elsewhere),
            }
            tokio::select! {
                () = gate.changed() => {}
                () = &mut hold => {
                    self.stats.calls_unanswered.count();
                    return Err(Closed(NOT_IN_TIME).into());
                }
            }
        }
    }

    /// Answers a write. A long multicall goes in parts; the answer is that to the whole.
    async fn write(
        &self,
        head: Head,
        body: Bytes,
        mut call: Option<Request>,
    ) -> Result<HttpReply, Unanswered> {
        if let Some(parts) = Parts::of(&mut call, body.len()) {
            drop(body);
            return self.write_parts(&head, parts).await;
        }
        let call = call.map(Arc::new);
        let answer = self.queue(head, body, call.clone()).await?;
        self.http(call.as_deref(), answer)
    }

    /// Makes one part after the other. If one gets no result for each entry, its answer is that to the whole.
    async fn write_parts(&self, head: &Head, parts: Parts) -> Result<HttpReply, Unanswered> {
        let mut whole = ListWriter::answer();
        for part in parts {
            let part = Arc::new(part);
            let body = xmlrpc::encode_call(&Request::clone(&part).into());
            let answer = self
                .queue(head.clone(), body.into(), Some(part.clone()))
                .await?;
            let reply = match &answer {
                Answer::Made(reply) => Some(reply.clone()),
                Answer::Raw(raw) => xmlrpc::decode_reply(&raw.body).ok(),
                Answer::Close | Answer::Elsewhere => None,
            };
            match reply.map(|reply| batch::with_uri(&part, reply, &self.uri)) {
                Some(Reply::Value(Value::Array(results)))
                    if results.len() == part.entries().len() =>
                {
                    results.iter().for_each(|result| whole.push(result));
                }
                _ => return self.http(Some(&part), answer),
            }
        }
        Ok(encoded(whole.finish()))
    }

    fn http(&self, call: Option<&Request>, answer: Answer) -> Result<HttpReply, Unanswered> {
        match answer {
            Answer::Raw(raw) => Ok(forwarded(&self.uri, call, raw)),
            Answer::Made(reply) => Ok(made(&self.uri, call, &reply)),
            Answer::Close => Err(Closed(UNANSWERED).into()),
            Answer::Elsewhere => Err(Unanswered::Elsewhere),
        }
    }

    /// Queues a write. While the master is away, the mirror answers it from the queue. During an injection,
    /// or while the master takes too long, it does so only if the write changes nothing.
    async fn queue(
        &self,
        head: Head,
        body: Bytes,
        call: Option<Arc<Request>>,
    ) -> Result<Answer, Unanswered> {
        if self.gate.state() == State::Injecting
            && let Some(reply) = self.answer_if_unchanged(call.as_deref()).await
        {
            return Ok(Answer::Made(reply));
        }
        let (answer, mut answered) = oneshot::channel();
        let item = Item {
            raw: Some((head, body)),
            call: call.clone(),
            answer,
            condition: None,
            way_made: false,
        };
        self.write_queue.submit(item).await;
        let call = call.as_deref();
        let mut gate = self.gate.clone();
        let mut held = std::pin::pin!(async {
            let answerable = call.is_some_and(Request::is_answerable);
            loop {
                gate.shut_for(self.hold).await;
                // An injection ends by itself; if it fails, the mirror answers.
                if !answerable || gate.state() != State::Injecting {
                    return;
                }
            }
        });
        let mut patience = std::pin::pin!(tokio::time::sleep_until(self.patience()));
        let mut patient = true;
        loop {
            tokio::select! {
                answer = &mut answered => return answer.map_err(|_| Closed(UNANSWERED).into()),
                () = &mut held => {
                    self.stats.calls_unanswered.count();
                    return Err(Closed(NOT_IN_TIME).into());
                }
                () = &mut patience, if patient => {
                    if !self.gate.is_open() {
                        // The gate may open to a master that hangs.
                        patience.as_mut().reset(tokio::time::Instant::now() + PATIENCE);
                        continue;
                    }
                    patient = false;
                    self.slow.notify_one();
                    if let Some(reply) = self.answer_if_unchanged(call).await {
                        return Ok(Answer::Made(reply));
                    }
                }
            }
        }
    }

    /// When the mirror answers instead of the master. If the master has kept an earlier call waiting, this
    /// call gets no [`PATIENCE`] of its own.
    fn patience(&self) -> tokio::time::Instant {
        let now = tokio::time::Instant::now();
        if self.pool.is_stalled() {
            return now;
        }
        self.write_queue.unanswered_since().unwrap_or(now) + PATIENCE
    }

    /// The mirror's answer to a write that changes nothing; none if it does.
    async fn answer_if_unchanged(&self, call: Option<&Request>) -> Option<Reply> {
        let call = call.filter(|call| call.is_answerable())?;
        let (reply, mark) = self.ledger.answer_if_unchanged(Instant::now(), call)?;
        // The write that made this one redundant may not be safe yet.
        if let Some(mark) = self.ledger.to_await(mark)
            && !self.ledger.durable(mark).await
        {
            return None;
        }
        self.stats.calls_without_master.count();
        Some(reply)
    }
}
