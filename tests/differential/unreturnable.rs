//! Values that rosmaster cannot return. The codec must refuse to encode the same ones.

use ros1_master::xmlrpc::{Call, Reply, Struct, Value, encode_call, encode_reply};

use crate::support::{Rosmaster, Scratch, http_request};

/// At the limit of Python's recursion, rosmaster's behaviour depends on the depth of its own calls, so only a real
/// master can tell.
#[test]
fn values_that_rosmaster_cannot_return_become_its_fault() {
    let leaves = [
        Value::Int(1),
        Value::Bool(true),
        Value::Double(1.5),
        Value::from("<a>"),
        Value::DateTime("20240101T00:00:00".to_owned()),
        Value::Base64(b"abc".to_vec()),
        Value::Nil,
        Value::BigInt("2147483648".to_owned()),
        Value::BigDecimal("1.5".to_owned()),
        Value::Array(Vec::new()),
        Value::Struct(Struct::new()),
    ];
    let in_array = |value| Value::Array(vec![value]);
    let in_struct = |value| Value::Struct(Struct::from([("k".to_owned(), value)]));
    let wraps: [fn(Value) -> Value; 2] = [in_array, in_struct];
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let answer = |method: &str, params: Vec<Value>| {
        let call = encode_call(&Call::new(method, params));
        let response = master.client().exchange(&http_request(&call));
        response.unwrap().text()
    };
    for (leaf, wrap) in leaves
        .iter()
        .flat_map(|leaf| wraps.map(|wrap| (leaf, wrap)))
    {
        for depth in [1, 300, 489, 490, 491, 492, 493, 510] {
            let value = (0..depth).fold(leaf.clone(), |value, _| wrap(value));
            let caller = Value::from("/n");
            answer("setParam", vec![caller.clone(), "/p".into(), value.clone()]);
            let theirs = answer("getParam", vec![caller, "/p".into()]);
            let reply = Value::Array(vec![1.into(), "Parameter [/p]".into(), value]);
            let ours = encode_reply(&Reply::Value(reply));
            let ours = String::from_utf8(ours).unwrap();
            // The text of this error depends on what Python was doing.
            let too_deep = [&ours, &theirs].map(|text| text.contains("RecursionError"));
            assert!(
                ours == theirs || too_deep == [true; 2],
                "{leaf:?} at {depth}\n{ours}\n{theirs}"
            );
        }
    }
}
