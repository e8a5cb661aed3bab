//! Replies over HTTP: the master's bytes, or rosrescue's own.

use std::{
    convert::Infallible,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
};

use bytes::Bytes;
use http_body_util::Full;
use hyper::{
    Response, StatusCode,
    body::{Body, Frame, SizeHint},
    ext::ReasonPhrase,
    header::{CONTENT_ENCODING, CONTENT_TYPE, HeaderValue, SERVER},
};
use ros1_master::{
    master::Request,
    xmlrpc::{self, Python, Reply, Value},
};
use tokio::sync::mpsc;

use crate::{
    ledger::delivery::Delivery,
    upstream::{Head, RawReply},
    write_queue::batch,
};

/// The first bytes of everything that is compressed with gzip.
const GZIP: &[u8] = &[0x1f, 0x8b];

/// The reply that hyper sends.
pub(crate) type HttpReply = Response<ReplyBody>;

/// A value in a reply's extensions that is dropped when the reply has been written, or never will be.
#[derive(Clone)]
pub(crate) struct UntilWritten(
    #[expect(dead_code, reason = "held, not read")] Arc<dyn Send + Sync>,
);

impl UntilWritten {
    pub(super) fn new(held: impl Send + Sync + 'static) -> Self {
        Self(Arc::new(held))
    }
}

/// Returns `reply`, which is now ready to be written. `delivery`, which tracks the answer, learns that, and ends once
/// the reply has been written.
pub(super) fn delivered(mut reply: HttpReply, delivery: Option<Delivery>) -> HttpReply {
    if let Some(delivery) = delivery {
        delivery.ready();
        reply.extensions_mut().insert(UntilWritten::new(delivery));
    }
    reply
}

/// The body of a reply.
#[derive(Debug)]
pub(crate) enum ReplyBody {
    /// The whole body.
    Whole(Full<Bytes>),
    /// A stream that is produced while the client reads it.
    Events(mpsc::Receiver<Bytes>),
}

impl From<Bytes> for ReplyBody {
    fn from(bytes: Bytes) -> Self {
        Self::Whole(Full::new(bytes))
    }
}

impl Body for ReplyBody {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        match &mut *self {
            Self::Whole(whole) => Pin::new(whole).poll_frame(cx),
            Self::Events(events) => {
                let event = events.poll_recv(cx);
                event.map(|event| event.map(|event| Ok(Frame::data(event))))
            }
        }
    }

    fn is_end_stream(&self) -> bool {
        match self {
            Self::Whole(whole) => whole.is_end_stream(),
            Self::Events(_) => false,
        }
    }

    fn size_hint(&self) -> SizeHint {
        match self {
            Self::Whole(whole) => whole.size_hint(),
            Self::Events(_) => SizeHint::default(),
        }
    }
}

/// A reply of the mirror, or one result from the master's answer to several calls at once, with rosrescue's address in
/// place of the master's.
pub(super) fn encode_with_own_uri(uri: &str, call: Option<&Request>, reply: &Reply) -> HttpReply {
    match call.filter(|call| batch::asks_uri(call)) {
        Some(call) => xml(&batch::with_uri(call, reply.clone(), uri)),
        None => xml(reply),
    }
}

/// A master's reply, with rosrescue's address in place of the master's.
pub(super) fn forwarded(uri: &str, call: Option<&Request>, raw: RawReply) -> HttpReply {
    if let Some(call) = call.filter(|call| batch::asks_uri(call))
        && let Ok(reply @ Reply::Value(_)) = xmlrpc::decode_reply(&raw.body)
    {
        return xml(&batch::with_uri(call, reply, uri));
    }
    plain(raw)
}

fn plain(raw: RawReply) -> HttpReply {
    let mut reply = Response::new(ReplyBody::from(raw.body));
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

pub(super) fn xml(reply: &Reply) -> HttpReply {
    encoded(xmlrpc::encode_reply(reply))
}

/// A reply made by rosrescue that is already encoded.
pub(super) fn encoded(reply: impl Into<Bytes>) -> HttpReply {
    let mut http = Response::new(ReplyBody::from(reply.into()));
    http.headers_mut()
        .insert(CONTENT_TYPE, HeaderValue::from_static("text/xml"));
    http
}

pub(super) fn no_shutdown(why: &str) -> HttpReply {
    let reply: [Value; 3] = [(-1).into(), why.into(), 0.into()];
    xml(&Reply::Value(reply.to_vec().into()))
}

/// rosmaster's answer to a request that it refuses before it decodes the body: because of the path, or because of the
/// body's encoding. `None` if it decodes the body, or if that is not certain. `python` is its version of Python.
pub(super) fn refused_by_rosmaster(head: &Head, body: &[u8], python: Python) -> Option<HttpReply> {
    // Some versions read several slashes as one.
    let has_page = head.path == "/pydoc.css" && python >= Python::new(3, 11, 0);
    if !head.may_be_for_rpc() && !has_page {
        return Some(no_such_page());
    }
    let encoding = head.encoding.as_ref()?.to_str().ok()?.to_ascii_lowercase();
    let (status, reason) = match encoding.as_str() {
        "gzip" if body.is_empty() || body.starts_with(GZIP) => return None,
        "gzip" => (
            StatusCode::BAD_REQUEST,
            "error decoding gzip content".to_owned(),
        ),
        // Python quotes other texts differently.
        other if other.contains(['\'', '\\']) => return None,
        other => (
            StatusCode::NOT_IMPLEMENTED,
            format!("encoding '{other}' not supported"),
        ),
    };
    let mut http = Response::new(ReplyBody::from(Bytes::new()));
    *http.status_mut() = status;
    http.extensions_mut()
        .insert(ReasonPhrase::try_from(reason).ok()?);
    Some(http)
}

/// rosmaster's reply to a call at a path that it does not have.
pub(super) fn no_such_page() -> HttpReply {
    page(StatusCode::NOT_FOUND, "text/plain", "No such page")
}

/// A reply that is not XML-RPC.
pub(super) fn page(status: StatusCode, kind: &'static str, content: impl Into<Bytes>) -> HttpReply {
    let mut http = Response::new(ReplyBody::from(content.into()));
    *http.status_mut() = status;
    http.headers_mut()
        .insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    http
}

/// A plain-text reply that is not XML-RPC.
pub(super) fn text(status: StatusCode, text: String) -> HttpReply {
    page(status, "text/plain; charset=utf-8", text)
}
