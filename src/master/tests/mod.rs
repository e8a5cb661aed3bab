//! The model on its own. That it is rosmaster's equal is for `tests/differential.rs`.

mod costs;
mod exact;
mod inspect;
mod params;
mod planning;
mod quirks;

use super::{Master, Method, Notice, Request};
use crate::xmlrpc::{Call, Reply, Struct, Value};

/// A call with text parameters.
pub(super) fn call(method: &str, params: &[&str]) -> Request {
    Request::new(Method::named(method), params.iter().copied())
}

pub(super) fn set(key: &str, value: impl Into<Value>) -> Request {
    Request::new(
        Method::SetParam,
        [Value::from("/set"), key.into(), value.into()],
    )
}

pub(super) fn tree<const N: usize>(members: [(&str, Value); N]) -> Value {
    Value::Struct(Struct::from(
        members.map(|(key, value)| (key.to_owned(), value)),
    ))
}

pub(super) fn publish(node: &str, topic: &str, topic_type: &str) -> Request {
    call("registerPublisher", &[node, topic, topic_type, &api(node)])
}

pub(super) fn subscribe(node: &str, topic: &str, topic_type: &str) -> Request {
    call("registerSubscriber", &[node, topic, topic_type, &api(node)])
}

pub(super) fn provide(node: &str, service: &str) -> Request {
    call(
        "registerService",
        &[node, service, &format!("rosrpc://h{node}"), &api(node)],
    )
}

pub(super) fn watch(node: &str, key: &str) -> Request {
    call("subscribeParam", &[node, &api(node), key])
}

pub(super) fn api(node: &str) -> String {
    format!("http://h{node}")
}

/// A master after these calls.
pub(super) fn after(calls: impl IntoIterator<Item = Request>) -> Master {
    let mut master = Master::default();
    for call in calls {
        master.apply(&call);
    }
    master
}

/// Code, message and value of the answer.
pub(super) fn answer(master: &mut Master, call: &Request) -> (i32, String, Value) {
    match master.apply(call).reply {
        Reply::Value(Value::Array(answer)) => match answer.as_slice() {
            [Value::Int(code), Value::String(message), value] => {
                (*code, message.clone(), value.clone())
            }
            other => panic!("no answer of a master: {other:?}"),
        },
        other => panic!("no answer of a master: {other:?}"),
    }
}

pub(super) fn message(master: &mut Master, call: &Request) -> (i32, String) {
    let (code, message, _) = answer(master, call);
    (code, message)
}

pub(super) fn notices(master: &mut Master, call: &Request) -> Vec<Notice> {
    master.apply(call).notices
}
