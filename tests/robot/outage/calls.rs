//! What happens around an outage beside the paper's cases: calls in the gap, parameter subscriptions
//! and services of real nodes, and restarts that nobody saw.

use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    FakeNode, Library, Mode, Robot, State, encode_call, eventually, holds, http_request, kinds,
    params, tree, unreadable,
};
use rosrescue::xmlrpc::{Call, Reply, Value};
use rustix::process::Signal;

#[test]
fn cached_parameters_of_rospy_follow_after_the_crash() {
    cached_parameters_follow(Library::Rospy, Mode::Core);
    cached_parameters_follow(Library::Rospy, Mode::Proxy);
}

#[test]
fn cached_parameters_of_roscpp_follow_after_the_crash() {
    cached_parameters_follow(Library::Roscpp, Mode::Core);
    cached_parameters_follow(Library::Roscpp, Mode::Proxy);
}

fn cached_parameters_follow(library: Library, mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    client.set_param("/speed", 1);
    let node = robot.node(library, "param_user", &["/speed"]);
    let says = |value: &str| {
        eventually(&format!("the node's cache says {value}"), || {
            node.said("value").last().is_some_and(|last| last == value)
        });
    };
    says("1");
    client.set_param("/speed", 2);
    says("2");
    robot.crash_master();
    client.set_param("/speed", 3);
    says("3");
    robot.crash_master();
    client.set_param("/speed", 4);
    says("4");
    assert_eq!(
        node.said("value"),
        ["1", "2", "3", "4"],
        "a crash changes no value"
    );
    assert_eq!(node.said("failed"), Vec::<String>::new());
}

#[test]
fn services_of_rospy_are_found_all_through_an_outage() {
    services_are_found(Library::Rospy);
}

#[test]
fn services_of_roscpp_are_found_all_through_an_outage() {
    services_are_found(Library::Roscpp);
}

/// The client looks the service up for every call.
fn services_are_found(library: Library) {
    let mut robot = Robot::start(Mode::Proxy);
    let server = robot.node(library, "server", &[]);
    let user = robot.node(library, "client", &["10"]);
    let replies = || user.said("reply").len();
    eventually("the client got answers", || replies() >= 3);
    let dead = robot.master_pid();
    robot.kill_master();
    let before = replies();
    eventually("the client gets answers while there is no master", || {
        replies() >= before + 10
    });
    robot.revive_master();
    robot.await_recovery(dead);
    let before = replies();
    eventually("the client gets answers after the outage", || {
        replies() >= before + 10
    });
    assert_eq!(user.said("failed"), Vec::<String>::new());
    assert!(user.said("reply").iter().all(|name| name == "/server"));
    assert!(server.said("called").len() >= replies());
}

#[test]
fn no_node_hears_of_the_injection() {
    for mode in [Mode::Core, Mode::Proxy] {
        let mut robot = Robot::start(mode);
        let client = robot.client();
        let nodes: Vec<_> = (0..4)
            .map(|i| FakeNode::start(&format!("/fake{i}")))
            .collect();
        for node in &nodes {
            node.publish(&client, "/shared", "std_msgs/String");
            node.publish(&client, &format!("{}/own", node.name), "std_msgs/UInt64");
            node.offer(&client, &format!("{}/service", node.name));
        }
        for node in &nodes {
            node.subscribe(&client, "/shared", "std_msgs/String");
            node.subscribe(&client, "/fake0/own", "*");
            node.subscribe(&client, "/nobody/publishes", "std_msgs/Bool");
            node.watch_param(&client, "/gains");
        }
        client.set_param("/gains/p", 1.5);
        for node in &nodes {
            eventually("the nodes are told of the parameter", || {
                node.heard("paramUpdate").len() == 1
            });
        }
        let before = robot.settled_state();
        let heard = |method: &str| -> Vec<_> { nodes.iter().map(|n| n.heard(method)).collect() };
        let (params, updates) = (heard("paramUpdate"), heard("publisherUpdate"));
        robot.crash_master();
        before.assert_same(&robot.state(), "after the crash");
        // The health check may tell a subscriber the whole truth again, but never a part of it.
        let all: Vec<_> = nodes.iter().map(|node| node.api.clone()).collect();
        let quiet = holds(Duration::from_secs(2), || {
            nodes.iter().zip(&updates).all(|(node, updates)| {
                node.updates("/shared")[..]
                    .iter()
                    .skip(updates.len())
                    .all(|uris| *uris == all)
                    && node.heard("publisherUpdate").len() <= updates.len() + 3
            })
        });
        assert!(quiet, "{:?}", heard("publisherUpdate"));
        // As for parameters: what the dead master may have owed is told again, as it is now.
        let last = |node: &FakeNode| node.heard("paramUpdate").pop();
        for (node, before) in nodes.iter().zip(&params) {
            let mut now = node.heard("paramUpdate").into_iter();
            assert!(now.all(|told| Some(&told) == before.last()), "{mode:?}");
        }
        assert!(heard("shutdown").iter().all(Vec::is_empty), "{mode:?}");
        client.set_param("/gains/p", 2.5);
        for node in &nodes {
            eventually(
                "the nodes are told of the parameter after the crash too",
                || last(node).is_some_and(|told| told[2] == Value::Double(2.5)),
            );
        }
    }
}

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

