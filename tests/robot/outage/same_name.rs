//! Two nodes of the same name, and a master that dies before it has told the first node to shut down.

use std::thread;
use std::time::Duration;

use ros1_master::xmlrpc::Value;

use crate::support::{
    FakeNode, Library, Mode, Node, Robot, eventually, eventually_some, holds, in_both_modes,
    params, port_of,
};

/// The parameters of the call by which a master shuts down a node whose name was taken.
fn goodbye(name: &str) -> Vec<Value> {
    let reason = format!("[{name}] Reason: new node registered with same name");
    params!["/master", reason.as_str()]
}

fn twin(robot: &Robot) -> Node {
    robot.spawn_node(Library::Rospy, "talker", &["__name:=twin"])
}

/// Waits until /twin has left `port`, and kills the master at once.
fn kill_when_taken(robot: &mut Robot, master: u32, port: u16) {
    let client = robot.client();
    eventually_some("the second node takes the name", || {
        (port_of(&client, "/twin") != port).then_some(())
    });
    robot.kill_master_at_once(master);
}

#[test]
fn a_displaced_node_ends_although_the_master_died_before_telling_it() {
    a_displaced_node_ends(Robot::start(Mode::Core));
}

/// The master of this test never notifies a node.
#[test]
fn a_displaced_node_ends_although_the_master_never_tells_nodes() {
    a_displaced_node_ends(Robot::start_under(Mode::Proxy, "silent_rosmaster.py", &[]));
}

fn a_displaced_node_ends(mut robot: Robot) {
    let mut first = twin(&robot);
    first.wait_line("`ready`", |line| line.starts_with("ready "));
    let port = port_of(&robot.client(), "/twin");
    let master = robot.master_pid();
    let mut second = twin(&robot);
    kill_when_taken(&mut robot, master, port);
    robot.revive_master();
    second.wait_line("`ready`", |line| line.starts_with("ready "));
    eventually("one of the two nodes ends", || {
        first.exited().is_some() || second.exited().is_some()
    });
    robot.await_recovery(master);
    // A node that logs a message before it is told to shut down takes its name back by calling subscribeParam, with any
    // master.
    let taken_back = first.exited().is_none();
    assert!(
        !taken_back || first.log().contains("[WARN]"),
        "{}",
        first.log()
    );
    let heir = if taken_back { &mut first } else { &mut second };
    assert!(
        holds(Duration::from_secs(2), || heir.exited().is_none()),
        "{}",
        heir.log()
    );
    assert_eq!(port_of(&robot.bare(), "/twin") == port, taken_back);
}

/// The port of a displaced node already belongs to another node when the shutdown would be sent.
#[test]
fn a_node_that_now_has_the_port_of_a_displaced_node_is_not_shut_down() {
    for (mode, is_registered) in [(Mode::Core, false), (Mode::Proxy, true)] {
        let mut robot = Robot::start_under(mode, "silent_rosmaster.py", &[]);
        let port = node_that_ends(&robot);
        let other = other_node_at(&robot, port, is_registered);
        let master = robot.master_pid();
        let second = FakeNode::start("/twin");
        let client = robot.client();
        thread::scope(|scope| {
            let register = scope.spawn(|| second.publish(&client, "/chatter", "std_msgs/String"));
            kill_when_taken(&mut robot, master, port);
            robot.revive_master();
            robot.await_recovery(master);
            register.join().unwrap();
        });
        assert_unharmed(&other);
    }
}

/// Like the test above, but rosrescue itself notifies nodes because there is no master.
#[test]
fn a_node_that_now_has_the_port_is_not_shut_down_during_an_outage_either() {
    for is_registered in [false, true] {
        let mut robot = Robot::start_for_outages(Mode::Proxy);
        let port = node_that_ends(&robot);
        robot.take_master_away();
        let other = other_node_at(&robot, port, is_registered);
        let second = FakeNode::start("/twin");
        second.publish(&robot.client(), "/chatter", "std_msgs/String");
        assert_ne!(port_of(&robot.client(), "/twin"), port);
        assert_unharmed(&other);
        if !is_registered {
            robot.rescue.wait_line("the log says so", |line| {
                line.contains("is not told to shut down: it may not be the one that answers")
            });
        }
    }
}

