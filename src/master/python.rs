//! What Python makes of a value: its type's name, its truth, its items, its text in an error, and
//! whether `xmlrpc.client.dumps` can write it.

use std::borrow::Cow;

use crate::xmlrpc::{Reply, Struct, Value, decode_reply, encode_reply};

/// Deepest nesting of arrays and structs in a reply, the reply's own array counted, that rosmaster
/// can write before Python's recursion limit ends it. Measured with Python 3.11.
const DEEPEST_REPLY: usize = 492;

/// The name of the Python type.
pub(crate) fn type_name(value: &Value) -> &'static str {
    match value {
        Value::Nil => "NoneType",
        Value::Bool(_) => "bool",
        Value::Int(_) | Value::BigInt(_) => "int",
        Value::Double(_) => "float",
        Value::String(_) => "str",
        Value::DateTime(_) => "DateTime",
        Value::Base64(_) => "Binary",
        Value::Array(_) => "list",
        Value::Struct(_) => "dict",
    }
}

/// `bool(value)`.
pub(crate) fn is_true(value: &Value) -> bool {
    match value {
        Value::Nil => false,
        Value::Bool(truth) => *truth,
        Value::Int(number) => *number != 0,
        Value::Double(number) => *number != 0.0,
        Value::String(text) => !text.is_empty(),
        Value::Array(elements) => !elements.is_empty(),
        Value::Struct(members) => !members.is_empty(),
        Value::BigInt(_) | Value::DateTime(_) | Value::Base64(_) => true,
    }
}

/// The items that `for x in value` or `f(*value)` sees, if it is iterable. Those of a text or a dict
/// have to be made: no more than `most` of them are, for a text may have millions.
pub(crate) fn items(value: &Value, most: usize) -> Option<Cow<'_, [Value]>> {
    match value {
        Value::Array(elements) => Some(Cow::Borrowed(elements)),
        Value::Struct(members) => {
            let keys = members.keys().take(most);
            Some(keys.map(|key| key.as_str().into()).collect())
        }
        Value::String(text) => {
            let characters = text.chars().take(most);
            Some(characters.map(|c| Value::String(c.into())).collect())
        }
        _ => None,
    }
}

/// How many items there are in all.
pub(crate) fn count(value: &Value) -> usize {
    match value {
        Value::Array(elements) => elements.len(),
        Value::Struct(members) => members.len(),
        Value::String(text) => text.chars().count(),
        _ => 0,
    }
}

/// About how much memory a value takes, in bytes.
pub(crate) fn size(value: &Value) -> usize {
    let within = match value {
        Value::BigInt(text) | Value::String(text) | Value::DateTime(text) => text.len(),
        Value::Base64(bytes) => bytes.len(),
        Value::Array(elements) => elements.iter().map(size).sum(),
        Value::Struct(members) => {
            let members = members.iter();
            let members = members.map(|(key, value)| size_of::<String>() + key.len() + size(value));
            members.sum()
        }
        _ => 0,
    };
    size_of::<Value>() + within
}

/// What `value["name"]` raises for a value that is no dict.
pub(crate) fn subscript_error(value: &Value) -> String {
    match value {
        Value::String(_) => "string indices must be integers, not 'str'".to_owned(),
        Value::Array(_) => "list indices must be integers or slices, not str".to_owned(),
        _ => format!("'{}' object is not subscriptable", type_name(value)),
    }
}

/// What `del value[name]` after `name in value` raises for a value that is no dict; none if `name`
/// is not in it.
pub(crate) fn delete_error(value: &Value, name: &str) -> Option<String> {
    match value {
        Value::String(text) => text
            .contains(name)
            .then(|| "'str' object does not support item deletion".to_owned()),
        Value::Array(elements) => elements
            .iter()
            .any(|element| match element {
                Value::String(text) | Value::DateTime(text) => text == name,
                _ => false,
            })
            .then(|| "list indices must be integers or slices, not str".to_owned()),
        _ => Some(format!(
            "argument of type '{}' is not iterable",
            type_name(value)
        )),
    }
}

/// `repr` of a string.
pub(crate) fn repr(text: &str) -> String {
    let quote = if text.contains('\'') && !text.contains('"') {
        '"'
    } else {
        '\''
    };
    let mut out = String::from(quote);
    for c in text.chars() {
        match c {
            '\\' => out.push_str("\\\\"),
            '\n' => out.push_str("\\n"),
            '\r' => out.push_str("\\r"),
            '\t' => out.push_str("\\t"),
            _ if c == quote => out.extend(['\\', c]),
            _ if is_printable(c) => out.push(c),
            _ => out.push_str(&match u32::from(c) {
                code @ 0..=0xff => format!("\\x{code:02x}"),
                code @ 0x100..=0xffff => format!("\\u{code:04x}"),
                code => format!("\\U{code:08x}"),
            }),
        }
    }
    out.push(quote);
    out
}

/// `str.isprintable`, by the tables of Rust, whose Unicode is newer: the 15,097 characters that were
/// assigned after the Unicode 14 of Python 3.11 are printable here and not there. All others are
/// alike.
fn is_printable(c: char) -> bool {
    // Rust escapes the same categories, and these. Combining marks it escapes only at the start.
    matches!(c, '\\' | '\'' | '"')
        || ['a', c].iter().collect::<String>().escape_debug().count() == 2
}

