//! Graph resource names, resolved as in `rosgraph/names.py`.
//!
//! rosmaster resolves more names than it validates: the caller id `a/b` makes topics such as `a/t`, and
//! `/a//b` makes `/a//t`. It stores the results unchanged, so these functions accept any text.

use std::borrow::Cow;

/// The caller id of the calls that rosrescue itself makes to a master.
pub const CALLER_ID: &str = "/rosrescue";

/// rosgraph's `canonicalize_name`: removes doubled and trailing slashes.
pub(crate) fn canonicalize(name: &str) -> Cow<'_, str> {
    let global = name.starts_with('/');
    if name.len() < 2 || !(name.contains("//") || name.ends_with('/')) {
        return Cow::Borrowed(name);
    }
    let mut canonical = String::with_capacity(name.len());
    for part in parts(name) {
        if global || !canonical.is_empty() {
            canonical.push('/');
        }
        canonical.push_str(part);
    }
    if global && canonical.is_empty() {
        canonical.push('/');
    }
    Cow::Owned(canonical)
}

/// The non-empty parts of a name.
pub fn parts(name: &str) -> impl Iterator<Item = &str> {
    name.split('/').filter(|part| !part.is_empty())
}

/// rosgraph's `namespace`: everything up to and including the last slash, not counting one trailing slash.
pub(crate) fn namespace(name: &str) -> &str {
    let name = name.strip_suffix('/').unwrap_or(name);
    match name.rfind('/') {
        Some(slash) => name.get(..=slash).unwrap_or("/"),
        None => "/",
    }
}

/// rosgraph's `resolve_name`, for a non-empty name.
pub fn resolve<'a>(name: &'a str, caller_id: &str) -> Cow<'a, str> {
    let name = canonicalize(name);
    if name.starts_with('/') {
        name
    } else if let Some(rest) = name.strip_prefix('~') {
        Cow::Owned(canonicalize(&format!("{caller_id}/{rest}")).into_owned())
    } else {
        Cow::Owned(format!("{}{name}", namespace(caller_id)))
    }
}

/// rosgraph's `ns_join`: leaves a name that starts with `/` or `~` unchanged, and adds no slash after `~`.
pub(crate) fn join(namespace: &str, name: &str) -> String {
    if name.starts_with(['/', '~']) || namespace.is_empty() {
        name.to_owned()
    } else if namespace == "~" || namespace.ends_with('/') {
        format!("{namespace}{name}")
    } else {
        format!("{namespace}/{name}")
    }
}

/// The form in which rosmaster stores and announces the key of a parameter subscription: with a trailing
/// slash.
pub fn param_key(key: &str) -> String {
    let mut key = canonicalize(key).into_owned();
    if key != "/" {
        key.push('/');
    }
    key
}

/// Whether `name` has characters that rosmaster refuses in the name of a topic, service or node.
pub(crate) fn has_illegal_chars(name: &str) -> bool {
    name.contains([':', ' '])
}

/// Whether a node can register exactly this name of a topic or service. It must be global and canonical, and have no
/// illegal characters.
pub fn is_plain_topic(topic: &str) -> bool {
    topic.len() > 1
        && topic.starts_with('/')
        && !has_illegal_chars(topic)
        && canonicalize(topic) == topic
}

/// A name that the master resolves to `key` in a call of `caller_id`. Such a name exists for every key that this caller
/// has ever registered.
pub fn name_for(key: &str, caller_id: &str) -> Option<String> {
    if is_plain_topic(key) {
        return Some(key.to_owned());
    }
    spell(key, caller_id, |name| {
        !has_illegal_chars(name) && name != "/" && resolve(name, caller_id) == key
    })
}

/// A name that the master resolves to `key`, the key of a parameter subscription, in a call of `caller_id`.
pub fn param_name_for(key: &str, caller_id: &str) -> Option<String> {
    let trimmed = if key == "/" {
        key
    } else {
        key.strip_suffix('/')?
    };
    spell(trimmed, caller_id, |name| {
        param_key(&resolve(name, caller_id)) == key
    })
}

