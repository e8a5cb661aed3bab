//! Many clients at once, at the moment at which an outage begins: each gets the answer that is due to it,
//! in its order, and no more of them are parked than there are places.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod support;

use std::io;
use std::sync::{Arc, Barrier};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rosrescue::xmlrpc::{Call, Reply, Value};
use support::{
    Client, FakeNode, Mode, Robot, State, Wire, encode_call, eventually, holds, http_request,
    params, tree,
};

/// Clients of the crowd; a multiple of four.
const CROWD: i32 = 200;

/// The calls that each client of a kind makes, one behind the other on one connection without waiting for
/// answers.
fn calls_of(client: i32, api: &str) -> Vec<(&'static str, Vec<Value>)> {
    let name = format!("/client{client}");
    let own = |what: &str| format!("{name}/{what}");
    match client % 4 {
        0 => vec![
            ("getParam", params![name.as_str(), own("gain")]),
            ("hasParam", params![name.as_str(), own("nothing")]),
            ("lookupNode", params![name.as_str(), "/present"]),
            ("getUri", params![name.as_str()]),
            ("getPublishedTopics", params![name.as_str(), "/client1"]),
        ],
        1 => vec![(
            "unregisterPublisher",
            params![name.as_str(), own("old"), api],
        )],
        2 => (0..3)
            .map(|number| {
                let topic = own(&format!("new{number}"));
                let params = params![name.as_str(), topic, "std_msgs/String", api];
                ("registerPublisher", params)
            })
            .collect(),
        _ => (0..5)
            .map(|number| ("setParam", params![name.as_str(), own("last"), number]))
            .collect(),
    }
}

/// Code and value of each answer.
type Answers = io::Result<Vec<(i32, Value)>>;

