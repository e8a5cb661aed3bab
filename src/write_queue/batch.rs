//! Writes in the queue, how they are packed into one request, and what comes back.

use std::{collections::VecDeque, sync::Arc};

use bytes::Bytes;
use tokio::sync::oneshot;

use crate::{
    ledger::activity::LastCalls,
    upstream::{Head, RawReply},
};
use crate::{
    master::Kind,
    xmlrpc::{self, Call, Reply, Struct, Value},
};

/// Most calls in a batch. A compact multicall costs the master some 40 us a call, so that nobody
/// waits for more than a few milliseconds.
const CALLS_MAX: usize = 100;
/// Most bytes of bodies in a batch.
const BYTES_MAX: usize = 1 << 20;

/// The answer to a call in the queue.
#[derive(Debug)]
pub enum Answer {
    /// The master's reply as it came.
    Raw(RawReply),
    /// A reply that we write out: the mirror's, or one out of a batch.
    Made(Reply),
    /// No answer: close the connection, so that the client asks again.
    Close,
}

/// A call in the queue.
#[derive(Debug)]
pub struct Item {
    /// The client's bytes; none for a call of our own.
    pub raw: Option<(Head, Bytes)>,
    /// The call; none if the bytes could not be decoded.
    pub call: Option<Arc<Call>>,
    /// What sort of call it is.
    pub kind: Kind,
    /// Where the answer goes.
    pub answer: oneshot::Sender<Answer>,
    /// Of a call of our own: what it stands on.
    pub condition: Option<Condition>,
}

/// A node and its last last_calls, as they were when it was found out that something is to be registered or
/// unregistered for it. A node that does the contrary itself meanwhile knows better.
#[derive(Clone, Debug)]
pub struct Condition {
    /// The node.
    pub node: String,
    /// Its last last_calls then.
    pub last_calls: LastCalls,
}

impl Condition {
    /// Whether it still holds for a call of this kind, now that these are the node's last last_calls.
    pub fn holds(&self, kind: Kind, now: LastCalls) -> bool {
        match kind {
            Kind::Unregister => self.last_calls.registered == now.registered,
            _ => self.last_calls.unregistered == now.unregistered,
        }
    }
}

impl Item {
    /// The method and the caller id, for messages.
    pub fn describe(&self) -> String {
        let Some(call) = &self.call else {
            return "a request that rosrescue cannot decode".to_owned();
        };
        let caller_id = call.params.first().and_then(Value::as_str);
        format!("{:.100} of {:.200}", call.method, caller_id.unwrap_or("?"))
    }

    /// Whether it may share a batch with others. Only calls whose reply holds no parameter value: a
    /// value that the master cannot return would spoil the replies of all.
    fn may_share(&self) -> bool {
        let shareable = |call: &Arc<Call>| {
            matches!(
                call.method.as_str(),
                "registerPublisher"
                    | "registerSubscriber"
                    | "registerService"
                    | "unregisterPublisher"
                    | "unregisterSubscriber"
                    | "unregisterService"
                    | "unsubscribeParam"
                    | "setParam"
                    | "deleteParam"
            )
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

/// Takes the next batch from the front of `queue`: one call, or several that may share.
pub fn pack(queue: &mut VecDeque<Item>) -> Vec<Item> {
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

/// What goes out for `items`: the client's own bytes if it is one call.
pub fn outbound(items: &[Item]) -> (Head, Bytes) {
    if let [
        Item {
            raw: Some((head, body)),
            ..
        },
    ] = items
    {
        return (head.clone(), body.clone());
    }
    let mut calls = items
        .iter()
        .filter_map(|item| item.call.as_deref().cloned());
    let call = match (items.len(), calls.next()) {
        (1, Some(call)) => call,
        (_, first) => Call::multicall(first.into_iter().chain(calls)),
    };
    (Head::default(), Bytes::from(xmlrpc::encode_call(&call)))
}

/// The replies to `count` calls that travelled together; none if the master did not answer each.
pub fn unpack(reply: &Reply, count: usize) -> Option<Vec<Reply>> {
    let Reply::Value(Value::Array(results)) = reply else {
        return None;
    };
    let replies: Vec<_> = results.iter().map(unpack_one).collect::<Option<_>>()?;
    (replies.len() == count).then_some(replies)
}

/// One result of a multicall: `[value]`, or a struct that is a fault.
pub fn unpack_one(result: &Value) -> Option<Reply> {
    match result {
        Value::Array(one) => match one.as_slice() {
            [value] => Some(Reply::Value(value.clone())),
            _ => None,
        },
        Value::Struct(fault) => {
            let code = fault.get("faultCode")?.as_int()?;
            let text = fault.get("faultString")?.as_str()?.to_owned();
            Some(Reply::Fault { code, text })
        }
        _ => None,
    }
}

/// Whether the master writes its own address into the reply: `getUri`, alone or in a multicall.
pub fn asks_uri(call: &Call) -> bool {
    fn asks(method: Option<&Value>, params: Option<&Value>) -> bool {
        match method.and_then(Value::as_str) {
            Some("getUri") => true,
            Some("system.multicall") => {
                let entries = params.and_then(Value::as_array).and_then(<[Value]>::first);
                entries.is_some_and(|entries| entries.as_array().is_some_and(any))
            }
            _ => false,
        }
    }
    fn any(entries: &[Value]) -> bool {
        let mut entries = entries.iter().filter_map(Value::as_struct);
        entries.any(|entry| asks(entry.get("methodName"), entry.get("params")))
    }
    match call.method.as_str() {
        "getUri" => true,
        "system.multicall" => call
            .params
            .first()
            .and_then(Value::as_array)
            .is_some_and(any),
        _ => false,
    }
}

/// Puts our own address where the master wrote its own: into replies to `getUri`, alone or in a
/// multicall. None if there is nothing to change.
pub fn rewrite_uri(call: &Call, reply: &Reply, uri: &str) -> Option<Reply> {
    let Reply::Value(value) = reply else {
        return None;
    };
    rewrite(&call.method, &call.params, value, uri).map(Reply::Value)
}

fn rewrite(method: &str, params: &[Value], value: &Value, uri: &str) -> Option<Value> {
    match method {
        "getUri" => rewritten(value, uri),
        "system.multicall" => {
            let entries = params.first()?.as_array()?;
            let mut results = value.as_array()?.to_vec();
            let mut changed = false;
            for (entry, result) in entries.iter().zip(&mut results) {
                let entry = entry.as_struct();
                let member = |name| entry.and_then(|entry: &Struct| entry.get(name));
                if let Some(method) = member("methodName").and_then(Value::as_str)
                    && let Value::Array(one) = result
                    && let [value] = one.as_mut_slice()
                {
                    let params = member("params").and_then(Value::as_array);
                    if let Some(new) = rewrite(method, params.unwrap_or_default(), value, uri) {
                        *value = new;
                        changed = true;
                    }
                }
            }
            changed.then_some(Value::Array(results))
        }
        _ => None,
    }
}

fn rewritten(value: &Value, uri: &str) -> Option<Value> {
    match value.as_array()? {
        [code @ Value::Int(1), message, Value::String(_)] => Some(Value::Array(vec![
            code.clone(),
            message.clone(),
            Value::from(uri),
        ])),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
