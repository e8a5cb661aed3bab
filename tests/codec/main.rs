//! Compares the codec with CPython's: the same result and value for every document, and the same bytes for
//! every answer.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod cases;
mod documents;
mod fuzz_seeds;
mod peer;

use std::fmt::Write;

use proptest::prelude::*;

use cases::{any_value, double, mess, returnable, text};
use documents::{odd_documents, params, refused_documents};
use peer::{Peer, hex, unhex};
use ros1_master::xmlrpc::{
    Call, DecodeError, Python, Reply, Value, decode_call, decode_reply, encode_call,
    encode_node_call, encode_reply,
};

/// A value in the notation of `peer.py`.
fn notation(value: &Value) -> String {
    match value {
        Value::Nil => "nil".to_owned(),
        Value::Bool(truth) => format!("bool:{}", i32::from(*truth)),
        Value::Int(number) => format!("int:{number}"),
        Value::BigInt(digits) => format!("int:{digits}"),
        Value::BigDecimal(text) => format!("decimal:{text}"),
        Value::Double(number) if number.is_nan() => "double:nan".to_owned(),
        Value::Double(number) => format!("double:{:016x}", number.to_bits()),
        Value::String(text) => format!("string:{}", hex(text.as_bytes())),
        Value::DateTime(text) => format!("date:{}", hex(text.as_bytes())),
        Value::Base64(bytes) => format!("base64:{}", hex(bytes)),
        Value::Array(elements) => {
            let inside: String = elements.iter().map(|e| notation(e) + " ").collect();
            format!("[ {inside}]")
        }
        Value::Struct(members) => {
            let inside: String = members
                .iter()
                .map(|(name, member)| {
                    format!("string:{} {} ", hex(name.as_bytes()), notation(member))
                })
                .collect();
            format!("{{ {inside}}}")
        }
    }
}

/// The result of this decoder in the notation of `peer.py`.
fn verdict(verb: &str, document: &[u8]) -> Result<String, DecodeError> {
    if verb == "call" {
        let call = decode_call(document)?;
        let method = notation(&Value::from(call.method));
        return Ok(format!(
            "ok {method} {}",
            notation(&Value::Array(call.params))
        ));
    }
    Ok(match decode_reply(document)? {
        Reply::Value(value) => format!("ok {}", notation(&value)),
        Reply::Fault { code, text } => format!(
            "fault {} {}",
            notation(&Value::from(code)),
            notation(&Value::from(text))
        ),
    })
}

/// The document without carriage returns and dates, which are read differently in a reply because CPython
/// does not escape them.
fn plain(document: &[u8]) -> Vec<u8> {
    let text = String::from_utf8_lossy(document);
    let text = text.replace('\r', "").replace("dateTime.iso8601", "date");
    text.into_bytes()
}

/// Checks that both decoders give the same result, or that this one refuses for one of the permitted reasons. If this
/// decoder predicts the fault, it must be the same too.
fn compare(peer: &mut Peer, verb: &str, document: &[u8]) -> Result<(), String> {
    let theirs = peer.ask(verb, document);
    let shown = String::from_utf8_lossy(document);
    if verb == "call"
        && let Some(ours) = decode_call(document)
            .err()
            .and_then(|error| error.fault(document, Python::default()))
    {
        let theirs = peer.ask("fault", document);
        if ours != theirs {
            return Err(format!("{shown}\nours:   {ours}\ntheirs: {theirs}"));
        }
    }
    match verdict(verb, document) {
        Ok(ours) if ours == theirs => Ok(()),
        Ok(ours) => Err(format!("{shown}\nours:   {ours}\ntheirs: {theirs}")),
        Err(
            DecodeError::Unsupported { .. }
            | DecodeError::Encoding { .. }
            | DecodeError::TooDeep { .. },
        ) => Ok(()),
        Err(_) if theirs.starts_with("raise ") => Ok(()),
        Err(ours) => Err(format!("{shown}\nours:   {ours}\ntheirs: {theirs}")),
    }
}

#[test]
fn odd_calls_are_decoded_as_cpython_decodes_them() {
    let mut peer = Peer::start();
    let mut failures = String::new();
    for document in odd_documents() {
        let theirs = peer.ask("call", &document);
        let ours = verdict("call", &document);
        let same = match &ours {
            Ok(ours) => *ours == theirs,
            Err(_) => theirs.starts_with("raise "),
        };
        if !same {
            let shown = String::from_utf8_lossy(&document);
            let shown: String = shown.chars().take(300).collect();
            let theirs: String = theirs.chars().take(300).collect();
            writeln!(failures, "{shown}\n ours   {ours:?}\n theirs {theirs}").unwrap();
        }
    }
    assert!(failures.is_empty(), "{failures}");
}

