//! Forwarding: the same raw request to a bare rosmaster and to one behind rosrescue gets the same
//! answer, whatever HTTP and XML-RPC allow or forbid; and the form of every answer is one that all
//! clients understand.

use crate::support::{Twins, encode_call, http_request, params, request, tree};
use rosrescue::xmlrpc::{Call, Value};

#[test]
fn calls_are_answered_with_the_masters_bytes() {
    let twins = Twins::start();
    let api = "http://127.0.0.1:1/";
    let calls = [
        ("getParamNames", params!["/c"]),
        ("setParam", params!["/ns/c", "a", 1]),
        ("setParam", params!["/ns/c", "~b", "two"]),
        (
            "setParam",
            vec![
                "/c".into(),
                "/c".into(),
                tree! { "x" => 1.5, "y" => tree! { "z" => true } },
            ],
        ),
        ("getParam", params!["/c", "/"]),
        ("getParam", params!["/c", "/not/there"]),
        ("hasParam", params!["/ns/c", "a"]),
        ("searchParam", params!["/ns/c", "a"]),
        ("deleteParam", params!["/c", "/ns/a"]),
        ("deleteParam", params!["/c", "/ns/a"]),
        ("deleteParam", params!["/c", "/"]),
        ("setParam", params!["/c", "/", 1]),
        (
            "registerPublisher",
            params!["/p", "/t", "std_msgs/String", api],
        ),
        ("registerPublisher", params!["/p", "/t", "no type", api]),
        ("registerSubscriber", params!["/s", "/t", "*", api]),
        (
            "registerService",
            params!["/p", "/srv", "rosrpc://127.0.0.1:1", api],
        ),
        ("lookupService", params!["/c", "/srv"]),
        ("lookupService", params!["/c", "/nothing"]),
        ("lookupNode", params!["/c", "/p"]),
        ("lookupNode", params!["/c", "/nobody"]),
        ("subscribeParam", params!["/s", api, "/c"]),
        ("unsubscribeParam", params!["/s", api, "/c"]),
        ("getSystemState", params!["/c"]),
        ("getTopicTypes", params!["/c"]),
        ("getPublishedTopics", params!["/c", ""]),
        (
            "unregisterService",
            params!["/p", "/srv", "rosrpc://127.0.0.1:2"],
        ),
        (
            "unregisterService",
            params!["/p", "/srv", "rosrpc://127.0.0.1:1"],
        ),
        (
            "unregisterPublisher",
            params!["/p", "/t", "http://127.0.0.1:2/"],
        ),
        ("unregisterPublisher", params!["/p", "/t", api]),
        ("unregisterSubscriber", params!["/s", "/t", api]),
        ("unregisterSubscriber", params!["/s", "/t", api]),
        ("getSystemState", params!["/c"]),
        ("noSuchMethod", params!["/c", 1]),
        ("system.listMethods", params![]),
        ("uri", params![]),
        ("getPid", params![]),
        ("getPid", params!["/c", "too", "many"]),
        ("setParam", params![1, 2, 3]),
        ("setParam", params!["/c"]),
        ("registerPublisher", params!["/p", "", "", ""]),
        ("", params![]),
    ];
    for (method, params) in calls {
        twins.same_call(method, params);
    }
    let several = [
        Call::new("setParam", params!["/c", "/m", 1]),
        Call::new("getParam", params!["/c", "/m"]),
        Call::new("noSuchMethod", params!["/c"]),
        Call::multicall([Call::new("deleteParam", params!["/c", "/m"])]),
        Call::new("getParam", params!["/c", "/m"]),
    ];
    twins.same_call("system.multicall", Call::multicall(several).params);
    twins.same_call("system.multicall", params![1]);
    twins.same_call("system.multicall", vec![Value::Array(vec![])]);
    twins.same_call(
        "system.multicall",
        vec![Value::Array(vec![tree! { "x" => 1 }])],
    );
}

