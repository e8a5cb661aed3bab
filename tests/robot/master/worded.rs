//! A master whose answers have other words, as a vendor's patched rosmaster. That is no other state.

use crate::support::{FakeNode, Mode, Robot, eventually};

#[test]
fn a_master_with_other_words_is_read_once_per_method_and_restored_at_once() {
    let mut robot = Robot::start_under(Mode::Proxy, "worded_rosmaster.py", &[]);
    let client = robot.client();
    let node = FakeNode::start("/node");
    for number in 0..20 {
        let topic = format!("/topic{number}");
        node.publish(&client, &topic, "a/B");
        node.subscribe(&client, &topic, "a/B");
        client.set_param(&format!("/param{number}"), number);
    }
    node.watch_param(&client, "/param1");
    // `registerPublisher`, `registerSubscriber`, `setParam` and `subscribeParam`.
    let divergences = robot.counter("divergences");
    assert!((1..=4).contains(&divergences), "{divergences}");
    eventually("the mirror is as the master", || robot.is_open());
    for _ in 0..2 {
        robot.crash_master();
    }
    assert_eq!(robot.bare().param("/param7"), Some(7.into()));
    client.set_param("/param7", 8);
    assert!(robot.counter("divergences") <= 4);
    for line in robot.rescue.output() {
        let is_wrong = line.contains("another program has changed")
            || line.contains("does not hold the state");
        assert!(!is_wrong, "{line}");
    }
}
