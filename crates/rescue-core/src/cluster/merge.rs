//! Decides which partition writes (writes that a computer answered while it was cut off) still hold. A partition write is
//! lost if other computers have since changed the same parameter, node, service or topic registration. It is lost even if
//! they have changed it back.
//!
//! The same rules apply twice: on the computer that was cut off, to the changes that it reads in the journal; and on
//! the leader, before it makes the writes of each request, to later changes. See decision 42.

mod changes;
mod pending;
pub mod wire;

use std::fmt;

pub(super) use self::changes::value_at;
use self::changes::{param_of, param_path};
pub use self::{
    changes::{ChangeSubject, Changes, parameter_of},
    pending::{WritesToSend, weight},
};
use ros1_master::{
    master::{Effect, Master, Method, Request, Write, names},
    xmlrpc::Value,
};

/// The caller of the calls that set a parameter again, so that nodes are notified of its value. No node has this name.
pub(super) const TELLER: &str = "/rosrescue";

/// Which partition writes are sent to the leader, and which are lost.
#[derive(Debug, Default, PartialEq)]
pub struct Merged {
    /// The writes to send to the leader, in this order.
    pub send: Vec<Request>,
    pub lost: Vec<LostWrite>,
    /// The parameters that others have set to the same value, or whose nodes have replaced the value. They may have set
    /// another value since, which nodes on this computer heard before this computer's own value.
    pub equal: Vec<String>,
}

/// A partition write that is lost because of a conflict.
#[derive(Clone, Debug, PartialEq)]
pub struct LostWrite {
    pub call: Request,
    pub why: Conflict,
    /// The parameter's value after others changed it, or a namespace around it.
    pub present: Option<Value>,
}

/// What happens to one partition write; see [`judge_write`].
#[derive(Clone, Debug, PartialEq)]
pub enum MergeVerdict {
    /// The leader makes the write, because others have not changed the same parameter, node, service or topic
    /// registration.
    Apply,
    /// The write is unnecessary: others have made the same change, what it unregisters is no longer registered, or its
    /// node has replaced it.
    Redundant,
    Overtaken(LostWrite),
}

/// What others changed during the partition, so that a partition write is lost.
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
    /// The node has registered this topic again.
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
                write!(f, "`{node}` has registered `{name}` again meanwhile")
            }
        }
    }
}

/// Separates the `pending` writes into those to send and those that are lost because of `changes` by others. `now` is
/// the others' state.
pub fn merge<'a>(
    changes: &Changes,
    now: &Master,
    pending: impl IntoIterator<Item = &'a Request>,
) -> Merged {
    let mut merged = Merged::default();
    let mut deleted = Changes::default();
    let pending: Vec<_> = pending.into_iter().collect();
    for call in pending.into_iter().rev() {
        let path = param_of(call);
        match judge_write(changes, now, call) {
            MergeVerdict::Apply => merged.send.push(call.clone()),
            MergeVerdict::Redundant => merged.equal.extend(parameter_of(call)),
            // A value that this computer itself deleted later does not count as lost.
            MergeVerdict::Overtaken(_)
                if path.as_ref().is_some_and(|path| deleted.has_above(path)) => {}
            MergeVerdict::Overtaken(lost) => merged.lost.push(lost),
        }
        if *call.method() == Method::DeleteParam {
            ChangeSubject::changed_by(call)
                .into_iter()
                .for_each(|it| deleted.add(it));
        }
    }
    merged.send.reverse();
    merged.lost.reverse();
    merged
}

/// Decides what happens to the partition write `call`, which must not be a multicall, after `changes` by others, whose
/// state is `now`.
pub fn judge_write(changes: &Changes, now: &Master, call: &Request) -> MergeVerdict {
    let Some(why) = conflict(changes, now, call) else {
        return MergeVerdict::Apply;
    };
    if changes.has_replaced(call) {
        return MergeVerdict::Redundant;
    }
    let path = param_of(call).unwrap_or_default();
    let parts: Vec<&str> = names::parts(&path).collect();
    let present = value_at(now.params(), &parts).cloned();
    if matches!(why, Conflict::Parameter(_)) && !parts.is_empty() {
        let wanted = Write::parse(call).and_then(|write| write.value());
        if wanted == present.as_ref() {
            return MergeVerdict::Redundant;
        }
    }
    // The present owner of the name or service has already ended that registration.
    let over = matches!(why, Conflict::Node { .. } | Conflict::Service { .. });
    if over && Write::parse(call).is_some_and(|write| write.unregisters()) {
        return MergeVerdict::Redundant;
    }
    let call = call.clone();
    MergeVerdict::Overtaken(LostWrite { call, why, present })
}

fn conflict(changes: &Changes, now: &Master, call: &Request) -> Option<Conflict> {
    let write = Write::parse(call)?;
    let caller = write.caller;
    let node = |api| node(changes, now, caller, api);
    let registered_again = |publishes, topic: &str| {
        let subject = ChangeSubject::Topic {
            publishes,
            topic: topic.to_owned(),
            node: caller.to_owned(),
        };
        let registered = changes.has(&subject) && now.has_topic(caller, publishes, topic);
        registered.then(|| Conflict::Registration {
            name: topic.to_owned(),
            node: caller.to_owned(),
        })
    };
    match &write.effect {
        Effect::SetParam { key, .. } | Effect::DeleteParam { key } => {
            let changed = changes.has_param(&param_path(key));
            changed.then(|| Conflict::Parameter(key.to_string()))
        }
        Effect::RegisterPublisher { api, .. } | Effect::RegisterSubscriber { api, .. } => node(api),
        Effect::UnregisterPublisher { topic, api } => {
            node(api).or_else(|| registered_again(true, topic))
        }
        Effect::UnregisterSubscriber { topic, api } => {
            node(api).or_else(|| registered_again(false, topic))
        }
        Effect::RegisterService {
            service: name,
            service_api,
            api,
        } => node(api).or_else(|| service(changes, now, name, service_api)),
        Effect::UnregisterService {
            service: name,
            service_api,
        } => service(changes, now, name, service_api),
        Effect::SubscribeParam { api, .. } | Effect::UnsubscribeParam { api, .. } => node(api),
    }
}

/// Whether others have a node `caller` at another address than `api`. A registration would end that node.
fn node(changes: &Changes, now: &Master, caller: &str, api: &str) -> Option<Conflict> {
    let holder = now.api_of(caller).filter(|holder| *holder != api)?;
    let theirs = changes.has(&ChangeSubject::Node(caller.to_owned()));
    theirs.then(|| Conflict::Node {
        name: caller.to_owned(),
        api: holder.to_owned(),
    })
}

/// Whether another node provides the service that is at `api` on this computer.
fn service(changes: &Changes, now: &Master, name: &str, api: &str) -> Option<Conflict> {
    let provider = now.registry().services.get(name)?;
    let theirs = changes.has(&ChangeSubject::Service(name.to_owned()));
    (provider.api != api && theirs).then(|| Conflict::Service {
        name: name.to_owned(),
        node: provider.node.clone(),
    })
}

#[cfg(test)]
mod tests;
