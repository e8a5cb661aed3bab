//! A master that answers garbage. If the answer is HTTP, the client gets the master's own bytes. A master whose answer
//! is not HTTP, or is incomplete, counts as away: the mirror answers, and the next working master gets those writes.

use std::fs;
use std::sync::{Arc, Mutex};

use ros1_master::xmlrpc::{Call, Reply, Value};

use crate::support::{
    FakeMaster, FakeNode, Rescue, Rosmaster, Scratch, Setup, State, encode_call, eventually,
    eventually_some, http_request, params, status,
};

/// A real master behind a fake that gives a fixed answer to calls with a certain word.
struct Garbled {
    // Fields are dropped in this order.
    rescue: Rescue,
    _fake: FakeMaster,
    real: Rosmaster,
    answer: Arc<Mutex<(&'static [u8], Vec<u8>)>>,
    scratch: Scratch,
}

impl Garbled {
    /// Starts a master that gives `answer` to calls with `garbled`, without a slash because an injection sets parameters
    /// as members of the root. `reads` says whether the mirror or the master answers reads.
    fn start(answer: Vec<u8>, reads: &str) -> Self {
        let scratch = Scratch::new();
        let real = Rosmaster::start(&scratch);
        let master = real.client();
        let answer = Arc::new(Mutex::new((&b"garbled"[..], answer)));
        let said = answer.clone();
        let fake = FakeMaster::start(move |body| {
            let (word, answer) = &*said.lock().unwrap();
            if body.windows(word.len()).any(|window| window == *word) {
                return answer.clone();
            }
            match master.exchange(&http_request(body)) {
                Ok(response) => FakeMaster::proper(&response.reply()),
                Err(_) => Vec::new(),
            }
        });
        let rescue = Setup::proxy(&scratch, fake.port())
            .args(["--hold", "2", "--probe-interval", "100", "--reads", reads])
            // Writes and probes may take long on a busy computer. The mirror must not answer meanwhile, because this
            // master could never get those writes.
            .args(["--probe-timeout", "30000", "--stand-in-after", "30000"])
            .start();
        Self {
            rescue,
            _fake: fake,
            real,
            answer,
            scratch,
        }
    }

    /// Gives `answer` to calls that mention `word` from now on.
    fn say(&self, word: &'static [u8], answer: &[u8]) {
        *self.answer.lock().unwrap() = (word, answer.to_vec());
    }

