//! One request from its head to its answer.

use std::{net::SocketAddr, sync::Arc, time::Duration};

use bytes::Bytes;
use http_body_util::Full;
use hyper::{
    Method, Request, Response, StatusCode,
    body::Incoming,
    header::{CONTENT_ENCODING, CONTENT_TYPE, HeaderValue, SERVER, USER_AGENT},
};
use thiserror::Error;
use tokio::sync::oneshot;

use super::{
    Proxy,
    body::{self, BodyError, Room},
    door::{self, Refusal},
    gate::{StandIn, State},
    journey::{self, Answer, LaneItem},
    pace::Pace,
    upstream::{Head, INSTANCE_HEADER, RawReply},
};
use crate::{
    admin,
    master::{self, Kind},
    xmlrpc::{self, Call, Reply, Value},
};

/// What hyper sends.
pub type HttpReply = Response<Full<Bytes>>;

/// The connection is closed without an answer. A node asks again after that, whereas an error that
/// we make up would cost it its registration, or its life.
#[derive(Debug, Error)]
#[error("closed without an answer: {0}")]
pub struct Closed(&'static str);

/// A master that takes longer to say its process id is answered for: roslaunch waits 5 s for that,
/// and then starts a master of its own on our port.
const IDENTITY_TIME: Duration = Duration::from_secs(1);
/// How long a `setParam` of roscpp is held. `ros::param::set` keeps a lock until the master answers, and
/// says that it failed under that lock: if another thread of the node has said anything meanwhile, the
/// two wait for each other for ever. It has no time limit of its own.
const ROSCPP_SET_PARAM_HOLD: Duration = Duration::from_secs(24 * 3600);
/// What roscpp calls itself.
const ROSCPP: &[u8] = b"XMLRPC++";
/// Why a multicall is not answered while the gate is shut.
const UNANSWERABLE: &str = "so many answers at once are left to the master";
/// Said to another computer of a body that rosrescue cannot decode. The master may know how to, and
/// it may be a `shutdown`.
const UNDECODED: &str = "rosrescue cannot decode this request, and takes such from the master's own \
                         computer only; send XML-RPC in UTF-8, without a document type";

/// Answers one request.
pub async fn serve(
    proxy: Arc<Proxy>,
    peer: SocketAddr,
    pace: Pace,
    request: Request<Incoming>,
) -> Result<HttpReply, Closed> {
    pace.serving();
    let reply = route(proxy, peer, &pace, request).await;
    pace.replying();
    reply
}

async fn route(
    proxy: Arc<Proxy>,
    peer: SocketAddr,
    pace: &Pace,
    request: Request<Incoming>,
) -> Result<HttpReply, Closed> {
    match *request.method() {
        Method::GET => Ok(match door::check_host(request.headers(), &proxy.names) {
            Ok(()) => admin::page(&proxy, request.uri().path()),
            Err(refusal) => refuse(&proxy, peer, &refusal),
        }),
        Method::POST => post(proxy, peer, pace, request).await,
        ref method => Ok(text(
            StatusCode::NOT_IMPLEMENTED,
            format!("method {method} is not supported; XML-RPC is POST, the status page GET\n"),
        )),
    }
}

async fn post(
    proxy: Arc<Proxy>,
    peer: SocketAddr,
    pace: &Pace,
    request: Request<Incoming>,
) -> Result<HttpReply, Closed> {
    if request
        .headers()
        .get(INSTANCE_HEADER)
        .is_some_and(|of| of == proxy.instance.as_str())
    {
        proxy
            .looped
            .store(true, std::sync::atomic::Ordering::Relaxed);
        return Ok(text(
            StatusCode::LOOP_DETECTED,
            "this is rosrescue itself\n".to_owned(),
        ));
    }
    if let Err(refusal) = door::check_post(request.headers(), &proxy.names) {
        return Ok(refuse(&proxy, peer, &refusal));
    }
    let roscpp = request
        .headers()
        .get(USER_AGENT)
        .is_some_and(|agent| agent.as_bytes().starts_with(ROSCPP));
    let head = Head {
        path: request.uri().to_string(),
        encoding: request.headers().get(CONTENT_ENCODING).cloned(),
    };
    // Held until the call is answered.
    let mut room = Room::of(&proxy.bodies);
    let packing = Packing::of(head.encoding.as_ref());
    let read = async {
        let limit = proxy.config.max_body;
        let body = body::read(request.into_body(), limit, &mut room).await?;
        let call = decode(packing, body.clone(), limit, &mut room).await?;
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
        if packing != Packing::Unknown && !door::may_shut_down(peer.ip()) {
            proxy.stats.refused.count();
            tracing::warn!(%peer, "refused a request of another computer that cannot be decoded");
            return Ok(xml(&Reply::Fault {
                code: 1,
                text: UNDECODED.to_owned(),
            }));
        }
        proxy.stats.undecoded.count();
    }
    let hold = match &call {
        Some(call) if roscpp && call.method == "setParam" => ROSCPP_SET_PARAM_HOLD,
        _ => proxy.config.hold,
    };
    answer(&proxy, peer, pace, hold, head, body, call).await
}

async fn answer(
    proxy: &Arc<Proxy>,
    peer: SocketAddr,
    pace: &Pace,
    hold: Duration,
    head: Head,
    body: Bytes,
    call: Option<Call>,
) -> Result<HttpReply, Closed> {
    let kind = call.as_ref().map_or(Kind::Mutate, master::kind);
    match (&call, kind) {
        (Some(call), Kind::Identity)
            if call.method == "getUri" || !matches!(proxy.gate.state(), State::Open { .. }) =>
        {
            let reply = proxy.shadow.answer(call).ok_or(Closed(UNANSWERABLE))?;
            Ok(xml(&reply))
        }
        (_, Kind::Shutdown) if !door::may_shut_down(peer.ip()) => {
            tracing::warn!(%peer, "refused to shut the master down for another computer");
            Ok(no_shutdown(
                "shutdown is taken from the master's own computer only",
            ))
        }
        (Some(call), Kind::Shutdown) if door::is_for_a_node(call) => {
            tracing::warn!(%peer, "refused to shut down for a node that is registered at our address");
            Ok(no_shutdown("this is the master, and no node"))
        }
        (_, Kind::Read | Kind::Identity | Kind::Unknown) => {
            read(proxy, head, body, call.as_ref(), kind).await
        }
        (_, Kind::Unregister | Kind::Mutate | Kind::Shutdown) => {
            let Some(_place) = proxy.lane.place(&proxy.gate, kind).await else {
                proxy.stats.hold_expired.count();
                return Err(Closed(
                    "too many calls wait for the master, see --max-parked",
                ));
            };
            let (tx, rx) = oneshot::channel();
            let names_uri = call
                .as_ref()
                .filter(|call| journey::asks_uri(call))
                .cloned();
            let item = LaneItem::new(Some((head, body)), call, kind, tx);
            proxy.lane.submit(item).await;
            await_lane(proxy, pace, hold, rx, names_uri.as_ref()).await
        }
    }
}

/// Forwards a read; while the gate is shut, or when the master fails, the mirror answers.
async fn read(
    proxy: &Arc<Proxy>,
    head: Head,
    body: Bytes,
    call: Option<&Call>,
    kind: Kind,
) -> Result<HttpReply, Closed> {
    let mut gate = proxy.gate.clone();
    let mut parked = false;
    let mut hold = std::pin::pin!(tokio::time::sleep(proxy.config.hold));
    loop {
        let mut known = true;
        match gate.look() {
            State::Open { incarnation } => {
                let Proxy {
                    pool,
                    upstream,
                    mark,
                    ..
                } = &**proxy;
                let limit = match kind {
                    Kind::Identity => IDENTITY_TIME,
                    _ => Duration::MAX,
                };
                let mut watch = gate.clone();
                let reply = pool.forward(upstream, mark, &mut watch, incarnation, &head, &body);
                match tokio::time::timeout(limit, reply).await {
                    Ok(Ok(raw)) => return Ok(forwarded(proxy, call, raw)),
                    Ok(Err(error)) => tracing::debug!(%error, "read"),
                    Err(_) => tracing::debug!("the master is slow to say who it is"),
                }
            }
            State::Shut(stand_in) => known = stand_in != StandIn::Nobody,
        }
        if let Some(call) = call.filter(|_| known && kind != Kind::Unknown)
            && let Some(reply) = proxy.shadow.answer(call)
        {
            proxy.stats.stood_in.count();
            return Ok(xml(&reply));
        }
        if !std::mem::replace(&mut parked, true) {
            proxy.stats.parked.count();
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

async fn await_lane(
    proxy: &Arc<Proxy>,
    pace: &Pace,
    hold: Duration,
    mut answered: oneshot::Receiver<Answer>,
    names_uri: Option<&Call>,
) -> Result<HttpReply, Closed> {
    let mut gate = proxy.gate.clone();
    if matches!(gate.state(), State::Shut(_)) {
        proxy.stats.parked.count();
    }
    // While the master is there, a client may close its half and wait for the answer. A call that
    // is parked is not run for a client that has gone: it would register a node that is dead.
    let abandoned = async {
        let mut gate = proxy.gate.clone();
        pace.hung_up().await;
        gate.shut_for(Duration::ZERO).await;
    };
    tokio::select! {
        answer = &mut answered => match answer {
            Ok(Answer::Raw(raw)) => Ok(forwarded(proxy, names_uri, raw)),
            Ok(Answer::Made(reply)) => {
                let ours = names_uri.and_then(|it| journey::rewrite_uri(it, &reply, &proxy.uri));
                Ok(xml(ours.as_ref().unwrap_or(&reply)))
            }
            Ok(Answer::Close) | Err(_) => Err(Closed("the master gave no answer")),
        },
        () = gate.shut_for(hold) => {
            proxy.stats.hold_expired.count();
            Err(Closed("the master did not come back in time, see --hold"))
        }
        () = abandoned => Err(Closed("the client has gone")),
    }
}

/// A master's reply, with our address for its own.
fn forwarded(proxy: &Proxy, call: Option<&Call>, raw: RawReply) -> HttpReply {
    if let Some(call) = call.filter(|call| journey::asks_uri(call))
        && let Ok(reply) = xmlrpc::decode_reply(&raw.body)
        && let Some(rewritten) = journey::rewrite_uri(call, &reply, &proxy.uri)
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

/// How a body is packed, as rosmaster reads the header.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Packing {
    Plain,
    Gzip,
    /// rosmaster refuses it without a look at the body.
    Unknown,
}

impl Packing {
    fn of(encoding: Option<&HeaderValue>) -> Self {
        match encoding.map(HeaderValue::as_bytes) {
            None => Self::Plain,
            Some(name) if name.eq_ignore_ascii_case(b"identity") => Self::Plain,
            Some(name) if name.eq_ignore_ascii_case(b"gzip") => Self::Gzip,
            Some(_) => Self::Unknown,
        }
    }
}

/// What a body says, if it says it in a way that we know.
async fn decode(
    packing: Packing,
    body: Bytes,
    limit: usize,
    room: &mut Room<'_>,
) -> Result<Option<Call>, BodyError> {
    let body = match packing {
        Packing::Plain => Some(body),
        // What unpacks to more than the limit is not looked into; rosmaster will do as it likes.
        Packing::Gzip => body::unpack(body, limit, room).await?,
        Packing::Unknown => None,
    };
    let Some(body) = body else {
        return Ok(None);
    };
    if body.len() <= body::SMALL {
        return Ok(xmlrpc::decode_call(&body).ok());
    }
    body::room_for_values(&body, room).await?;
    let work = move || xmlrpc::decode_call(&body).ok();
    Ok(tokio::task::spawn_blocking(work).await.ok().flatten())
}
