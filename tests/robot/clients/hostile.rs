//! Requests that clients should not send: bytes that are not HTTP, malicious XML, incomplete requests, and
//! requests from web pages. Each is refused or gets the master's own answer, and other clients are served all
//! the time.

use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::time::Duration;

use ros1_master::xmlrpc::{Call, Reply, Value};

use crate::support::{
    Client, Mode, Netns, PATIENCE, Robot, Scratch, Setup, encode_call, eventually, free_port, gzip,
    http_request, params, request, within,
};

#[test]
fn bytes_that_are_not_http_are_refused_and_other_clients_served() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    client.set_param("/kept", 1);
    let body = encode_call("setParam", params!["/c", "/garbage", 1]);
    let text = String::from_utf8(body.clone()).unwrap();
    let length = body.len();
    let mut cases: Vec<Vec<u8>> = vec![
        b"\n\n\n\n".to_vec(),
        b"garbage\r\n\r\n".to_vec(),
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03TLS client hello".to_vec(),
        b"SSH-2.0-OpenSSH\r\n".to_vec(),
        b"POST\r\n\r\n".to_vec(),
        b"POST / HTTP/9.9\r\n\r\n".to_vec(),
        b"POST / HTTP/1.1\r\nno colon\r\n\r\n".to_vec(),
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec(),
        (0..=255).collect(),
        vec![0; 100_000],
        format!("POST / HTTP/1.1\r\nContent-Length: -1\r\n\r\n{text}").into(),
        format!("POST / HTTP/1.1\r\nContent-Length: many\r\n\r\n{text}").into(),
        format!("POST / HTTP/1.1\r\nContent-Length: 99999999999999999999\r\n\r\n{text}").into(),
        format!("POST / HTTP/1.1\r\nContent-Length: 10000000000\r\n\r\n{text}").into(),
        format!("POST / HTTP/1.1\r\nContent-Length: {length}\r\nContent-Length: 3\r\n\r\n{text}")
            .into(),
        format!("POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n{text}\r\n0\r\n\r\n")
            .into(),
        format!("POST /{} HTTP/1.1\r\n\r\n", "a".repeat(1_000_000)).into(),
        format!("POST / HTTP/1.1\r\nX: {}\r\n\r\n", "a".repeat(1_000_000)).into(),
        format!("POST / HTTP/1.1\r\n{}\r\n", "X: y\r\n".repeat(100_000)).into(),
    ];
    // A whole request, cut short at different places.
    let whole = http_request(&body);
    for end in (1..whole.len()).step_by(17) {
        cases.push(whole[..end].to_vec());
    }
    for bytes in &cases {
        let mut wire = client.connect().unwrap();
        wire.set_patience(PATIENCE);
        // rosrescue may refuse a request before it has read all of it.
        let _ = wire.send(bytes);
        let _ = wire.finish();
        if let Ok(response) = wire.response() {
            let shown = String::from_utf8_lossy(&bytes[..bytes.len().min(80)]).into_owned();
            assert!(response.code >= 400, "{}: {shown}", response.status);
        }
    }
    assert_eq!(client.param("/kept"), Some(1.into()));
    assert_eq!(robot.bare().param("/garbage"), None);
    robot.rescue.assert_no_panic();
}