#[test]
fn a_restart_that_nobody_saw_is_found() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    client.set_param("/kept", "yes");
    let node = FakeNode::start("/fake");
    node.publish(&client, "/topic", "std_msgs/String");
    let before = robot.settled_state();
    let dead = robot.master_pid();
    crate::support::stop(robot.rescue.pid());
    robot.kill_master();
    robot.revive_master();
    robot.rescue.signal(Signal::CONT);
    robot.await_recovery(dead);
    before.assert_same(&robot.state(), "after the restart that nobody saw");
    assert_eq!(node.heard("shutdown"), Vec::<Vec<_>>::new());
}

#[test]
fn every_sub_call_of_a_multicall_is_recorded_for_itself() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let set = |key: &str, value: i32| Call::new("setParam", params!["/test", key, value]);
    let delete = |key: &str| Call::new("deleteParam", params!["/test", key]);
    client.set_param("/old", 1);
    let inner = Call::multicall([set("/nested", 3), delete("/not/there"), set("/nested2", 4)]);
    let calls = [
        set("/a", 1),
        delete("/old"),
        delete("/not/there"),
        inner,
        set("/b", 2),
    ];
    let Reply::Value(Value::Array(answers)) = client
        .call("system.multicall", Call::multicall(calls).params)
        .unwrap()
    else {
        panic!("no answer to a multicall");
    };
    assert_eq!(answers.len(), 5);
    // A malformed entry fails the whole call after the entries before it have been done.
    let bad = Value::Array(vec![
        tree! { "methodName" => "setParam", "params" => params!["/test", "/before", 5] },
        tree! { "no method name" => 1 },
        tree! { "methodName" => "setParam", "params" => params!["/test", "/behind", 6] },
    ]);
    let answer = client.call("system.multicall", vec![bad]).unwrap();
    assert!(matches!(answer, Reply::Fault { .. }), "{answer:?}");
    let before = robot.settled_state();
    for (key, value) in [
        ("/a", Some(1)),
        ("/b", Some(2)),
        ("/nested", Some(3)),
        ("/nested2", Some(4)),
        ("/before", Some(5)),
        ("/behind", None),
        ("/old", None),
    ] {
        assert_eq!(robot.bare().param(key), value.map(Value::Int), "{key}");
    }
    robot.crash_master();
    before.assert_same(&robot.state(), "after the crash");
}

#[test]
fn parameters_of_every_kind_come_back() {
    for mode in [Mode::Core, Mode::Proxy] {
        let mut robot = Robot::start(mode);
        let client = robot.client();
        client.set_param("/kinds", kinds());
        client.set_param(
            "/robot_description",
            "<robot name=\"r\">\n\t<link/>\n</robot>\n".repeat(20_000),
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
}
