//! Finds the subscribers to notify of a changed parameter, like `compute_param_updates` of `rosmaster/paramserver.py`.

use std::{collections::HashSet, sync::LazyLock};

use super::api::Failure;
use super::names;
use super::registry::Registrations;
use crate::xmlrpc::{Struct, Value};

/// The value of a deleted parameter in a `paramUpdate`.
pub(crate) static GONE: LazyLock<Value> = LazyLock::new(|| Value::Struct(Struct::new()));

const HOLDS_SLASH: &str = "a member's name holds a slash";

/// A `paramUpdate` to the subscribers of one key. Its value is the value that the call sets, a part of that value, or
/// [`GONE`].
pub(crate) struct Update<'a> {
    pub(crate) nodes: &'a [String],
    /// The node that made the change and so is not notified.
    pub(crate) ignored: Option<&'a str>,
    pub(crate) key: &'a str,
    pub(crate) value: &'a Value,
}

/// The updates caused by setting `key`, which ends in a slash, to `value`. The node `ignored` gets no updates for `key`
/// itself.
pub(crate) fn updates<'a>(
    subscribers: &'a Registrations,
    key: &'a str,
    value: &'a Value,
    ignored: Option<&'a str>,
) -> Result<Vec<Update<'a>>, Failure> {
    if subscribers.is_empty() {
        return Ok(Vec::new());
    }
    let mut below = Below {
        subscribers,
        longest: subscribers.keys().map(String::len).max().unwrap_or(0),
        found: Vec::new(),
    };
    let members = value.as_struct();
    if let Some(members) = members {
        below.find(&mut key.to_owned(), members);
    }
    let set: HashSet<&str> = below.found.iter().map(|(key, _)| *key).collect();
    let mut updates = Vec::new();
    for (subscribed, nodes) in subscribers {
        if key.starts_with(subscribed.as_str()) {
            updates.push(Update {
                nodes,
                ignored,
                key,
                value,
            });
        } else if members.is_some()
            && subscribed.starts_with(key)
            && !set.contains(subscribed.as_str())
        {
            updates.push(Update {
                nodes,
                ignored: None,
                key: subscribed,
                value: &GONE,
            });
        }
    }
    let length = key.chars().count();
    for (changed, nodes) in below.found {
        // To get the path of a changed key below `key`, rosmaster cuts off as many characters as `key` has, even if the
        // changed key does not start with `key`.
        let rest: String = changed.chars().skip(length).collect();
        updates.push(Update {
            nodes,
            ignored: None,
            key: changed,
            value: descend(value, &rest)?,
        });
    }
    Ok(updates)
}

/// rosmaster's `_compute_all_keys`, but only for keys that have subscribers. All keys together can be far
/// longer than the call, because each one contains the names of all its parents.
struct Below<'a> {
    subscribers: &'a Registrations,
    /// Length of the longest key that has subscribers.
    longest: usize,
    /// Each key found with its subscribers, in the order of the members.
    found: Vec<(&'a str, &'a [String])>,
}

impl Below<'_> {
    /// Finds keys with subscribers among `members` of the namespace `key`. Restores `key` at the end.
    fn find(&mut self, key: &mut String, members: &Struct) {
        for (name, value) in members {
            // rosgraph's `ns_join` does not join a name that starts with `/` or `~` to the namespace.
            let mut alone = String::new();
            let key = match name.starts_with(['/', '~']) {
                true => &mut alone,
                false => &mut *key,
            };
            let length = key.len();
            key.push_str(name);
            key.push('/');
            if key.len() <= self.longest
                && let Some((key, nodes)) = self.subscribers.get_key_value(key.as_str())
            {
                self.found.push((key, nodes));
            }
            if let Value::Struct(inner) = value {
                self.find(key, inner);
            }
            key.truncate(length);
        }
    }
}

/// Finds the value at `path`. Like rosmaster, fails if the name of a member on the path contains a slash.
fn descend<'a>(value: &'a Value, path: &str) -> Result<&'a Value, Failure> {
    names::parts(path).try_fold(value, |value, part| match value {
        Value::Struct(members) => {
            let member = members.get(part);
            member.ok_or(Failure::Internal(HOLDS_SLASH))
        }
        Value::DateTime(_) | Value::Base64(_) => Err(Failure::Instance(HOLDS_SLASH)),
        _ => Err(Failure::Type(HOLDS_SLASH)),
    })
}
