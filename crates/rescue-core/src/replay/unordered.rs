//! Compares masters with unordered dictionaries, as on Python 2. Their answers show an order that no call has
//! determined, and that another master with the same state may not have.

use std::collections::HashMap;

use indexmap::IndexMap;

use ros1_master::xmlrpc::{Reply, Struct, Value};

/// Puts `found` into the order of `known`. Whatever only `found` has comes last, in its own order.
pub(super) fn arrange<'k, A>(
    found: &mut IndexMap<String, A>,
    known: impl Iterator<Item = &'k String>,
) {
    let known: HashMap<&str, usize> = known.map(String::as_str).zip(0..).collect();
    let place = |key: &str| known.get(key).copied().unwrap_or(usize::MAX);
    found.sort_by(|a, _, b, _| place(a).cmp(&place(b)));
}

/// Like [`arrange`], but also orders the structs inside `found`, including those in lists.
pub(super) fn arrange_params(found: &mut Struct, known: &Struct) {
    if found == known {
        return;
    }
    arrange(found, known.keys());
    for (key, value) in found.iter_mut() {
        if let Some(known) = known.get(key) {
            arrange_value(value, known);
        }
    }
}

fn arrange_value(found: &mut Value, known: &Value) {
    match (found, known) {
        (Value::Struct(found), Value::Struct(known)) => arrange_params(found, known),
        (Value::Array(found), Value::Array(known)) => {
            for (found, known) in found.iter_mut().zip(known) {
                arrange_value(found, known);
            }
        }
        _ => {}
    }
}

/// Whether two replies are equal apart from the order of struct members.
pub(super) fn are_alike(a: &Reply, b: &Reply) -> bool {
    match (a, b) {
        (Reply::Value(a), Reply::Value(b)) => a.equals_in_any_order(b),
        _ => a == b,
    }
}

/// `value` with the members of its structs sorted. With `lists`, lists whose elements all have the form `[name, …]` are
/// sorted by name as well.
pub(super) fn sorted(value: &Value, lists: bool) -> Value {
    match value {
        Value::Struct(members) => {
            let mut members: Vec<_> = members
                .iter()
                .map(|(key, value)| (key.clone(), sorted(value, lists)))
                .collect();
            members.sort_by(|(a, _), (b, _)| a.cmp(b));
            Value::Struct(members.into_iter().collect())
        }
        Value::Array(elements) => {
            let mut elements: Vec<_> = elements.iter().map(|value| sorted(value, lists)).collect();
            let are_named = elements.iter().all(|element| name(element).is_some());
            if lists && are_named {
                elements.sort_by(|a, b| name(a).cmp(&name(b)));
            }
            Value::Array(elements)
        }
        other => other.clone(),
    }
}

fn name(element: &Value) -> Option<&str> {
    element.as_array()?.first()?.as_str()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree(keys: &[&str]) -> Struct {
        let inner: Struct = keys
            .iter()
            .map(|key| ((*key).to_owned(), 1.into()))
            .collect();
        let outer = keys.iter().map(|key| ((*key).to_owned(), inner.clone()));
        outer
            .map(|(key, inner)| (key, Value::Struct(inner)))
            .collect()
    }

    #[test]
    fn a_state_read_from_an_unordered_master_gets_the_known_order() {
        let known = tree(&["c", "a", "b"]);
        let mut found = tree(&["a", "b", "c"]);
        arrange_params(&mut found, &known);
        assert_eq!(found, known);
        let mut more = tree(&["x", "a", "b", "c"]);
        arrange_params(&mut more, &known);
        assert_eq!(more.keys().collect::<Vec<_>>(), ["c", "a", "b", "x"]);
        // The controllers of a robot are a list of dictionaries.
        let list = |tree: Struct| {
            Struct::from([("list".to_owned(), Value::Array(vec![Value::Struct(tree)]))])
        };
        let mut found = list(tree(&["a", "b", "c"]));
        arrange_params(&mut found, &list(known.clone()));
        assert_eq!(found, list(known));
    }

    #[test]
    fn two_replies_are_alike_if_only_the_order_of_dictionaries_differs() {
        let list = |names: &[&str]| -> Value {
            let pairs = names.iter().map(|name| vec![(*name).into(), "type".into()]);
            Value::Array(pairs.map(Value::Array).collect())
        };
        let (a, b) = (list(&["/a", "/b"]), list(&["/b", "/a"]));
        assert_eq!(sorted(&a, true), sorted(&b, true));
        assert_ne!(sorted(&a, false), sorted(&b, false));
        assert_ne!(sorted(&a, true), sorted(&list(&["/a", "/c"]), true));
        let of = |keys: &[&str]| Reply::Value(Value::Struct(tree(keys)));
        assert!(are_alike(&of(&["a", "b"]), &of(&["b", "a"])));
        assert!(!are_alike(&of(&["a", "b"]), &of(&["b", "c"])));
        // Lists of nodes are ordered.
        let nodes = |names: [&str; 2]| Value::Array(names.map(Value::from).into());
        assert_ne!(
            sorted(&nodes(["/n", "/m"]), true),
            sorted(&nodes(["/m", "/n"]), true)
        );
    }
}
