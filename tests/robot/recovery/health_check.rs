//! The health check after an outage decides which nodes are unregistered and which are kept: nodes that died, nodes
//! whose port another node has, and nodes that do not answer.

use std::time::Duration;

use crate::support::{
    FakeNode, Library, Mode, Robot, State, eventually, holds, in_both_modes, names, status,
};

/// Waits for the report of a recovery whose health check has finished, and checks the fields of every report.
#[track_caller]
fn report(robot: &Robot, what: &str, wanted: impl Fn(&serde_json::Value) -> bool) {
    let mut last = serde_json::Value::Null;
    let found = holds(Duration::from_secs(20), || {
        last = status(&robot.client())["last_recovery"].clone();
        !wanted(&last)
    });
    assert!(!found, "the report does not have {what}: {last:#}");
    for field in [
        "cause",
        "outcome",
        "phases",
        "restored",
        "not_restored",
        "mismatches",
        "removed",
        "reconciled",
        "unreachable",
        "told_again",
    ] {
        assert!(!last[field].is_null(), "no `{field}` in {last:#}");
    }
}

in_both_modes!(a_node_whose_port_refuses_connections_is_unregistered_and_others_are_told);

fn a_node_whose_port_refuses_connections_is_unregistered_and_others_are_told(mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    let dead = FakeNode::start("/dead");
    let living = FakeNode::start("/living");
    let subscriber = FakeNode::start("/subscriber");
    for node in [&dead, &living] {
        node.publish(&client, "/topic", "std_msgs/String");
        node.subscribe(&client, "/other", "std_msgs/String");
        node.offer(&client, &format!("{}/service", node.name));
        node.watch_param(&client, "/gains");
    }
    subscriber.subscribe(&client, "/topic", "std_msgs/String");
    let after = robot.settled_state().without_node("/dead");
    drop(dead);
    robot.crash_master();
    robot.await_state(&after, "after the dead node was unregistered");
    eventually("the subscriber is notified", || {
        subscriber.updates("/topic").last() == Some(&vec![living.api.clone()])
    });
    report(&robot, "the removed node", |report| {
        names(&report["removed"]) == ["/dead"]
    });
    for node in [&living, &subscriber] {
        assert_eq!(node.received("shutdown"), Vec::<Vec<_>>::new());
    }
}

/// rosrescue asked both nodes for their process ids soon after they had registered.
#[test]
fn another_process_at_the_port_counts_as_another_node() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let [old, same] = [("/old", 4001), ("/same", 4002)].map(|(name, pid)| {
        let node = FakeNode::start(name);
        node.claim_pid(pid);
        // Topics that all nodes have prove nothing.
        node.publish(&client, "/rosout", "rosgraph_msgs/Log");
        node.offer(&client, &format!("{name}/service"));
        node
    });
    for node in [&old, &same] {
        eventually("the node is asked for its process id", || {
            !node.received("getPid").is_empty()
        });
    }
    let after = robot.settled_state().without_node("/old");
    let taker = take_port(old, "/taker");
    taker.claim_pid(4003);
    taker.claim_publication("/rosout", Some("rosgraph_msgs/Log"));
    robot.crash_master();
    robot.await_state(&after, "after the old node was unregistered");
    report(&robot, "the removed node", |report| {
        names(&report["removed"]) == ["/old"]
    });
    assert_eq!(taker.received("shutdown"), Vec::<Vec<_>>::new());
    assert_eq!(same.received("shutdown"), Vec::<Vec<_>>::new());
}

/// Some client libraries report invented process ids.
#[test]
fn matching_topics_count_for_more_than_a_changed_process_id() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let node = FakeNode::start("/restless");
    node.claim_restless_pid();
    node.publish(&client, "/topic", "std_msgs/String");
    node.offer(&client, "/service");
    eventually("the node is asked for its process id", || {
        !node.received("getPid").is_empty()
    });
    let before = robot.settled_state();
    for _ in 0..2 {
        assert_kept(&mut robot, &before);
    }
}

/// Kills the master, and checks that the next one has the state `before`, even after the health check.
#[track_caller]
fn assert_kept(robot: &mut Robot, before: &State) {
    let dead = robot.master_pid();
    robot.crash_master();
    report(robot, "the time of the health check", |report| {
        report["master_pid"] != dead && report["health_check_ms"].is_number()
    });
    before.assert_same(&robot.state(), "after the health check");
}

/// The node answers `getPublications` and `getSubscriptions` with empty lists.
#[test]
fn a_node_that_cannot_list_its_topics_keeps_its_registrations() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let stub = FakeNode::start("/stub");
    stub.publish(&client, "/published", "std_msgs/String");
    stub.subscribe(&client, "/subscribed", "std_msgs/String");
    stub.claim_publication("/published", None);
    stub.claim_subscription("/subscribed", None);
    let before = robot.settled_state();
    assert_kept(&mut robot, &before);
}

