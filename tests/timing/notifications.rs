//! Without a master, subscribers that cannot be notified or do not answer delay no other node.

use std::time::Duration;

use crate::support::{Client, FakeNode, Mode, Netns, Robot, eventually, params, within};

/// Maximum time until every reachable node has been notified. It would take longer if nodes waited for each other.
const SOON: Duration = Duration::from_secs(4);
/// Number of unreachable nodes: more than rosrescue notifies at the same time.
const UNREACHABLE: u16 = 100;

fn robot_without_master() -> (Robot, Client) {
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    robot.take_master_away();
    let client = robot.client();
    (robot, client)
}

/// Registers `publisher`. Panics unless `subscriber` knows it soon.
#[track_caller]
fn assert_heard(client: &Client, publisher: &FakeNode, subscriber: &FakeNode) {
    within(SOON, "a notification", || {
        publisher.publish(client, "/chatter", "std_msgs/String");
        eventually("the subscriber knows the publisher", || {
            let updates = subscriber.updates("/chatter");
            updates.iter().any(|list| list.contains(&publisher.api))
        });
    });
}

/// The computer of the unreachable nodes vanishes without notice, so each attempt to notify them lasts until its time
/// limit.
#[test]
fn unreachable_subscribers_delay_no_other_node() {
    let _turn = crate::turn();
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
    let publishers = ["/first", "/second"].map(FakeNode::start);
    for publisher in &publishers {
        assert_heard(&client, publisher, &living);
    }
}

/// The node accepts calls and does not answer them.
#[test]
fn a_subscriber_that_does_not_answer_delays_no_other_node() {
    let _turn = crate::turn();
    let (_robot, client) = robot_without_master();
    let [silent, living] = ["/silent", "/living"].map(FakeNode::start);
    for node in [&silent, &living] {
        node.subscribe(&client, "/chatter", "std_msgs/String");
    }
    silent.hold();
    let [first, second] = ["/first", "/second"].map(FakeNode::start);
    for publisher in [&first, &second] {
        assert_heard(&client, publisher, &living);
    }
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
