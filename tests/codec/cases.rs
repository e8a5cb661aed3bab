//! Random values and documents.

use proptest::prelude::*;
use ros1_master::xmlrpc::{Struct, Value};

/// Text that XML and XML-RPC libraries tend to mishandle.
pub(crate) fn text() -> impl Strategy<Value = String> {
    prop_oneof![
        "[a-z/_ ]{0,12}",
        "[ \t\n\r<>&'\"\\]a-c;#]{0,16}",
        "[\u{20}-\u{fffd}]{0,8}",
        "[\u{10000}-\u{10ffff}]{0,4}",
        Just("&#13;]]>".to_owned()),
    ]
}

pub(crate) fn double() -> impl Strategy<Value = f64> {
    let decimal = |(n, e): (i64, i32)| format!("{n}e{e}").parse().unwrap();
    prop_oneof![
        any::<u64>()
            .prop_map(f64::from_bits)
            .prop_filter("one nan", |n| !n.is_nan()),
        (1..1_u64 << 52).prop_map(f64::from_bits),
        (any::<i64>(), -40..10).prop_map(decimal),
        (-9999..9999_i64, -30..30).prop_map(decimal),
        proptest::sample::select(vec![
            0.0,
            -0.0,
            1.0,
            1e15,
            1e16,
            1e17,
            9999999999999998.0,
            1e-4,
            1e-5,
            0.00012,
            0.000099,
            5e-324,
            f64::MAX,
            f64::MIN_POSITIVE,
            f64::EPSILON,
            f64::NAN,
            f64::INFINITY,
            f64::NEG_INFINITY,
        ]),
    ]
}

/// Any value that rosmaster can return.
pub(crate) fn returnable() -> impl Strategy<Value = Value> {
    values(any::<i32>().prop_map(Value::Int).boxed())
}

/// Any value.
pub(crate) fn any_value() -> impl Strategy<Value = Value> {
    let big = "-?[1-9][0-9]{10,40}".prop_map(Value::BigInt);
    values(prop_oneof![any::<i32>().prop_map(Value::Int), big, Just(Value::Nil)].boxed())
}

pub(crate) fn values(more: BoxedStrategy<Value>) -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        more,
        any::<bool>().prop_map(Value::Bool),
        double().prop_map(Value::Double),
        text().prop_map(Value::String),
        "[0-9T:-]{0,17}".prop_map(Value::DateTime),
        proptest::collection::vec(any::<u8>(), 0..130).prop_map(Value::Base64),
    ];
    leaf.prop_recursive(5, 40, 6, |inner| {
        prop_oneof![
            proptest::collection::vec(inner.clone(), 0..6).prop_map(Value::Array),
            proptest::collection::vec((text(), inner), 0..6)
                .prop_map(|members| Value::Struct(members.into_iter().collect::<Struct>())),
        ]
    })
}

/// A document fragment that is mostly well-formed and rarely a valid call.
pub(crate) fn mess() -> impl Strategy<Value = String> {
    let text = proptest::sample::select(vec![
        "",
        " ",
        "\n",
        "1",
        "0",
        "a",
        "a&amp;b",
        "\r\n",
        "\r",
        "<![CDATA[<x>]]>",
        "<!-- c -->",
        "<?pi x?>",
        "&#13;",
        "]]",
        "é",
        "-7",
        "1.5",
        "QUI=",
        "faultCode",
        "]]>",
        "&",
        "<",
        "\u{ffff}",
        "'",
        "2147483648",
    ]);
    let tag = proptest::sample::select(vec![
        "value",
        "value",
        "value",
        "string",
        "name",
        "int",
        "i4",
        "i8",
        "double",
        "boolean",
        "nil",
        "array",
        "data",
        "struct",
        "member",
        "params",
        "param",
        "fault",
        "methodName",
        "base64",
        "dateTime.iso8601",
        "foo",
        "x:array",
        "x:value",
        "x:foo",
        "x:struct",
        "methodCall",
        "a b='c'",
        "a b=\"&lt;'\" c = 'd>'",
    ]);
    let leaf = text.prop_map(str::to_owned);
    leaf.prop_recursive(6, 40, 5, move |inner| {
        (tag.clone(), proptest::collection::vec(inner, 0..5)).prop_map(|(tag, inside)| {
            let name = tag.split(' ').next().unwrap();
            format!("<{tag}>{}</{name}>", inside.concat())
        })
    })
}
