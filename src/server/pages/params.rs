//! Parameters as the page shows them. Hides the values that the operator wants hidden, and lists a part of the tree at
//! a time, so that even 100,000 parameters are no problem.

use rescue_core::hide::{Hide, Masked};
use ros1_master::xmlrpc::{Struct, Value};
use serde::Serialize;

/// Maximum number of entries in one answer. The answer says where entries are left out, and the page can ask for them.
const ENTRIES: usize = 1000;
/// Maximum number of characters of a value. A robot description may have a million.
const TEXT: usize = 2000;
/// Maximum number of results of a search.
const FOUND: usize = 200;

/// A parameter or a namespace.
#[derive(Debug, PartialEq, Eq, Serialize)]
pub(super) struct ParamEntry {
    /// The last part of the name. In search results, the whole name.
    name: String,
    /// `namespace`, or the type of the value as rosparam calls it.
    #[serde(rename = "type")]
    kind: &'static str,
    /// The value as text. `None` if it is hidden.
    #[serde(skip_serializing_if = "Option::is_none")]
    value: Option<String>,
    /// Whether the value is shortened.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    cut: bool,
    /// Whether the value is hidden.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    hidden: bool,
    /// The members of a namespace. `None` if they were left out and must be asked for.
    #[serde(flatten)]
    members: Option<Members>,
    /// Number of parameters in a namespace and below it.
    #[serde(skip_serializing_if = "Option::is_none")]
    count: Option<usize>,
}

/// The members of a namespace, sorted by name.
#[derive(Debug, Default, PartialEq, Eq, Serialize)]
pub(super) struct Members {
    members: Vec<ParamEntry>,
    /// Number of members that are left out.
    more: usize,
}

/// The members of the namespace `name`. `None` if there is no such namespace.
pub(super) fn members(tree: &Struct, name: &str, hide: &Hide) -> Option<Members> {
    let mut namespace = tree;
    for part in name.split('/').filter(|part| !part.is_empty()) {
        let Some(Value::Struct(inner)) = namespace.get(part) else {
            return None;
        };
        namespace = inner;
    }
    let mut room = ENTRIES;
    let name = name.trim_end_matches('/');
    Some(list(namespace, name, hide, &mut room))
}

/// Lists members of a namespace, and reduces `room` by their number.
fn list(namespace: &Struct, name: &str, hide: &Hide, room: &mut usize) -> Members {
    let mut sorted: Vec<_> = namespace.iter().collect();
    sorted.sort_by_key(|(name, _)| *name);
    let shown = sorted.len().min(*room);
    *room -= shown;
    let members = sorted.iter().take(shown).map(|(part, value)| {
        let name = format!("{name}/{part}");
        match value {
            Value::Struct(inner) if !inner.is_empty() => {
                let (count, entries) = size(inner);
                let members = (entries <= *room).then(|| list(inner, &name, hide, room));
                ParamEntry {
                    members,
                    count: Some(count),
                    ..ParamEntry::named((*part).clone(), "namespace")
                }
            }
            value => ParamEntry::new((*part).clone(), &name, value, hide),
        }
    });
    Members {
        members: members.collect(),
        more: sorted.len() - shown,
    }
}

/// The number of parameters below `namespace`, without and with namespaces.
fn size(namespace: &Struct) -> (usize, usize) {
    let sizes = namespace.values().map(|value| match value {
        Value::Struct(inner) if !inner.is_empty() => {
            let (count, entries) = size(inner);
            (count, entries + 1)
        }
        _ => (1, 1),
    });
    sizes.fold((0, 0), |(a, b), (c, d)| (a + c, b + d))
}

/// Finds the parameters with `text` in their full names, in upper or lower case. Values are not searched, because that
/// would reveal hidden ones.
pub(super) fn search(tree: &Struct, text: &str, hide: &Hide) -> Members {
    let mut found = Members::default();
    collect(tree, "", &text.to_lowercase(), hide, &mut found);
    found.members.sort_by(|a, b| a.name.cmp(&b.name));
    found
}

fn collect(namespace: &Struct, above: &str, text: &str, hide: &Hide, found: &mut Members) {
    for (part, value) in namespace {
        let name = format!("{above}/{part}");
        match value {
            Value::Struct(inner) if !inner.is_empty() => collect(inner, &name, text, hide, found),
            _ if !name.to_lowercase().contains(text) => {}
            _ if found.members.len() == FOUND => found.more += 1,
            value => found
                .members
                .push(ParamEntry::new(name.clone(), &name, value, hide)),
        }
    }
}

impl ParamEntry {
    fn named(name: String, kind: &'static str) -> Self {
        Self {
            name,
            kind,
            value: None,
            cut: false,
            hidden: false,
            members: None,
            count: None,
        }
    }

    /// Makes the entry of a parameter. `name` is the name to show, `full` the parameter's full name.
    fn new(name: String, full: &str, value: &Value, hide: &Hide) -> Self {
        let kind = match value {
            Value::Nil => "none",
            Value::Bool(_) => "bool",
            Value::Int(_) | Value::BigInt(_) => "int",
            Value::Double(_) => "double",
            Value::BigDecimal(_) => "decimal",
            Value::String(_) => "str",
            Value::DateTime(_) => "date",
            Value::Base64(_) => "binary",
            Value::Array(_) => "list",
            Value::Struct(_) => "dict",
        };
        if hide.hides(full) {
            return Self {
                hidden: true,
                ..Self::named(name, kind)
            };
        }
        let mut text = text_of(&hide.mask(full, value));
        let end = text.char_indices().nth(TEXT).map(|(end, _)| end);
        if let Some(end) = end {
            text.truncate(end);
        }
        Self {
            value: Some(text),
            cut: end.is_some(),
            ..Self::named(name, kind)
        }
    }
}

