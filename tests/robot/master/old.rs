//! A master that behaves like rosmaster 1.14.3: it also notifies the node that has set a parameter itself.
//! While there is no master, rosrescue does the same.

use crate::support::{FakeNode, Mode, Robot, eventually, holds, params};
use std::time::Duration;

use ros1_master::xmlrpc::Value;

#[test]
fn a_node_that_sets_a_parameter_is_notified_as_by_the_old_master() {
    for is_old in [true, false] {
        let mut robot = match is_old {
            true => Robot::start_under(Mode::Proxy, "old_rosmaster.py", &[]),
            false => Robot::start(Mode::Proxy),
        };
        let client = robot.client();
        let node = FakeNode::start("/node");
        node.watch_param(&client, "/gain");
        let set = |value: i32| client.ok("setParam", params!["/node", "/gain", value]);
        let told = |value| {
            let calls = node.calls().into_iter();
            let mut values = calls.filter(|call| call.method == "paramUpdate");
            values.any(|call| call.params[2] == Value::Int(value))
        };
        let is_told = |value| match is_old {
            true => eventually("the node is notified", || told(value)),
            false => assert!(holds(Duration::from_millis(300), || !told(value))),
        };
        set(1);
        is_told(1);
        let dead = robot.master_pid();
        robot.take_master_away();
        set(2);
        is_told(2);
        let (code, _, value) = client.status("lookupService", params!["/n", ""]).unwrap();
        let empty = if is_old { 0.into() } else { "".into() };
        assert_eq!((code, value), (-1, empty));
        robot.revive_master();
        robot.await_recovery(dead);
        set(3);
        is_told(3);
    }
}
