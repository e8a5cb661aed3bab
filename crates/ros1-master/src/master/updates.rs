//! The subscribers to notify of a changed parameter: `compute_param_updates` of `rosmaster/paramserver.py`.

use std::{collections::HashSet, sync::LazyLock};

use super::api::Failure;
use super::names;
use super::registry::Registrations;
use crate::xmlrpc::{Struct, Value};

/// The value of a deleted parameter in a `paramUpdate`.
pub(crate) static GONE: LazyLock<Value> = LazyLock::new(|| Value::Struct(Struct::new()));

/// A `paramUpdate` to the subscribers of one key. Its value is that of the call, or a part of it.
pub(crate) struct Update<'a> {
    pub(crate) nodes: &'a [String],
    /// The one of them that made the change: it is not notified.
    pub(crate) ignored: Option<&'a str>,
    pub(crate) key: &'a str,
    pub(crate) value: &'a Value,
}

/// The updates of `key`, which ends in a slash and has this value now. None go to `ignored`.
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
        // Cut off by the length of the key that was set, even if this key does not start with it.
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

/// `_compute_all_keys`, without keys that have no subscribers: all keys together can be far longer than the
/// call, because each contains the names of all its parents.
struct Below<'a> {
    subscribers: &'a Registrations,
    /// Length of the longest subscribed key.
    longest: usize,
    /// Each key with its subscribers, in the order of the members.
    found: Vec<(&'a str, &'a [String])>,
}

impl Below<'_> {
    /// Finds subscribed keys among `members`, whose key is `key`, which is left unchanged.
    fn find(&mut self, key: &mut String, members: &Struct) {
        for (name, value) in members {
            // As in `ns_join`: such a name is not joined.
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

/// Members with a slash in their names are announced, but then not found.
fn descend<'a>(value: &'a Value, path: &str) -> Result<&'a Value, Failure> {
    names::parts(path).try_fold(value, |value, part| match value {
        Value::Struct(members) => {
            let member = members.get(part);
            member.ok_or(Failure::Internal("a member's name holds a slash"))
        }
        _ => Err(Failure::Type("a member's name holds a slash")),
    })
}
