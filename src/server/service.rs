//! Serves one request, from its head to its answer.

use std::{
    net::SocketAddr,
    sync::{Arc, PoisonError},
    time::{Duration, Instant},
};

use bytes::Bytes;
use hyper::{
    Method, Request, StatusCode,
    body::Incoming,
    header::{CONNECTION, CONTENT_ENCODING, HeaderValue},
};
use rescue_core::admission::{self, Rejection};
use ros1_master::{
    master::{self, Kind, Master},
    xmlrpc::{Python, Reply},
};

use super::{
    Server,
    access::Grant,
    answers,
    body::{self, BodyError, Room},
    calls::Closed,
    deadlines::Deadlines,
    pages,
    replies::{HttpReply, text, xml},
};
use crate::{
    limit::rarely,
    upstream::{
        Head, INSTANCE_HEADER, open_requests,
        peer::{CALLER_HEADER, HOLD_HEADER},
    },
};

/// The answer to a client on another computer if rosrescue cannot decode its body. The master may be able to decode it,
/// and the call may be a `shutdown`.
const UNDECODED: &str = "rosrescue cannot decode this request, and accepts such requests only from the master's own computer; send XML-RPC in UTF-8, without a document type";

/// The reason if a large answer finds no memory and cannot be made again later.
const NO_ROOM: Closed = Closed("too many large answers at the same time");
/// How often an answer is made at most. It is made again if it has grown meanwhile.
const ATTEMPTS: u32 = 4;

/// Answers one request.
pub(crate) async fn serve(
    server: Arc<Server>,
    peer: SocketAddr,
    grant: Grant,
    deadlines: Deadlines,
    request: Request<Incoming>,
) -> Result<HttpReply, Closed> {
    deadlines.serving();
    let mut reply = match grant.check(peer.ip()) {
        Ok(()) => route(server, peer, grant, &deadlines, request).await,
        Err(refusal) => {
            let mut reply = refuse_peer(&server, peer, &refusal);
            // The connection must close to make room for others.
            let close = HeaderValue::from_static("close");
            reply.headers_mut().insert(CONNECTION, close);
            Ok(reply)
        }
    };
    let extensions = reply.as_mut().map(hyper::Response::extensions_mut);
    deadlines.replying(extensions.ok().and_then(|of| of.remove()));
    reply
}

async fn route(
    server: Arc<Server>,
    peer: SocketAddr,
    grant: Grant,
    deadlines: &Deadlines,
    request: Request<Incoming>,
) -> Result<HttpReply, Closed> {
    match *request.method() {
        Method::GET => match admission::check_get(request.headers(), &server.names) {
            Ok(()) => {
                let made = pages::page(&server, request.uri(), request.headers()).await;
                page(&server, made, deadlines).await
            }
            Err(refusal) => Ok(refuse(&server, peer, &refusal)),
        },
        Method::POST => post(server, peer, grant, deadlines, request).await,
        ref method => Ok(text(
            StatusCode::NOT_IMPLEMENTED,
            format!("method {method} is not supported; XML-RPC is POST, the status page GET\n"),
        )),
    }
}

async fn post(
    server: Arc<Server>,
    peer: SocketAddr,
    grant: Grant,
    deadlines: &Deadlines,
    request: Request<Incoming>,
) -> Result<HttpReply, Closed> {
    if request
        .headers()
        .get(INSTANCE_HEADER)
        .is_some_and(open_requests::is_own)
    {
        server.looped.notify_one();
        return Ok(text(
            StatusCode::LOOP_DETECTED,
            "this is rosrescue itself\n".to_owned(),
        ));
    }
    if let Err(refusal) = admission::check_post(request.headers(), &server.names) {
        return Ok(refuse(&server, peer, &refusal));
    }
    let python = server.calls.ledger.with_mirror(Master::python);
    let caller = request.headers().get(CALLER_HEADER);
    let hold = request.headers().get(HOLD_HEADER);
    let hold = hold.and_then(|hold| hold.to_str().ok()?.parse().ok());
    let head = Head {
        path: request.uri().to_string(),
        caller: caller.and_then(|caller| caller.to_str().ok()?.parse().ok()),
        hold: hold.map(Duration::from_millis),
        encoding: request
            .headers()
            .get(CONTENT_ENCODING)
            .filter(|name| !name.as_bytes().eq_ignore_ascii_case(b"identity"))
            .cloned(),
    };
    // The memory stays reserved until the call is answered.
    let mut room = Room::new(&server.bodies);
    let read = async {
        let limit = server.max_body;
        let body = body::read(request.into_body(), limit, &mut room).await?;
        // A compressed body is forwarded without decoding. No ROS client compresses.
        let call = match &head.encoding {
            None => decode(body.clone(), python, &mut room).await?,
            Some(_) => None,
        };
        Ok((body, call))
    };
    let (body, call) = match read.await {
        Ok(read) => read,
        Err(BodyError::TooLarge { limit }) => {
            server.stats.requests_refused.count();
            rarely!(warn, %peer, limit, "refused a request body larger than the limit (--max-body)");
            let reason = format!("the body is larger than {limit} bytes, see --max-body\n");
            return Ok(text(StatusCode::PAYLOAD_TOO_LARGE, reason));
        }
        Err(BodyError::Broken) => return Err(Closed("the request ended early")),
        Err(BodyError::TooSlow) => return Err(Closed("the request came too slowly")),
        Err(BodyError::NoRoom) => return Err(Closed("too many large requests at the same time")),
    };
    let kind = call.as_ref().map(master::Request::kind);
    if let Err(refusal) = grant.check_call(peer.ip(), kind) {
        return Ok(refuse_peer(&server, peer, &refusal));
    }
    server.stats.calls.count();
    if let Some(call) = &call {
        let caller_id = call.caller().unwrap_or_default();
        server.clients.called(peer, caller_id);
        tracing::debug!(%peer, method = call.method().name(), caller_id, "call");
    } else {
        tracing::debug!(%peer, bytes = body.len(), "a request that cannot be decoded");
        if !admission::may_shut_down(peer.ip()) {
            server.stats.requests_refused.count();
            rarely!(warn, %peer, "refused a request that cannot be decoded, from another computer");
            return Ok(xml(&Reply::Fault {
                code: 1,
                text: UNDECODED.to_owned(),
            }));
        }
        server.stats.requests_not_understood.count();
    }
    let start = Instant::now();
    let answered = answer(&server, peer, deadlines, head, body, call).await;
    let time = server.clients.end_call(peer, start);
    server.stats.times.count(kind, time);
    answered
}

