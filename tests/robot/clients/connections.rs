//! Connections of clients: how long they live, requests in pieces, many at once, large, compressed or slow,
//! over IPv4 and IPv6.

use std::thread;
use std::time::Duration;

use ros1_master::xmlrpc::{Reply, Value};

use crate::support::{
    Client, FakeNode, Mode, Robot, Rosmaster, Scratch, Setup, Twins, assert_form, encode_call,
    free_port, gzip, holds, http_request, params, request, within,
};

#[test]
fn connections_are_kept_as_long_as_a_bare_master_keeps_them() {
    let twins = Twins::start();
    let body = encode_call("hasParam", params!["/c", "/x"]);
    let cases: [(&str, &[&str], bool); 5] = [
        ("POST /RPC2 HTTP/1.1", &[], true),
        ("POST /RPC2 HTTP/1.1", &["Connection: close"], false),
        ("POST /RPC2 HTTP/1.0", &[], false),
        ("POST /RPC2 HTTP/1.0", &["Connection: keep-alive"], true),
        ("POST /RPC2 HTTP/1.1", &["Connection: keep-alive"], true),
    ];
    for (first, headers, lives) in cases {
        for (who, client) in [
            ("the bare master", &twins.bare),
            ("rosrescue", &twins.through),
        ] {
            let mut wire = client.connect().unwrap();
            wire.send(&request(first, headers, &body)).unwrap();
            assert_eq!(wire.response().unwrap().code, 200);
            if lives {
                for _ in 0..3 {
                    wire.send(&request(first, headers, &body)).unwrap();
                    assert_eq!(
                        wire.response().unwrap().code,
                        200,
                        "{who}: {first} {headers:?}"
                    );
                }
                assert!(
                    !wire.closes(Duration::from_millis(100)),
                    "{who}: {first} {headers:?}"
                );
            } else {
                assert!(
                    wire.closes(crate::support::PATIENCE),
                    "{who}: {first} {headers:?}"
                );
            }
        }
    }
}

#[test]
fn pipelined_requests_are_answered_in_order() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let mut bytes = Vec::new();
    for i in 0..50 {
        bytes.extend(http_request(&encode_call(
            "setParam",
            params!["/c", "/counter", i],
        )));
        bytes.extend(http_request(&encode_call(
            "getParam",
            params!["/c", "/counter"],
        )));
    }
    let mut wire = client.connect().unwrap();
    wire.send(&bytes).unwrap();
    for i in 0..50 {
        let reply = |value: Value| {
            Reply::Value(Value::Array(vec![
                1.into(),
                "Parameter [/counter]".into(),
                value,
            ]))
        };
        assert_eq!(wire.response().unwrap().code, 200);
        assert_eq!(wire.response().unwrap().reply(), reply(i.into()));
    }
}

#[test]
fn a_request_may_come_in_any_pieces() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let bytes = http_request(&encode_call("setParam", params!["/c", "/slow", "value"]));
    let mut wire = client.connect().unwrap();
    for piece in bytes.chunks(3) {
        wire.send(piece).unwrap();
        thread::sleep(Duration::from_micros(300));
    }
    assert_eq!(wire.response().unwrap().code, 200);
    assert_eq!(robot.bare().param("/slow"), Some("value".into()));
    // The client may close its half of the connection after the request.
    let mut wire = client.connect().unwrap();
    wire.send(&bytes).unwrap();
    wire.finish().unwrap();
    assert_eq!(wire.response().unwrap().code, 200);
}

/// rosmaster sends `100 Continue` too, but only together with the answer.
#[test]
fn expect_100_continue_is_answered_before_the_body_is_sent() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let body = encode_call("setParam", params!["/c", "/expected", 1]);
    let whole = request("POST /RPC2 HTTP/1.1", &["Expect: 100-continue"], &body);
    let (head, body) = whole.split_at(whole.len() - body.len());
    let mut wire = client.connect().unwrap();
    wire.send(head).unwrap();
    assert_eq!(wire.head().unwrap().code, 100);
    wire.send(body).unwrap();
    let response = wire.response().unwrap();
    assert_eq!(response.code, 200);
    assert_form(&response, "Expect: 100-continue");
    assert_eq!(robot.bare().param("/expected"), Some(1.into()));
    // A client that does not wait for it gets the answer as well.
    wire.send(&whole).unwrap();
    let mut response = wire.response().unwrap();
    if response.code == 100 {
        response = wire.response().unwrap();
    }
    assert_eq!(response.code, 200);
}

