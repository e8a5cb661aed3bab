//! Nodes that end while there is no master: one that closes its port before it unregisters, as roslisp does,
//! and one that dies.

use std::time::{Duration, Instant};

use ros1_master::xmlrpc::Value;
use rosrescue::clock::moment_of;

use crate::support::{
    Client, Control, FakeNode, Mode, Robot, Rosmaster, eventually, holds, in_both_modes, names,
    params, status,
};

/// Pause between the calls of a node that ends. It is longer than the time until rosrescue asks a refusing
/// port again.
const PAUSE: Duration = Duration::from_millis(1500);

/// The unregistrations of a node, in order.
type Calls = Vec<(&'static str, Vec<Value>)>;

/// A node that is registered at both masters, and its unregistrations.
fn registered(masters: [&Client; 2]) -> (FakeNode, Calls) {
    let node = FakeNode::start("/leaving");
    for master in masters {
        node.publish(master, "/topic", "std_msgs/String");
        node.subscribe(master, "/topic", "std_msgs/String");
        node.offer(master, "/service_a");
        node.offer(master, "/service_b");
    }
    let (name, api, service) = (node.name.as_str(), node.api.as_str(), node.service_api());
    let service = service.as_str();
    let calls = vec![
        // The node itself is notified of this unregistration.
        ("unregisterPublisher", params![name, "/topic", api]),
        ("unregisterService", params![name, "/service_a", service]),
        ("unregisterService", params![name, "/service_b", service]),
        ("unregisterSubscriber", params![name, "/topic", api]),
    ];
    (node, calls)
}

/// Whether the ending node is still registered.
fn knows(master: &Client) -> bool {
    let params = params!["/test", "/leaving"];
    master.ask("lookupNode", params).is_some()
}

/// Makes `calls` at a bare master. Returns its answers.
fn answers(bare: &Client, calls: &Calls) -> Vec<(i32, String, Value)> {
    let calls = calls.iter();
    let answers = calls.map(|(method, params)| bare.status(method, params.clone()).unwrap());
    answers.collect()
}

/// Makes `calls` in order. Each must get its answer of `expected`. Returns false if one comes more than `limit` after
/// the one before it, or the first one after `last`.
#[track_caller]
fn leave(
    client: &Client,
    calls: Calls,
    expected: Vec<(i32, String, Value)>,
    pause: Duration,
    (mut last, limit): (Instant, Duration),
) -> bool {
    let count = calls.len();
    for (i, ((method, params), expected)) in calls.into_iter().zip(expected).enumerate() {
        assert_eq!(expected.2, Value::Int(1), "{expected:?}");
        let sent = Instant::now();
        let answer = client.status(method, params).unwrap();
        if last.elapsed() > limit {
            return false;
        }
        assert_eq!(answer, expected, "{method}");
        last = sent;
        let is_last = i + 1 == count;
        let stays = holds(pause, || is_last || knows(client));
        if last.elapsed() > limit {
            return false;
        }
        assert!(stays, "the node was removed after {method}");
    }
    assert!(!knows(client));
    true
}

in_both_modes!(a_node_that_closes_its_port_before_it_unregisters_is_answered_as_by_rosmaster);

fn a_node_that_closes_its_port_before_it_unregisters_is_answered_as_by_rosmaster(mode: Mode) {
    let mut robot = Robot::start_for_outages(mode);
    let bare = Rosmaster::start(&robot.scratch);
    let client = robot.client();
    let (node, calls) = registered([&client, &bare.client()]);
    // Asked first, so that it delays no call.
    let expected = answers(&bare.client(), &calls);
    robot.kill_master();
    drop(node);
    let always = (Instant::now(), Duration::MAX);
    leave(&client, calls, expected, PAUSE, always);
    assert!(!robot.is_open(), "a master was there during the outage");
    let log = robot.rescue.stderr().join("\n");
    assert!(!log.contains("answers again"), "{log}");
}

/// The health check after the recovery asks the node between its calls.
#[test]
fn a_node_that_unregisters_slowly_after_the_recovery_is_given_time() {
    const ATTEMPTS: usize = 5;
    let control = Control::start();
    if !(0..ATTEMPTS).any(|_| leaves_in_time()) {
        let busy = control.allows(Duration::ZERO);
        assert!(
            busy > Duration::from_millis(500),
            "calls were late on a quiet computer: {busy:?}"
        );
        println!("this computer was too busy to make the calls in time, {ATTEMPTS} times");
    }
}

/// Returns false if this computer is so busy that the node may count as dead: it was asked twice between two of its
/// calls.
fn leaves_in_time() -> bool {
    let mut robot = Robot::start(Mode::Proxy);
    let bare = Rosmaster::start(&robot.scratch);
    let client = robot.client();
    let (node, calls) = registered([&client, &bare.client()]);
    let expected = answers(&bare.client(), &calls);
    drop(node);
    robot.crash_master();
    let status = status(&client);
    let rescue = status["last_rescues"].as_array().unwrap().last().unwrap();
    let took = rescue["phases"]["total_ms"].as_f64().unwrap() / 1e3;
    let opened = moment_of(rescue["detected_at"].as_f64().unwrap() + took);
    // The second question comes 1.2 s after the first one, which comes when calls pass again.
    let in_time = (opened, Duration::from_millis(1100));
    leave(
        &client,
        calls,
        expected,
        Duration::from_millis(500),
        in_time,
    )
}

#[test]
fn a_node_that_dies_during_an_outage_is_unregistered_after_the_recovery() {
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    let client = robot.client();
    let (dead, _) = registered([&client, &robot.bare()]);
    let publisher = FakeNode::start("/publisher");
    let before = robot.master_pid();
    robot.kill_master();
    drop(dead);
    publisher.publish(&client, "/topic", "std_msgs/String");
    eventually("the node is known to be dead", || {
        names(&status(&client)["dead_nodes"]) == ["/leaving"]
    });
    let stays = || knows(&client);
    assert!(
        holds(Duration::from_secs(4), stays),
        "the node was unregistered"
    );
    robot.revive_master();
    robot.await_recovery(before);
    eventually("the node is unregistered from the master", || {
        !knows(&robot.bare())
    });
    eventually("no node is unreachable or dead any more", || {
        let status = status(&client);
        ["unreachable", "dead_nodes"]
            .iter()
            .all(|list| names(&status[*list]).is_empty())
    });
}