/// Answers a call. If there is no memory for a large answer, the answer is dropped and made again later, so that few
/// large answers wait.
async fn answer(
    server: &Server,
    peer: SocketAddr,
    deadlines: &Deadlines,
    head: Head,
    body: Bytes,
    mut call: Option<master::Request>,
) -> Result<HttpReply, Closed> {
    let mut room = None;
    for _ in 0..ATTEMPTS {
        let (again, calls) = (head.clone(), &server.calls);
        let reply = calls.answer(peer, again, body.clone(), call).await?;
        let Some(size) = answers::size(&reply) else {
            return Ok(reply);
        };
        if let Some(room) = server.answers.room_for(room.take(), size).await {
            return Ok(server
                .answers
                .hold_room(reply, room, &deadlines.reader)
                .await);
        }
        call = match body.len() <= body::SMALL {
            true => {
                let python = calls.ledger.with_mirror(Master::python);
                master::Request::decode_for(&body, python).ok()
            }
            false => None,
        };
        if call.as_ref().map(master::Request::kind) != Some(Kind::Read) {
            return Err(NO_ROOM);
        }
        drop(reply);
        room = Some(server.answers.reserve(size).await);
    }
    Err(Closed("its answer keeps growing"))
}

/// Answers with a page. A large page waits for memory, like any large answer.
async fn page(
    server: &Server,
    page: HttpReply,
    deadlines: &Deadlines,
) -> Result<HttpReply, Closed> {
    let Some(size) = answers::size(&page) else {
        return Ok(page);
    };
    let room = server.answers.room_for(None, size).await.ok_or(NO_ROOM)?;
    Ok(server
        .answers
        .hold_room(page, room, &deadlines.reader)
        .await)
}

fn refuse(server: &Server, peer: SocketAddr, refusal: &Rejection) -> HttpReply {
    server.stats.requests_refused.count();
    rarely!(warn, %peer, status = refusal.status.as_u16(), reason = refusal.reason, "refused a request");
    text(refusal.status, format!("{}\n", refusal.reason))
}

/// Refuses a request, and logs each address at most once a minute, because a refused node calls again and again.
fn refuse_peer(server: &Server, peer: SocketAddr, refusal: &Rejection) -> HttpReply {
    let mut said = server
        .refused
        .lock()
        .unwrap_or_else(PoisonError::into_inner);
    if said.is_due(Instant::now(), peer.ip()) {
        tracing::warn!("refused: {}", refusal.reason);
    }
    server.stats.requests_refused.count();
    text(refusal.status, format!("{}\n", refusal.reason))
}

/// Decodes a body as a master on this version of Python would, so that no call means something else to the master.
/// `None` if it cannot be decoded.
async fn decode(
    body: Bytes,
    python: Python,
    room: &mut Room<'_>,
) -> Result<Option<master::Request>, BodyError> {
    if body.len() <= body::SMALL {
        return Ok(master::Request::decode_for(&body, python).ok());
    }
    body::room_for_values(&body, room).await?;
    let work = move || master::Request::decode_for(&body, python).ok();
    Ok(crate::task::spawn_blocking(work).await.ok().flatten())
}
