//! Many clients call when an outage begins. Each gets the right answers, at once and in order.

use std::io;
use std::sync::{Arc, Barrier};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::{Reply, Value};

use crate::support::{
    Client, Control, FakeNode, Mode, Robot, State, Wire, encode_call, http_request, in_both_modes,
    params,
};

/// Number of clients that call at once, a multiple of four.
const CLIENTS: i32 = 200;

/// The calls that each client of a kind makes, one after another on one connection without waiting for
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

/// Starts a client with its own connection. It makes its calls when all clients are ready.
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

in_both_modes!(two_hundred_clients_that_call_when_the_outage_begins_get_the_right_answers);

fn two_hundred_clients_that_call_when_the_outage_begins_get_the_right_answers(mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    let present = FakeNode::start("/present");
    present.publish(&client, "/present/topic", "std_msgs/String");
    // The nodes must answer the health check.
    let nodes: Vec<_> = (0..CLIENTS)
        .map(|number| FakeNode::start(&format!("/client{number}")))
        .collect();
    for (node, number) in nodes.iter().zip(0..CLIENTS) {
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
    let barrier = Arc::new(Barrier::new(CLIENTS as usize + 1));
    let callers: Vec<_> = (0..CLIENTS)
        .zip(&nodes)
        .map(|(number, node)| start(&client, calls_of(number, &node.api), &barrier))
        .collect();
    let control = Control::start();
    barrier.wait();
    robot.kill_master_at_once(dead);

    // No client waits for a master.
    let answers: Vec<_> = callers
        .into_iter()
        .map(|thread| thread.join().unwrap())
        .collect();
    let allowed = control.allows(Duration::from_secs(20));
    for ((answers, took), number) in answers.into_iter().zip(0..CLIENTS) {
        let answers = answers.unwrap_or_else(|error| panic!("client {number}: {error}"));
        assert!(took < allowed, "client {number}: {took:?}");
        let expected = [
            (1, Value::Int(number)),
            (1, Value::Bool(false)),
            (1, Value::from(present.api.as_str())),
            (1, Value::from(client.uri())),
        ];
        match number % 4 {
            0 => {
                assert_eq!(answers[..4], expected, "client {number}");
                assert_eq!(answers[4].0, 1);
            }
            1 => assert_eq!(answers, [(1, Value::Int(1))], "client {number}"),
            _ => assert!(
                answers.iter().all(|(code, _)| *code == 1),
                "client {number}: {answers:?}"
            ),
        }
    }
    let state = State::read(&client);
    assert!(
        !(0..CLIENTS).any(|number| number % 4 == 1 && state.knows(&format!("/client{number}")))
    );
    robot.revive_master();
    robot.await_recovery(dead);
    // No connection was closed without an answer.
    assert_eq!(robot.counter("calls_unanswered"), 0);
    let (bare, state) = (robot.bare(), robot.state());
    for number in 0..CLIENTS {
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
                "{name}: the last of its calls must win"
            ),
            _ => {}
        }
    }
}
