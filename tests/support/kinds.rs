//! Parameter values of every kind.

use std::sync::OnceLock;

use ros1_master::xmlrpc::Value;

use super::tree;

/// Values that a master can return, and that YAML, XML or Python code tends to break.
pub(crate) fn kinds() -> Value {
    #[rustfmt::skip]
    let texts = [
        "", " ", "  two  ", "no", "on", "yes", "null", "~", "=", "<<", "1:30", "0x1f", "0o17",
        "1_000", "1.0", "1e3", ".inf", "2001-01-01", "- a", "a: b", "# c", "'", "\"", "\\n", "%d",
        "&amp;", "]]>", "<b>&lt;</b>", "tab\there", "line\nbreak\n", "\n", "naïve ☃ 𝄞",
        "\u{85}\u{2028}", "trailing ",
    ];
    tree! {
        "texts" => texts.to_vec(),
        "one" => 1, "one point" => 1.0, "truth" => true, "falsehood" => false,
        "largest" => i32::MAX, "least" => i32::MIN,
        "third" => 1.0 / 3.0, "tiny" => 5e-324, "huge" => f64::MAX, "zero" => -0.0,
        "infinite" => f64::INFINITY, "not a number" => f64::NAN,
        "bytes" => Value::Base64((0..=255).collect()),
        "no time" => Value::DateTime("once upon a time".to_owned()),
        "when" => Value::DateTime("20260101T12:00:00".to_owned()),
        "nothing" => Value::Array(vec![]),
        "mixed" => Value::Array(vec![1.into(), "two".into(), 3.0.into(), vec!["four"].into()]),
        "on" => "a key that YAML 1.1 takes for a truth", "1" => "a number", "" => "no key",
        "with/slash" => "unreachable by its path",
    }
}

/// Whether the dictionaries of the master under test have no order, as on Python 2 (`ROSRESCUE_UNORDERED`).
pub(crate) fn unordered() -> bool {
    static UNORDERED: OnceLock<bool> = OnceLock::new();
    *UNORDERED.get_or_init(|| std::env::var_os("ROSRESCUE_UNORDERED").is_some())
}

/// Sorts the keys at every level, to compare values that were sent in another order.
pub(crate) fn sorted(value: &Value) -> Value {
    match value {
        Value::Struct(members) => {
            let mut members: Vec<_> = members
                .iter()
                .map(|(k, v)| (k.clone(), sorted(v)))
                .collect();
            members.sort_by(|a, b| a.0.cmp(&b.0));
            Value::Struct(members.into_iter().collect())
        }
        Value::Array(elements) => elements.iter().map(sorted).collect::<Vec<_>>().into(),
        other => other.clone(),
    }
}
