//! Forwarding: a bare rosmaster and one behind rosrescue give the same answer to the same raw request,
//! whatever HTTP and XML-RPC allow or forbid, and in a form that all clients understand.

use ros1_master::xmlrpc::{Call, Value};

use crate::support::{Twins, encode_call, http_request, params, request, stop, tree};

#[test]
fn calls_are_answered_with_the_same_bytes_as_by_a_bare_master() {
    let twins = Twins::start();
    let api = "http://127.0.0.1:1/";
    // One call of each kind. `tests/differential` makes any number of them.
    let calls = [
        (
            "setParam",
            params!["/ns/c", "~b", tree! { "x" => 1.5, "y" => true }],
        ),
        ("getParam", params!["/c", "/"]),
        ("getParam", params!["/c", "/not/there"]),
        ("searchParam", params!["/ns/c", "a"]),
        ("registerPublisher", params!["/p", "/t", "no type", api]),
        ("subscribeParam", params!["/s", api, "/c"]),
        ("lookupNode", params!["/c", "/nobody"]),
        ("getSystemState", params!["/c"]),
        ("getTopicTypes", params!["/c"]),
        ("unregisterPublisher", params!["/p", "/t", api]),
        ("noSuchMethod", params!["/c", 1]),
        ("system.listMethods", params![]),
        ("getPid", params!["/c", "too", "many"]),
        ("setParam", params![1, 2, 3]),
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
    // Only getUri has another answer: the address of rosrescue.
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
    // The master reports errors in the parameters of a call.
    twins.same_call("getUri", params![]);
    twins.same_call("getUri", params!["/c", 1]);
}

#[test]
fn every_kind_of_xml_is_answered_as_by_a_bare_master() {
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
    // One document of each kind. `tests/codec` tries any number of them.
    let bodies = [
        String::new(),
        "garbage".to_owned(),
        "<methodCall></methodCall>".to_owned(),
        "<methodCall><methodName>getPid</methodName><params>".to_owned(),
        call("<params/>"),
        value("untyped  text "),
        value("<string>&lt;&amp;&gt; &#65; <![CDATA[<raw>]]></string>"),
        value("<i8>99999999999</i8>"),
        value("<int>five</int>"),
        value("<nil/>"),
        value("<struct><member><name>a</name></member></struct>"),
        value("<dateTime.iso8601>20260101T00:00:00</dateTime.iso8601>"),
        value("<unknown>1</unknown>"),
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

/// The XML-RPC code of an STM32 library writes bare line feeds, a `Host` with a typing error and `<param>` within
/// `<param>`. The content type is the default of curl, wget and ESP-IDF.
fn board(node: &str) -> Vec<u8> {
    let body = format!(
        "<?xml version=\"1.0\"?> <methodCall> <methodName>registerPublisher</methodName> <params> <param> \
         <value>{node}</value> </param> <param> <value>chatter</value> <param> <value>std_msgs/String</value> </param> \
         <param> <value>http://127.0.0.1:9/</value> </param> </param> </params> </methodCall>"
    );
    let length = body.len();
    let head = format!(
        "POST / HTTP/1.1\nUser-Agent: curl/7.35.0\nHost: pc:11311\\Accept: */*\nContent-Length: {length}\n\
         Content-Type: application/x-www-form-urlencoded\n\n"
    );
    (head + &body).into_bytes()
}

#[test]
fn boards_are_answered_as_by_a_bare_master() {
    let twins = Twins::start_with(&["--probe-timeout", "500"]);
    let state = encode_call("getSystemState", params!["/script"]);
    let compare = |node: &str| {
        twins.same(&board(node));
        for header in [
            "Content-Type: application/x-www-form-urlencoded",
            "Content-Type: text/plain",
            "Content-Type: application/json",
            "Content-Type: ",
            // mROS
            "Host: ",
            // Java 11
            "Connection: Upgrade, HTTP2-Settings\r\nUpgrade: h2c\r\nHTTP2-Settings: AAMAAABkAAQAAP__",
        ] {
            let length = state.len();
            let head = format!("POST / HTTP/1.1\r\n{header}\r\nContent-Length:{length}\r\n\r\n");
            let answer = twins.same(&[head.as_bytes(), &state].concat());
            assert!(answer.text().contains(node), "{header}");
        }
    };
    compare("/first");
    // The mirror answers while the master hangs.
    stop(twins.behind.master_pid().expect("a master"));
    compare("/second");
}

#[test]
fn http_paths_methods_and_versions_are_treated_as_by_a_bare_master() {
    let twins = Twins::start();
    let body = encode_call("hasParam", params!["/c", "/x"]);
    let mut differences = Vec::new();
    for path in ["/", "/RPC2", "//", "/rpc2", "/RPC2/", "/other", "*"] {
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