/// The mirror answers with these faults while there is no master.
#[test]
fn faults_for_undecodable_calls_are_in_cpythons_words() {
    let mut peer = Peer::start();
    let mut known = 0;
    let mut failures = String::new();
    for document in odd_documents() {
        let Err(error) = decode_call(&document) else {
            continue;
        };
        let Some(ours) = error.fault(&document, Python::default()) else {
            continue;
        };
        known += 1;
        let theirs = peer.ask("fault", &document);
        if ours != theirs {
            let shown = String::from_utf8_lossy(&document);
            writeln!(failures, "{shown}\n ours   {ours}\n theirs {theirs}").unwrap();
        }
    }
    assert!(failures.is_empty(), "{failures}");
    assert!(known > 50, "only {known}");
}

#[test]
fn the_documents_that_only_cpython_accepts_are_listed_correctly() {
    let mut peer = Peer::start();
    for (why, document) in refused_documents() {
        let theirs = peer.ask("call", &document);
        assert!(theirs.starts_with("ok "), "{why}: CPython says {theirs}");
        let ours = verdict("call", &document);
        assert!(ours.is_err(), "{why}: our decoder accepts it as {ours:?}");
    }
}

#[test]
fn odd_replies_are_decoded_as_a_python_client_decodes_them() {
    let fault = |members: &str| {
        format!(
            "<methodResponse><fault><value><struct>{members}</struct></value></fault></methodResponse>"
        )
    };
    let member = |name: &str, value: &str| {
        format!("<member><name>{name}</name><value>{value}</value></member>")
    };
    let code = member("faultCode", "<int>4</int>");
    let text = member("faultString", "no &lt;");
    let mut peer = Peer::start();
    for document in [
        "<methodResponse><params><param><value>x</value></param></params></methodResponse>"
            .to_owned(),
        "<methodResponse><params/></methodResponse>".to_owned(),
        "<methodResponse><params><value>a</value><value>b</value></params></methodResponse>"
            .to_owned(),
        "<methodResponse><value>a</value></methodResponse>".to_owned(),
        "<methodCall><methodName>m</methodName><value>a</value></methodCall>".to_owned(),
        "<params><value>a</value></params>".to_owned(),
        fault(""),
        fault(&code),
        fault(&text),
        fault(&[code.as_str(), &text].concat()),
        fault(&[text.as_str(), &code].concat()),
        fault(&[code.as_str(), &text, &code].concat()),
        fault(&[code.as_str(), &text, &member("more", "x")].concat()),
        fault(&[member("faultCode", "4").as_str(), &text].concat()),
        "<fault><value>x</value></fault>".to_owned(),
        "<fault/>".to_owned(),
        "<a><value>x</value><fault/></a>".to_owned(),
        "<a><fault/><params><value>x</value></params></a>".to_owned(),
    ] {
        compare(&mut peer, "reply", document.as_bytes()).unwrap();
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn an_encoded_call_decodes_to_the_same_call(method in text(), params in proptest::collection::vec(any_value(), 0..4)) {
        let call = Call::new(method, params);
        prop_assert_eq!(decode_call(&encode_call(&call)).unwrap(), call);
    }

    #[test]
    fn an_encoded_reply_decodes_to_the_same_reply(value in returnable()) {
        let reply = decode_reply(&encode_reply(&Reply::Value(value.clone()))).unwrap();
        prop_assert_eq!(reply, Reply::Value(value));
    }

    #[test]
    fn an_encoded_fault_decodes_to_the_same_fault(code in any::<i32>(), text in "[ -~\n]{0,40}") {
        let fault = Reply::Fault { code, text };
        prop_assert_eq!(decode_reply(&encode_reply(&fault)).unwrap(), fault);
    }
}

/// Runs a property test with one peer for all cases.
fn with_peer<S: Strategy>(
    cases: &S,
    property: impl Fn(&mut Peer, S::Value) -> Result<(), TestCaseError>,
) {
    let peer = std::cell::RefCell::new(Peer::start());
    let config = ProptestConfig {
        failure_persistence: None,
        ..ProptestConfig::default()
    };
    let mut runner = proptest::test_runner::TestRunner::new(config);
    runner
        .run(cases, |case| property(&mut peer.borrow_mut(), case))
        .unwrap();
}

#[test]
fn cpython_understands_our_calls_and_answers_with_our_bytes() {
    with_peer(&any_value(), |peer, value| {
        let ours = encode_reply(&Reply::Value(value.clone()));
        let theirs = peer.echo(&value);
        prop_assert_eq!(String::from_utf8(ours), String::from_utf8(theirs));
        Ok(())
    });
}

#[test]
fn calls_of_nodes_are_written_as_cpythons_client_writes_them() {
    let cases = proptest::collection::vec(returnable(), 0..4);
    with_peer(&cases, |peer, params| {
        let call = Call::new("paramUpdate", params);
        let theirs = unhex(&peer.ask("dumps", &encode_call(&call)));
        prop_assert_eq!(
            String::from_utf8(encode_node_call(&call)),
            String::from_utf8(theirs)
        );
        Ok(())
    });
}

#[test]
fn doubles_are_written_as_python_writes_them() {
    with_peer(
        &proptest::collection::vec(double(), 100),
        |peer, numbers| {
            let value = Value::from(numbers);
            let ours = encode_reply(&Reply::Value(value.clone()));
            let theirs = peer.echo(&value);
            prop_assert_eq!(String::from_utf8(ours), String::from_utf8(theirs));
            Ok(())
        },
    );
}

#[test]
fn random_documents_are_decoded_as_cpython_decodes_them() {
    with_peer(&proptest::collection::vec(mess(), 1..4), |peer, inside| {
        let document = params(&inside.concat());
        for verb in ["call", "reply"] {
            let document = if verb == "reply" {
                plain(&document)
            } else {
                document.clone()
            };
            compare(peer, verb, &document).map_err(TestCaseError::fail)?;
        }
        Ok(())
    });
}

/// Texts that are inserted into a document to damage it.
#[rustfmt::skip]
const DAMAGE: &[&str] = &[
    "", "<", ">", "/", "&", ";", "'", "=", " ", "\n", "]]>", "<!--", "-->", "--", "<?", "?>", "<![CDATA[", "x",
    "\u{1}", "é", "</value>", "<value>", "<array>", "</array>", "<a/>", "\u{ffff}", ":", "\"", "!", "?", "]",
    "-", "/>", "</", "<!", " a='b'", "&#", "&#65;", "\r",
];

#[test]
fn damaged_documents_are_decoded_as_cpython_decodes_them() {
    let damage = (
        any::<proptest::sample::Index>(),
        0..4_usize,
        proptest::sample::select(DAMAGE),
    );
    let sound = prop_oneof![
        any_value().prop_map(|value| encode_call(&Call::new("m", vec![value]))),
        mess().prop_map(|inside| params(&inside)),
    ];
    let sound = sound.prop_map(|document| String::from_utf8(document).unwrap());
    let cases = (sound, proptest::collection::vec(damage, 1..4));
    with_peer(&cases, |peer, (mut document, damages)| {
        for (place, cut, put) in damages {
            let mut at = place.index(document.len());
            while !document.is_char_boundary(at) {
                at -= 1;
            }
            let until = document
                .char_indices()
                .map(|(index, _)| index)
                .find(|&index| index >= at + cut)
                .unwrap_or(document.len());
            document.replace_range(at..until, put);
        }
        compare(peer, "call", document.as_bytes()).map_err(TestCaseError::fail)
    });
}

/// If a reply holds several values that cannot be encoded, the first one decides about the fault.
#[test]
fn the_first_unencodable_value_decides_the_fault() {
    let mut peer = Peer::start();
    for value in [
        Value::Array(vec![Value::Nil, Value::BigInt("2147483648".to_owned())]),
        Value::Array(vec![Value::BigInt("2147483648".to_owned()), Value::Nil]),
        Value::Array(vec![Value::Array(vec![Value::from("x")]), Value::Nil]),
    ] {
        let ours = encode_reply(&Reply::Value(value.clone()));
        assert_eq!(
            String::from_utf8(ours),
            String::from_utf8(peer.echo(&value))
        );
    }
}

/// A body that consists of nothing but nesting must neither overflow the stack nor take long.
#[test]
fn an_extremely_deep_document_is_refused_quickly() {
    for tag in ["array", "struct", "value", "x"] {
        let document = params(&format!("<{tag}>").repeat(1_000_000));
        assert!(matches!(
            decode_call(&document),
            Err(DecodeError::TooDeep { .. })
        ));
    }
}
