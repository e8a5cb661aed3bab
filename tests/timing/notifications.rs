//! Without a master, subscribers that cannot be notified or do not answer delay no other node.

use std::time::{Duration, Instant};

use crate::support::{Client, FakeNode, Mode, Netns, Robot, eventually, eventually_some, params};

/// Maximum time until every reachable node has been notified, on a busy computer. It would take longer if nodes waited
/// for each other.
const SOON: Duration = Duration::from_secs(4);
/// Number of unreachable nodes: more than rosrescue notifies at the same time.
const UNREACHABLE: u16 = 100;

fn robot_without_master() -> (Robot, Client) {
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    robot.take_master_away();
    let client = robot.client();
    (robot, client)
}

/// The time from the registration of `publisher` until `subscriber` knows it.
#[track_caller]
fn time_to_hear(client: &Client, publisher: &FakeNode, subscriber: &FakeNode) -> Duration {
    let start = Instant::now();
    publisher.publish(client, "/chatter", "std_msgs/String");
    eventually_some("the subscriber knows the publisher", || {
        let updates = subscriber.updates("/chatter");
        let knows = updates.iter().any(|list| list.contains(&publisher.api));
        knows.then(|| start.elapsed())
    })
}

/// The computer of the unreachable nodes vanishes without notice, so each attempt to notify them lasts until its time
/// limit.
#[test]
fn unreachable_subscribers_delay_no_other_node() {
    let _alone = crate::alone();
    let net = Netns::new();
    let (_robot, client) = robot_without_master();
    net.cut(2);
    for i in 0..UNREACHABLE {
        let name = format!("/unreachable{i}");
        let api = format!("http://{}:{}/", net.far(2), 20_000 + i);
        let params = params![name.as_str(), "/chatter", "std_msgs/String", api.as_str()];
        client.ok("registerSubscriber", params);
    }
    // This subscriber is the last one in the list.
    let living = FakeNode::start("/living");
    living.subscribe(&client, "/chatter", "std_msgs/String");
    let [first, second] = ["/first", "/second"].map(FakeNode::start);
    let times = [&first, &second].map(|publisher| time_to_hear(&client, publisher, &living));
    println!(
        "with {UNREACHABLE} unreachable nodes, the living subscriber was notified after {times:?}"
    );
    assert!(times.iter().all(|time| *time < SOON), "{times:?}");
}

/// The node accepts calls and does not answer them.
#[test]
fn a_subscriber_that_does_not_answer_delays_no_other_node() {
    let _alone = crate::alone();
    let (_robot, client) = robot_without_master();
    let [silent, living] = ["/silent", "/living"].map(FakeNode::start);
    for node in [&silent, &living] {
        node.subscribe(&client, "/chatter", "std_msgs/String");
    }
    silent.hold();
    let [first, second] = ["/first", "/second"].map(FakeNode::start);
    let times = [&first, &second].map(|publisher| time_to_hear(&client, publisher, &living));
    assert!(times.iter().all(|time| *time < SOON), "{times:?}");
    silent.release();
    // As soon as the silent subscriber answers again, it gets the latest list of publishers.
    let both = [first.api.clone(), second.api.clone()];
    eventually("the silent subscriber is notified at last", || {
        silent
            .updates("/chatter")
            .last()
            .is_some_and(|list| *list == both)
    });
}
