//! A master, or a node that is asked by the census, that answers garbage: the client gets the master's own
//! bytes where they are HTTP and a closed connection else, never an invented answer; nothing is recorded
//! that was no success.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod support;

use std::fs;
use std::time::Duration;

use rosrescue::xmlrpc::{Reply, Value};
use support::{
    Client, FakeMaster, FakeNode, Mode, Rescue, Robot, Rosmaster, Scratch, Setup, encode_call,
    eventually, holds, http_request, params,
};

/// A master that is real but for calls that mention `/poison`: those get `answer`.
struct Poisoned {
    // The order is that of the drops.
    rescue: Rescue,
    _fake: FakeMaster,
    real: Rosmaster,
    _scratch: Scratch,
}

impl Poisoned {
    fn start(answer: Vec<u8>) -> Self {
        let scratch = Scratch::new();
        let real = Rosmaster::start(&scratch);
        let master = real.client();
        let fake = FakeMaster::start(move |body| {
            if body.windows(7).any(|window| window == b"/poison") {
                return answer.clone();
            }
            match master.exchange(&http_request(body)) {
                Ok(response) => FakeMaster::proper(&response.reply()),
                Err(_) => Vec::new(),
            }
        });
        let rescue = Setup::proxy(&scratch, fake.port())
            .args(["--hold", "2"])
            .start();
        Self {
            rescue,
            _fake: fake,
            real,
            _scratch: scratch,
        }
    }
}

/// Status and body that the client must get, if that is certain.
type Due<'a> = Option<(u16, &'a str)>;

#[test]
fn garbage_from_the_master() {
    let http = |head: &str, body: &str| format!("{head}\r\n\r\n{body}").into_bytes();
    let with = |status: &str, body: &str| {
        http(
            &format!("HTTP/1.1 {status}\r\nContent-Length: {}", body.len()),
            body,
        )
    };
    let fine = "<methodResponse><params><param><value><array><data><value><int>1</int></value>\
                <value><string>ok</string></value><value><int>0</int></value></data></array></value>\
                </param></params></methodResponse>";
    let cases: Vec<(Vec<u8>, Due<'_>)> = vec![
        (b"".to_vec(), None),
        (b"SSH-2.0-OpenSSH_9.2\r\n".to_vec(), None),
        (b"\x00\x01\x02\x03".to_vec(), None),
        (b"HTTP/1.1".to_vec(), None),
        (b"HTTP/1.1 200 OK\r\nContent-".to_vec(), None),
        (
            http("HTTP/1.1 200 OK\r\nContent-Length: 100000", fine),
            None,
        ),
        (http("HTTP/1.1 200 OK\r\nContent-Length: many", fine), None),
        (
            http("HTTP/1.1 200 OK\r\nContent-Length: 10000000000", fine),
            None,
        ),
        (
            http("HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked", "zz\r\n"),
            None,
        ),
        (with("200 OK", ""), None),
        (with("200 OK", "not xml"), Some((200, "not xml"))),
        (
            with("200 OK", "<methodResponse>"),
            Some((200, "<methodResponse>")),
        ),
        (with("200 OK", "<a><b/></a>"), Some((200, "<a><b/></a>"))),
        (
            with("500 Internal Server Error", "<html>oops</html>"),
            Some((500, "<html>oops</html>")),
        ),
        (with("503 Busy", fine), Some((503, fine))),
        (
            with(
                "200 OK",
                "<methodResponse><params><param><value><int>1</int></value></param></params></methodResponse>",
            ),
            None,
        ),
    ];
    for (number, (answer, due)) in cases.into_iter().enumerate() {
        let poisoned = Poisoned::start(answer);
        let client = poisoned.rescue.client();
        client.set_param("/kept", 1);
        let body = encode_call("setParam", params!["/c", "/poison", "in the cup"]);
        let got = client.exchange(&http_request(&body));
        match (&got, due) {
            (Ok(response), Some((code, text))) => {
                assert_eq!(
                    (response.code, response.text().as_str()),
                    (code, text),
                    "case {number}"
                );
                assert_eq!(
                    response.header("content-length"),
                    Some(&*text.len().to_string())
                );
            }
            (Ok(response), None) => {
                let invented = response.code == 200 && response.text().contains("fault");
                assert!(!invented, "case {number}: {}", response.text());
            }
            (Err(error), None) => {
                assert_ne!(
                    error.kind(),
                    std::io::ErrorKind::WouldBlock,
                    "case {number}"
                );
            }
            (Err(error), Some(_)) => panic!("case {number}: {error}"),
        }
        // The others are served, and what was no success is not recorded as one.
        eventually("other calls pass", || {
            client.ask("setParam", params!["/c", "/kept", 2]).is_some()
        });
        assert_eq!(poisoned.real.client().param("/kept"), Some(2.into()));
        let checkpoint = fs::read_to_string(poisoned.rescue.checkpoint()).unwrap();
        assert!(
            checkpoint.contains("kept") && !checkpoint.contains("poison"),
            "{checkpoint}"
        );
        poisoned.rescue.assert_no_panic();
    }
}

