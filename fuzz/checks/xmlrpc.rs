//! Checks that must hold for any bytes that are received as XML-RPC.

use rescue_core::replay;
use ros1_master::{
    master::{Master, Request},
    xmlrpc::{
        Call, Python, Reply, Value, decode_call, decode_call_for, decode_reply, encode_call,
        encode_reply,
    },
};

/// Panics if decoding panics, or if a decoded document is not the same after it was encoded and decoded
/// again.
pub(crate) fn check(bytes: &[u8]) {
    if let Ok(call) = decode_call(bytes) {
        assert_eq!(decode_call(&encode_call(&call)), Ok(call.clone()));
        // The mirror has an answer to every call, and the answer can be sent.
        let request = Request::from(call);
        request.kind();
        request.is_answerable();
        let mut mirror = Master::default();
        let reply = mirror.apply(&request).reply;
        replay::accepted(&Master::default(), &request, &reply);
        assert!(decode_reply(&encode_reply(&reply)).is_ok(), "{reply:?}");
        assert_eq!(
            Master::from_snapshot(mirror.snapshot()).as_ref(),
            Ok(&mirror)
        );
    }
    for python in [Python::default(), Python::new(2, 7, 18)] {
        if let Err(error) = decode_call_for(bytes, python) {
            error.fault(bytes, python);
        }
    }
    if let Ok(reply) = decode_reply(bytes) {
        check_reply(&reply);
    }
}

fn check_reply(reply: &Reply) {
    let again = decode_reply(&encode_reply(reply));
    match reply {
        Reply::Fault { .. } => assert_eq!(again.as_ref(), Ok(reply)),
        Reply::Value(value) => {
            // As a parameter the value is encoded in rosrescue's own form, which keeps everything.
            let call = Call::new("m", vec![value.clone()]);
            assert_eq!(decode_call(&encode_call(&call)), Ok(call));
            match form(value, 1) {
                Form::Kept => assert_eq!(again.as_ref(), Ok(reply)),
                Form::Refused => assert!(matches!(again, Ok(Reply::Fault { code: 1, .. }))),
                Form::Spoiled => {}
            }
        }
    }
}

/// What happens to a value in a reply, which is encoded as by CPython. Later variants are worse.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Form {
    /// It is decoded unchanged.
    Kept,
    /// It is a date with markup, which CPython does not escape.
    Spoiled,
    /// CPython does not encode it.
    Refused,
}

fn form(value: &Value, level: usize) -> Form {
    match value {
        Value::Nil | Value::BigInt(_) | Value::BigDecimal(_) => Form::Refused,
        // From here on CPython is close to its recursion limit, so it may or may not encode the value.
        _ if level > 480 => Form::Spoiled,
        Value::DateTime(text) if text.contains(['&', '<', '>']) => Form::Spoiled,
        Value::Array(elements) => elements
            .iter()
            .map(|element| form(element, level + 1))
            .max()
            .unwrap_or(Form::Kept),
        Value::Struct(members) => members
            .values()
            .map(|member| form(member, level + 1))
            .max()
            .unwrap_or(Form::Kept),
        _ => Form::Kept,
    }
}
