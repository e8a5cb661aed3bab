//! While there is no master, nodes get the same notifications as with a master. `tests/timing/notifications.rs` tests
//! how soon.

use std::time::{Duration, Instant};

use rescue_core::order::RECENT;
use ros1_master::xmlrpc::Value;

use crate::support::{FakeNode, Mode, Robot, eventually, holds, params, tree};

#[test]
fn a_subscriber_is_told_the_publishers_whenever_they_change() {
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
    let subscribed = Instant::now();
    // A node is told a state once more if it has just been answered. rosrescue may note the answer late.
    eventually("the answer is old", || subscribed.elapsed() > 2 * RECENT);
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
        // The master may have notified the first subscriber of the first publisher before, or rosrescue may have
        // repeated notifications that the master may not have sent.
        eventually("every list has arrived", || {
            node.updates("/chatter").ends_with(&wanted)
        });
    }
    assert_eq!(
        late.updates("/chatter"),
        wanted,
        "other lists were sent as well"
    );
    robot.revive_master();
    robot.await_recovery(dead);
    // A notification that is repeated later has the present list.
    assert!(holds(Duration::from_secs(2), || {
        let repeated = late.updates("/chatter").split_off(wanted.len());
        repeated.iter().all(Vec::is_empty)
    }));
}

#[test]
fn a_subscriber_of_a_parameter_is_told_values_in_order_and_the_last_one() {
    const VALUES: i32 = 100;
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    robot.take_master_away();
    let client = robot.client();
    let [exact, above] = ["/exact", "/above"].map(FakeNode::start);
    assert_eq!(exact.watch_param(&client, "/gains/p"), tree! {});
    above.watch_param(&client, "/gains");
    for value in 0..VALUES {
        client.set_param("/gains/p", value);
    }
    client.set_param("/gains", tree! { "p" => -1, "d" => "no" });
    client.ok("deleteParam", params!["/test", "/gains/p"]);
    // The updates of each state, in turn. If too many updates had to wait, only the present state is sent.
    let update = |key: &str, value: Value| params!["/master", key, value];
    let values = (0..VALUES).map(|value| (Value::Int(value), tree! { "p" => value }));
    let changed = (Value::Int(-1), tree! { "p" => -1, "d" => "no" });
    let deleted = (tree! {}, tree! { "d" => "no" });
    let states: Vec<_> = values
        .chain([changed, deleted])
        .map(|(p, gains)| [update("/gains/p/", p), update("/gains/", gains)])
        .collect();
    let last = states.len() - 1;
    // The second node gets two updates for the last two states, and perhaps each twice.
    for (node, twice) in [(exact, last), (above, last - 1)] {
        eventually("the last value arrives", || {
            let heard = node.received("paramUpdate");
            heard.last().is_some_and(|it| states[last].contains(it))
        });
        // A value may be left out if there is a newer one.
        let mut at = 0;
        for heard in node.received("paramUpdate") {
            let found = states.iter().position(|updates| updates.contains(&heard));
            let position = found.unwrap_or_else(|| panic!("{heard:?} was never set"));
            assert!(
                position >= at.min(twice),
                "{heard:?} came after {:?}",
                states[at]
            );
            at = at.max(position);
        }
    }
}