/// What is HTTP and a success arrives, in whatever form the master sends it.
#[test]
fn unusual_but_right_answers_of_the_master() {
    let reply = Reply::Value(Value::Array(vec![1.into(), "unusual".into(), 0.into()]));
    let body = String::from_utf8(rosrescue::xmlrpc::encode_reply(&reply)).unwrap();
    let (left, right) = body.split_at(body.len() / 2);
    let answers = [
        format!("HTTP/1.0 200 OK\r\n\r\n{body}"),
        format!(
            "HTTP/1.1 200 Fine\r\ncontent-length:{}\r\n\r\n{body}",
            body.len()
        ),
        format!(
            "HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n{:x}\r\n{left}\r\n{:x}\r\n{right}\r\n0\r\n\r\n",
            left.len(),
            right.len()
        ),
    ];
    for answer in answers {
        let poisoned = Poisoned::start(answer.clone().into_bytes());
        let call = encode_call("setParam", params!["/c", "/poison", 1]);
        let response = poisoned
            .rescue
            .client()
            .exchange(&http_request(&call))
            .unwrap();
        assert_eq!(response.text(), body, "{answer}");
        assert!(
            response
                .headers
                .iter()
                .any(|line| line.starts_with("Content-Length: ")
                    || line.starts_with("Content-length: ")
                    || line.starts_with("content-length: "))
        );
        assert_eq!(response.header("transfer-encoding"), None, "{answer}");
        let checkpoint = fs::read_to_string(poisoned.rescue.checkpoint()).unwrap();
        assert!(
            checkpoint.contains("poison"),
            "a success is recorded: {answer}"
        );
    }
}

#[test]
fn something_that_is_no_master_at_all() {
    let scratch = Scratch::new();
    for (number, answer) in [
        &b"SSH-2.0-OpenSSH_9.2\r\n"[..],
        b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n",
        b"",
    ]
    .into_iter()
    .enumerate()
    {
        let fake = FakeMaster::start(move |_| answer.to_vec());
        let mut rescue = Setup::proxy(&scratch, fake.port())
            .args(["--hold", "1"])
            .at_checkpoint(scratch.path(format!("{number}.yaml")))
            .spawn();
        rescue.wait_line("something of its master", |line| {
            line.contains(&fake.port().to_string())
        });
        let client = rescue.client();
        eventually("it listens", || client.connect().is_ok());
        assert!(client.ask("setParam", params!["/c", "/x", 1]).is_none());
        // It does not spin: it asks with pauses.
        assert!(
            rescue.output().len() < 100,
            "{} lines",
            rescue.output().len()
        );
        assert_eq!(rescue.terminate().code(), Some(0));
    }
}

/// A node's own port that answers nothing, or everything, harms no one (the census asks it).
#[test]
fn nodes_that_answer_garbage_to_the_census() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let garbage = FakeMaster::start(|_| b"garbage\r\n\r\n".to_vec());
    let silent = FakeNode::start("/silent");
    silent.publish(&client, "/topic", "std_msgs/String");
    silent.hold();
    let api = Client::new(garbage.port()).uri();
    client.ok(
        "registerPublisher",
        params!["/garbage", "/topic", "std_msgs/String", api],
    );
    let good = FakeNode::start("/good");
    good.subscribe(&client, "/topic", "std_msgs/String");
    let before = robot.settled_state();
    robot.crash_master();
    client.set_param("/goes/on", 1);
    client.ok("deleteParam", params!["/c", "/goes"]);
    assert!(holds(Duration::from_secs(5), || {
        let now = robot.state();
        now.knows("/silent") && now.knows("/good")
    }));
    silent.release();
    let (before, now) = (before.without_node("/garbage"), robot.settled_state());
    before.assert_same(&now.without_node("/garbage"), "after the census");
}
