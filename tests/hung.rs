//! A master that hangs, and one that is only slow: the one is found by probes, replaced by `core` and waited
//! for by `proxy`, and what it goes on with is done once; the other is left alone.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod support;

use std::fs;
use std::thread;
use std::time::{Duration, Instant};

use rosrescue::xmlrpc::Value;
use rustix::process::Signal;
use support::{FakeNode, Library, Mode, NODES, Robot, State, alive, eventually, holds, params};

/// Options with which a master that does not answer for a second counts as hung.
const PROBES: [&str; 6] = [
    "--probe-interval",
    "100",
    "--probe-timeout",
    "500",
    "--probe-count",
    "2",
];

/// The values that a node was told of a parameter, as they came.
fn told(node: &FakeNode, key: &str) -> Vec<i32> {
    let updates = node.heard("paramUpdate");
    let of_key = updates
        .iter()
        .filter(|call| call[1].as_str().map(|key| key.trim_end_matches('/')) == Some(key));
    of_key.map(|call| call[2].as_int().unwrap()).collect()
}

/// The gate shuts, the mirror answers, and what was under way or parked is done once when the same master
/// goes on.
#[test]
fn a_proxy_stands_in_for_a_hung_master_and_nothing_is_done_twice() {
    let robot = Robot::start_with(Mode::Proxy, &PROBES);
    let client = robot.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    client.set_param("/gain", 7);
    for key in ["/flying", "/parked"] {
        node.watch_param(&client, key);
    }
    let watcher = FakeNode::start("/watcher");
    watcher.subscribe(&client, "/topic", "std_msgs/String");
    let before = State::read(&client);
    let pid = robot.master_pid();
    let injections = robot.counter("injections");

    support::stop(pid);
    // One call is under way in the master, more are parked behind it.
    let call = |method: &'static str, params: Vec<Value>| {
        let client = client.clone();
        let waiting = thread::spawn(move || client.status(method, params));
        assert!(holds(Duration::from_millis(100), || !waiting.is_finished()));
        waiting
    };
    let mut waiting = vec![call("setParam", params!["/test", "/flying", 1])];
    let reading = thread::spawn({
        let client = client.clone();
        move || client.param("/gain")
    });
    eventually("the gate is shut", || !robot.is_open());
    assert_eq!(
        reading.join().unwrap(),
        Some(Value::Int(7)),
        "it asked before the gate was shut"
    );
    for number in 1..=3 {
        waiting.push(call("setParam", params!["/test", "/parked", number]));
    }
    let coming = FakeNode::start("/coming");
    coming.claim_publication("/topic", Some("std_msgs/String"));
    let params = params!["/coming", "/topic", "std_msgs/String", coming.api.as_str()];
    waiting.push(call("registerPublisher", params));

    // What the master said before it hung.
    let start = Instant::now();
    before.assert_same(&State::read(&client), "while the master hangs");
    assert_eq!(client.param("/gain"), Some(Value::Int(7)));
    assert_eq!(client.master_pid(), Some(pid));
    assert!(
        start.elapsed() < Duration::from_secs(10),
        "{:?}",
        start.elapsed()
    );
    assert!(waiting.iter().all(|call| !call.is_finished()));

    support::signal(pid, Signal::CONT);
    for call in waiting {
        assert_eq!(call.join().unwrap().expect("the call is answered").0, 1);
    }
    assert_eq!(robot.master_pid(), pid, "the same master goes on");
    assert_eq!(
        robot.counter("injections"),
        injections,
        "nothing is injected into it"
    );
    eventually("the node is told of every value", || {
        told(&node, "/parked") == [1, 2, 3]
    });
    let both = [node.api.clone(), coming.api.clone()];
    eventually("the subscriber is told of the new publisher", || {
        watcher
            .updates("/topic")
            .last()
            .is_some_and(|uris| *uris == both)
    });
    // Not a second time, and never of a part of the publishers.
    assert!(holds(Duration::from_secs(1), || told(&node, "/parked")
        == [1, 2, 3]));
    assert_eq!(told(&node, "/flying"), [1]);
    let updates = watcher.updates("/topic");
    let new = updates.iter().filter(|uris| **uris == both).count();
    assert_eq!(new, 1, "{updates:?}");
    assert_eq!(robot.state().publishers_of("/topic"), ["/node", "/coming"]);
    before.assert_same(
        &robot
            .state()
            .without_node("/coming")
            .with_params_of(&before),
        "but for what was called",
    );
}