/// rosrescue has never asked the old node for its process id.
#[test]
fn different_topics_at_the_port_count_as_another_node() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let old = FakeNode::start("/old");
    old.publish(&client, "/rosout", "rosgraph_msgs/Log");
    old.publish(&client, "/old/topic", "std_msgs/String");
    old.offer(&client, "/old/service");
    let same = FakeNode::start("/same");
    same.publish(&client, "/rosout", "rosgraph_msgs/Log");
    same.publish(&client, "/same/topic", "std_msgs/String");
    let taker = take_port(old, "/taker");
    taker.publish(&client, "/rosout", "rosgraph_msgs/Log");
    taker.publish(&client, "/taker/topic", "std_msgs/String");
    let after = robot.settled_state().without_node("/old");
    robot.crash_master();
    robot.await_state(&after, "after the old node was unregistered");
    assert_eq!(taker.received("shutdown"), Vec::<Vec<_>>::new());
    assert_eq!(same.received("shutdown"), Vec::<Vec<_>>::new());
}

/// Ends `node` and starts another node at its port.
fn take_port(node: FakeNode, name: &str) -> FakeNode {
    let port = node.port();
    drop(node);
    FakeNode::start_at(name, port)
}

#[test]
fn a_node_that_does_not_answer_is_unreachable_until_it_answers_again() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--node-timeout", "300"]);
    let client = robot.client();
    let silent = FakeNode::start("/silent");
    silent.subscribe(&client, "/topic", "std_msgs/String");
    client.set_param("/gain", 1);
    silent.watch_param(&client, "/gain");
    let before = robot.settled_state();
    silent.hold();
    robot.crash_master();
    let unreachable = || names(&status(&client)["unreachable"]);
    eventually("the node is unreachable", || unreachable() == ["/silent"]);
    report(&robot, "the unreachable node", |report| {
        names(&report["unreachable"]) == ["/silent"]
    });
    before.assert_same(&robot.state(), "while the node is unreachable");
    // The master has tried to notify the node of this, or is still trying.
    let late = FakeNode::start("/late");
    late.publish(&client, "/topic", "std_msgs/String");
    client.set_param("/gain", 2);
    silent.release();
    eventually("the node is reachable again", || unreachable().is_empty());
    eventually("the node knows the publisher", || {
        silent.updates("/topic").last() == Some(&vec![late.api.clone()])
    });
    eventually("the node knows the parameter", || {
        let told = silent.received("paramUpdate");
        told.last().is_some_and(|told| told[2] == 2.into())
    });
}

#[test]
fn an_unreachable_node_that_dies_is_unregistered() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--node-timeout", "300"]);
    let client = robot.client();
    let silent = FakeNode::start("/silent");
    silent.publish(&client, "/topic", "std_msgs/String");
    let after = robot.settled_state().without_node("/silent");
    silent.hold();
    robot.crash_master();
    eventually("the node is unreachable", || {
        names(&status(&client)["unreachable"]) == ["/silent"]
    });
    drop(silent);
    robot.await_state(&after, "after the unreachable node has died");
    eventually("no node is unreachable", || {
        names(&status(&client)["unreachable"]).is_empty()
    });
}

/// No outage is needed for this.
#[test]
fn reap_all_unregisters_dead_nodes_and_is_off_by_default() {
    let robot = Robot::start_with(Mode::Core, &["--reap", "all"]);
    let client = robot.client();
    let mut talker = robot.node(Library::Rospy, "talker", &[]);
    let listener = robot.node(Library::Roscpp, "listener", &[]);
    listener.wait_messages("/talker", 5);
    let after = robot.settled_state().without_node("/talker");
    let with = robot.settled_state();
    assert!(holds(Duration::from_secs(2), || {
        let now = State::try_read(&robot.bare());
        now.is_ok_and(|now| now == with)
    }));
    talker.kill();
    robot.await_state(&after, "after the regular health check");
    eventually("the listener is notified", || {
        listener.updates("/chatter").last() == Some(&Vec::new())
    });

    let robot = Robot::start(Mode::Proxy);
    let dead = FakeNode::start("/dead");
    dead.publish(&robot.client(), "/topic", "std_msgs/String");
    let before = robot.settled_state();
    drop(dead);
    assert!(holds(Duration::from_secs(3), || {
        let now = State::try_read(&robot.bare());
        now.is_ok_and(|now| now == before)
    }));
    drop((client, after));
}

/// A node that does not answer, for example because it is busy, does not have to wait when it registers.
#[test]
fn a_node_that_does_not_answer_can_register_at_once_during_an_outage() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    let dead = robot.master_pid();
    robot.kill_master();
    node.hold();
    node.subscribe(&client, "/more", "std_msgs/String");
    assert!(!robot.is_open(), "a master was there during the outage");
    robot.revive_master();
    robot.await_recovery(dead);
    node.release();
    let state = robot.state();
    assert_eq!(state.subscribers_of("/more"), ["/node"]);
    assert_eq!(state.publishers_of("/topic"), ["/node"]);
}
