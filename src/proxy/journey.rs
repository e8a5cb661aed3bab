//! What travels through the lane, how calls are packed together, and what comes back.

use std::collections::{BTreeSet, VecDeque};

use bytes::Bytes;
use thiserror::Error;
use tokio::sync::oneshot;

use super::{
    look::LookError,
    pool::VerifyError,
    upstream::{CallError, Head, RawReply},
};
use crate::{
    master::{self, Kind},
    xmlrpc::{self, Call, Reply, Struct, Value},
};

/// Most calls that travel together. A compact multicall costs the master some 40 us a call, so
/// that nobody waits for more than a few milliseconds.
const TOGETHER: usize = 100;
/// Most bytes of bodies that travel together.
const TOGETHER_BYTES: usize = 1 << 20;

/// The answer to a call in the lane.
#[derive(Debug)]
pub enum Answer {
    /// The master's reply as it came.
    Raw(RawReply),
    /// A reply that we write out, because the call did not travel alone.
    Made(Reply),
    /// No answer: close the connection, so that the client asks again.
    Close,
}

/// A call in the lane.
#[derive(Debug)]
pub struct LaneItem {
    /// The client's bytes; none for a call of our own.
    pub raw: Option<(Head, Bytes)>,
    /// The call; none if the bytes could not be decoded.
    pub call: Option<Call>,
    /// What sort of call it is.
    pub kind: Kind,
    /// Where the answer goes.
    pub answer: oneshot::Sender<Answer>,
    /// How often it has travelled in vain.
    pub attempts: u32,
    /// What the first journey whose reply was lost must have come to, if it arrived.
    pub foretold: Option<Reply>,
}

impl LaneItem {
    /// A call that has not travelled yet.
    pub fn new(
        raw: Option<(Head, Bytes)>,
        call: Option<Call>,
        kind: Kind,
        answer: oneshot::Sender<Answer>,
    ) -> Self {
        Self {
            raw,
            call,
            kind,
            answer,
            attempts: 0,
            foretold: None,
        }
    }

    /// The caller id, for messages.
    pub fn caller(&self) -> Option<&str> {
        self.call.as_ref()?.params.first()?.as_str()
    }

    /// The answer of an earlier journey whose reply was lost, if `reply` shows that it was run then:
    /// what could be done before can not be done any more.
    pub fn done_before(&self, reply: &Reply) -> Option<Reply> {
        let refused = matches!(reply, Reply::Value(Value::Array(_))) && !master::is_success(reply);
        let first = self.foretold.as_ref().filter(|_| refused)?;
        master::is_success(first).then(|| first.clone())
    }

    /// The nodes whose registrations the call may change. What cannot be decoded has none that we
    /// know of.
    pub fn registrants(&self) -> BTreeSet<String> {
        self.call
            .as_ref()
            .map(master::registrants)
            .unwrap_or_default()
    }