/// What was unregistered while the master did not answer is unregistered in the master that goes on.
#[test]
fn unregistrations_in_a_hang_reach_the_master_that_goes_on() {
    let robot = Robot::start_with(Mode::Proxy, &PROBES);
    let client = robot.client();
    let [leaving, staying] = ["/leaving", "/staying"].map(FakeNode::start);
    for node in [&leaving, &staying] {
        node.publish(&client, "/topic", "std_msgs/String");
        node.subscribe(&client, "/other", "std_msgs/String");
        node.offer(&client, &format!("{}/service", node.name));
    }
    let after = robot.settled_state().without_node("/leaving");
    let pid = robot.master_pid();
    support::stop(pid);
    // Whether the answer comes at once or when the master goes on: it is a promise.
    let unregistering = thread::spawn(move || {
        leaving.unpublish(&client, "/topic");
        leaving.unsubscribe(&client, "/other");
        leaving.withdraw(&client, "/leaving/service");
        leaving
    });
    holds(Duration::from_secs(3), || !unregistering.is_finished());
    support::signal(pid, Signal::CONT);
    let _leaving = unregistering.join().unwrap();
    robot.await_gate();
    robot.await_state(&after, "when the master went on");
    assert_eq!(robot.client().master_pid(), Some(pid));
    after.assert_same(&State::read(&robot.client()), "through rosrescue");
}

/// Nobody says twice that it unregisters. If nobody answered, it is done all the same: by the next master,
/// if the one that hangs dies of it.
#[test]
fn an_unregistration_that_a_hung_master_took_with_it_is_not_forgotten() {
    let options = [&PROBES[..], &["--hold", "1"]].concat();
    let mut robot = Robot::start_with(Mode::Proxy, &options);
    let client = robot.client();
    let [leaving, staying] = ["/leaving", "/staying"].map(FakeNode::start);
    for node in [&leaving, &staying] {
        node.publish(&client, "/topic", "std_msgs/String");
    }
    let after = robot.settled_state().without_node("/leaving");
    let dead = robot.master_pid();
    support::stop(dead);
    // Under way in the master when it hangs, and closed without an answer when it was held long enough.
    let params = params!["/leaving", "/topic", leaving.api.as_str()];
    let answer = client.status("unregisterPublisher", params);
    assert!(answer.is_err(), "{answer:?}");
    leaving.claim_publication("/topic", None);
    robot.kill_master();
    robot.revive_master();
    robot.await_recovery(dead);
    robot.await_state(&after, "in the next master");
    after.assert_same(&State::read(&client), "through rosrescue");
}

/// `core` asks, decides, kills and replaces; the streams of its nodes go on.
#[test]
fn a_core_replaces_a_hung_master_under_its_nodes() {
    let robot = Robot::start_with(Mode::Core, &PROBES);
    let client = robot.client();
    let talker = robot.node(Library::Rospy, "talker", &[]);
    let listener = robot.node(Library::Roscpp, "listener", &[]);
    listener.wait_messages("/talker", 5);
    let before = robot.settled_state();
    let hung = robot.master_pid();
    support::stop(hung);
    let waiting = thread::spawn({
        let client = client.clone();
        move || client.status("setParam", params!["/test", "/waits", 1])
    });
    eventually("the mirror reads while nobody else does", || {
        !robot.is_open() && State::read(&client).knows("/talker")
    });
    robot.await_recovery(hung);
    assert!(!alive(hung), "the master that hangs is ended");
    assert_eq!(waiting.join().unwrap().expect("the call is answered").0, 1);
    client.ok("deleteParam", params!["/test", "/waits"]);
    before.assert_same(&robot.state(), "after the hung master was replaced");
    let status = robot.status().unwrap();
    assert_eq!(
        status["last_recovery"]["cause"],
        "the master stopped answering"
    );
    listener.wait_messages("/talker", 10);
    listener.assert_no_message_lost("/talker");
    listener.assert_no_link_lost();
    talker.assert_no_link_lost();
}

/// Two seconds a call are no reason to end a master that is given three, and four seconds are.
#[test]
fn a_slow_master_is_left_alone_below_the_threshold() {
    let program = format!("{NODES}/slow_rosmaster.py");
    let options = [
        "--rosmaster",
        &program,
        "--no-rosout",
        "--probe-interval",
        "100",
        "--probe-timeout",
        "1500",
        "--probe-count",
        "2",
    ];
    let robot = Robot::start_with(Mode::Core, &options);
    let client = robot.client();
    client.set_param("/kept", 0);
    let pid = robot.master_pid();
    let slow = robot.scratch.path("slow");

    fs::write(&slow, "2").unwrap();
    let start = Instant::now();
    for number in 1..=3 {
        client.set_param("/kept", number);
        assert_eq!(client.param("/kept"), Some(Value::Int(number)));
    }
    assert!(
        start.elapsed() > Duration::from_secs(11),
        "it was not slow: {:?}",
        start.elapsed()
    );
    let ask = Instant::now();
    assert_eq!(client.master_pid(), Some(pid));
    assert!(
        ask.elapsed() < Duration::from_secs(2),
        "roslaunch waits for this: {:?}",
        ask.elapsed()
    );
    let status = robot.status().unwrap();
    assert_eq!(status["recoveries"], 1, "{status}");
    assert!(robot.is_open());

    fs::write(&slow, "20").unwrap();
    eventually("the gate is shut", || !robot.is_open());
    fs::remove_file(&slow).unwrap();
    robot.await_recovery(pid);
    assert!(!alive(pid));
    assert_eq!(robot.bare().param("/kept"), Some(Value::Int(3)));
}