/// The value in one line, longer than the length that can be shown if it must be shortened.
fn text_of(value: &Masked<'_>) -> String {
    let mut text = String::new();
    match value.value() {
        Value::String(words) => text.extend(words.chars().take(TEXT + 1)),
        value => write(value, &mut text),
    }
    text
}

/// Writes a value in one line, and stops soon after the length that can be shown.
fn write(value: &Value, to: &mut String) {
    if to.len() > 4 * TEXT {
        return;
    }
    match value {
        Value::Nil => to.push_str("null"),
        Value::Bool(truth) => to.push_str(if *truth { "true" } else { "false" }),
        Value::Int(number) => to.push_str(&number.to_string()),
        Value::Double(number) => to.push_str(&format!("{number:?}")),
        Value::BigInt(text) | Value::BigDecimal(text) | Value::DateTime(text) => to.push_str(text),
        Value::String(text) => {
            to.push('"');
            to.extend(text.chars().take(TEXT));
            to.push('"');
        }
        Value::Base64(bytes) => to.push_str(&format!("{} bytes", bytes.len())),
        Value::Array(elements) => {
            to.push('[');
            for (index, element) in elements.iter().enumerate() {
                if index > 0 {
                    to.push_str(", ");
                }
                write(element, to);
            }
            to.push(']');
        }
        Value::Struct(members) => {
            to.push('{');
            for (index, (name, value)) in members.iter().enumerate() {
                if index > 0 {
                    to.push_str(", ");
                }
                to.push_str(&format!("{name}: "));
                write(value, to);
            }
            to.push('}');
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree(members: &[(&str, Value)]) -> Struct {
        members.into()
    }

    fn json(of: &impl Serialize) -> serde_json::Value {
        serde_json::to_value(of).unwrap()
    }

    #[test]
    fn a_tree_is_sorted_and_shows_values_but_the_hidden_ones() {
        let hide = "password|secret".parse().unwrap();
        let login = tree(&[("user", "me".into()), ("Password", "hunter2".into())]);
        let logins = Value::Array(vec![Value::Struct(login.clone()), 0.5.into()]);
        let given = tree(&[
            ("wifi", Value::Struct(login)),
            ("secret", Value::Struct(tree(&[("a", 1.into())]))),
            ("rate", 10.0.into()),
            ("list", logins),
            ("empty", Value::Struct(tree(&[]))),
        ]);
        let shown = json(&members(&given, "", &hide));
        let expected = serde_json::json!({"more": 0, "members": [
            {"name": "empty", "type": "dict", "value": "{}"},
            {"name": "list", "type": "list", "value": "[{user: \"me\", Password: \"(hidden)\"}, 0.5]"},
            {"name": "rate", "type": "double", "value": "10.0"},
            {"name": "secret", "type": "namespace", "count": 1, "more": 0, "members": [
                {"name": "a", "type": "int", "hidden": true}]},
            {"name": "wifi", "type": "namespace", "count": 2, "more": 0, "members": [
                {"name": "Password", "type": "str", "hidden": true},
                {"name": "user", "type": "str", "value": "me"}]},
        ]});
        assert_eq!(shown, expected);
        let found = json(&search(&given, "PASS", &hide));
        let expected = serde_json::json!({"more": 0, "members": [
            {"name": "/wifi/Password", "type": "str", "hidden": true}]});
        assert_eq!(found, expected);
        assert_eq!(search(&given, "hunter", &hide), Members::default());
        assert_eq!(members(&given, "/rate", &hide), None);
        assert_eq!(
            json(&members(&given, "/wifi/", &hide))["members"][1]["value"],
            "me"
        );
    }

    #[test]
    fn a_large_tree_is_sent_in_parts() {
        let hide = "".parse().unwrap();
        let many = |count: usize| {
            let members = (0..count).map(|index| (format!("p{index:06}"), Value::Int(1)));
            Value::Struct(members.collect())
        };
        let given = tree(&[("big", many(100_000)), ("small", many(10))]);
        let shown = json(&members(&given, "/", &hide));
        assert_eq!(shown["members"][0]["count"], 100_000);
        assert!(shown["members"][0]["members"].is_null());
        assert_eq!(shown["members"][1]["members"].as_array().unwrap().len(), 10);
        let part = members(&given, "/big", &hide).unwrap();
        assert_eq!(
            (part.members.len(), part.more),
            (ENTRIES, 100_000 - ENTRIES)
        );
        let found = search(&given, "p09", &hide);
        assert_eq!((found.members.len(), found.more), (FOUND, 10_000 - FOUND));
        let long = tree(&[("long", Value::from("ü".repeat(1_000_000)))]);
        let shown = json(&members(&long, "", &hide));
        assert_eq!(shown["members"][0]["cut"], true);
        assert_eq!(shown["members"][0]["value"], "ü".repeat(TEXT));
    }
}