/// Deep or endless XML exhausts neither the stack nor the memory.
#[test]
fn malicious_xml_is_refused_and_other_clients_are_served() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    client.set_param("/kept", 1);
    let wrap = |value: &str| {
        format!(
            "<methodCall><methodName>setParam</methodName><params><param><value>/c</value></param>\
             <param><value>/hostile</value></param><param><value>{value}</value></param></params></methodCall>"
        )
    };
    let deep = |depth: usize| {
        wrap(&format!(
            "{}{}",
            "<array><data><value>".repeat(depth),
            "</value></data></array>".repeat(depth)
        ))
    };
    let many: String = "<value><i4>1</i4></value>".repeat(50_000);
    let bodies = [
        deep(10_000),
        deep(50_000),
        "<a>".repeat(100_000),
        wrap(&format!("<array><data>{many}</data></array>")),
        wrap(&format!("<int>{}</int>", "9".repeat(200_000))),
        wrap(&format!("<double>{}</double>", "9".repeat(200_000))),
        wrap(&format!("<base64>{}</base64>", "=".repeat(200_000))),
        format!(
            "<methodCall><methodName>{}</methodName></methodCall>",
            "m".repeat(1_000_000)
        ),
        format!(
            "<?xml version='1.0' encoding='{}'?><methodCall/>",
            "x".repeat(200_000)
        ),
    ];
    for body in bodies {
        let mut wire = client.connect().unwrap();
        let _ = wire.send(&http_request(body.as_bytes()));
        // The client gets the master's own answer, whatever it is, or the connection ends.
        let _ = wire.response();
        assert_eq!(client.param("/kept"), Some(1.into()), "{:.60}", body);
    }
    robot.rescue.assert_no_panic();
}

#[test]
fn an_incomplete_request_is_ended_after_a_time_limit() {
    let robot = Robot::start(Mode::Proxy);
    let whole = http_request(&encode_call("setParam", params!["/c", "/half", 1]));
    let head = whole
        .windows(4)
        .position(|window| window == b"\r\n\r\n")
        .unwrap();
    let mut wires = [10, head, whole.len() - 1].map(|end| {
        let mut wire = robot.client().connect().unwrap();
        wire.send(&whole[..end]).unwrap();
        (end, wire)
    });
    for (end, wire) in &mut wires {
        wire.set_patience(PATIENCE);
        match wire.response() {
            Ok(response) => assert_eq!(response.code, 408, "{}", response.status),
            Err(error) => assert_ne!(
                error.kind(),
                std::io::ErrorKind::WouldBlock,
                "a request of {end} bytes has still not been ended after {PATIENCE:?}"
            ),
        }
    }
    assert_eq!(robot.bare().param("/half"), None);
}

/// A client that announces a large body and sends little or nothing takes no memory from others and is
/// dropped.
#[test]
fn a_body_that_is_only_announced_takes_no_memory_from_others() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let head = "POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 67108864\r\n\r\n";
    let chunked = "POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n";
    let wires: Vec<_> = (0..40)
        .map(|number| {
            let mut wire = client.connect().unwrap();
            let more = " ".repeat([0, 1, 100_000][number % 3]);
            match number % 2 {
                0 => wire.send(format!("{head}{more}").as_bytes()).unwrap(),
                _ => wire
                    .send(format!("{chunked}{:x}\r\n{more}", 64 << 20).as_bytes())
                    .unwrap(),
            }
            wire
        })
        .collect();
    // rosrescue gives these requests up after 10 s.
    within(Duration::from_secs(8), "two large writes", || {
        for key in ["/large", "/large_too"] {
            client.set_param(key, "z".repeat(1 << 20));
        }
    });
    assert_eq!(
        robot.bare().param("/large"),
        Some("z".repeat(1 << 20).into())
    );
    for mut wire in wires {
        assert!(
            wire.closes(PATIENCE),
            "rosrescue has not closed the connection"
        );
    }
}

