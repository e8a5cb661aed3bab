//! Calls during an outage beyond the cases of the paper: calls while there is no master, parameter
//! subscriptions and services of real nodes, and restarts that rosrescue did not see.

use std::thread;
use std::time::{Duration, Instant};

use rescue_core::order::RECENT;
use ros1_master::xmlrpc::{Call, Value};

use crate::support::{
    FakeNode, Mode, Robot, Rosmaster, State, encode_call, eventually, holds, http_request,
    in_both_modes, kinds, params, request, tree, unreadable, within,
};

#[test]
fn calls_during_an_outage_are_answered_so_that_nodes_keep_working() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    client.set_param("/gain", 7);
    let node = FakeNode::start("/fake");
    node.publish(&client, "/topic", "std_msgs/String");
    let dead = robot.master_pid();
    robot.kill_master();

    // roslaunch waits five seconds for getPid, and then starts another master on this port.
    within(Duration::from_secs(4), "calls", || {
        assert_eq!(client.master_pid(), Some(dead));
        assert_eq!(
            client.ok("getUri", params!["/test"]),
            Value::from(client.uri())
        );
        // A roscpp node whose getParam fails continues with its default value.
        assert_eq!(client.param("/gain"), Some(Value::Int(7)));
        let state = State::read(&client);
        assert_eq!(state.publishers_of("/topic"), ["/fake"]);
        // rospy makes these calls only once.
        node.unpublish(&client, "/topic");
        assert!(!State::read(&client).knows("/fake"));
    });

    // Calls that change the state do not wait either.
    let watcher = FakeNode::start("/watcher");
    watcher.subscribe(&client, "/topic", "std_msgs/String");
    watcher.watch_param(&client, "/last");
    let subscribed = Instant::now();
    // A node is told a state once more if it has just been answered. rosrescue may note the answer late.
    eventually("the answers are old", || subscribed.elapsed() > 2 * RECENT);
    within(Duration::from_secs(4), "writes and reads", || {
        for number in 0..5 {
            client.set_param("/last", number);
            assert_eq!(client.param("/last"), Some(Value::Int(number)));
        }
    });
    eventually("the subscriber gets every value", || {
        told(&watcher, "/last") == [0, 1, 2, 3, 4]
    });
    let coming = FakeNode::start("/coming");
    coming.publish(&client, "/topic", "std_msgs/String");
    eventually("the subscriber knows the publisher", || {
        watcher.updates("/topic") == [[coming.api.as_str()]]
    });
    assert!(!robot.is_open(), "a master was there during the outage");
    let before = State::read(&client);

    robot.revive_master();
    robot.await_recovery(dead);
    let state = robot.state();
    assert_eq!(robot.bare().param("/last"), Some(Value::Int(4)));
    assert!(
        !state.knows("/fake"),
        "a node that was unregistered during the outage is back:\n{state}"
    );
    before.assert_same(&state, "in the next master");
}

/// The values of a parameter in a node's notifications, in order.
fn told(node: &FakeNode, key: &str) -> Vec<i32> {
    let updates = node.received("paramUpdate").into_iter();
    let of_key = updates.filter(|update| update[1].as_str() == Some(&format!("{key}/")));
    of_key.map(|update| update[2].as_int().unwrap()).collect()
}

/// The call is a request in UTF-16, which only a master understands.
#[test]
fn an_undecodable_call_is_held_for_a_limited_time_and_never_answered_wrongly() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--hold", "1.5"]);
    robot.kill_master();
    let start = Instant::now();
    let error = robot
        .client()
        .exchange(&unreadable("/late", 1))
        .expect_err("the call must not be answered");
    let waited = start.elapsed();
    // The connection is closed without a byte. Nodes treat that as a lost connection and try again.
    assert!(error.to_string().contains("closed after []"), "{error}");
    assert!(
        waited >= Duration::from_millis(1400),
        "the call was held only for {waited:?}"
    );
    robot.revive_master();
    robot.await_gate();
    assert_eq!(robot.bare().param("/late"), None);
    robot.client().set_param("/late", 2);
    assert_eq!(robot.bare().param("/late"), Some(Value::Int(2)));
}

#[test]
fn an_undecodable_call_waits_for_the_next_master_and_gets_its_answer() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--hold", "60"]);
    let client = robot.client();
    robot.kill_master();
    let request = unreadable("/waited", 1);
    let waiting = {
        let request = request.clone();
        thread::spawn(move || client.exchange(&request).expect("an answer").reply())
    };
    assert!(holds(Duration::from_secs(1), || !waiting.is_finished()));
    robot.revive_master();
    let answer = waiting.join().unwrap();
    assert_eq!(robot.bare().param("/waited"), Some(Value::Int(1)));
    let of_a_master = robot.bare().exchange(&request).unwrap().reply();
    assert_eq!(answer, of_a_master);
}

