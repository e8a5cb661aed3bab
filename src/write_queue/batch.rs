//! Queued writes, how a batch becomes one request, and how its reply is unpacked.

use std::{collections::VecDeque, sync::Arc};

use bytes::Bytes;
use tokio::sync::oneshot;

use crate::{
    ledger::activity::LastCalls,
    upstream::{Head, RawReply},
};
use crate::{
    master::{Entry, Kind, Method, Request, entry_reply},
    xmlrpc::{self, Reply, Value},
};

/// Most calls in a batch. A compact multicall costs the master some 40 us a call, so a call waits for a few
/// milliseconds at most.
pub(super) const CALLS_MAX: usize = 100;
/// Most bytes of bodies in a batch.
pub(super) const BYTES_MAX: usize = 1 << 20;

#[derive(Debug)]
pub(crate) enum Answer {
    /// The master's reply as it came.
    Raw(RawReply),
    /// A reply to encode: the mirror's, or one from a batch.
    Made(Reply),
    /// No answer: closes the connection, so that the client retries.
    Close,
    /// Another computer has the master, and is to be given the call.
    Elsewhere,
}

#[derive(Debug)]
pub(crate) struct Item {
    /// The client's bytes; none for a call of our own.
    pub raw: Option<(Head, Bytes)>,
    /// The call; none if the bytes could not be decoded.
    pub call: Option<Arc<Request>>,
    pub answer: oneshot::Sender<Answer>,
    /// For a call of our own: when it is still right.
    pub condition: Option<Condition>,
    /// Whether those whose ports it takes have been dealt with.
    pub way_made: bool,
}

/// A node and its last calls at the time of the decision to register or unregister something for it. The
/// condition fails if the node does the opposite itself meanwhile.
#[derive(Clone, Debug)]
pub struct Condition {
    pub node: String,
    pub last_calls: LastCalls,
}

impl Condition {
    /// Whether it holds for a call of this kind, given the node's last calls `now`.
    pub fn holds(&self, kind: Kind, now: LastCalls) -> bool {
        match kind {
            Kind::Unregister => self.last_calls.registered == now.registered,
            _ => self.last_calls.unregistered == now.unregistered,
        }
    }
}

impl Item {
    /// Method and caller id, for messages.
    pub(crate) fn describe(&self) -> String {
        let Some(call) = &self.call else {
            return "a request that rosrescue cannot decode".to_owned();
        };
        let caller_id = call.caller().unwrap_or("?");
        format!("{:.100} of {caller_id:.200}", call.method().name())
    }

    /// Whether it may share a batch. Only if its reply holds no parameter value: a value that the master
    /// cannot return would spoil the whole reply.
    fn may_share(&self) -> bool {
        let shareable = |call: &Arc<Request>| {
            let shows = [Method::Multicall, Method::SubscribeParam].contains(call.method());
            !shows && call.kind().mutates()
        };
        let plain = self
            .raw
            .as_ref()
            .is_none_or(|(head, _)| matches!(head.path.as_str(), "/" | "/RPC2"));
        plain && self.call.as_ref().is_some_and(shareable)
    }

    fn weight(&self) -> usize {
        self.raw.as_ref().map_or(0, |(_, body)| body.len())
    }
}

/// Takes the next batch from the front of `queue`: one call, or several that may share a batch.
pub(crate) fn pack(queue: &mut VecDeque<Item>) -> Vec<Item> {
    let mut items: Vec<_> = queue.pop_front().into_iter().collect();
    let mut bytes = items.first().map_or(0, Item::weight);
    while items.first().is_some_and(Item::may_share)
        && items.len() < CALLS_MAX
        && let Some(next) = queue.front()
        && next.may_share()
        && bytes + next.weight() <= BYTES_MAX
    {
        bytes += next.weight();
        items.extend(queue.pop_front());
    }
    items
}

/// The request for `items`: the client's own bytes if it is a single call.
pub(crate) fn outbound(items: &[Item]) -> (Head, Bytes) {
    if let [
        Item {
            raw: Some((head, body)),
            ..
        },
    ] = items
    {
        return (head.clone(), body.clone());
    }
    let calls = items.iter().filter_map(|item| item.call.as_deref());
    let call = match items {
        [
            Item {
                call: Some(call), ..
            },
        ] => Request::clone(call),
        _ => Request::multicall(calls.cloned()),
    };
    let body = xmlrpc::encode_call(&call.into());
    (Head::default(), Bytes::from(body))
}

/// The replies to the `count` calls of a batch; none if the master did not answer each.
pub(crate) fn unpack(reply: &Reply, count: usize) -> Option<Vec<Reply>> {
    let Reply::Value(Value::Array(results)) = reply else {
        return None;
    };
    let replies: Vec<_> = results.iter().map(entry_reply).collect::<Option<_>>()?;
    (replies.len() == count).then_some(replies)
}

/// Whether the reply holds the master's address: `getUri`, alone or in a multicall.
pub(crate) fn asks_uri(call: &Request) -> bool {
    let mut calls = call.calls().into_iter();
    calls.any(|call| *call.method() == Method::GetUri)
}

/// Replaces the master's address with our own in replies to `getUri`, alone or in a multicall.
pub(crate) fn with_uri(call: &Request, mut reply: Reply, uri: &str) -> Reply {
    if let Reply::Value(value) = &mut reply {
        write_uri(call, value, uri);
    }
    reply
}

fn write_uri(call: &Request, value: &mut Value, uri: &str) {
    let Value::Array(values) = value else { return };
    if *call.method() == Method::GetUri
        && let [Value::Int(1), _, own @ Value::String(_)] = values.as_mut_slice()
    {
        *own = uri.into();
    }
    for (entry, result) in call.entries().iter().zip(values) {
        if let Entry::Request(call) = entry
            && let Value::Array(one) = result
            && let [value] = one.as_mut_slice()
        {
            write_uri(call, value, uri);
        }
    }
}

#[cfg(test)]
mod tests;
