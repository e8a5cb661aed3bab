//! Masters whose dictionaries have no order of their own: Python 2. Their answers show an order that no call has
//! made, and that another master with the same state may not have.

use indexmap::IndexMap;

use crate::xmlrpc::{Reply, Struct, Value};

/// Puts `found` into the order of `known`. What only `found` has comes last, as it is.
pub(super) fn arrange<A, B>(found: &mut IndexMap<String, A>, known: &IndexMap<String, B>) {
    let place = |key: &str| known.get_index_of(key).unwrap_or(usize::MAX);
    found.sort_by(|a, _, b, _| place(a).cmp(&place(b)));
}

/// As [`arrange`], with the structs within.
pub(super) fn arrange_params(found: &mut Struct, known: &Struct) {
    if found == known {
        return;
    }
    arrange(found, known);
    for (key, value) in found.iter_mut() {
        if let (Value::Struct(found), Some(Value::Struct(known))) = (value, known.get(key)) {
            arrange_params(found, known);
        }
    }
}

/// Whether two replies are the same but for the order of members of structs.
pub(super) fn are_alike(a: &Reply, b: &Reply) -> bool {
    match (a, b) {
        (Reply::Value(a), Reply::Value(b)) => sorted(a, false) == sorted(b, false),
        _ => a == b,
    }
}

/// `value` with the members of its structs sorted. `lists`: with lists of `[name, …]` sorted, too.
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
    fn what_is_read_gets_the_known_order() {
        let known = tree(&["c", "a", "b"]);
        let mut found = tree(&["a", "b", "c"]);
        arrange_params(&mut found, &known);
        assert_eq!(found, known);
        let mut more = tree(&["x", "a", "b", "c"]);
        arrange_params(&mut more, &known);
        assert_eq!(more.keys().collect::<Vec<_>>(), ["c", "a", "b", "x"]);
    }

    #[test]
    fn only_the_order_of_dictionaries_is_no_difference() {
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
        // Nodes are kept in lists.
        let nodes = |names: [&str; 2]| Value::Array(names.map(Value::from).into());
        assert_ne!(
            sorted(&nodes(["/n", "/m"]), true),
            sorted(&nodes(["/m", "/n"]), true)
        );
    }
}