    /// Whether it may travel in a multicall with others. Only calls whose reply holds no parameter
    /// value: a value that the master cannot return would spoil the replies of all.
    fn may_share(&self) -> bool {
        let shareable = |call: &Call| {
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

/// Takes from the front of `queue` what travels next: one call, or several that may share.
pub fn pack(queue: &mut VecDeque<LaneItem>) -> Vec<LaneItem> {
    let mut items: Vec<_> = queue.pop_front().into_iter().collect();
    let mut bytes = items.first().map_or(0, LaneItem::weight);
    while items.first().is_some_and(LaneItem::may_share)
        && items.len() < TOGETHER
        && let Some(next) = queue.front()
        && next.may_share()
        && bytes + next.weight() <= TOGETHER_BYTES
    {
        bytes += next.weight();
        items.extend(queue.pop_front());
    }
    items
}

/// What goes out for `items`: the client's own bytes if it is one call.
pub fn outbound(items: &[LaneItem]) -> (Head, Bytes) {
    if let [
        LaneItem {
            raw: Some((head, body)),
            ..
        },
    ] = items
    {
        return (head.clone(), body.clone());
    }
    let mut calls = items.iter().filter_map(|item| item.call.clone());
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

/// Why a journey failed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TravelError {
    /// There was no connection to the right incarnation.
    #[error(transparent)]
    Connect(#[from] VerifyError),
    /// The calls got no reply.
    #[error(transparent)]
    Call(#[from] CallError),
    /// The look at the master failed.
    #[error(transparent)]
    Look(#[from] LookError),
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
mod tests {
    use super::*;

    fn item(call: Call) -> LaneItem {
        let body = Bytes::from(xmlrpc::encode_call(&call));
        let raw = Some((Head::default(), body));
        LaneItem::new(raw, Some(call), Kind::Mutate, oneshot::channel().0)
    }

    #[test]
    fn what_was_done_by_a_lost_journey_is_answered_as_done() {
        let answer = |code: i32| Reply::Value(vec![Value::from(code), "".into(), 0.into()].into());
        let mut item = item(Call::new("deleteParam", vec!["/n".into(), "/a".into()]));
        assert_eq!(item.done_before(&answer(-1)), None);
        item.foretold = Some(answer(1));
        assert_eq!(item.done_before(&answer(-1)), Some(answer(1)));
        assert_eq!(item.done_before(&answer(1)), None);
        item.foretold = Some(answer(-1));
        assert_eq!(item.done_before(&answer(-1)), None);
    }

    fn set(key: &str, value: impl Into<Value>) -> Call {
        Call::new("setParam", vec!["/n".into(), key.into(), value.into()])
    }

    fn packed(calls: Vec<Call>) -> Vec<usize> {
        let mut queue: VecDeque<_> = calls.into_iter().map(item).collect();
        let mut sizes = Vec::new();
        while !queue.is_empty() {
            sizes.push(pack(&mut queue).len());
        }
        sizes
    }

    #[test]
    fn calls_that_may_share_travel_together_and_keep_their_order() {
        let subscribe = Call::new(
            "subscribeParam",
            vec!["/n".into(), "http://n:1/".into(), "/k".into()],
        );
        let calls = vec![set("/a", 1), set("/b", 2), subscribe, set("/c", 3)];
        assert_eq!(packed(calls), [2, 1, 1]);
        assert_eq!(
            packed((0..250).map(|i| set("/a", i)).collect()),
            [100, 100, 50]
        );
        let big = "x".repeat(TOGETHER_BYTES / 2 + 1);
        assert_eq!(
            packed(vec![set("/a", &*big), set("/b", &*big), set("/c", 1)]),
            [1, 2]
        );
    }

    #[test]
    fn a_single_call_goes_out_as_its_own_bytes() {
        let body = Bytes::from_static(b"<methodCall> odd </methodCall>");
        let mut odd = item(set("/a", 1));
        odd.raw = Some((Head::default(), body.clone()));
        assert_eq!(outbound(&[odd]).1, body);
        let (_, both) = outbound(&[item(set("/a", 1)), item(set("/b", 2))]);
        let expected = Call::multicall([set("/a", 1), set("/b", 2)]);
        assert_eq!(xmlrpc::decode_call(&both).unwrap(), expected);
    }

    #[test]
    fn replies_come_apart_only_when_each_is_there() {
        let fault = Struct::from([
            ("faultCode".to_owned(), Value::Int(1)),
            ("faultString".to_owned(), Value::from("no")),
        ]);
        let reply = Reply::Value(Value::Array(vec![
            Value::from(vec![Value::from(7)]),
            Value::Struct(fault),
        ]));
        let replies = vec![
            Reply::Value(Value::Int(7)),
            Reply::Fault {
                code: 1,
                text: "no".to_owned(),
            },
        ];
        assert_eq!(unpack(&reply, 2), Some(replies));
        assert_eq!(unpack(&reply, 3), None);
        assert_eq!(
            unpack(
                &Reply::Fault {
                    code: 1,
                    text: String::new()
                },
                0
            ),
            None
        );
    }

    #[test]
    fn the_masters_own_address_becomes_ours() {
        let answer = |uri: &str| Value::Array(vec![1.into(), "".into(), uri.into()]);
        let call = Call::new("getUri", vec!["/n".into()]);
        let reply = rewrite_uri(&call, &Reply::Value(answer("http://m:1/")), "http://us:2/");
        assert_eq!(reply, Some(Reply::Value(answer("http://us:2/"))));
        let both = Call::multicall([Call::new("getPid", vec!["/n".into()]), call]);
        let results = |uri: &str| {
            let pid = Value::Array(vec![1.into(), "".into(), 42.into()]);
            Reply::Value(Value::Array(vec![
                vec![pid].into(),
                vec![answer(uri)].into(),
            ]))
        };
        let reply = rewrite_uri(&both, &results("http://m:1/"), "http://us:2/");
        assert_eq!(reply, Some(results("http://us:2/")));
        let nested = Call::multicall([both.clone()]);
        let within = |reply: Reply| match reply {
            Reply::Value(value) => Reply::Value(vec![Value::Array(vec![value])].into()),
            fault => fault,
        };
        let reply = rewrite_uri(&nested, &within(results("http://m:1/")), "http://us:2/");
        assert_eq!(reply, Some(within(results("http://us:2/"))));
        assert!(asks_uri(&both) && asks_uri(&nested));
        assert!(!asks_uri(&Call::multicall([Call::new("getPid", vec![])])));
    }
}
