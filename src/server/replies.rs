//! Replies over HTTP: the master's bytes, or our own.

use bytes::Bytes;
use http_body_util::Full;
use hyper::{
    Response, StatusCode,
    header::{CONTENT_ENCODING, CONTENT_TYPE, HeaderValue, SERVER},
};

use crate::{
    master::Request,
    upstream::RawReply,
    write_queue::batch,
    xmlrpc::{self, Reply, Value},
};

/// What hyper sends.
pub(crate) type HttpReply = Response<Full<Bytes>>;

/// The mirror's reply, or the master's from a batch, with our address in place of the master's.
pub(super) fn made(uri: &str, call: Option<&Request>, reply: &Reply) -> HttpReply {
    match call.filter(|call| batch::asks_uri(call)) {
        Some(call) => xml(&batch::with_uri(call, reply.clone(), uri)),
        None => xml(reply),
    }
}

/// A master's reply, with our address in place of its own.
pub(super) fn forwarded(uri: &str, call: Option<&Request>, raw: RawReply) -> HttpReply {
    if let Some(call) = call.filter(|call| batch::asks_uri(call))
        && let Ok(reply @ Reply::Value(_)) = xmlrpc::decode_reply(&raw.body)
    {
        return xml(&batch::with_uri(call, reply, uri));
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

pub(super) fn xml(reply: &Reply) -> HttpReply {
    encoded(xmlrpc::encode_reply(reply))
}

/// A reply of our own that is encoded already.
pub(super) fn encoded(reply: impl Into<Bytes>) -> HttpReply {
    let mut http = Response::new(Full::new(reply.into()));
    http.headers_mut()
        .insert(CONTENT_TYPE, HeaderValue::from_static("text/xml"));
    http
}

pub(super) fn no_shutdown(why: &str) -> HttpReply {
    let reply: [Value; 3] = [(-1).into(), why.into(), 0.into()];
    xml(&Reply::Value(reply.to_vec().into()))
}

/// A reply that is not XML-RPC.
pub(super) fn page(status: StatusCode, kind: &'static str, text: String) -> HttpReply {
    let mut http = Response::new(Full::new(Bytes::from(text)));
    *http.status_mut() = status;
    http.headers_mut()
        .insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    http
}

/// As [`page`], in plain text.
pub(super) fn text(status: StatusCode, text: String) -> HttpReply {
    page(status, "text/plain; charset=utf-8", text)
}