#[test]
fn xml_of_every_kind_gets_the_masters_own_verdict() {
    let twins = Twins::start();
    let call = |params: &str| {
        format!(
            "<?xml version='1.0'?><methodCall><methodName>setParam</methodName>{params}</methodCall>"
        )
    };
    let value = |value: &str| {
        call(&format!(
            "<params><param><value>/c</value></param><param><value>/v</value></param>\
             <param><value>{value}</value></param></params>"
        ))
    };
    let bodies = [
        String::new(),
        "garbage".to_owned(),
        "<methodCall>".to_owned(),
        "<methodCall></methodCall>".to_owned(),
        "<methodResponse><params></params></methodResponse>".to_owned(),
        "<methodCall><methodName>getPid</methodName></methodCall> trailing".to_owned(),
        "<methodCall><methodName>getPid</methodName><params>".to_owned(),
        "<!DOCTYPE x [<!ENTITY a \"b\">]><methodCall><methodName>&a;</methodName></methodCall>"
            .to_owned(),
        call(""),
        call("<params/>"),
        value("untyped  text "),
        value("<string>&lt;&amp;&gt; &#65; <![CDATA[<raw>]]></string>"),
        value("<i4>5</i4>"),
        value("<int>-2147483648</int>"),
        value("<int>2147483648</int>"),
        value("<i8>99999999999</i8>"),
        value("<int>five</int>"),
        value("<boolean>1</boolean>"),
        value("<boolean>2</boolean>"),
        value("<double>1e3</double>"),
        value("<double>nan</double>"),
        value("<nil/>"),
        value("<array><data><value><nil/></value></data></array>"),
        value("<struct><member><name>a</name><value><i4>1</i4></value></member></struct>"),
        value("<struct><member><name>a</name></member></struct>"),
        value("<base64>aGVsbG8=</base64>"),
        value("<dateTime.iso8601>20260101T00:00:00</dateTime.iso8601>"),
        value("<unknown>1</unknown>"),
        value(&format!(
            "{}{}",
            "<array><data><value>".repeat(50),
            "</value></data></array>".repeat(50)
        )),
        value("\u{1}"),
    ];
    let mut differences = Vec::new();
    for body in bodies {
        differences.extend(twins.compare(&http_request(body.as_bytes())).err());
        twins.same(&http_request(&encode_call("getParam", params!["/c", "/v"])));
        let _ = twins.same_call("deleteParam", params!["/c", "/v"]);
    }
    let mut broken = value("<string>text</string>").into_bytes();
    let place = broken
        .windows(4)
        .rposition(|window| window == b"text")
        .unwrap();
    broken[place] = 0xff;
    differences.extend(twins.compare(&http_request(&broken)).err());
    assert!(differences.is_empty(), "{}", differences.join("\n\n"));
}

#[test]
fn paths_methods_and_versions() {
    let twins = Twins::start();
    let body = encode_call("hasParam", params!["/c", "/x"]);
    let mut differences = Vec::new();
    for path in [
        "/",
        "/RPC2",
        "//",
        "/rpc2",
        "/RPC2/",
        "/RPC2?x=1",
        "/other",
        "/a/b",
        "*",
    ] {
        for version in ["HTTP/1.1", "HTTP/1.0"] {
            let first = format!("POST {path} {version}");
            differences.extend(twins.compare(&request(&first, &[], &body)).err());
        }
    }
    for method in ["HEAD", "OPTIONS", "PUT", "DELETE", "TRACE", "PATCH", "BREW"] {
        let mut wires = [
            twins.bare.connect().unwrap(),
            twins.through.connect().unwrap(),
        ];
        let codes = wires.each_mut().map(|wire| {
            wire.send(&request(&format!("{method} / HTTP/1.1"), &[], b""))
                .unwrap();
            wire.head().unwrap().code
        });
        if codes[0] != codes[1] {
            differences.push(format!("{method}: {codes:?}"));
        }
    }
    assert!(differences.is_empty(), "{}", differences.join("\n\n"));
}

#[test]
fn get_uri_is_the_address_of_rosrescue() {
    let twins = Twins::start();
    assert_eq!(
        twins.through.ok("getUri", params!["/c"]),
        Value::from(twins.through.uri())
    );
    assert_eq!(twins.through.master_pid(), twins.behind.master_pid());
    let several = Call::multicall([Call::new("getUri", params!["/c"])]);
    let response = twins
        .through
        .call("system.multicall", several.params)
        .unwrap();
    assert!(
        !format!("{response:?}").contains(&twins.behind.uri()),
        "{response:?}"
    );
    // What is wrong about the call is the master's to say.
    twins.same_call("getUri", params![]);
    twins.same_call("getUri", params!["/c", 1]);
}
