//! Finds out which parameter values a master can return. A master also accepts values that Python's
//! `xmlrpc.client.dumps` cannot encode, so it can never return them.

use crate::xmlrpc::{MAX_REPLY_DEPTH, Reply, Struct, Value, decode_reply, encode_reply, refusal};

/// The text of the fault that rosmaster answers when it cannot encode this reply. `None` if it can.
pub(crate) fn reply_error(reply: &Value) -> Option<&'static str> {
    error_within(reply, 0)
}

/// The text of the fault that rosmaster answers when it cannot encode this value of a parameter in a reply `[code,
/// message, value]`. `None` if it can.
pub(crate) fn param_error(value: &Value) -> Option<&'static str> {
    error_within(value, 1)
}

fn error_within(value: &Value, depth: usize) -> Option<&'static str> {
    let deeper = |value| error_within(value, depth + 1);
    refusal(value, depth).or_else(|| match value {
        Value::Array(elements) => elements.iter().find_map(deeper),
        Value::Struct(members) => members.values().find_map(deeper),
        _ => None,
    })
}

/// Whether a reply can contain this value where `levels` more levels of nesting are allowed.
fn is_returnable(value: &Value, levels: usize) -> bool {
    error_within(value, MAX_REPLY_DEPTH - levels).is_none() && !holds_markup(value)
}

/// Whether the text of a date breaks the XML of a reply, because CPython does not escape it.
fn holds_markup(value: &Value) -> bool {
    match value {
        Value::DateTime(text) if text.contains(['<', '>', '&']) => {
            let reply = Reply::Value(value.clone());
            decode_reply(&encode_reply(&reply)).as_ref() != Ok(&reply)
        }
        Value::Array(elements) => elements.iter().any(holds_markup),
        Value::Struct(members) => members.values().any(holds_markup),
        _ => false,
    }
}

/// Deepest nesting of a namespace that a multicall can return with the whole tree. The lists of the result, the entry
/// and the answer take the other levels.
const DEEPEST_NAMESPACE: usize = MAX_REPLY_DEPTH - 4;

/// Whether a multicall can return the whole tree in one piece.
pub fn is_writable(tree: &Struct) -> bool {
    tree.values().all(is_readable)
}

/// Whether a multicall can return this value of the tree.
pub fn is_readable(value: &Value) -> bool {
    is_returnable(value, DEEPEST_NAMESPACE)
}

/// The tree without the values that a master accepts but cannot return, and the keys that were left out.
pub fn writable(tree: &Struct) -> (Struct, Vec<String>) {
    let mut left_out = Vec::new();
    let kept = keep_writable(tree, "", DEEPEST_NAMESPACE, &mut left_out);
    (kept, left_out)
}

fn keep_writable(tree: &Struct, path: &str, levels: usize, left_out: &mut Vec<String>) -> Struct {
    let mut kept = Struct::with_capacity(tree.len());
    for (key, value) in tree {
        let path = format!("{path}/{key}");
        let kept_value = match value {
            _ if is_returnable(value, levels) => Some(value.clone()),
            Value::Struct(members) if levels > 1 => Some(Value::Struct(keep_writable(
                members,
                &path,
                levels - 1,
                left_out,
            ))),
            _ => None,
        };
        match kept_value {
            Some(value) => {
                kept.insert(key.clone(), value);
            }
            None => left_out.push(path),
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nested(depth: usize, innermost: &Value) -> Value {
        (0..depth).fold(innermost.clone(), |value, _| Value::Array(vec![value]))
    }

    #[test]
    fn a_value_in_491_lists_can_be_returned_and_one_in_492_cannot() {
        let empty = Value::Array(Vec::new());
        for innermost in [Value::Int(1), empty, Value::Struct(Struct::new())] {
            assert_eq!(param_error(&nested(491, &innermost)), None);
            assert!(param_error(&nested(492, &innermost)).is_some());
        }
    }

    #[test]
    fn an_unreturnable_value_is_left_out_without_its_neighbours() {
        let poisoned = Struct::from([
            (
                "a".into(),
                Value::Struct(Struct::from([
                    ("big".into(), Value::BigInt("5000000000".into())),
                    ("good".into(), Value::Int(1)),
                ])),
            ),
            ("nil".into(), Value::Array(vec![Value::Nil])),
        ]);
        assert!(!is_writable(&poisoned));
        let (kept, left_out) = writable(&poisoned);
        assert_eq!(left_out, ["/a/big", "/nil"]);
        let good = Struct::from([("good".into(), Value::Int(1))]);
        assert_eq!(
            Value::Struct(kept),
            Value::Struct(Struct::from([("a".into(), Value::Struct(good))]))
        );
    }

    #[test]
    fn a_date_is_left_out_if_its_text_would_break_the_reply() {
        let tree = |text: &str| {
            let date = Value::Array(vec![Value::DateTime(text.to_owned())]);
            Struct::from([("d".to_owned(), date)])
        };
        for fine in [
            "",
            "20240101T00:00:00",
            "a > b",
            "a&amp;b",
            "&lt;",
            "a\rb",
            "]]",
        ] {
            assert!(is_writable(&tree(fine)), "{fine}");
        }
        for broken in [
            "a<b",
            "a & b",
            "&nbsp;",
            "]]>",
            "a<!-- -->",
            "</dateTime.iso8601></value><value>",
        ] {
            assert_eq!(
                writable(&tree(broken)),
                (Struct::new(), vec!["/d".to_owned()])
            );
            assert!(!is_writable(&tree(broken)), "{broken}");
        }
    }
}
