//! Nodes that end while there is no master: one that closes its port before it unregisters, as roslisp does,
//! and one that dies.

use std::time::Duration;

use ros1_master::xmlrpc::Value;

use crate::support::{
    Client, FakeNode, Mode, Robot, Rosmaster, eventually, holds, in_both_modes, names, params,
    status,
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

/// Makes `calls` in order. Each must be answered as by `bare`.
#[track_caller]
fn leave(client: &Client, bare: &Client, calls: Calls, pause: Duration) {
    let count = calls.len();
    // Asked first, so that it delays no call.
    let expected: Vec<_> = (calls.iter())
        .map(|(method, params)| bare.status(method, params.clone()).unwrap())
        .collect();
    for (i, ((method, params), expected)) in calls.into_iter().zip(expected).enumerate() {
        assert_eq!(expected.2, Value::Int(1), "{expected:?}");
        assert_eq!(client.status(method, params).unwrap(), expected, "{method}");
        let is_last = i + 1 == count;
        let stays = || is_last || knows(client);
        assert!(holds(pause, stays), "the node was removed after {method}");
    }
    assert!(!knows(client));
}

in_both_modes!(a_node_that_closes_its_port_before_it_unregisters_is_answered_as_by_rosmaster);

fn a_node_that_closes_its_port_before_it_unregisters_is_answered_as_by_rosmaster(mode: Mode) {
    let mut robot = Robot::start_for_outages(mode);
    let bare = Rosmaster::start(&robot.scratch);
    let client = robot.client();
    let (node, calls) = registered([&client, &bare.client()]);
    robot.kill_master();
    drop(node);
    leave(&client, &bare.client(), calls, PAUSE);
    assert!(!robot.is_open(), "a master was there during the outage");
    let log = robot.rescue.stderr().join("\n");
    assert!(!log.contains("answers again"), "{log}");
}

/// The health check after the recovery asks the node between its calls.
#[test]
fn a_node_that_unregisters_slowly_after_the_recovery_is_given_time() {
    let mut robot = Robot::start(Mode::Proxy);
    let bare = Rosmaster::start(&robot.scratch);
    let client = robot.client();
    let (node, calls) = registered([&client, &bare.client()]);
    drop(node);
    robot.crash_master();
    // The next call must come before the second question, 1.2 s after the first one, also on a busy computer.
    leave(&client, &bare.client(), calls, Duration::from_millis(500));
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