/// Memory has room for four bodies of the largest size. When more bodies have each been half sent, they must not wait
/// for each other forever.
#[test]
fn more_large_bodies_than_fit_into_memory_are_accepted_in_turn() {
    let robot = Robot::start_with(Mode::Proxy, &["--max-body", "1"]);
    let client = robot.client();
    let requests: Vec<_> = (0..12)
        .map(|number| {
            let key = format!("/large/of{number}");
            http_request(&encode_call(
                "setParam",
                params!["/c", key, "z".repeat(1_000_000)],
            ))
        })
        .collect();
    let halves = std::sync::Barrier::new(requests.len());
    std::thread::scope(|scope| {
        for request in &requests {
            let (client, halves) = (client.clone(), &halves);
            scope.spawn(move || {
                let mut wire = client.connect().unwrap();
                let (first, second) = request.split_at(request.len() / 2);
                wire.send(first).unwrap();
                // Each client has sent one half of its body by now.
                halves.wait();
                wire.send(second).unwrap();
                assert_eq!(wire.response().unwrap().code, 200);
            });
        }
    });
    let tree = robot.bare().param("/large").unwrap();
    assert_eq!(tree.as_struct().unwrap().len(), requests.len());
    // A body in chunks does not say how long it is. This one does not end.
    let mut wire = client.connect().unwrap();
    let head = "POST /RPC2 HTTP/1.1\r\nHost: robot\r\nContent-Type: text/xml\r\nTransfer-Encoding: chunked\r\n\r\n";
    let chunk = format!("10000\r\n{}\r\n", "z".repeat(0x10000));
    wire.send((head.to_owned() + &chunk.repeat(17)).as_bytes())
        .unwrap();
    assert_eq!(wire.response().unwrap().code, 413);
}

/// rosmaster does not read the body after a head that it refuses. The rest in that connection must not become
/// part of another request.
#[test]
fn a_refused_request_does_not_affect_other_calls() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    client.set_param("/kept", 1);
    let body = encode_call("getParam", params!["/c", "/kept"]);
    let refused = [
        request("POST /no/such/page HTTP/1.1", &[], &body),
        request("POST /RPC2 HTTP/1.1", &["Content-Encoding: br"], &body),
        request("POST /RPC2 HTTP/1.1", &["Content-Encoding: gzip"], &body),
        request("PUT / HTTP/1.1", &[], &body),
    ];
    for bytes in refused.iter().cycle().take(20) {
        let response = client.exchange(bytes).unwrap();
        assert!(response.code >= 400, "{}", response.status);
        for _ in 0..5 {
            let answer = client.status("getParam", params!["/c", "/kept"]);
            assert_eq!(answer.expect("an answer").2, 1.into());
        }
    }
}

/// A page that someone on the robot's network opens in a browser must not be able to set parameters.
#[test]
fn a_web_page_cannot_change_anything() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let body = encode_call("setParam", params!["/c", "/evil", 1]);
    let length = body.len();
    let text = String::from_utf8(body.clone()).unwrap();
    let post =
        |head: &str| format!("POST / HTTP/1.1\r\n{head}Content-Length: {length}\r\n\r\n{text}");
    // As sent by `fetch(url, {method: 'POST', mode: 'no-cors', body: new Uint8Array(...)})`.
    let address = format!("Host: 127.0.0.1:{}\r\n", robot.port());
    let untyped = |origin: &str| post(&format!("{address}Origin: {origin}\r\n"));
    // The content types that a browser sends without asking first, and XML-RPC's.
    let types = [
        "text/plain",
        "text/plain;charset=UTF-8",
        "application/x-www-form-urlencoded",
        "multipart/form-data; boundary=x",
        "text/xml",
    ];
    let foreign = [
        "Origin: http://evil.example",
        "Origin: null",
        "Sec-Fetch-Site: cross-site",
        "Sec-Fetch-Site: same-site",
    ];
    let of_pages = types.iter().flat_map(|kind| {
        let (post, address) = (&post, &address);
        let of = foreign.iter();
        of.map(move |header| post(&format!("{address}Content-Type: {kind}\r\n{header}\r\n")))
    });
    let untyped_or_rebound = [
        untyped("http://evil.example"),
        untyped("http://127.0.0.1:8000"),
        untyped("null"),
        // A page whose own name was pointed at this address.
        post(
            "Host: evil.example\r\nOrigin: http://evil.example\r\nSec-Fetch-Site: same-origin\r\n",
        ),
    ];
    for bytes in of_pages.chain(untyped_or_rebound) {
        let response = client.exchange(bytes.as_bytes()).unwrap();
        assert_eq!(response.code, 403, "{}: {bytes}", response.status);
    }
    assert_eq!(robot.bare().param("/evil"), None);
    let fine = [
        request("POST / HTTP/1.1", &[], &body),
        // Clients that are not browsers: without a content type, and with a host name unknown to us.
        post(&address).into_bytes(),
        post("Host: robot.example:11311\r\nContent-Type: text/xml\r\n").into_bytes(),
        post("").into_bytes(),
        // Boards, with the default content type of curl, wget and ESP-IDF.
        post("Content-Type: application/x-www-form-urlencoded\r\n").into_bytes(),
        post("Content-Type: text/plain\r\n").into_bytes(),
        // A page that rosrescue itself has served.
        untyped(&format!("http://127.0.0.1:{}", robot.port())).into_bytes(),
    ];
    for bytes in &fine {
        assert_eq!(client.exchange(bytes).unwrap().code, 200);
        // The mirror may answer for a late master, because it still has the value.
        eventually("the master has the value", || {
            robot.bare().param("/evil") == Some(1.into())
        });
        robot.bare().ok("deleteParam", params!["/c", "/evil"]);
    }
}

