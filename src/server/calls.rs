//! Answers calls, from the master or from the mirror.

use std::{
    net::{IpAddr, Ipv4Addr, SocketAddr},
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use rescue_core::{admission, checkpoint::format::Origin, cluster::sharing::Source};
use ros1_master::{
    master::{Kind, Master, Method, Request},
    xmlrpc::{self, ListWriter, Reply, Value},
};
use thiserror::Error;
use tokio::sync::Mutex;

use super::{
    body::SMALL,
    compare::Comparisons,
    hold::Hold,
    others::{Others, own_address},
    replies::{
        HttpReply, delivered, encode_with_own_uri, encoded, forwarded, no_shutdown,
        refused_by_rosmaster, xml,
    },
};
use crate::{
    cli::Reads,
    gate::{self, State},
    ledger::{Ledger, delivery::Delivery},
    limit::rarely,
    resolver,
    status::stats::Stats,
    upstream::{Head, pool::Pool},
    write_queue::{
        PATIENCE, WriteQueue,
        batch::{self, AnswerAndDelivery, CallAnswer, Item},
        parts::Parts,
    },
};

/// A call is not answered, and its connection is closed, so that the node calls again. An error made up by rosrescue
/// would cost the node its registration, or end the node.
#[derive(Debug, Error)]
#[error("closed without an answer: {0}")]
pub(crate) struct Closed(pub(super) &'static str);

/// Values larger than this, in bytes, take more than a millisecond to encode.
const LARGE: usize = 64 << 10;
/// Largest encoded answer that is kept for the next call, in bytes.
const KEPT_MOST: usize = 16 << 20;
/// The reason if a write is not answered.
const UNANSWERED: &str = "the master did not answer";
/// The reason if a call that only a master can answer is not answered.
pub(super) const NOT_IN_TIME: &str = "the master did not come back in time, see --hold";
/// The reason if a multicall of reads is not answered while the master is away.
const UNANSWERABLE: &str = "only a master can answer so many reads at once";

/// The reason why a call is not answered here.
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
    /// The gate, which tells whether calls pass to the master.
    pub gate: gate::Rx,
    pub ledger: Arc<Ledger>,
    /// Whether the mirror or the master answers reads while there is a master.
    pub reads: Reads,
    /// The last large answer of the mirror.
    pub last_large: Mutex<Option<LargeAnswer>>,
    /// Comparisons of the master's answers with the mirror.
    pub compared: Comparisons,
    /// Connections for reads.
    pub pool: Arc<Pool>,
    pub write_queue: WriteQueue,
    pub stats: &'static Stats,
    /// rosrescue's own address. It replaces the master's in replies.
    pub uri: String,
    /// How long a call waits if only a master can answer it.
    pub hold: Duration,
    /// The other computers. `None` without `--cluster`.
    pub(crate) others: Option<Others>,
}

/// Where a call comes from.
#[derive(Clone)]
pub(super) struct Incoming {
    source: Source,
    caller: IpAddr,
}

impl Incoming {
    /// A call from `source`, made at the address `caller`.
    pub(super) fn new(source: Source, caller: IpAddr) -> Self {
        let caller = caller.to_canonical();
        Self { source, caller }
    }
}

/// An answer of the mirror, and its encoding.
pub struct LargeAnswer {
    value: Value,
    text: Bytes,
}

/// Refuses a `shutdown` that was meant for a node, or that comes from another computer.
fn refuse_shutdown(peer: SocketAddr, call: Option<&Request>) -> Option<HttpReply> {
    let call = call.filter(|call| call.kind() == Kind::Shutdown)?;
    if !admission::may_shut_down(peer.ip()) {
        rarely!(warn, %peer, "refused a shutdown of the master from another computer");
        return Some(no_shutdown(
            "shutdown is accepted only from the master's own computer",
        ));
    }
    if admission::is_for_a_node(call) {
        rarely!(warn, %peer, "refused a shutdown that was meant for a node: a node is registered at rosrescue's address");
        return Some(no_shutdown("this is the master, not a node"));
    }
    None
}

impl Calls {
    /// Answers a call of `peer`. `call` is `None` if the body could not be decoded.
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
            None => {
                let incoming = Incoming::new(Source::Here, peer.ip());
                let mut hold = Hold::new(self.hold);
                Ok(self
                    .answer_here(head, body, call, incoming, &mut hold)
                    .await?)
            }
            Some(others) => others.answer(self, peer, head, body, call).await,
        }
    }

    /// Answers a call on the computer that has the master. An error means that another computer has the master now, or
    /// that there is no answer.
    pub(super) async fn answer_here(
        &self,
        head: Head,
        body: Bytes,
        call: Option<Request>,
        incoming: Incoming,
        hold: &mut Hold,
    ) -> Result<HttpReply, Unanswered> {
        let call = match self.understood(&head, &body, call) {
            Ok(call) => call,
            Err(refusal) => {
                self.stats.calls_without_master.count();
                return Ok(*refusal);
            }
        };
        let kind = call.as_ref().map_or(Kind::Mutate, Request::kind);
        match (&call, kind) {
            (Some(call), Kind::Identity)
                if *call.method() == Method::GetUri || !self.gate.is_open() =>
            {
                Ok(self.identity(call)?)
            }
            (_, Kind::Read | Kind::Identity | Kind::Unknown) => {
                self.read(head, body, call.as_ref(), hold).await
            }
            (_, Kind::Unregister | Kind::Mutate | Kind::Shutdown) => {
                self.write(head, body, call, incoming, hold).await
            }
        }
    }

    /// The answer to a `getUri`, and to a `getPid` without a master or with several computers.
    pub(super) fn identity(&self, call: &Request) -> Result<HttpReply, Closed> {
        let reply = self.ledger.answer(call).ok_or(Closed(UNANSWERABLE))?;
        Ok(xml(&reply))
    }

    /// The call as the master that is away or late would understand it. `call` is `None` if it could not be decoded.
    /// `Ok(None)` if only a master can tell. The error is rosmaster's answer if it would refuse the request.
    fn understood(
        &self,
        head: &Head,
        body: &Bytes,
        call: Option<Request>,
    ) -> Result<Option<Request>, Box<HttpReply>> {
        if let State::Open { .. } | State::Unknown | State::Elsewhere = self.gate.state() {
            return Ok(call);
        }
        let python = self.ledger.with_mirror(Master::python);
        if let Some(refusal) = refused_by_rosmaster(head, body, python) {
            return Err(Box::new(refusal));
        }
        if call.is_some() || head.encoding.is_some() || body.len() > SMALL {
            return Ok(call);
        }
        let error = match Request::decode_for(body, python) {
            Ok(call) => return Ok(Some(call)),
            Err(error) => error,
        };
        if let Some(text) = error.fault(body, python) {
            return Err(Box::new(xml(&Reply::Fault { code: 1, text })));
        }
        let plain = xmlrpc::without_doctype(body);
        Ok(plain.and_then(|body| Request::decode_for(&body, python).ok()))
    }

    /// The mirror's answer to a read while there is a master. `None` if the master's answer may differ.
    async fn exact_answer(&self, call: Option<&Request>) -> Option<HttpReply> {
        let read = call.filter(|_| self.reads == Reads::Mirror)?;
        let answer = || self.ledger.exact_answer(read).map(Reply::Value);
        let reply = self.encode(answer).await?;
        self.stats.calls_from_mirror.count();
        Some(reply)
    }

    /// The mirror's answer to a read in place of a master that is away or late.
    pub(super) async fn answer_from_mirror(&self, call: Option<&Request>) -> Option<HttpReply> {
        let read = call?;
        let reply = self.encode(|| self.ledger.answer(read)).await?;
        self.stats.calls_without_master.count();
        Some(reply)
    }

    /// The mirror's answer to a `subscribeParam` whose subscription already exists, while another computer has the
    /// master.
    pub(super) async fn answer_subscribed_from_mirror(&self, call: &Request) -> Option<HttpReply> {
        let reply = self
            .encode(|| self.ledger.answer_if_subscribed(call))
            .await?;
        self.stats.calls_without_master.count();
        Some(reply)
    }

    /// Encodes the reply that `answer` returns. `None` if there is no reply, or if XML-RPC cannot express it.
    ///
    /// An answer that takes milliseconds is encoded outside of the runtime, one at a time. Equal answers in a row are
    /// encoded once. Values share memory, so comparing them is quick.
    async fn encode(&self, answer: impl Fn() -> Option<Reply>) -> Option<HttpReply> {
        let value = match answer()? {
            Reply::Value(value) => value,
            fault @ Reply::Fault { .. } => return Some(xml(&fault)),
        };
        if !value.is_larger_than(LARGE) {
            return Some(encoded(xmlrpc::encode_result(&value).ok()?));
        }
        // A call that waits for its turn must not keep the large value in memory.
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
        let encoding = crate::task::spawn_blocking(move || encode(before));
        let answer = encoding.await.ok()??;
        let text = answer.text.clone();
        *last = Some(answer).filter(|answer| answer.text.len() <= KEPT_MOST);
        Some(encoded(text))
    }

    /// Answers a read from the mirror, or forwards it. The mirror answers while the master is away,
    /// fails or takes too long.
    async fn read(
        &self,
        head: Head,
        body: Bytes,
        call: Option<&Request>,
        hold: &mut Hold,
    ) -> Result<HttpReply, Unanswered> {
        let known = call.filter(|call| call.is_answerable() && head.may_be_for_rpc());
        let mut gate = self.gate.clone();
        let delivery = self.begin_read(call).await;
        let reply = self.read_in_order(head, body, call, known, &mut gate, hold);
        Ok(delivered(reply.await?, delivery))
    }

    /// Begins the answer to a read. Waits until the master has answered the calls that may notify the caller. Does not
    /// wait for a late master, because its notifications are repeated later.
    async fn begin_read(&self, read: Option<&Request>) -> Option<Delivery> {
        let mut changed = self.ledger.order_changed();
        let patience = self.patience();
        loop {
            changed.mark_unchanged();
            if let Ok(delivery) = Delivery::of_read(&self.ledger, Instant::now(), read) {
                return delivery;
            }
            if tokio::time::timeout_at(patience, changed.changed())
                .await
                .is_err()
            {
                self.write_queue.report_slow();
                return Delivery::of_read_now(&self.ledger, read?);
            }
        }
    }

    /// Does the work of [`Self::read`] after [`Self::begin_read`]. `known` is the decoded call; `None` if the mirror
    /// must not answer it.
    async fn read_in_order(
        &self,
        head: Head,
        body: Bytes,
        call: Option<&Request>,
        known: Option<&Request>,
        gate: &mut gate::Rx,
        hold: &mut Hold,
    ) -> Result<HttpReply, Unanswered> {
        loop {
            match gate.observe() {
                State::Open { incarnation } => {
                    let read = call.filter(|_| head.is_for_rpc());
                    if let Some(reply) = self.exact_answer(read).await {
                        return Ok(reply);
                    }
                    let patience = self.patience();
                    if self.ledger.pending() > 0 {
                        // The master must have run what was answered before this call came.
                        tokio::select! {
                            () = self.ledger.all_acknowledged() => {}
                            () = gate.changed() => continue,
                            () = tokio::time::sleep_until(patience) => {}
                        }
                    }
                    // While the mirror may be outdated, it does not answer for a late master. Nor does it answer a call
                    // of an unknown method, which that master may know.
                    let is_late =
                        |call: &&Request| call.kind() != Kind::Unknown && !self.ledger.is_doubted();
                    let known_now = known.filter(is_late);
                    if patience <= tokio::time::Instant::now()
                        && let Some(reply) = self.answer_from_mirror(known_now).await
                    {
                        return Ok(reply);
                    }
                    let version = self.comparable(call);
                    let mut forwarding = Box::pin({
                        let (pool, head, body) = (self.pool.clone(), head.clone(), body.clone());
                        async move { pool.forward(incarnation, &head, &body).await }
                    });
                    let reply = match tokio::time::timeout_at(patience, &mut forwarding).await {
                        Ok(reply) => reply,
                        Err(_) => {
                            self.write_queue.report_slow();
                            if let Some(reply) = self.answer_from_mirror(known_now).await {
                                // The read continues, because its end shows that the master answers again.
                                let pool = self.pool.clone();
                                crate::task::spawn(async move {
                                    let _stalled = pool.stalled();
                                    let _ = forwarding.await;
                                });
                                return Ok(reply);
                            }
                            forwarding.await
                        }
                    };
                    match reply {
                        Ok(raw) => {
                            self.compare(call, version, &raw);
                            return Ok(forwarded(&self.uri, call, raw));
                        }
                        Err(error) => tracing::debug!(%error, "read"),
                    }
                    if let Some(reply) = self.answer_from_mirror(known).await {
                        return Ok(reply);
                    }
                }
                State::StandingIn | State::Late | State::Injecting | State::Frozen => {
                    if let Some(reply) = self.answer_from_mirror(known).await {
                        return Ok(reply);
                    }
                }
                State::Unknown => {}
                State::Elsewhere => return Err(Unanswered::Elsewhere),
            }
            tokio::select! {
                // On a busy computer both branches may be ready.
                biased;
                () = gate.changed() => {}
                () = hold.wait_until_spent() => {
                    self.stats.calls_unanswered.count();
                    return Err(Closed(NOT_IN_TIME).into());
                }
            }
        }
    }

    /// Answers a write. A long multicall is sent in parts, but gets one answer.
    async fn write(
        &self,
        head: Head,
        body: Bytes,
        mut call: Option<Request>,
        incoming: Incoming,
        hold: &mut Hold,
    ) -> Result<HttpReply, Unanswered> {
        if let Some(parts) = Parts::split(&mut call, body.len()) {
            drop(body);
            return self.write_parts(&head, parts, incoming, hold).await;
        }
        let call = call.map(Arc::new);
        let (answer, delivery) = self.queue(head, body, call.clone(), incoming, hold).await?;
        self.http(call.as_deref(), answer, delivery)
    }

    /// Sends the parts one after the other. If a part does not get one result for each entry, its answer is used for
    /// the whole multicall.
    async fn write_parts(
        &self,
        head: &Head,
        parts: Parts,
        incoming: Incoming,
        hold: &mut Hold,
    ) -> Result<HttpReply, Unanswered> {
        let mut whole = ListWriter::answer();
        for part in parts {
            let part = Arc::new(part);
            let body = part.encode();
            // Each part's answer counts as written when it arrives. That is safe, because no node makes so many calls
            // at once about something of which it is also notified.
            let (answer, delivery) = self
                .queue(
                    head.clone(),
                    body.into(),
                    Some(part.clone()),
                    incoming.clone(),
                    hold,
                )
                .await?;
            let reply = match &answer {
                CallAnswer::Made(reply) => Some(reply.clone()),
                CallAnswer::Raw(raw) => xmlrpc::decode_reply(&raw.body).ok(),
                CallAnswer::Close | CallAnswer::Elsewhere => None,
            };
            match reply.map(|reply| batch::with_uri(&part, reply, &self.uri)) {
                Some(Reply::Value(Value::Array(results)))
                    if results.len() == part.entries().len() =>
                {
                    results.iter().for_each(|result| whole.push(result));
                }
                _ => return self.http(Some(&part), answer, delivery),
            }
        }
        Ok(encoded(whole.finish()))
    }

    fn http(
        &self,
        call: Option<&Request>,
        answer: CallAnswer,
        delivery: Option<Delivery>,
    ) -> Result<HttpReply, Unanswered> {
        let reply = match answer {
            CallAnswer::Raw(raw) => forwarded(&self.uri, call, raw),
            CallAnswer::Made(reply) => encode_with_own_uri(&self.uri, call, &reply),
            CallAnswer::Close => return Err(Closed(UNANSWERED).into()),
            CallAnswer::Elsewhere => return Err(Unanswered::Elsewhere),
        };
        Ok(delivered(reply, delivery))
    }

    /// Queues a write. While the master is away, is late or gets its state, the mirror answers it from the queue. While the
    /// mirror is frozen, it answers only a write that changes nothing.
    async fn queue(
        &self,
        head: Head,
        body: Bytes,
        call: Option<Arc<Request>>,
        incoming: Incoming,
        hold: &mut Hold,
    ) -> Result<AnswerAndDelivery, Unanswered> {
        let is_answerable = call.as_deref().is_some_and(Request::is_answerable);
        let patience = Some(self.patience().into_std());
        let (item, answered) = Item::of_client((head, body), call, patience);
        let item = item.came_from(incoming.source, self.origin(incoming.caller));
        self.write_queue.submit(item).await;
        let mut gate = self.gate.clone();
        let held = async {
            loop {
                hold.wait_until_spent_while_shut(&mut gate).await;
                // This ends by itself. If the injection fails, the mirror answers.
                if !is_answerable || gate.state() != State::Frozen {
                    return;
                }
                gate.changed().await;
            }
        };
        tokio::select! {
            // On a busy computer both branches may be ready.
            biased;
            answer = answered => answer.map_err(|_| Closed(UNANSWERED).into()),
            () = held => {
                self.stats.calls_unanswered.count();
                Err(Closed(NOT_IN_TIME).into())
            }
        }
    }

    /// The origin of a write that was made at the address `caller`. This computer may lose its own address later, and its
    /// nodes are still its own.
    fn origin(&self, caller: IpAddr) -> Origin {
        Origin::At(match (resolver::is_own(caller), &self.others) {
            (false, _) => caller,
            (true, None) => IpAddr::V4(Ipv4Addr::LOCALHOST),
            (true, Some(_)) => own_address(&self.uri),
        })
    }

    /// When the mirror answers instead of the master. If an earlier call waits for the master already, this call does
    /// not get another [`PATIENCE`].
    fn patience(&self) -> tokio::time::Instant {
        let now = tokio::time::Instant::now();
        if self.pool.is_stalled() {
            return now;
        }
        self.write_queue.unanswered_since().unwrap_or(now) + PATIENCE
    }
}
