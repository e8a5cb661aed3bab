//! Converts parameters to YAML for `rosparam load`.

use super::{EncodeError, emit};
use crate::hide::Masked;
use ros1_master::xmlrpc::{Struct, Value};

/// Maximum number of characters of a value in a message.
const SHOWN: usize = 100;

/// Converts the parameter tree to YAML that `rosparam load` reads correctly. Also returns a sentence for each parameter
/// that was left out or changed because rosparam cannot send it.
///
/// # Errors
///
/// [`EncodeError::TooDeep`] for a parameter that is nested deeper than [`DEPTH_MAX`](super::DEPTH_MAX).
pub fn for_rosparam(tree: &Struct) -> Result<(Vec<u8>, Vec<String>), EncodeError> {
    let mut left_out = Vec::new();
    let tree = carried(tree, "", &mut left_out);
    let mut yaml = Vec::new();
    match tree.is_empty() {
        true => yaml.extend_from_slice(b"{}\n"),
        false => emit::block(&mut yaml, &tree, 0, 0)?,
    }
    Ok((yaml, left_out))
}

/// `value` in one line for messages: as in a checkpoint, but shortened.
pub fn shown(value: &Masked<'_>) -> String {
    let mut line = Vec::new();
    if emit::flow(&mut line, value.value(), 0).is_err() {
        return "(nested too deep)".to_owned();
    }
    let line = String::from_utf8_lossy(&line);
    match line.char_indices().nth(SHOWN) {
        None => line.into_owned(),
        Some((end, _)) => format!("{}…", line.get(..end).unwrap_or_default()),
    }
}

fn carried(tree: &Struct, path: &str, left_out: &mut Vec<String>) -> Struct {
    let mut kept = Struct::new();
    for (key, value) in tree {
        let name = format!("{path}/{key}");
        let odd_name = key.is_empty() || key.contains('/') || key.starts_with('~');
        let why = match value {
            _ if odd_name => Some("rosparam would take its key for another name"),
            // rosparam reads `_ns` as the namespace of a whole document.
            _ if path.is_empty() && key == "_ns" => Some("rosparam would take it for a namespace"),
            Value::Struct(members) if members.is_empty() => {
                Some("rosparam cannot set an empty namespace")
            }
            Value::Struct(members) => {
                let members = carried(members, &name, left_out);
                if !members.is_empty() {
                    kept.insert(key.clone(), Value::Struct(members));
                }
                continue;
            }
            value => refusal(value),
        };
        match why {
            Some(why) => left_out.push(format!("left out {name}: {why}")),
            None => drop(kept.insert(key.clone(), value.clone())),
        }
    }
    kept
}

/// Why rosparam cannot send this value. `None` if it can.
fn refusal(value: &Value) -> Option<&'static str> {
    match value {
        Value::Nil => Some("it holds null, which rosparam cannot send"),
        Value::BigInt(_) => Some("it holds an integer beyond 32 bits, which rosparam cannot send"),
        Value::BigDecimal(_) => Some("it holds a decimal number, which rosparam cannot send"),
        Value::DateTime(text) if emit::timestamp(text).is_none() => {
            Some("it holds a date that is not in the calendar")
        }
        Value::Array(elements) => elements.iter().find_map(refusal),
        Value::Struct(members) => members.values().find_map(refusal),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hide::Hide;

    fn tree(members: &[(&str, Value)]) -> Struct {
        members.into()
    }

    #[test]
    fn parameters_that_rosparam_cannot_carry_are_left_out_and_named() {
        let odd = tree(&[
            ("x/y", 1.into()),
            ("", 2.into()),
            ("ok", Value::Double(1.0)),
        ]);
        let given = tree(&[
            ("a", Value::Struct(odd)),
            ("none", Value::Array(vec![Value::Nil])),
            ("big", Value::BigInt("9999999999".to_owned())),
            ("when", Value::DateTime("20260102T03:04:05".to_owned())),
            ("never", Value::DateTime("20260231T03:04:05".to_owned())),
            ("empty", Value::Struct(Struct::new())),
            ("gone", Value::Struct(tree(&[("~", 1.into())]))),
            ("angle", "deg(90)".into()),
        ]);
        let (yaml, left_out) = for_rosparam(&given).unwrap();
        assert_eq!(
            String::from_utf8(yaml).unwrap(),
            "\"a\":\n  \"ok\": 1.0\n\"when\": !!timestamp \"2026-01-02T03:04:05\"\n\"angle\": \"deg(90)\"\n"
        );
        let named = [
            "/a/x/y", "/a/", "/none", "/big", "/never", "/empty", "/gone/~",
        ];
        assert_eq!(left_out.len(), named.len());
        for (sentence, name) in left_out.iter().zip(named) {
            let start = format!("left out {name}: ");
            assert!(sentence.starts_with(&start), "{sentence}");
        }
        assert_eq!(
            for_rosparam(&Struct::new()).unwrap(),
            (b"{}\n".to_vec(), vec![])
        );
    }

    #[test]
    fn a_long_value_is_shortened_for_display() {
        let shown = |value: &Value| shown(&Hide::nothing().mask("", value));
        assert_eq!(shown(&"ü".into()), "\"ü\"");
        let long = shown(&"ü".repeat(1000).into());
        assert_eq!(long.chars().count(), SHOWN + 1);
    }
}