/// A client on a connection of its own, which makes its calls when the barrier falls.
fn start(
    client: &Client,
    calls: Vec<(&'static str, Vec<Value>)>,
    barrier: &Arc<Barrier>,
) -> JoinHandle<(Answers, Duration)> {
    let mut wire = client.connect().unwrap();
    let ask = http_request(&encode_call("getPid", params!["/client"]));
    wire.send(&ask).unwrap();
    wire.response().unwrap();
    let barrier = Arc::clone(barrier);
    thread::spawn(move || {
        barrier.wait();
        let start = Instant::now();
        (say(&mut wire, &calls), start.elapsed())
    })
}

fn say(wire: &mut Wire, calls: &[(&str, Vec<Value>)]) -> Answers {
    let bytes: Vec<_> = calls
        .iter()
        .flat_map(|(method, params)| http_request(&encode_call(method, params.clone())))
        .collect();
    wire.send(&bytes)?;
    let answer = |wire: &mut Wire| match wire.response()?.reply() {
        Reply::Value(Value::Array(fields)) => Ok((fields[0].as_int().unwrap(), fields[2].clone())),
        other => Err(io::Error::other(format!("{other:?}"))),
    };
    calls.iter().map(|_| answer(wire)).collect()
}

#[test]
fn two_hundred_clients_call_when_the_outage_begins() {
    when_the_outage_begins(Mode::Proxy);
}

#[test]
fn two_hundred_clients_call_when_the_own_master_dies() {
    when_the_outage_begins(Mode::Core);
}

fn when_the_outage_begins(mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    let present = FakeNode::start("/present");
    present.publish(&client, "/present/topic", "std_msgs/String");
    // The census asks the nodes whether they are alive.
    let nodes: Vec<_> = (0..CROWD)
        .map(|number| FakeNode::start(&format!("/client{number}")))
        .collect();
    for (node, number) in nodes.iter().zip(0..CROWD) {
        match number % 4 {
            0 => client.set_param(&format!("{}/gain", node.name), number),
            1 => {
                let old = format!("{}/old", node.name);
                node.publish(&client, &old, "std_msgs/String");
                node.claim_publication(&old, None);
            }
            2 => {
                for topic in ["new0", "new1", "new2"] {
                    let topic = format!("{}/{topic}", node.name);
                    node.claim_publication(&topic, Some("std_msgs/String"));
                }
            }
            _ => {}
        }
    }
    let dead = robot.master_pid();
    let barrier = Arc::new(Barrier::new(CROWD as usize + 1));
    let crowd: Vec<_> = (0..CROWD)
        .zip(&nodes)
        .map(|(number, node)| start(&client, calls_of(number, &node.api), &barrier))
        .collect();
    barrier.wait();
    robot.kill_master_at_once(dead);

    // Nobody who reads or leaves waits for a master.
    let (quick, patient): (Vec<_>, Vec<_>) = crowd
        .into_iter()
        .zip(0..CROWD)
        .partition(|(_, number)| number % 4 < 2);
    for (thread, number) in quick {
        let (answers, took) = thread.join().unwrap();
        let answers = answers.unwrap_or_else(|error| panic!("client {number}: {error}"));
        assert!(took < Duration::from_secs(20), "client {number}: {took:?}");
        if number % 4 == 1 {
            assert_eq!(answers, [(1, Value::Int(1))], "client {number}");
            continue;
        }
        let expected = [
            (1, Value::Int(number)),
            (1, Value::Bool(false)),
            (1, Value::from(present.api.as_str())),
            (1, Value::from(client.uri())),
        ];
        assert_eq!(answers[..4], expected, "client {number}");
        assert_eq!(answers[4].0, 1);
    }
    let state = State::read(&client);
    assert!(!(0..CROWD).any(|number| number % 4 == 1 && state.knows(&format!("/client{number}"))));
    robot.revive_master();
    robot.await_recovery(dead);
    for (thread, number) in patient {
        let (answers, _) = thread.join().unwrap();
        let answers = answers.unwrap_or_else(|error| panic!("client {number}: {error}"));
        assert!(
            answers.iter().all(|(code, _)| *code == 1),
            "client {number}: {answers:?}"
        );
    }
    // No call was closed without an answer.
    assert_eq!(robot.counter("hold_expired"), 0);
    let (bare, state) = (robot.bare(), robot.state());
    for number in 0..CROWD {
        let name = format!("/client{number}");
        let publishes = |what: &str| state.publishers_of(&format!("{name}/{what}"));
        match number % 4 {
            1 => assert!(publishes("old").is_empty(), "{name} is back:\n{state}"),
            2 => {
                let found = ["new0", "new1", "new2"].map(publishes);
                let own = vec![name.clone()];
                assert_eq!(found, [own.clone(), own.clone(), own]);
            }
            3 => assert_eq!(
                bare.param(&format!("{name}/last")),
                Some(Value::Int(4)),
                "the last of its calls counts"
            ),
            _ => {}
        }
    }
}

#[test]
fn no_more_calls_are_parked_than_there_are_places() {
    const PLACES: usize = 50;
    let mut robot = Robot::start_with(Mode::Proxy, &["--max-parked", "50", "--hold", "4"]);
    let client = robot.client();
    client.set_param("/kept", "yes");
    let leaving: Vec<_> = (0..20)
        .map(|number| {
            let node = FakeNode::start(&format!("/leaving{number}"));
            node.publish(&client, "/topic", "std_msgs/String");
            node
        })
        .collect();
    let dead = robot.master_pid();
    robot.kill_master();
    eventually("the gate is shut", || !robot.is_open());
    let crowd = |round: i32| -> Vec<_> {
        let setter = |number: i32| {
            let client = client.clone();
            thread::spawn(move || {
                let key = format!("/crowd{round}/of{number}");
                client.status("setParam", params!["/crowd", key, number])
            })
        };
        (0..CROWD).map(setter).collect()
    };
    let waiting = |crowd: &[JoinHandle<_>]| crowd.iter().filter(|one| !one.is_finished()).count();

    let first = crowd(1);
    eventually("those for whom there is no place are sent away", || {
        waiting(&first) <= PLACES
    });
    assert_eq!(waiting(&first), PLACES);
    // Those who leave have places of their own, and those who read need none.
    for node in &leaving[..10] {
        node.unpublish(&client, "/topic");
    }
    assert_eq!(client.param("/kept"), Some("yes".into()));
    assert_eq!(waiting(&first), PLACES);
    for one in first {
        let error = one.join().unwrap().expect_err("nobody did it");
        assert!(error.to_string().contains("closed after []"), "{error}");
    }
    // The places are free again, though nothing else has happened.
    let second = crowd(2);
    eventually("those for whom there is no place are sent away", || {
        waiting(&second) <= PLACES
    });
    assert!(holds(Duration::from_millis(300), || waiting(&second) == PLACES));
    for node in &leaving[10..] {
        node.unpublish(&client, "/topic");
    }
    robot.revive_master();
    robot.await_recovery(dead);
    let mut done: Vec<_> = second
        .into_iter()
        .zip(0..CROWD)
        .filter_map(|(one, number)| match one.join().unwrap() {
            Ok((1, ..)) => Some(number),
            Ok(other) => panic!("{other:?}"),
            Err(_) => None,
        })
        .collect();
    done.sort_unstable();
    assert!(!done.is_empty());
    assert_eq!(robot.bare().param("/crowd1"), None);
    let expected = done
        .iter()
        .map(|number| (format!("of{number}"), Value::Int(*number)));
    let found = robot.bare().param("/crowd2").unwrap();
    let mut found: Vec<_> = found.as_struct().unwrap().clone().into_iter().collect();
    found.sort_by_key(|(_, value)| value.as_int());
    assert_eq!(found, expected.collect::<Vec<_>>());
    assert!(robot.state().publishers_of("/topic").is_empty());
}

/// What rospy sends when a node ends is one multicall. It says nothing that a roslaunch, or anybody else, has
/// to do first.
#[test]
fn a_parked_multicall_keeps_nobody_from_leaving() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let nodes = ["/parked", "/leaving"].map(FakeNode::start);
    for node in &nodes {
        node.publish(&client, "/topic", "std_msgs/String");
    }
    let dead = robot.master_pid();
    robot.kill_master();
    eventually("the gate is shut", || !robot.is_open());
    let park = |calls: Vec<Call>| {
        let client = client.clone();
        let before = robot.counter("parked");
        let call =
            thread::spawn(move || client.call("system.multicall", Call::multicall(calls).params));
        eventually("a call is parked", || robot.counter("parked") > before);
        call
    };
    let unregister = |node: &FakeNode, topic: &str| {
        let params = params![node.name.as_str(), topic, node.api.as_str()];
        Call::new("unregisterPublisher", params)
    };
    let launch = park(vec![
        Call::new(
            "setParam",
            params!["/roslaunch", "/launched", tree! { "a" => 1 }],
        ),
        Call::new("setParam", params!["/leaving", "/leaving/private", 1]),
    ]);
    let params = params!["/parked", "/late", "std_msgs/String", nodes[0].api.as_str()];
    let late = park(vec![Call::new("registerPublisher", params)]);

    // At once, although multicalls are parked.
    nodes[1].claim_publication("/topic", None);
    let leave = Call::multicall([unregister(&nodes[1], "/topic")]).params;
    let answer = client.call("system.multicall", leave).unwrap();
    let Reply::Value(Value::Array(answers)) = answer else {
        panic!("{answer:?}");
    };
    assert_eq!(
        answers[0].as_array().unwrap()[0].as_array().unwrap()[2],
        Value::Int(1)
    );
    assert_eq!(State::read(&client).publishers_of("/topic"), ["/parked"]);
    assert!(!launch.is_finished() && !late.is_finished());

    // Behind the same node's own registration: else that would come after it.
    let behind = park(vec![unregister(&nodes[0], "/late")]);
    assert!(holds(Duration::from_millis(500), || !behind.is_finished()));
    robot.revive_master();
    robot.await_recovery(dead);
    for call in [launch, late, behind] {
        let answer = call.join().unwrap().unwrap();
        assert!(
            matches!(answer, Reply::Value(Value::Array(_))),
            "{answer:?}"
        );
    }
    let state = robot.state();
    assert_eq!(state.publishers_of("/topic"), ["/parked"]);
    assert!(state.publishers_of("/late").is_empty(), "{state}");
    assert_eq!(robot.bare().param("/launched/a"), Some(Value::Int(1)));
}