/// Registers a node named `/twin`, which then ends without a word. Returns its port.
fn node_that_ends(robot: &Robot) -> u16 {
    let first = FakeNode::start("/twin");
    first.publish(&robot.client(), "/chatter", "std_msgs/String");
    eventually("rosrescue asks for the node's process id", || {
        !first.received("getPid").is_empty()
    });
    first.port()
}

/// Another node at `port`, with another process id.
fn other_node_at(robot: &Robot, port: u16, is_registered: bool) -> FakeNode {
    let other = FakeNode::start_at("/other", port);
    other.claim_pid(4_000_000);
    other.claim_publication("/elsewhere", Some("std_msgs/String"));
    if is_registered {
        other.publish(&robot.client(), "/elsewhere", "std_msgs/String");
    }
    other
}

fn assert_unharmed(other: &FakeNode) {
    assert!(
        holds(Duration::from_secs(3), || other
            .received("shutdown")
            .is_empty()),
        "{:?}",
        other.calls()
    );
}

in_both_modes!(
    a_displaced_node_is_told_by_the_next_worker_if_master_and_worker_died,
    a_displaced_node_is_told_by_the_next_worker_if_the_master_lives,
);

/// The master has not told the node to shut down, and the worker dies together with the master.
fn a_displaced_node_is_told_by_the_next_worker_if_master_and_worker_died(mode: Mode) {
    displaced_before_the_worker_dies(mode, true);
}

/// The worker may die before the master has told the node to shut down. The master lives on.
fn a_displaced_node_is_told_by_the_next_worker_if_the_master_lives(mode: Mode) {
    displaced_before_the_worker_dies(mode, false);
}

fn displaced_before_the_worker_dies(mode: Mode, master_dies: bool) {
    let mut robot = Robot::start_under(mode, "silent_rosmaster.py", &[]);
    let client = robot.client();
    // For the last two registrations, the first node takes its name back.
    let nodes = ["/twin", "/twin", "/back", "/back"].map(FakeNode::start);
    let [first, second, owner, taker] = &nodes;
    for node in [owner, taker, owner, first, second] {
        node.publish(
            &client,
            &format!("{}/chatter", node.name),
            "std_msgs/String",
        );
    }
    let master = robot.master_pid();
    robot.rescue.kill();
    if master_dies {
        robot.kill_master_at_once(master);
    }
    robot.rescue.start_again();
    if master_dies {
        robot.revive_proxied_master();
        robot.await_recovery(master);
    } else {
        robot.rescue.wait_serving();
        assert_eq!(robot.master_pid(), master);
    }
    let heard = || nodes.each_ref().map(|node| node.received("shutdown"));
    let none = Vec::<Vec<Value>>::new;
    let wanted = [
        vec![goodbye("/twin")],
        none(),
        none(),
        vec![goodbye("/back")],
    ];
    eventually("the displaced nodes are told to shut down", || {
        heard() == wanted
    });
    assert!(
        holds(Duration::from_secs(1), || heard() == wanted),
        "{:?}",
        heard()
    );
    for node in [second, owner] {
        let api = robot
            .bare()
            .ok("lookupNode", params!["/test", node.name.as_str()]);
        assert_eq!(api, Value::from(node.api.as_str()));
    }
}

/// The node is told to shut down exactly once, with the text that a master uses.
#[test]
fn a_node_displaced_during_an_outage_is_told_exactly_once() {
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    let client = robot.client();
    let first = FakeNode::start("/twin");
    first.claim_pid(4_000_000);
    first.publish(&client, "/chatter", "std_msgs/String");
    let dead = robot.master_pid();
    robot.take_master_away();
    let second = FakeNode::start("/twin");
    second.publish(&client, "/chatter", "std_msgs/String");
    eventually("the first node is told to shut down", || {
        !first.received("shutdown").is_empty()
    });
    robot.revive_master();
    robot.await_recovery(dead);
    assert!(holds(Duration::from_secs(3), || {
        first.received("shutdown") == [goodbye("/twin")] && second.received("shutdown").is_empty()
    }));
    let api = robot.bare().ok("lookupNode", params!["/test", "/twin"]);
    assert_eq!(api, Value::from(second.api.as_str()));
}