/// The default limit of `--max-body`.
#[test]
fn a_body_of_64_mib_is_accepted_and_a_larger_one_refused() {
    let twins = Twins::start();
    let text = "<0123456789abcdef>".repeat((1 << 20) / 18);
    twins.through.set_param("/large", text.as_str());
    assert_eq!(twins.through.param("/large"), Some(Value::String(text)));
    // The master answers these at once, because it has no such method.
    let around = encode_call("noSuchMethod", params![""]).len();
    let of_length =
        |length: usize| encode_call("noSuchMethod", params!["x".repeat(length - around)]);
    let small = twins.bare.call("noSuchMethod", params![]).unwrap();
    let answer = twins.through.exchange(&http_request(&of_length(64 << 20)));
    assert_eq!(answer.unwrap().reply(), small);
    // The head alone is enough, because it says how long the body is.
    let length = (64 << 20) + 1;
    let head =
        format!("POST /RPC2 HTTP/1.1\r\nHost: localhost\r\nContent-Length: {length}\r\n\r\n");
    let mut wire = twins.through.connect().unwrap();
    wire.send(head.as_bytes()).unwrap();
    assert_eq!(wire.response().unwrap().code, 413);
    assert!(twins.through.master_pid().is_some());
}

#[test]
fn compressed_requests_are_accepted() {
    let twins = Twins::start();
    let body = encode_call("setParam", params!["/c", "/zipped", "z".repeat(5000)]);
    let zipped = gzip(&body);
    twins.same(&request(
        "POST /RPC2 HTTP/1.1",
        &["Content-Encoding: gzip"],
        &zipped,
    ));
    assert_eq!(twins.behind.param("/zipped"), Some("z".repeat(5000).into()));
    // A client that accepts gzip gets an answer that it can read. An uncompressed one is readable too.
    let body = encode_call("getParam", params!["/c", "/zipped"]);
    let response = twins
        .through
        .exchange(&request(
            "POST /RPC2 HTTP/1.1",
            &["Accept-Encoding: gzip"],
            &body,
        ))
        .unwrap();
    assert_form(&response, "Accept-Encoding: gzip");
    if response.header("content-encoding").is_none() {
        assert_eq!(response.body, twins.same(&http_request(&body)).body);
    } else {
        assert_eq!(response.header("content-encoding"), Some("gzip"));
        assert!(response.body.starts_with(&[0x1f, 0x8b]));
    }
    // The master must refuse a body that is not gzip.
    let broken = request(
        "POST /RPC2 HTTP/1.1",
        &["Content-Encoding: gzip"],
        b"no gzip",
    );
    twins.same(&broken);
    twins.same(&request(
        "POST /RPC2 HTTP/1.1",
        &["Content-Encoding: br"],
        b"what",
    ));
}

#[test]
fn a_slow_client_does_not_delay_others() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let whole = http_request(&encode_call("setParam", params!["/c", "/half", 1]));
    let half: Vec<_> = (0..50)
        .map(|i| {
            let mut wire = client.connect().unwrap();
            wire.send(&whole[..10 + i * (whole.len() - 11) / 50])
                .unwrap();
            wire
        })
        .collect();
    // A node that accepts a publisherUpdate and does not answer delays no other node.
    let stuck = FakeNode::start("/stuck");
    stuck.subscribe(&client, "/topic", "std_msgs/String");
    stuck.hold();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    assert!(holds(Duration::from_millis(500), || {
        within(Duration::from_secs(5), "a write", || {
            client.set_param("/quick", 1);
        });
        true
    }));
    drop(half);
    assert_eq!(robot.bare().param("/half"), None);
}

#[test]
fn clients_and_the_master_may_use_ipv6() {
    let scratch = Scratch::new();
    let port = free_port();
    let _master = Rosmaster::start_with(&scratch, port, |command| {
        command.env("ROS_IPV6", "on").env("ROS_IP", "::1");
    });
    let uri = format!("http://[::1]:{port}");
    let bare = Client::at("[::1]", port);

    // rosrescue listens at all addresses by default.
    let listen = free_port();
    let mut rescue = Setup::bare(&scratch, ["proxy", "--master", &uri])
        .env("ROS_MASTER_URI", format!("http://localhost:{listen}"))
        .env("ROS_IP", "")
        .env("ROS_HOSTNAME", "localhost.localdomain")
        .at_port(listen)
        .start();
    for host in ["[::1]", "127.0.0.1"] {
        Client::at(host, listen).set_param("/from", host);
        assert_eq!(bare.param("/from"), Some(host.into()));
    }
    assert_eq!(rescue.terminate().code(), Some(0));

    let only = format!("[::1]:{listen}");
    let _rescue = Setup::bare(&scratch, ["proxy", "--master", &uri, "--listen", &only]).start();
    Client::at("[::1]", listen).set_param("/from", "one address");
    assert_eq!(bare.param("/from"), Some("one address".into()));
}