/// Calls that no ROS node sends, but tools, scanners and other XML-RPC libraries do. Each is answered at
/// once, with the bytes of a rosmaster that was never killed.
#[test]
fn unusual_calls_during_an_outage_get_the_bytes_of_a_living_rosmaster() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--hold", "1"]);
    let bare = Rosmaster::start(&robot.scratch);
    robot.take_master_away();
    let client = robot.client();
    let mut requests = Vec::new();
    for method in [
        "system.listMethods",
        "getMasterUri",
        "_shutdown",
        "",
        "uri",
        "services",
    ] {
        requests.push(encode_call(method, params!["/n"]));
    }
    for params in [
        params![],
        params!["/n"],
        params!["/n", "reason", "more"],
        params![1, "reason"],
    ] {
        requests.push(encode_call("shutdown", params));
    }
    let entry = |method: &str| Call::new(method, params!["/n"]).into_entry();
    let set = Call::new("setParam", params!["/n", "/first", 1]).into_entry();
    for list in [
        Value::Int(1),
        Value::Array(vec![Value::Int(1)]),
        Value::Array(vec!["x".into()]),
        Value::Array(vec![Value::Array(vec![])]),
        Value::Array(vec![tree! {}]),
        Value::Array(vec![tree! { "methodName" => "getPid" }]),
        Value::Array(vec![entry("noSuchMethod"), entry("getParamNames")]),
        Value::Array(vec![entry("shutdown")]),
        Value::Array(vec![set, tree! {}]),
    ] {
        requests.push(encode_call("system.multicall", vec![list]));
    }
    requests.push(encode_call("hasParam", params!["/n", "/first"]));
    let document = |value: &str| {
        format!(
            "<methodCall><methodName>setParam</methodName><params><param><value>/n</value></param>\
             <param><value>/v</value></param><param><value>{value}</value></param></params></methodCall>"
        )
    };
    for value in [
        "<nil/>",
        "<array><data><value><nil/></value></data></array>",
        "<i8>99999999999</i8>",
        "<int>-2147483649</int>",
        "<int>five</int>",
        "<int></int>",
        "<double>1,5</double>",
        "<boolean>true</boolean>",
        "<int>\u{661}</int>",
        "<base64>A</base64>",
        "<unknown>1</unknown>",
        "<struct><member><name>a</name></member></struct>",
        "&nbsp;",
        "&#0;",
        "<string>1</int>",
    ] {
        requests.push(document(value).into_bytes());
        requests.push(encode_call("getParam", params!["/n", "/v"]));
    }
    let whole = document("1");
    for text in [
        format!("<!DOCTYPE methodCall>{whole}"),
        format!("<?xml version='1.0'?>\n<!DOCTYPE methodCall >\n{whole}"),
        String::new(),
        "\n ".to_owned(),
        "garbage".to_owned(),
        "<".to_owned(),
        "<methodCall>".to_owned(),
        "<methodCall/>".to_owned(),
        format!("{whole}<more/>"),
        format!("{whole}more"),
        format!(" <?xml version='1.0'?>{whole}"),
        "<methodResponse><params/></methodResponse>".to_owned(),
        whole.trim_end_matches('>').to_owned(),
        "{}".to_owned(),
        format!("<!ENTITY a 'b'>{whole}"),
        format!("<?xml version='1.0' encoding='latin1'?>{whole}"),
    ] {
        requests.push(text.into_bytes());
    }
    for key in [Value::Nil, 0.into(), 1.into(), Value::Array(vec![])] {
        requests.push(encode_call("getParam", params!["/n", key]));
    }
    requests.push(encode_call("deleteParam", params!["/n", "/v"]));
    let units = whole.encode_utf16().flat_map(u16::to_le_bytes);
    requests.push([0xff, 0xfe].into_iter().chain(units).collect());
    let mut requests: Vec<_> = requests.iter().map(|body| http_request(body)).collect();
    for (first, header) in [
        ("POST /x HTTP/1.1", "X-A: b"),
        ("POST /rpc2 HTTP/1.1", "X-A: b"),
        ("POST / HTTP/1.1", "Content-Encoding: X"),
        ("POST / HTTP/1.1", "Content-Encoding: gzip"),
    ] {
        requests.push(request(first, &[header], whole.as_bytes()));
    }
    let mut differences = Vec::new();
    for request in requests {
        let theirs = bare.client().exchange(&request).unwrap().text();
        let ours = client.exchange(&request);
        let ours = ours.map_or_else(|error| error.to_string(), |answer| answer.text());
        if ours != theirs {
            let request = String::from_utf8_lossy(&request).into_owned();
            differences.push(format!("{request}\n{theirs}\n{ours}"));
        }
    }
    assert!(differences.is_empty(), "{}", differences.join("\n\n"));
}

in_both_modes!(parameters_of_every_kind_are_restored);

fn parameters_of_every_kind_are_restored(mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    client.set_param("/kinds", kinds());
    client.set_param(
        "/robot_description",
        "<robot name=\"r\">\n\t<link/>\n</robot>\n".repeat(2_000),
    );
    client.set_param("/empty", tree! {});
    client.set_param("/kinds/deeper/still", vec![1, 2, 3]);
    client.ok("deleteParam", params!["/test", "/kinds/deeper/still"]);
    let before = robot.settled_state();
    robot.crash_master();
    before.assert_same(&robot.state(), "after the crash");
    robot.rescue.kill();
    let dead = robot.master_pid();
    robot.kill_master_at_once(dead);
    robot.revive_master();
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    before.assert_same(&robot.state(), "after the crash of both");
}
