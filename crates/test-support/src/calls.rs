//! Short ways to make calls to a master, and to read their answers.

use ros1_master::{
    master::{Entry, Malformed, Master, Method, Notice, Request},
    xmlrpc::{Reply, Struct, Value},
};

/// A call whose parameters are all strings.
pub fn call(method: &str, params: &[&str]) -> Request {
    Request::new(Method::named(method), params.iter().copied())
}

pub fn set(key: &str, value: impl Into<Value>) -> Request {
    Request::new(
        Method::SetParam,
        [Value::from("/set"), key.into(), value.into()],
    )
}

pub fn tree<const N: usize>(members: [(&str, Value); N]) -> Value {
    Value::Struct(Struct::from(
        members.map(|(key, value)| (key.to_owned(), value)),
    ))
}

pub fn publish(node: &str, topic: &str, topic_type: &str) -> Request {
    call("registerPublisher", &[node, topic, topic_type, &api(node)])
}

pub fn subscribe(node: &str, topic: &str, topic_type: &str) -> Request {
    call("registerSubscriber", &[node, topic, topic_type, &api(node)])
}

pub fn provide(node: &str, service: &str) -> Request {
    call(
        "registerService",
        &[node, service, &format!("rosrpc://h{node}"), &api(node)],
    )
}

pub fn watch(node: &str, key: &str) -> Request {
    call("subscribeParam", &[node, &api(node), key])
}

pub fn api(node: &str) -> String {
    format!("http://h{node}")
}

/// A master that has run these calls.
pub fn after(calls: impl IntoIterator<Item = Request>) -> Master {
    let mut master = Master::default();
    for call in calls {
        master.apply(&call);
    }
    master
}

/// Code, message and value of the answer to `call`.
pub fn answer(master: &mut Master, call: &Request) -> (i32, String, Value) {
    match master.apply(call).reply {
        Reply::Value(Value::Array(answer)) => match answer.as_slice() {
            [Value::Int(code), Value::String(message), value] => {
                (*code, message.clone(), value.clone())
            }
            other => panic!("not a master's answer: {other:?}"),
        },
        other => panic!("not a master's answer: {other:?}"),
    }
}

pub fn message(master: &mut Master, call: &Request) -> (i32, String) {
    let (code, message, _) = answer(master, call);
    (code, message)
}

pub fn notices(master: &mut Master, call: &Request) -> Vec<Notice> {
    master.apply(call).notices
}

/// Adds a malformed entry at the end of a multicall.
pub fn malformed(call: Request) -> Request {
    let mut entries = call.into_entries();
    entries.push(Entry::Malformed(Malformed::Arity));
    Request::of_entries(entries)
}
