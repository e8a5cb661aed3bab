//! One request from its head to its answer.

use std::{
    net::SocketAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use http_body_util::Full;
use hyper::{
    Method, Request, Response, StatusCode,
    body::Incoming,
    header::{CONTENT_ENCODING, CONTENT_TYPE, HeaderValue, SERVER},
};
use thiserror::Error;
use tokio::sync::oneshot;

use super::pages;
use super::{
    admission::{self, Refusal},
    body::{self, BodyError, Room},
    deadlines::Deadlines,
};
use crate::{
    cli::SyncPolicy,
    master::{self, Kind},
    xmlrpc::{self, Call, Reply, Value},
};
use crate::{
    gate::State,
    proxy::Proxy,
    upstream::{Head, INSTANCE_HEADER, RawReply, pool},
    write_queue::batch::{self, Answer, Item},
};

/// What hyper sends.
pub type HttpReply = Response<Full<Bytes>>;

/// The connection is closed without an answer. A node asks again after that, whereas an error that
/// we make up would cost it its registration, or its life.
#[derive(Debug, Error)]
#[error("closed without an answer: {0}")]
pub struct Closed(&'static str);

/// A master that takes longer is answered for by the mirror, where that is exact. A rosmaster answers
/// in less than a millisecond, and behind a call that keeps its interpreter busy in some ten.
const PATIENCE: Duration = Duration::from_millis(100);
/// Why a multicall of reads is not answered while the master is away.
const UNANSWERABLE: &str = "so many answers at once are left to the master";
/// Said to another computer of a body that rosrescue cannot decode. The master may know how to, and
/// it may be a `shutdown`.
const UNDECODED: &str = "rosrescue cannot decode this request, and takes such from the master's own \
                         computer only; send XML-RPC in UTF-8, without a document type";

/// Answers one request.
pub async fn serve(
    proxy: Arc<Proxy>,
    peer: SocketAddr,
    deadlines: Deadlines,
    request: Request<Incoming>,
) -> Result<HttpReply, Closed> {
    deadlines.serving();
    let reply = route(proxy, peer, request).await;
    deadlines.replying();
    reply
}

async fn route(
    proxy: Arc<Proxy>,
    peer: SocketAddr,
    request: Request<Incoming>,
) -> Result<HttpReply, Closed> {
    match *request.method() {
        Method::GET => Ok(
            match admission::check_host(request.headers(), &proxy.names) {
                Ok(()) => pages::page(&proxy, request.uri().path()),
                Err(refusal) => refuse(&proxy, peer, &refusal),
            },
        ),
        Method::POST => post(proxy, peer, request).await,
        ref method => Ok(text(
            StatusCode::NOT_IMPLEMENTED,
            format!("method {method} is not supported; XML-RPC is POST, the status page GET\n"),
        )),
    }
}

async fn post(
    proxy: Arc<Proxy>,
    peer: SocketAddr,
    request: Request<Incoming>,
) -> Result<HttpReply, Closed> {
    if request
        .headers()
        .get(INSTANCE_HEADER)
        .is_some_and(|of| of == proxy.instance.as_str())
    {
        proxy.looped.notify_one();
        return Ok(text(
            StatusCode::LOOP_DETECTED,
            "this is rosrescue itself\n".to_owned(),
        ));
    }
    if let Err(refusal) = admission::check_post(request.headers(), &proxy.names) {
        return Ok(refuse(&proxy, peer, &refusal));
    }
    let head = Head {
        path: request.uri().to_string(),
        encoding: request
            .headers()
            .get(CONTENT_ENCODING)
            .filter(|name| !name.as_bytes().eq_ignore_ascii_case(b"identity"))
            .cloned(),
    };
    // Held until the call is answered.
    let mut room = Room::of(&proxy.bodies);
    let read = async {
        let limit = proxy.config.max_body;
        let body = body::read(request.into_body(), limit, &mut room).await?;
        // What is packed is the master's to unpack: no ROS client packs.
        let call = match &head.encoding {
            None => decode(body.clone(), &mut room).await?,
            Some(_) => None,
        };
        Ok((body, call))
    };
    let (body, call) = match read.await {
        Ok(read) => read,
        Err(BodyError::TooLarge { limit }) => {
            proxy.stats.refused.count();
            tracing::warn!(%peer, limit, "refused a request body beyond the limit (--max-body)");
            let reason = format!("the body is larger than {limit} bytes, see --max-body\n");
            return Ok(text(StatusCode::PAYLOAD_TOO_LARGE, reason));
        }
        Err(BodyError::Broken) => return Err(Closed("the request broke off")),
        Err(BodyError::TooSlow) => return Err(Closed("the request came too slowly")),
        Err(BodyError::NoRoom) => return Err(Closed("too many large requests at the same time")),
    };
    proxy.stats.calls.count();
    if let Some(call) = &call {
        let caller_id = call
            .params
            .first()
            .and_then(Value::as_str)
            .unwrap_or_default();
        proxy.clients.called(peer, caller_id);
        tracing::debug!(%peer, method = call.method, caller_id, "call");
    } else {
        tracing::debug!(%peer, bytes = body.len(), "a request that cannot be decoded");
        if !admission::may_shut_down(peer.ip()) {
            proxy.stats.refused.count();
            tracing::warn!(%peer, "refused a request of another computer that cannot be decoded");
            return Ok(xml(&Reply::Fault {
                code: 1,
                text: UNDECODED.to_owned(),
            }));
        }
        proxy.stats.undecoded.count();
    }
    answer(&proxy, peer, head, body, call).await
}

async fn answer(
    proxy: &Arc<Proxy>,
    peer: SocketAddr,
    head: Head,
    body: Bytes,
    call: Option<Call>,
) -> Result<HttpReply, Closed> {
    let kind = call.as_ref().map_or(Kind::Mutate, master::kind);
    match (&call, kind) {
        (Some(call), Kind::Identity) if call.method == "getUri" || !proxy.gate.is_open() => {
            let reply = proxy.ledger.answer(call).ok_or(Closed(UNANSWERABLE))?;
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
            read(proxy, head, body, call.as_ref(), kind).await
        }
        (_, Kind::Unregister | Kind::Mutate | Kind::Shutdown) => {
            write(proxy, head, body, call.map(Arc::new), kind).await
        }
    }
}

/// Forwards a read. While the master is away, fails or takes too long the mirror answers.
async fn read(
    proxy: &Arc<Proxy>,
    head: Head,
    body: Bytes,
    call: Option<&Call>,
    kind: Kind,
) -> Result<HttpReply, Closed> {
    let from_mirror = || {
        let call = call.filter(|_| kind != Kind::Unknown)?;
        let reply = proxy.ledger.answer(call)?;
        proxy.stats.stood_in.count();
        Some(xml(&reply))
    };
    let mut gate = proxy.gate.clone();
    let mut hold = std::pin::pin!(tokio::time::sleep(proxy.config.hold));
    loop {
        match gate.look() {
            State::Open { incarnation } => {
                let patience = patience(proxy);
                if patience <= tokio::time::Instant::now()
                    && let Some(reply) = from_mirror()
                {
                    return Ok(reply);
                }
                let mut forwarding = Box::pin({
                    let (proxy, head, body) = (proxy.clone(), head.clone(), body.clone());
                    async move { pool::forward(&proxy, incarnation, &head, &body).await }
                });
                let reply = match tokio::time::timeout_at(patience, &mut forwarding).await {
                    Ok(reply) => reply,
                    Err(_) => {
                        proxy.slow.notify_one();
                        if let Some(reply) = from_mirror() {
                            // Its end tells that the master answers again.
                            let proxy = proxy.clone();
                            tokio::spawn(async move {
                                let _stalled = proxy.pool.stalled();
                                let _ = forwarding.await;
                            });
                            return Ok(reply);
                        }
                        forwarding.await
                    }
                };
                match reply {
                    Ok(raw) => return Ok(forwarded(proxy, call, raw)),
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
                proxy.stats.hold_expired.count();
                return Err(Closed("the master did not come back in time, see --hold"));
            }
        }
    }
}

/// Queues a write. While the master is away the mirror answers it from there; during an injection and
/// behind a master that takes too long, only if it changes nothing.
async fn write(
    proxy: &Arc<Proxy>,
    head: Head,
    body: Bytes,
    call: Option<Arc<Call>>,
    kind: Kind,
) -> Result<HttpReply, Closed> {
    if proxy.gate.state() == State::Injecting
        && let Some(reply) = answer_idle(proxy, call.as_deref()).await
    {
        return Ok(reply);
    }
    let (answer, mut answered) = oneshot::channel();
    let item = Item {
        raw: Some((head, body)),
        call: call.clone(),
        kind,
        answer,
        condition: None,
    };
    proxy.write_queue.submit(item).await;
    let call = call.as_deref();
    let mut gate = proxy.gate.clone();
    let mut held = std::pin::pin!(async {
        let answerable = call.is_some_and(master::is_answerable);
        loop {
            gate.shut_for(proxy.config.hold).await;
            // An injection ends by itself, and the mirror answers if it fails.
            if !answerable || gate.state() != State::Injecting {
                return;
            }
        }
    });
    let mut patience = std::pin::pin!(tokio::time::sleep_until(patience(proxy)));
    let mut patient = true;
    loop {
        tokio::select! {
            answer = &mut answered => return match answer {
                Ok(Answer::Raw(raw)) => Ok(forwarded(proxy, call, raw)),
                Ok(Answer::Made(reply)) => Ok(made(proxy, call, &reply)),
                Ok(Answer::Close) | Err(_) => Err(Closed("the master gave no answer")),
            },
            () = &mut held => {
                proxy.stats.hold_expired.count();
                return Err(Closed("the master did not come back in time, see --hold"));
            }
            () = &mut patience, if patient => {
                if !proxy.gate.is_open() {
                    // It may open to a master that hangs.
                    patience.as_mut().reset(tokio::time::Instant::now() + PATIENCE);
                    continue;
                }
                patient = false;
                proxy.slow.notify_one();
                if let Some(reply) = answer_idle(proxy, call).await {
                    return Ok(reply);
                }
            }
        }
    }
}

/// Until when the master may answer before the mirror does. One that keeps others waiting gets no fresh
/// [`PATIENCE`].
fn patience(proxy: &Proxy) -> tokio::time::Instant {
    let now = tokio::time::Instant::now();
    if proxy.pool.is_stalled() {
        return now;
    }
    proxy.write_queue.unanswered_since().unwrap_or(now) + PATIENCE
}

/// The mirror's answer to a write that changes nothing; none if it does.
async fn answer_idle(proxy: &Proxy, call: Option<&Call>) -> Option<HttpReply> {
    let call = call.filter(|call| master::is_answerable(call))?;
    let (reply, seq) = proxy.ledger.answer_idle(Instant::now(), call)?;
    // What made it idle may not be on the disk yet.
    if let Some(seq) = seq.filter(|_| proxy.config.sync == SyncPolicy::Always) {
        proxy.ledger.durable(seq).await;
    }
    proxy.stats.stood_in.count();
    Some(xml(&reply))
}

fn made(proxy: &Proxy, call: Option<&Call>, reply: &Reply) -> HttpReply {
    let ours = call.filter(|call| batch::asks_uri(call));
    let ours = ours.and_then(|call| batch::rewrite_uri(call, reply, &proxy.uri));
    xml(ours.as_ref().unwrap_or(reply))
}

/// A master's reply, with our address for its own.
fn forwarded(proxy: &Proxy, call: Option<&Call>, raw: RawReply) -> HttpReply {
    if let Some(call) = call.filter(|call| batch::asks_uri(call))
        && let Ok(reply) = xmlrpc::decode_reply(&raw.body)
        && let Some(rewritten) = batch::rewrite_uri(call, &reply, &proxy.uri)
    {
        return xml(&rewritten);
    }
    plain(raw)
}

fn plain(raw: RawReply) -> HttpReply {
    let mut reply = Response::new(Full::new(raw.body));
    *reply.status_mut() = raw.status;
    if let Some(reason) = raw.reason {
        reply.extensions_mut().insert(reason);
    }
    for name in [CONTENT_TYPE, CONTENT_ENCODING, SERVER] {
        if let Some(value) = raw.headers.get(&name) {
            reply.headers_mut().insert(name, value.clone());
        }
    }
    reply
}

fn xml(reply: &Reply) -> HttpReply {
    let mut http = Response::new(Full::new(Bytes::from(xmlrpc::encode_reply(reply))));
    http.headers_mut()
        .insert(CONTENT_TYPE, HeaderValue::from_static("text/xml"));
    http
}

fn no_shutdown(why: &str) -> HttpReply {
    let reply: [Value; 3] = [(-1).into(), why.into(), 0.into()];
    xml(&Reply::Value(reply.to_vec().into()))
}

fn text(status: StatusCode, text: String) -> HttpReply {
    let mut http = Response::new(Full::new(Bytes::from(text)));
    *http.status_mut() = status;
    let plain = HeaderValue::from_static("text/plain; charset=utf-8");
    http.headers_mut().insert(CONTENT_TYPE, plain);
    http
}

fn refuse(proxy: &Proxy, peer: SocketAddr, refusal: &Refusal) -> HttpReply {
    proxy.stats.refused.count();
    tracing::warn!(%peer, status = refusal.status.as_u16(), reason = refusal.reason, "refused a request");
    text(refusal.status, format!("{}\n", refusal.reason))
}

/// What a body says, if it says it in a way that we know.
async fn decode(body: Bytes, room: &mut Room<'_>) -> Result<Option<Call>, BodyError> {
    if body.len() <= body::SMALL {
        return Ok(xmlrpc::decode_call(&body).ok());
    }
    body::room_for_values(&body, room).await?;
    let work = move || xmlrpc::decode_call(&body).ok();
    Ok(tokio::task::spawn_blocking(work).await.ok().flatten())
}
