//! What nodes are told while there is no master: the same as by a master.

use std::time::{Duration, Instant};

use rosrescue::xmlrpc::Value;

use crate::support::{
    Client, FakeNode, Mode, Netns, Robot, eventually, eventually_some, holds, params, tree,
};

/// By then whoever can be reached has been told, on two busy cores.
const SOON: Duration = Duration::from_secs(1);
/// More than rosrescue notifies at the same time.
const UNREACHABLE: u16 = 100;

fn robot_without_master() -> (Robot, Client) {
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    robot.take_master_away();
    let client = robot.client();
    (robot, client)
}

#[test]
fn a_subscriber_is_told_all_publishers_whenever_they_change() {
    let _alone = crate::alone();
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    let client = robot.client();
    let publishers = ["/one", "/two", "/three"].map(FakeNode::start);
    let [one, two, three] = &publishers;
    let subscriber = FakeNode::start("/subscriber");
    one.publish(&client, "/chatter", "std_msgs/String");
    subscriber.subscribe(&client, "/chatter", "std_msgs/String");
    let dead = robot.master_pid();
    robot.take_master_away();
    let late = FakeNode::start("/late");
    late.subscribe(&client, "/chatter", "std_msgs/String");
    two.publish(&client, "/chatter", "std_msgs/String");
    three.publish(&client, "/chatter", "std_msgs/String");
    one.unpublish(&client, "/chatter");
    three.unpublish(&client, "/chatter");
    two.unpublish(&client, "/chatter");
    let lists: [&[&FakeNode]; 5] = [&[one, two], &[one, two, three], &[two, three], &[two], &[]];
    let wanted = lists.map(|list| {
        let apis = list.iter().map(|node| node.api.clone());
        apis.collect::<Vec<_>>()
    });
    for node in [&subscriber, &late] {
        // The master may have told the first subscriber of the first publisher before, or rosrescue of what
        // that may have owed.
        eventually("every list has come", || {
            node.updates("/chatter").ends_with(&wanted)
        });
    }
    assert_eq!(late.updates("/chatter"), wanted, "and nothing else");
    robot.revive_master();
    robot.await_recovery(dead);
    // What may be repeated then is the present list.
    assert!(holds(Duration::from_secs(2), || {
        let repeated = late.updates("/chatter").split_off(wanted.len());
        repeated.iter().all(Vec::is_empty)
    }));
}

#[test]
fn a_subscriber_of_a_parameter_is_told_each_value_in_order() {
    let _alone = crate::alone();
    const VALUES: i32 = 100;
    let (_robot, client) = robot_without_master();
    let [exact, above] = ["/exact", "/above"].map(FakeNode::start);
    assert_eq!(exact.watch_param(&client, "/gains/p"), tree! {});
    above.watch_param(&client, "/gains");
    for value in 0..VALUES {
        client.set_param("/gains/p", value);
    }
    client.set_param("/gains", tree! { "p" => -1, "d" => "no" });
    client.ok("deleteParam", params!["/test", "/gains/p"]);
    let update = |key: &str, value: Value| params!["/master", key, value];
    let mut wanted: Vec<_> = (0..VALUES)
        .map(|value| update("/gains/p/", value.into()))
        .collect();
    let mut wanted_above = wanted.clone();
    wanted.extend([Value::Int(-1), tree! {}].map(|value| update("/gains/p/", value)));
    wanted_above.push(update("/gains/", tree! { "p" => -1, "d" => "no" }));
    wanted_above.push(update("/gains/p/", tree! {}));
    for (node, wanted) in [(exact, wanted), (above, wanted_above)] {
        eventually("the last value is told", || {
            node.heard("paramUpdate").last() == wanted.last()
        });
        assert_eq!(node.heard("paramUpdate"), wanted);
    }
}

/// How long it takes until `subscriber` knows `publisher`, which registers now.
#[track_caller]
fn time_to_hear(client: &Client, publisher: &FakeNode, subscriber: &FakeNode) -> Duration {
    let start = Instant::now();
    publisher.publish(client, "/chatter", "std_msgs/String");
    eventually_some("the subscriber hears of the publisher", || {
        let updates = subscriber.updates("/chatter");
        let knows = updates.iter().any(|list| list.contains(&publisher.api));
        knows.then(|| start.elapsed())
    })
}

/// Their computer has vanished, and nobody has noticed before: each is waited for until a time limit.
#[test]
fn subscribers_that_cannot_be_reached_delay_nobody() {
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
    // The last in the list.
    let living = FakeNode::start("/living");
    living.subscribe(&client, "/chatter", "std_msgs/String");
    let [first, second] = ["/first", "/second"].map(FakeNode::start);
    let times = [&first, &second].map(|publisher| time_to_hear(&client, publisher, &living));
    println!("{UNREACHABLE} beside it are unreachable: told after {times:?}");
    assert!(times.iter().all(|time| *time < SOON), "{times:?}");
}

/// It takes calls and does not answer.
#[test]
fn a_subscriber_that_does_not_answer_delays_nobody() {
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
    // As soon as it answers again it is told everything.
    let both = [first.api.clone(), second.api.clone()];
    eventually("the silent one is told at last", || {
        silent
            .updates("/chatter")
            .last()
            .is_some_and(|list| *list == both)
    });
}
