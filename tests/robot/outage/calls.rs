//! What happens around an outage beside the paper's cases: calls in the gap, parameter subscriptions
//! and services of real nodes, and restarts that nobody saw.

use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    FakeNode, Mode, Robot, State, encode_call, eventually, holds, http_request, in_both_modes,
    kinds, params, tree, unreadable,
};
use rosrescue::xmlrpc::Value;

#[test]
fn calls_in_the_gap_get_what_their_senders_need() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    client.set_param("/gain", 7);
    let node = FakeNode::start("/fake");
    node.publish(&client, "/topic", "std_msgs/String");
    let dead = robot.master_pid();
    robot.kill_master();

    // roslaunch waits five seconds for getPid, then it starts a master of its own on this port.
    let start = Instant::now();
    assert_eq!(client.master_pid(), Some(dead));
    assert_eq!(
        client.ok("getUri", params!["/test"]),
        Value::from(client.uri())
    );
    // A roscpp node whose getParam fails goes on with its default.
    assert_eq!(client.param("/gain"), Some(Value::Int(7)));
    let state = State::read(&client);
    assert_eq!(state.publishers_of("/topic"), ["/fake"]);
    // rospy says these only once.
    node.unpublish(&client, "/topic");
    assert!(!State::read(&client).knows("/fake"));
    assert!(
        start.elapsed() < Duration::from_secs(4),
        "{:?}",
        start.elapsed()
    );

    // Nor does anybody wait who changes something.
    let watcher = FakeNode::start("/watcher");
    watcher.subscribe(&client, "/topic", "std_msgs/String");
    watcher.watch_param(&client, "/last");
    let setting = Instant::now();
    for number in 0..5 {
        client.set_param("/last", number);
        assert_eq!(client.param("/last"), Some(Value::Int(number)));
    }
    assert!(
        setting.elapsed() < Duration::from_secs(4),
        "{:?}",
        setting.elapsed()
    );
    eventually("the subscriber is told every value", || {
        told(&watcher, "/last") == [0, 1, 2, 3, 4]
    });
    let coming = FakeNode::start("/coming");
    coming.publish(&client, "/topic", "std_msgs/String");
    eventually("the subscriber is told of the publisher", || {
        watcher.updates("/topic") == [[coming.api.as_str()]]
    });
    assert!(!robot.is_open(), "there was a master");
    let before = State::read(&client);

    robot.revive_master();
    robot.await_recovery(dead);
    let state = robot.state();
    assert_eq!(robot.bare().param("/last"), Some(Value::Int(4)));
    assert!(
        !state.knows("/fake"),
        "what was unregistered in the gap is back:\n{state}"
    );
    before.assert_same(&state, "in the next master");
}

/// The values that a node was told of a parameter, as they came.
fn told(node: &FakeNode, key: &str) -> Vec<i32> {
    let updates = node.heard("paramUpdate").into_iter();
    let of_key = updates.filter(|update| update[1].as_str() == Some(&format!("{key}/")));
    of_key.map(|update| update[2].as_int().unwrap()).collect()
}

/// Only a master knows what it would answer.
#[test]
fn a_call_outside_the_master_api_is_not_held_for_ever_and_never_answered_falsely() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--hold", "1.5"]);
    robot.kill_master();
    for request in [
        http_request(&encode_call("setLocation", params!["/test", "here"])),
        unreadable("/late", 1),
    ] {
        let start = Instant::now();
        let error = robot
            .client()
            .exchange(&request)
            .expect_err("no answer is right here");
        let waited = start.elapsed();
        // Closed without a byte: that is what nodes take for a lost connection and try again.
        assert!(error.to_string().contains("closed after []"), "{error}");
        assert!(
            waited >= Duration::from_millis(1400),
            "it was held only {waited:?}"
        );
    }
    robot.revive_master();
    robot.await_gate();
    assert_eq!(robot.bare().param("/late"), None);
    robot.client().set_param("/late", 2);
    assert_eq!(robot.bare().param("/late"), Some(Value::Int(2)));
}

#[test]
fn a_call_outside_the_master_api_waits_for_the_next_master_and_gets_its_answer() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--hold", "60"]);
    let client = robot.client();
    robot.kill_master();
    let requests = [
        http_request(&encode_call("setLocation", params!["/test", "here"])),
        unreadable("/waited", 1),
    ];
    let waiting: Vec<_> = requests
        .clone()
        .into_iter()
        .map(|request| {
            let client = client.clone();
            thread::spawn(move || client.exchange(&request).expect("an answer").reply())
        })
        .collect();
    assert!(holds(Duration::from_secs(1), || {
        waiting.iter().all(|call| !call.is_finished())
    }));
    robot.revive_master();
    for (waiting, request) in waiting.into_iter().zip(requests) {
        let of_a_master = robot.bare().exchange(&request).unwrap().reply();
        assert_eq!(waiting.join().unwrap(), of_a_master);
    }
    assert_eq!(robot.bare().param("/waited"), Some(Value::Int(1)));
}

in_both_modes!(parameters_of_every_kind_come_back);

fn parameters_of_every_kind_come_back(mode: Mode) {
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