    /// Checks that other calls are served, and that no failed call was recorded as a success.
    fn assert_sound(&self, case: &str, round: i32) {
        let client = self.rescue.client();
        eventually("other calls pass", || {
            let call = params!["/c", "/kept", round];
            client.ask("setParam", call).is_some()
        });
        assert_eq!(self.real.client().param("/kept"), Some(round.into()));
        let checkpoint = fs::read_to_string(self.rescue.checkpoint()).unwrap();
        assert!(
            checkpoint.contains("kept") && !checkpoint.contains("garbled"),
            "{case}: {checkpoint}"
        );
        self.rescue.assert_no_panic();
    }
}

const FAULT: &str = "<methodResponse><fault><value><struct><member><name>faultCode</name><value><int>1</int>\
                     </value></member><member><name>faultString</name><value><string>no</string></value>\
                     </member></struct></value></fault></methodResponse>";

fn with_status(status: &str, body: &[u8]) -> Vec<u8> {
    let length = body.len();
    // The fake closes the connection after this answer. Without `Connection: close` rosrescue may send the next call on
    // it before it is closed, and a master that loses a call counts as away.
    let head =
        format!("HTTP/1.1 {status}\r\nConnection: close\r\nContent-Length: {length}\r\n\r\n");
    [head.as_bytes(), body].concat()
}

/// Calls of `/c` that change a master's state, and calls that do not, all of them garbled. `subscribeParam`
/// is left out: if its reply is complete but unreadable, it is recorded as predicted, because no read shows
/// what became of it.
fn garbled_calls(node: &FakeNode) -> [Vec<(&'static str, Vec<Value>)>; 2] {
    let (api, service) = (node.api.as_str(), node.service_api());
    let set = || Call::new("setParam", params!["/c", "/garbled", "and more"]);
    let get = Call::new("getParam", params!["/c", "/garbled"]);
    let changes = vec![
        ("setParam", set().params),
        ("deleteParam", params!["/c", "/garbled"]),
        ("registerPublisher", params!["/c", "/garbled", "a/B", api]),
        ("registerSubscriber", params!["/c", "/garbled", "a/B", api]),
        ("registerService", params!["/c", "/garbled", service, api]),
        ("unregisterPublisher", params!["/c", "/garbled", api]),
        ("system.multicall", Call::multicall([set(), set()]).params),
    ];
    let reads = vec![
        ("getParam", params!["/c", "/garbled"]),
        ("lookupNode", params!["/c", "/garbled"]),
        ("getSystemState", params!["/garbled"]),
        ("system.multicall", Call::multicall([get]).params),
    ];
    [changes, reads]
}

#[test]
fn garbage_in_valid_http_is_forwarded_and_never_recorded_as_a_success() {
    let whole = |status: &str, body: &[u8]| {
        let code: u16 = status.split(' ').next().unwrap().parse().unwrap();
        (with_status(status, body), (code, body.to_vec()))
    };
    let fine = "<methodResponse><params><param><value><array><data><value><int>1</int></value>\
                <value><string>ok</string></value><value><int>0</int></value></data></array></value>\
                </param></params></methodResponse>";
    let number = "<methodResponse><params><param><value><int>1</int></value></param></params>\
                  </methodResponse>";
    // The master's answers, each with the status and body that the client must get.
    let cases = [
        whole("200 OK", b""),
        whole("200 OK", b"not xml"),
        whole("200 OK", b"<methodResponse>"),
        whole("200 OK", b"<a><b/></a>"),
        whole("200 OK", number.as_bytes()),
        whole("200 OK", FAULT.as_bytes()),
        whole("500 Internal Server Error", b"<html>oops</html>"),
        whole("503 Busy", fine.as_bytes()),
    ];
    let garbled = Garbled::start(Vec::new(), "master");
    let client = garbled.rescue.client();
    let node = FakeNode::start("/c");
    let [changes, reads] = garbled_calls(&node);
    let several = changes.last().unwrap().clone();
    for (number, (answer, (code, body))) in cases.into_iter().enumerate() {
        garbled.say(b"garbled", &answer);
        for (method, params) in &[changes.clone(), reads.clone()].concat() {
            if params == &several.1 && answer.ends_with(FAULT.as_bytes()) {
                continue; // Tested below.
            }
            let case = format!("case {number}, {method}");
            let request = http_request(&encode_call(method, params.clone()));
            // If the master is late, the mirror may answer a read, or a write that changes nothing.
            let response = eventually_some(&case, || {
                let response = client.exchange(&request).expect(&case);
                (response.code == code && response.body == body).then_some(response)
            });
            let length = body.len().to_string();
            assert_eq!(response.header("content-length"), Some(&*length), "{case}");
        }
        let round = i32::try_from(number).unwrap();
        garbled.assert_sound(&format!("case {number}"), round);
    }
    // A multicall that fails as a whole may have been run in part. That part counts as recorded until the
    // state has been read from the master and shows that nothing was run.
    garbled.say(b"garbled", &with_status("200 OK", FAULT.as_bytes()));
    let request = http_request(&encode_call("system.multicall", several.1));
    assert_eq!(client.exchange(&request).unwrap().text(), FAULT);
    client.set_param("/kept", 99);
    eventually("the checkpoint has no garbled write", || {
        let checkpoint = fs::read_to_string(garbled.rescue.checkpoint()).unwrap();
        !checkpoint.contains("garbled") && checkpoint.contains("99")
    });
    assert_eq!(status(&client)["state"]["params"], 1);
}

/// The repetition is not forgotten when other calls pass in the meantime. Until it succeeds, the master answers reads
/// itself.
#[test]
fn reading_the_masters_state_is_repeated_until_it_succeeds() {
    let garbled = Garbled::start(Vec::new(), "mirror");
    let client = garbled.rescue.client();
    // The answer to the call, and to each attempt to read the state.
    garbled.say(b"getTopicTypes", &with_status("200 OK", FAULT.as_bytes()));
    let set = Call::new("setParam", params!["/c", "/garbled", 1]);
    let types = Call::new("getTopicTypes", params!["/c"]);
    let request = http_request(&encode_call(
        "system.multicall",
        Call::multicall([set, types]).params,
    ));
    assert_eq!(client.exchange(&request).unwrap().text(), FAULT);
    client.set_param("/kept", 1);
    assert_eq!(client.param("/garbled"), None);
    assert_eq!(status(&client)["state"]["params"], 2);
    garbled.say(b"/no call says this", b"");
    eventually("the mirror equals the master", || {
        status(&client)["state"]["params"] == 1
    });
}

/// Each answer has exactly the bytes of a healthy master, and is true as soon as this master is healthy again.
#[test]
fn a_master_whose_answers_are_not_http_counts_as_away() {
    let broken = |head: &str, body: &str| format!("{head}\r\n\r\n{body}").into_bytes();
    let fine = "<methodResponse/>";
    let cases = [
        b"".to_vec(),
        b"SSH-2.0-OpenSSH_9.2\r\n".to_vec(),
        b"\x00\x01\x02\x03".to_vec(),
        b"HTTP/1.1".to_vec(),
        b"HTTP/1.1 200 OK\r\nContent-".to_vec(),
        broken("HTTP/1.1 200 OK\r\nContent-Length: 100000", fine),
        broken("HTTP/1.1 200 OK\r\nContent-Length: many", fine),
        broken("HTTP/1.1 200 OK\r\nContent-Length: 10000000000", fine),
        broken("HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked", "zz\r\n"),
    ];
    let garbled = Garbled::start(Vec::new(), "master");
    let client = garbled.rescue.client();
    let real = garbled.real.client();
    let twin = Rosmaster::start(&garbled.scratch);
    let well = twin.client();
    let node = FakeNode::start("/c");
    node.claim_publication("/garbled", Some("a/B"));
    node.claim_subscription("/garbled", Some("a/B"));
    let [changes, reads] = garbled_calls(&node);
    for (number, answer) in cases.into_iter().enumerate() {
        garbled.say(b"garbled", &answer);
        // Only the first call meets the master. Then it counts as away.
        let pairs = changes.iter().zip(reads.iter().cycle()).cycle();
        for (change, read) in pairs.skip(number).take(2) {
            for (method, params) in [change, read] {
                let case = format!("case {number}, {method}");
                let request = http_request(&encode_call(method, params.clone()));
                let response = client.exchange(&request).expect(&case);
                let right = well.exchange(&request).unwrap();
                assert_eq!(response.text(), right.text(), "{case}");
            }
        }
        assert_eq!(status(&client)["open"], false, "case {number}");
        assert_eq!(real.param("/garbled"), None, "case {number}");
        garbled.say(b"no call mentions this", b"");
        eventually("the gate is open", || status(&client)["open"] == true);
        let right = State::read(&well);
        right.assert_same(&State::read(&real), &format!("after case {number}"));
        right.assert_same(&State::read(&client), &format!("after case {number}"));
        let (api, service) = (node.api.as_str(), node.service_api());
        for (method, params) in [
            ("deleteParam", params!["/c", "/garbled"]),
            ("unregisterPublisher", params!["/c", "/garbled", api]),
            ("unregisterSubscriber", params!["/c", "/garbled", api]),
            ("unregisterService", params!["/c", "/garbled", service]),
        ] {
            let right = well.status(method, params.clone()).unwrap();
            assert_eq!(client.status(method, params).unwrap(), right);
        }
    }
    garbled.rescue.assert_no_panic();
}

/// A master that is out of memory behaves like this.
#[test]
fn a_master_that_answers_only_faults_for_a_while_counts_as_away() {
    let garbled = Garbled::start(Vec::new(), "master");
    let client = garbled.rescue.client();
    client.set_param("/kept", 1);
    let fault = with_status("200 OK", FAULT.as_bytes());
    garbled.say(b"<", &fault);
    let is_open = || status(&client)["open"] == true;
    let set = || {
        let call = encode_call("setParam", params!["/c", "/garbled", 1]);
        client.exchange(&http_request(&call))
    };
    let is_success = |text: &str| text.contains("parameter /garbled set");
    eventually("the gate is shut", || {
        // Until the gate is shut, the master's own answer is forwarded.
        let text = set().expect("an answer").text();
        assert!(text == FAULT || is_success(&text) && !is_open(), "{text}");
        !is_open()
    });
    let text = set().unwrap().text();
    assert!(is_success(&text), "{text}");
    assert_eq!(garbled.real.client().param("/garbled"), None);
    assert_eq!(client.param("/kept"), Some(1.into()));
    assert_eq!(client.param("/garbled"), Some(1.into()));
    garbled.say(b"no call mentions this", b"");
    eventually("the gate is open", is_open);
    for key in ["/kept", "/garbled"] {
        assert_eq!(garbled.real.client().param(key), Some(1.into()), "{key}");
    }
    garbled.rescue.assert_no_panic();
}

/// An answer that is a success in valid HTTP is accepted, whatever form the master sends it in.
#[test]
fn unusual_but_valid_answers_of_the_master_are_accepted() {
    let reply = Reply::Value(Value::Array(vec![1.into(), "unusual".into(), 0.into()]));
    let body = String::from_utf8(ros1_master::xmlrpc::encode_reply(&reply)).unwrap();
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
    let garbled = Garbled::start(Vec::new(), "master");
    for (number, answer) in answers.into_iter().enumerate() {
        garbled.say(b"garbled", answer.as_bytes());
        let key = format!("garbled{number}");
        let call = encode_call("setParam", params!["/c", format!("/{key}"), 1]);
        let response = garbled
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
        let checkpoint = fs::read_to_string(garbled.rescue.checkpoint()).unwrap();
        assert!(checkpoint.contains(&key), "a success is recorded: {answer}");
    }
}

#[test]
fn a_server_that_is_not_a_master_is_reported_and_asked_seldom() {
    let scratch = Scratch::new();
    for (number, answer) in [
        &b"SSH-2.0-OpenSSH_9.2\r\n"[..],
        b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n",
        b"",
        &with_status("200 OK", FAULT.as_bytes()),
    ]
    .into_iter()
    .enumerate()
    {
        let answer = answer.to_vec();
        let fake = FakeMaster::start(move |_| answer.clone());
        let mut rescue = Setup::proxy(&scratch, fake.port())
            .args(["--hold", "1"])
            .at_checkpoint(scratch.path(format!("{number}.yaml")))
            .spawn();
        rescue.wait_line("the log says that this is not a master", |line| {
            line.contains(&fake.port().to_string())
        });
        let client = rescue.client();
        eventually("rosrescue listens", || client.connect().is_ok());
        assert!(client.ask("setParam", params!["/c", "/x", 1]).is_none());
        // rosrescue asks with pauses and does not busy-loop.
        assert!(
            rescue.output().len() < 100,
            "{} lines",
            rescue.output().len()
        );
        assert_eq!(rescue.terminate().code(), Some(0));
    }
}
