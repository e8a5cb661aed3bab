//! What of the writes that a computer has answered while it was alone still holds: all but those about
//! something that was changed meanwhile, where the others are. What was changed is seen by comparing the
//! state at which the computer was cut off with the present one. A parameter that has a value which was written
//! alone, too, was not changed by others: that write had reached them before.

use std::{collections::HashMap, fmt};

use crate::{
    master::{Master, Method, Request, names},
    xmlrpc::{Struct, Value},
};

/// What becomes of the writes.
#[derive(Debug, Default, PartialEq)]
pub struct Merged {
    /// To be sent to the leader, in this order.
    pub send: Vec<Request>,
    pub lost: Vec<Lost>,
}

/// A write that does not hold.
#[derive(Debug, PartialEq)]
pub struct Lost {
    pub call: Request,
    pub why: Conflict,
}

/// What was changed meanwhile by others.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Conflict {
    Parameter(String),
    /// Another node has this name.
    Node {
        name: String,
        api: String,
    },
    /// Another node provides this service.
    Service {
        name: String,
        node: String,
    },
    /// The node has registered this anew.
    Registration {
        name: String,
        node: String,
    },
}

impl fmt::Display for Conflict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Parameter(key) => write!(f, "the parameter `{key}` was changed meanwhile"),
            Self::Node { name, api } => {
                write!(
                    f,
                    "another node was registered as `{name}` meanwhile, at {api}"
                )
            }
            Self::Service { name, node } => {
                write!(
                    f,
                    "the service `{name}` was registered meanwhile by `{node}`"
                )
            }
            Self::Registration { name, node } => {
                write!(f, "`{node}` has registered `{name}` anew meanwhile")
            }
        }
    }
}

/// Separates `pending`, writes that were answered from the state `base` on, in order. `now` is the state
/// where the others are.
pub fn merge(base: &Master, now: &Master, pending: &[Request]) -> Merged {
    let mut merged = Merged::default();
    // The first write of each parameter: it may have been on its way when this computer was cut off.
    let mut written: HashMap<String, Value> = HashMap::new();
    for call in pending.iter().flat_map(Request::calls) {
        if let (Method::SetParam, Some(caller), [_, key, value, ..]) =
            (call.method(), call.caller(), call.params())
            && let Some(key) = key.as_str()
        {
            let key = names::resolve(key, caller);
            written.entry(key).or_insert_with(|| value.clone());
        }
    }
    let has_arrived = |why: &Conflict| {
        let Conflict::Parameter(key) = why else {
            return false;
        };
        let path: Vec<&str> = names::parts(key).collect();
        let present = value_at(now.params(), &path);
        written.get(key).is_some_and(|value| Some(value) == present)
    };
    for call in pending.iter().flat_map(Request::calls) {
        let call = call.clone();
        match conflict(base, now, &call).filter(|why| !has_arrived(why)) {
            Some(why) => merged.lost.push(Lost { call, why }),
            None => merged.send.push(call),
        }
    }
    merged
}

fn conflict(base: &Master, now: &Master, call: &Request) -> Option<Conflict> {
    let caller = call.caller()?;
    let name = |at: usize| Some(names::resolve(call.text(at)?, caller));
    let node = |at: usize| node(base, now, caller, call.text(at)?);
    let anew = |topic: String, of: fn(&Master, &str, &str) -> bool| {
        let registered = of(now, &topic, caller) && !of(base, &topic, caller);
        registered.then(|| Conflict::Registration {
            name: topic,
            node: caller.to_owned(),
        })
    };
    match call.method() {
        Method::SetParam | Method::DeleteParam => {
            let key = name(1)?;
            let path: Vec<&str> = names::parts(&key).collect();
            is_changed(base.params(), now.params(), &path).then_some(Conflict::Parameter(key))
        }
        Method::RegisterPublisher | Method::RegisterSubscriber => node(3),
        Method::UnregisterPublisher => node(2).or_else(|| {
            anew(name(1)?, |master, topic, node| {
                master.publications(node).any(|of| of == topic)
            })
        }),
        Method::UnregisterSubscriber => node(2).or_else(|| {
            anew(name(1)?, |master, topic, node| {
                master.subscriptions(node).any(|of| of == topic)
            })
        }),
        Method::RegisterService => node(3).or_else(|| service(base, now, &name(1)?, call.text(2)?)),
        Method::UnregisterService => service(base, now, &name(1)?, call.text(2)?),
        Method::SubscribeParam | Method::UnsubscribeParam => node(1),
        _ => None,
    }
}

/// Whether another node has taken the name `caller`, which is at `api` here. A registration would end it.
fn node(base: &Master, now: &Master, caller: &str, api: &str) -> Option<Conflict> {
    let holder = now.api_of(caller).filter(|holder| *holder != api)?;
    (base.api_of(caller) != Some(holder)).then(|| Conflict::Node {
        name: caller.to_owned(),
        api: holder.to_owned(),
    })
}

/// Whether another node provides the service that is at `api` here.
fn service(base: &Master, now: &Master, name: &str, api: &str) -> Option<Conflict> {
    let provider = now.registry.services.get(name)?;
    let before = base.registry.services.get(name);
    (provider.api != api && before != Some(provider)).then(|| Conflict::Service {
        name: name.to_owned(),
        node: provider.node.clone(),
    })
}

fn value_at<'a>(tree: &'a Struct, path: &[&str]) -> Option<&'a Value> {
    let (first, rest) = path.split_first()?;
    match (tree.get(*first)?, rest) {
        (value, []) => Some(value),
        (Value::Struct(below), rest) => value_at(below, rest),
        _ => None,
    }
}

/// Whether anything at or below `path` differs, or a namespace above it has become a value.
fn is_changed(base: &Struct, now: &Struct, path: &[&str]) -> bool {
    let Some((first, rest)) = path.split_first() else {
        return base != now;
    };
    match (base.get(*first), now.get(*first)) {
        (was, is) if rest.is_empty() => was != is,
        (Some(Value::Struct(was)), Some(Value::Struct(is))) => is_changed(was, is, rest),
        (None, Some(Value::Struct(is))) => is_changed(&Struct::new(), is, rest),
        (Some(Value::Struct(was)), None) => is_changed(was, &Struct::new(), rest),
        (was, is) => was != is,
    }
}

#[cfg(test)]
mod tests;