/// `curl $ROS_MASTER_URI` must work with any name of the robot, but a page whose own host name was pointed at
/// our address must not be able to read it.
#[test]
fn the_status_page_is_served_under_every_name_of_the_computer() {
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).env("ROS_HOSTNAME", "unit7.robots.example");
    let rescue = setup.start();
    let code = |host: &str| {
        let page = format!("GET / HTTP/1.1\r\nHost: {host}:{}\r\n\r\n", rescue.port());
        rescue.client().exchange(page.as_bytes()).unwrap().code
    };
    let system = rustix::system::uname();
    let hostname = system.nodename().to_str().unwrap();
    for host in [
        "127.0.0.1",
        "localhost",
        hostname,
        "unit7.robots.example",
        "Unit7.local",
        "unit7",
    ] {
        assert_eq!(code(host), 200, "{host}");
    }
    for host in [
        "evil.example",
        "evil.unit7",
        "unit71.local",
        "unit7.evil.example",
        &format!("{hostname}.evil.example"),
    ] {
        assert_eq!(code(host), 403, "{host}");
    }
}

/// rosrescue recognises its own requests to end itself if the master's address leads back to it. A program
/// that has seen such a request could use its mark otherwise.
#[test]
fn a_mark_that_was_seen_in_a_request_to_the_master_does_not_end_rosrescue() {
    let scratch = Scratch::new();
    let master = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = master.local_addr().unwrap().port();
    let rescue = Setup::proxy(&scratch, port).spawn();
    let next_mark = || {
        loop {
            let (connection, _) = master.accept().unwrap();
            connection
                .set_read_timeout(Some(Duration::from_millis(500)))
                .unwrap();
            let lines = BufReader::new(connection).lines().map_while(Result::ok);
            let mark = lines.take_while(|line| !line.is_empty()).find_map(|line| {
                let (name, value) = line.split_once(": ")?;
                let is_mark = name.eq_ignore_ascii_case("x-rosrescue-instance");
                is_mark.then(|| value.to_owned())
            });
            if let Some(mark) = mark {
                return mark;
            }
        }
    };
    let seen = next_mark();
    // The first request has failed by now.
    next_mark();
    let body = encode_call("getUri", params!["/c"]);
    for mark in [seen, "0".to_owned()] {
        let header = format!("X-Rosrescue-Instance: {mark}");
        let bytes = request("POST / HTTP/1.1", &[&header], &body);
        assert_eq!(rescue.client().exchange(&bytes).unwrap().code, 200);
    }
    assert_eq!(
        rescue
            .client()
            .exchange(&request("POST / HTTP/1.1", &[], &body))
            .unwrap()
            .code,
        200
    );
    rescue.assert_no_panic();
}