fn spell(key: &str, caller_id: &str, names: impl Fn(&str) -> bool) -> Option<String> {
    // `/` is refused as the global namespace, but `//` is accepted.
    let absolute = if key == "/" { "//" } else { key };
    if names(absolute) {
        return Some(absolute.to_owned());
    }
    let relative = key.strip_prefix(namespace(caller_id)).map(str::to_owned);
    let private = key
        .strip_prefix(caller_id)
        .map(|rest| format!("~{}", rest.trim_start_matches('/')));
    [relative, private]
        .into_iter()
        .flatten()
        .find(|name| !name.is_empty() && names(name))
}

/// A caller id and a name that the master resolves to `key`. The caller id is `preferred` if possible, and
/// must pass `usable`. `None` if no call can name `key`, as for a node that calls itself `/a/`.
pub fn reach(
    key: &str,
    preferred: &str,
    usable: impl Fn(&str) -> bool,
) -> Option<(String, String)> {
    if usable(preferred)
        && let Some(name) = name_for(key, preferred)
    {
        return Some((preferred.to_owned(), name));
    }
    let base = key.rfind('/').map_or(0, |slash| slash + 1);
    let neighbour = format!("{}rosrescue", key.get(..base).unwrap_or_default());
    [neighbour.as_str(), key]
        .into_iter()
        .filter(|caller_id| usable(caller_id))
        .find_map(|caller_id| Some((caller_id.to_owned(), name_for(key, caller_id)?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_canonicalized_as_rosgraph_does() {
        for (name, canonical) in [
            ("", ""),
            ("/", "/"),
            ("//", "/"),
            ("/a", "/a"),
            ("//a//b/", "/a/b"),
            ("a/", "a"),
            ("a//b", "a/b"),
            ("~a//b/", "~a/b"),
        ] {
            assert_eq!(canonicalize(name), canonical, "{name}");
        }
    }

    #[test]
    fn names_are_joined_as_rosgraph_does() {
        for (namespace, name, joined) in [
            ("/", "a", "/a"),
            ("/a", "b", "/a/b"),
            ("/a/", "b", "/a/b"),
            ("", "a", "a"),
            ("~", "a", "~a"),
            ("~a", "b", "~a/b"),
            ("/a", "~b", "~b"),
            ("/a", "/b", "/b"),
        ] {
            assert_eq!(join(namespace, name), joined, "{namespace} {name}");
        }
    }

    #[test]
    fn names_are_resolved_as_rosgraph_does() {
        for (name, caller_id, resolved) in [
            ("t", "/talker", "/t"),
            ("t", "/ns/talker", "/ns/t"),
            ("t", "/ns/talker/", "/ns/t"),
            ("t", "talker", "/t"),
            ("t", "a/b", "a/t"),
            ("t", "/a//b", "/a//t"),
            ("t", "", "/t"),
            ("t/", "/x", "/t"),
            ("//t//u/", "/x", "/t/u"),
            ("~t", "/x", "/x/t"),
            ("~", "talker", "talker"),
            ("~/t", "/x/", "/x/t"),
            ("~", "", "/"),
            ("a~", "/x", "/a~"),
        ] {
            assert_eq!(resolve(name, caller_id), resolved, "{name} by {caller_id}");
        }
    }

    #[test]
    fn a_caller_can_name_every_key_that_it_has_registered() {
        let callers = ["/x", "/ns/x", "x", "a/b", "/a//b", "", "/a b/c", "/x/", "/"];
        let names = ["t", "/t", "//", "~", "~t", "t/u", "~//t/"];
        for caller in callers {
            for name in names {
                let key = resolve(name, caller);
                let again = name_for(&key, caller).expect(&key);
                assert_eq!(resolve(&again, caller), key, "{name} by {caller}");
            }
        }
    }

    #[test]
    fn a_node_with_a_strange_name_can_be_looked_up() {
        for node in ["/x", "x", "a/b", "/a//b", "/a b", "/a:b/c"] {
            let (caller, name) = reach(node, CALLER_ID, |_| true).expect(node);
            assert_eq!(resolve(&name, &caller), node);
        }
        assert_eq!(reach("/a/", CALLER_ID, |_| true), None);
    }
}