/// `str` of a number, truth or None: what an unknown method's name looks like in the fault.
pub(crate) fn text(value: &Value) -> Option<String> {
    match value {
        Value::Nil => Some("None".to_owned()),
        Value::Bool(true) => Some("True".to_owned()),
        Value::Bool(false) => Some("False".to_owned()),
        Value::Int(number) => Some(number.to_string()),
        Value::BigInt(text) | Value::String(text) => Some(text.clone()),
        Value::Double(number) => Some(float(*number)),
        _ => None,
    }
}

/// `repr` of a float: as short as it can be read back, with an exponent below 1e-4 and from 1e16 on.
fn float(number: f64) -> String {
    if !number.is_finite() {
        return number.to_string().to_lowercase();
    }
    let magnitude = number.abs();
    if magnitude != 0.0 && !(1e-4..1e16).contains(&magnitude) {
        let text = format!("{number:e}");
        let (digits, exponent) = text.split_once('e').unwrap_or((&text, "0"));
        let (sign, exponent) = match exponent.strip_prefix('-') {
            Some(exponent) => ('-', exponent),
            None => ('+', exponent),
        };
        format!("{digits}e{sign}{exponent:0>2}")
    } else {
        format!("{number:?}")
    }
}

/// What rosmaster answers instead of a reply that it cannot write, if it cannot write it.
pub(crate) fn write_error(reply: &Value) -> Option<&'static str> {
    error_within(reply, DEEPEST_REPLY)
}

/// Like [`write_error`] for a parameter's value, which travels in `[code, message, value]`.
pub(crate) fn param_error(value: &Value) -> Option<&'static str> {
    error_within(value, DEEPEST_REPLY - 1)
}

fn error_within(value: &Value, levels: usize) -> Option<&'static str> {
    let deeper = |value| match levels.checked_sub(1) {
        Some(levels) => error_within(value, levels),
        None => None,
    };
    match value {
        Value::Nil => Some("<class 'TypeError'>:cannot marshal None unless allow_none is enabled"),
        Value::BigInt(_) => Some("<class 'OverflowError'>:int exceeds XML-RPC limits"),
        Value::Array(_) | Value::Struct(_) if levels == 0 => {
            Some("<class 'RecursionError'>:maximum recursion depth exceeded")
        }
        Value::Array(elements) => elements.iter().find_map(deeper),
        Value::Struct(members) => members.values().find_map(deeper),
        _ => None,
    }
}

/// Whether a reply that holds this value, inside so many `levels` less than the deepest, is a document
/// with that value in it.
fn is_returnable(value: &Value, levels: usize) -> bool {
    error_within(value, levels).is_none() && !holds_markup(value)
}

/// Whether a date's text breaks the reply's XML: CPython does not escape it.
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

/// Levels of a namespace within the tree that can be written in a multicall's result, where the tree
/// lies in the result's list, the entry's, and the answer's.
const DEEPEST_NAMESPACE: usize = DEEPEST_REPLY - 4;

/// Whether a multicall can return the whole tree.
pub(crate) fn is_writable(tree: &Struct) -> bool {
    tree.values().all(is_readable)
}

/// Whether a multicall can return a value of the tree.
pub(crate) fn is_readable(value: &Value) -> bool {
    is_returnable(value, DEEPEST_NAMESPACE)
}

/// Whether a multicall can return the whole tree with `value` at a key of so many `names`.
pub(crate) fn is_readable_at(names: usize, value: &Value) -> bool {
    let levels = DEEPEST_NAMESPACE.checked_sub(names.saturating_sub(1));
    levels.is_some_and(|levels| is_returnable(value, levels))
}

/// The tree without what a master could take but never return, and the keys of what was left out.
pub(crate) fn writable(tree: &Struct) -> (Struct, Vec<String>) {
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

    fn nested(depth: usize) -> Value {
        (0..depth).fold(Value::Int(1), |value, _| Value::Array(vec![value]))
    }

    #[test]
    fn repr_is_pythons() {
        assert_eq!(repr("x"), "'x'");
        assert_eq!(repr("it's"), "\"it's\"");
        assert_eq!(repr("é\"'"), "'é\"\\''");
        assert_eq!(
            repr("\t\u{7f}\u{a0}\u{3000}\u{200b}\u{1F600}"),
            "'\\t\\x7f\\xa0\\u3000\\u200b\u{1F600}'"
        );
        assert_eq!(
            repr("\u{61c}e\u{301}\u{180e}\\"),
            "'\\u061ce\u{301}\\u180e\\\\'"
        );
        assert_eq!(repr("\u{e0001}\u{10fffd}"), "'\\U000e0001\\U0010fffd'");
    }

    #[test]
    fn floats_are_written_as_python_writes_them() {
        for (number, text) in [
            (1.5, "1.5"),
            (1e20, "1e+20"),
            (1e16, "1e+16"),
            (1e15, "1000000000000000.0"),
            (0.0001, "0.0001"),
            (0.00001, "1e-05"),
            (-0.0, "-0.0"),
            (f64::NAN, "nan"),
            (f64::NEG_INFINITY, "-inf"),
        ] {
            assert_eq!(float(number), text);
        }
    }

    #[test]
    fn a_parameter_of_491_levels_can_be_returned_and_one_of_492_cannot() {
        assert_eq!(param_error(&nested(491)), None);
        assert!(param_error(&nested(492)).is_some());
    }

    #[test]
    fn what_cannot_be_written_is_left_out_by_its_smallest_key() {
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
    fn a_date_is_left_out_if_its_text_breaks_the_reply() {
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
