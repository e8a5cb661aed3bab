//! Values that some YAML readers misread, and random values.

use proptest::prelude::*;
use ros1_master::xmlrpc::{Struct, Value};

/// Texts that some YAML readers read as something else.
#[rustfmt::skip]
const TEXTS: &[&str] = &[
    "", " ", "  both  ", "no", "No", "on", "OFF", "y", "yes", "true", "null", "~", "Null", "1:30",
    "=", "<<", "1.0", "1", "-1", "0x10", "0o17", "017", "1_000", "1e3", ".inf", ".nan", "+1",
    "2024-01-31", "2024-01-31 12:00:00", "a: b", "a #b", "#", "- a", "-", "?", ":", "!tag", "&a",
    "*a", "%YAML", "---", "...", "@", "`", "|", ">", "{}", "[]", ",", "'", "\"", "\\", "\\n",
    "a\nb", "a\r\nb", "\r", "\t", "\ttab\t", "\n", "\n\n", "]]>", "<value/>", "\u{7f}", "\u{80}",
    "\u{85}", "\u{a0}", "\u{ad}", "\u{2028}", "\u{2029}", "\u{202e}", "\u{feff}", "\u{feff}bom",
    "\u{fffe}", "\u{ffff}", "\u{fdd0}", "\u{1fffe}", "\u{10ffff}", "\u{1f916}", "é", "日本",
    "\u{e000}", "\u{fffd}", "\0", "\u{1}", "\u{1b}", "journal:", "\njournal:\n",
    "- {seq: 1, call: \"x\", params: []} #00000000 00000000", "/a/b", "~private", "$(arg x)",
    "deg(90)", "rad(1.0)", "é\nü\u{85}", "trailing\\",
];

const NUMBERS: &[f64] = &[
    0.0,
    -0.0,
    1.0,
    -1.5,
    0.1,
    1e300,
    -1e300,
    1e16,
    1e15,
    1.5e-7,
    5e-324,
    2.2250738585072014e-308,
    f64::MAX,
    f64::MIN,
    f64::EPSILON,
    f64::INFINITY,
    f64::NEG_INFINITY,
    f64::NAN,
    123_456_789.123,
];

pub(crate) fn catalogue() -> Vec<Value> {
    let mut values: Vec<Value> = TEXTS.iter().map(|text| Value::from(*text)).collect();
    values.extend(TEXTS.iter().map(|text| Value::DateTime((*text).to_owned())));
    values.extend(NUMBERS.iter().map(|number| Value::Double(*number)));
    values.extend([i32::MIN, -1, 0, 1, 8, 60, i32::MAX].map(Value::Int));
    values.extend(
        [
            "2147483648",
            "-2147483649",
            "9223372036854775808",
            "-18446744073709551616",
        ]
        .map(|digits| Value::BigInt(digits.to_owned())),
    );
    values.extend(["1.5", "-0.250", "x"].map(|text| Value::BigDecimal(text.to_owned())));
    values.push(Value::BigInt("7".repeat(4_000)));
    values.push(Value::BigInt("7".repeat(5_000)));
    for odd in ["5", "-0", "007", "", "x", "1: {", "00000000000000000001"] {
        values.push(Value::BigInt(odd.to_owned()));
    }
    for moment in [
        "20240131T12:00:00",
        "20240229T00:00:00",
        "20230229T00:00:00",
        "99991231T23:59:59",
        "00010101T00:00:00",
        "00000101T00:00:00",
        "20240131T24:00:00",
        "2024-01-31T12:00:00",
        "20240131T12:00:00Z",
        "20240131t12:00:00",
        "+0240131T12:00:00",
        "2024-131T12:00:00",
    ] {
        values.push(Value::DateTime(moment.to_owned()));
    }
    values.push(Value::Base64(Vec::new()));
    values.push(Value::Base64((0..=255).collect()));
    values.extend([Value::Nil, Value::Bool(true), Value::Bool(false)]);
    values.extend([Value::Array(vec![]), Value::Struct(Struct::new())]);
    values.push(Value::Struct(
        TEXTS
            .iter()
            .enumerate()
            .map(|(nth, key)| ((*key).to_owned(), Value::Int(nth as i32)))
            .collect(),
    ));
    values.push(Value::from("long ".repeat(2_000)));
    for length in [900, 990, 1_000, 1_010, 1_020, 1_024, 1_030, 5_000] {
        let value = Value::from(vec![Value::Struct(Struct::from([(
            "k".repeat(length),
            1.into(),
        )]))]);
        values.push(Value::Struct(Struct::from([("k".repeat(length), value)])));
        values.push(Value::Struct(Struct::from([
            (
                "\u{e9}".repeat(length),
                Value::Struct(Struct::from([("in".to_owned(), 1.into())])),
            ),
            ("next".to_owned(), 2.into()),
        ])));
    }
    values
}

pub(crate) fn values() -> impl Strategy<Value = Value> {
    let text = || {
        prop_oneof![
            any::<String>(),
            proptest::sample::select(TEXTS).prop_map(str::to_owned)
        ]
    };
    let leaf = prop_oneof![
        Just(Value::Nil),
        any::<bool>().prop_map(Value::Bool),
        any::<i32>().prop_map(Value::Int),
        "-?[1-9][0-9]{10,40}".prop_map(Value::BigInt),
        // NaN has only one form, on the wire and in a checkpoint.
        any::<f64>().prop_map(|n| Value::Double(if n.is_nan() { f64::NAN } else { n })),
        any::<u64>()
            .prop_map(f64::from_bits)
            .prop_map(|n| { Value::Double(if n.is_nan() { f64::NAN } else { n }) }),
        text().prop_map(Value::String),
        text().prop_map(Value::DateTime),
        proptest::collection::vec(any::<u8>(), 0..20).prop_map(Value::Base64),
    ];
    leaf.prop_recursive(5, 40, 6, move |inner| {
        prop_oneof![
            proptest::collection::vec(inner.clone(), 0..6).prop_map(Value::Array),
            proptest::collection::vec((text(), inner), 0..6)
                .prop_map(|members| Value::Struct(members.into_iter().collect())),
        ]
    })
}
