//! The health check after an outage decides which nodes are unregistered and which are kept: nodes that died, nodes
//! whose port another node has, and nodes that do not answer.

use std::time::Duration;

use crate::support::{
    FakeNode, Library, Mode, PATIENCE, Robot, State, eventually, holds, names, status,
};

/// Waits for the report of a recovery whose health check has finished, and checks the fields of every report.
#[track_caller]
fn report(robot: &Robot, what: &str, wanted: impl Fn(&serde_json::Value) -> bool) {
    let mut last = serde_json::Value::Null;
    let found = holds(PATIENCE, || {
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

/// Nodes of many kinds, which one health check judges.
#[test]
fn only_dead_nodes_and_those_whose_port_another_node_has_are_unregistered() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let [dead, living, subscriber] = ["/dead", "/living", "/subscriber"].map(FakeNode::start);
    for node in [&dead, &living] {
        node.publish(&client, "/topic", "std_msgs/String");
        node.subscribe(&client, "/other", "std_msgs/String");
        node.offer(&client, &format!("{}/service", node.name));
        node.watch_param(&client, "/gains");
    }
    subscriber.subscribe(&client, "/topic", "std_msgs/String");
    let [old, same] = [("/old", 4001), ("/same", 4002)].map(|(name, pid)| {
        let node = FakeNode::start(name);
        node.claim_pid(pid);
        // Topics that all nodes have prove nothing.
        node.publish(&client, "/rosout", "rosgraph_msgs/Log");
        node.offer(&client, &format!("{name}/service"));
        node
    });
    // Some client libraries report invented process ids. Matching topics count for more.
    let restless = FakeNode::start("/restless");
    restless.claim_restless_pid();
    restless.publish(&client, "/restless/topic", "std_msgs/String");
    restless.offer(&client, "/restless/service");
    // This node answers `getPublications` and `getSubscriptions` with empty lists.
    let stub = FakeNode::start("/stub");
    stub.publish(&client, "/stub/published", "std_msgs/String");
    stub.subscribe(&client, "/stub/subscribed", "std_msgs/String");
    stub.claim_publication("/stub/published", None);
    stub.claim_subscription("/stub/subscribed", None);
    for node in [&old, &same, &restless] {
        eventually("the node is asked for its process id", || {
            !node.received("getPid").is_empty()
        });
    }
    // rosrescue has not asked this node for its process id yet. The node that gets its port has other topics.
    let different = FakeNode::start("/different");
    different.publish(&client, "/rosout", "rosgraph_msgs/Log");
    different.publish(&client, "/different/topic", "std_msgs/String");
    different.offer(&client, "/different/service");
    let other = take_port(different, "/other");
    other.publish(&client, "/rosout", "rosgraph_msgs/Log");
    other.publish(&client, "/other/topic", "std_msgs/String");
    drop(dead);
    // Another process has the port of this node.
    let taker = take_port(old, "/taker");
    taker.claim_pid(4003);
    taker.claim_publication("/rosout", Some("rosgraph_msgs/Log"));
    let removed = ["/dead", "/different", "/old"];
    let before = robot.settled_state();
    let after = removed
        .iter()
        .fold(before, |state, node| state.without_node(node));
    robot.crash_master();
    robot.await_state(&after, "after three nodes were unregistered");
    eventually("the subscriber is notified", || {
        subscriber.updates("/topic").last() == Some(&vec![living.api.clone()])
    });
    report(&robot, "the removed nodes", |report| {
        names(&report["removed"]) == removed
    });
    assert_kept(&mut robot, &after);
    for node in [
        &living,
        &subscriber,
        &same,
        &restless,
        &stub,
        &other,
        &taker,
    ] {
        assert_eq!(node.received("shutdown"), Vec::<Vec<_>>::new());
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

/// Ends `node` and starts another node at its port.
fn take_port(node: FakeNode, name: &str) -> FakeNode {
    let port = node.port();
    drop(node);
    FakeNode::start_at(name, port)
}

#[test]
fn a_node_that_does_not_answer_is_unreachable_until_it_answers_again_or_dies() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--node-timeout", "300"]);
    let client = robot.client();
    let [silent, dying] = ["/silent", "/dying"].map(FakeNode::start);
    silent.subscribe(&client, "/topic", "std_msgs/String");
    client.set_param("/gain", 1);
    silent.watch_param(&client, "/gain");
    dying.publish(&client, "/last_words", "std_msgs/String");
    let before = robot.settled_state();
    silent.hold();
    dying.hold();
    robot.crash_master();
    let unreachable = || names(&status(&client)["unreachable"]);
    let both = ["/dying", "/silent"];
    eventually("the nodes are unreachable", || unreachable() == both);
    report(&robot, "the unreachable nodes", |report| {
        names(&report["unreachable"]) == both
    });
    before.assert_same(&robot.state(), "while the nodes are unreachable");
    drop(dying);
    let after = before.without_node("/dying");
    robot.await_state(&after, "after an unreachable node has died");
    eventually("the other node is unreachable", || {
        unreachable() == ["/silent"]
    });
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

/// No outage is needed for this. `liveness.rs` shows that dead nodes stay registered by default.
#[test]
fn reap_all_unregisters_dead_nodes() {
    let robot = Robot::start_with(Mode::Core, &["--reap", "all"]);
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