/// Tries every form of `shutdown` that rosmaster understands. From another computer, rosrescue does not
/// forward what it cannot read.
#[test]
fn no_other_computer_can_shut_the_master_down() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).env("ROS_IP", net.near());
    let rescue = setup.start();
    let here = rescue.client();
    // A connection to one of our own addresses comes from that address, which is not loopback.
    let elsewhere = Client::at(&net.near(), rescue.port());
    let plain = encode_call("shutdown", params!["/evil", "because"]);
    let text = String::from_utf8(plain.clone()).unwrap();
    let document = &text[text.find("<methodCall").unwrap()..];
    let utf16 = |text: &str, mark: bool| {
        let text = format!("{}{text}", if mark { "\u{feff}" } else { "" });
        let units = text.encode_utf16();
        units.flat_map(u16::to_le_bytes).collect::<Vec<u8>>()
    };
    let within = |more: Value| {
        let several = [
            Call::new("hasParam", vec!["/evil".into(), more]),
            Call::new("shutdown", params!["/evil", "because"]),
        ];
        encode_call("system.multicall", Call::multicall(several).params)
    };
    let odd = String::from_utf8(within("odd".into())).unwrap();
    let (first, second) = plain.split_at(30);
    let with = |header: &str, body: &[u8]| request("POST /RPC2 HTTP/1.1", &[header], body);
    let requests = [
        http_request(&plain),
        http_request(&within(1.into())),
        http_request(odd.replace("odd", "<bigdecimal>1</bigdecimal>").as_bytes()),
        with("Content-Encoding: identity", &plain),
        with("Content-Encoding: Identity", &plain),
        with("Content-Encoding: br", &plain),
        with("Content-Encoding: gzip", &gzip(&plain)),
        with("content-encoding: GZip", &gzip(&plain)),
        with(
            "Content-Encoding: gzip",
            &[gzip(first), gzip(second)].concat(),
        ),
        http_request(format!("<!DOCTYPE methodCall>{document}").as_bytes()),
        http_request(
            format!("<!DOCTYPE a [<!ENTITY b 'shutdown'>]>{document}")
                .replace(">shutdown<", ">&b;<")
                .as_bytes(),
        ),
        http_request(format!("<?xml version='1.0' encoding='cp1252'?>{document}").as_bytes()),
        http_request(&utf16(document, true)),
        http_request(&utf16(
            &format!("<?xml version='1.0' encoding='utf-16'?>{document}"),
            false,
        )),
        with("Content-Encoding: gzip", &gzip(&utf16(document, true))),
        with(
            "Content-Encoding: gzip",
            &gzip(&[&plain[..], &[b' '; 20 << 20]].concat()),
        ),
        http_request(b"garbage"),
    ];
    let master = here.master_pid().expect("a master");
    for (number, bytes) in requests.iter().enumerate() {
        let response = elsewhere.exchange(bytes).unwrap();
        match response.reply() {
            Reply::Fault { text, .. } => assert!(text.contains("own computer"), "{text}"),
            Reply::Value(value) => {
                let refusal = value.as_array().and_then(<[_]>::first);
                assert_eq!(refusal, Some(&(-1).into()), "request {number}: {value:?}");
            }
        }
    }
    // A master tells a node whose name is taken to shut down. Here that node's address is rosrescue's.
    for api in [rescue.client().uri().as_str(), "http://127.0.0.1:1/"] {
        let node = params!["/evil", "/t", "std_msgs/String", api];
        elsewhere.ok("registerPublisher", node);
    }
    eventually("the master has tried to shut rosrescue down", || {
        let log = rescue.output();
        log.iter()
            .any(|line| line.contains("registered at rosrescue's address"))
    });
    // All other calls pass.
    let body = encode_call("setParam", params!["/far", "/far", 1]);
    for header in [
        "Content-Encoding: IDENTITY",
        "Content-Type: text/xml; charset=utf-8",
    ] {
        assert_eq!(elsewhere.exchange(&with(header, &body)).unwrap().code, 200);
    }
    assert_eq!(elsewhere.param("/far"), Some(1.into()));
    assert_eq!(here.master_pid(), Some(master));
    // A call from the same computer may have any form.
    here.exchange(&requests[8]).unwrap();
    eventually(
        "the master has been shut down, and there is another",
        || here.master_pid().is_some_and(|pid| pid != master),
    );
    assert_eq!(here.param("/far"), Some(1.into()));
}
