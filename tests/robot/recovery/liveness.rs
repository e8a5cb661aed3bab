//! The status reports dead nodes, long before a rescue or `--reap` unregisters them.

use std::time::Instant;

use rescue_core::order::RECENT;

use super::reap::{await_watched, has_logged, shown};
use crate::support::{
    FakeNode, Library, Mode, Robot, Tool, eventually, free_port, names, page, params,
};

#[test]
fn killed_nodes_are_reported_as_dead_and_stay_registered() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let mut talker = robot.node(Library::Roscpp, "talker", &[]);
    let mut listener = robot.node(Library::Rospy, "listener", &[]);
    let fakes = ["/a", "/b", "/c"].map(FakeNode::start);
    for node in &fakes {
        node.publish(&client, "/topic", "std_msgs/String");
    }
    // This host name does not exist, so the node cannot be asked.
    let lost = "http://nobody.invalid:4711/";
    client.ok("registerSubscriber", params!["/lost", "/topic", "*", lost]);
    let status = || robot.status().unwrap_or_default();
    let unchecked = || names(&status()["unchecked_nodes"]);
    eventually("all other nodes are known to be alive", || {
        let all = status()["state"]["nodes"].as_u64();
        unchecked() == ["/lost"] && status()["alive_nodes"].as_u64().map(|alive| alive + 1) == all
    });
    assert_eq!(names(&status()["dead_nodes"]), Vec::<String>::new());
    await_watched(&robot, &[("/talker", talker.pid())]);
    let before = robot.settled_state();
    let process = format!("its process {} ended at", talker.pid());

    talker.kill();
    listener.kill();
    eventually("the killed nodes are reported as dead", || {
        names(&status()["dead_nodes"]) == ["/listener", "/talker"]
    });
    eventually("the log reports the dead node", || {
        let report = "would have unregistered /talker: ";
        has_logged(
            &robot,
            &[report, &process, "no process listens at its port"],
        )
    });
    assert_eq!(status()["node_health"]["/talker"]["health"], "dead");
    before.assert_same(&robot.settled_state(), "dead nodes stay registered");
    assert_eq!(status()["unreachable"], serde_json::json!([]));
    let printed = Tool::rosrescue(&robot.scratch, robot.port(), &["status"]).ended(1);
    for part in [
        "NODES DIED, since 2",
        "2 dead but registered: /listener since 2",
        ", /talker since 2",
        "; 1 not checked: /lost since 2",
    ] {
        assert!(printed.contains(part), "{part}: {printed}");
    }
    let metrics = page(&client, "/metrics");
    for line in [
        "\nrosrescue_dead_nodes 2\n",
        "\nrosrescue_unchecked_nodes 1\n",
        "\nrosrescue_node_since_seconds{node=\"/talker\",health=\"dead\"} ",
    ] {
        assert!(metrics.contains(line), "{line}: {metrics}");
    }
    let node = |name: &str| shown(&robot, name).unwrap();
    assert_eq!(node("/talker")["health"], "dead");
    assert!(node("/talker")["removed_at"].is_null() && !node("/talker")["checked_at"].is_null());
    assert_eq!(
        (&node("/lost")["health"], &node("/lost")["checked_at"]),
        (&"unchecked".into(), &serde_json::Value::Null)
    );
    // rosrescue asked each node at most once, for its process id when it was new.
    assert!(fakes[0].calls().len() <= 1, "{:?}", fakes[0].calls());

    let _again = robot.node(Library::Roscpp, "talker", &[]);
    eventually("the restarted node is alive", || {
        names(&status()["dead_nodes"]) == ["/listener"]
    });
}

/// This also holds for a node that never existed.
#[test]
fn a_node_whose_port_has_no_listener_is_reported_as_dead() {
    let robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let api = format!("http://127.0.0.1:{}/", free_port());
    let call = params!["/dead", "/a", "std_msgs/String", api.as_str()];
    robot.client().ok("registerPublisher", call);
    eventually("the node is reported as dead", || {
        names(&robot.status().unwrap_or_default()["dead_nodes"]) == ["/dead"]
    });
    let said = |line: &String| line.contains("a registered node is dead") && line.contains("/dead");
    eventually("the log reports the dead node", || {
        robot.rescue.output().iter().any(said)
    });
}

/// rosrescue tells a node the state again if the master has notified it soon after an answer. A refused connection is
/// no failed health check.
#[test]
fn a_node_that_refuses_a_notification_stays_registered() {
    let robot = Robot::start_with(Mode::Core, &["--verbose", "--no-rosout"]);
    let client = robot.client();
    let node = FakeNode::start("/subscriber");
    let publisher = FakeNode::start("/publisher");
    node.subscribe(&client, "/topic", "std_msgs/String");
    let again = params![
        "/subscriber",
        "/topic",
        "std_msgs/String",
        node.api.as_str()
    ];
    drop(node);
    eventually("the master notifies the node soon after an answer", || {
        let asked = Instant::now();
        client.ok("registerSubscriber", again.clone());
        publisher.publish(&client, "/topic", "std_msgs/String");
        let is_soon = asked.elapsed() < RECENT;
        if !is_soon {
            publisher.unpublish(&client, "/topic");
        }
        is_soon
    });
    let registered = robot.settled_state();
    for part in [
        "a node does not answer",
        "a port refuses connections; its nodes stay registered",
    ] {
        eventually(part, || {
            let output = robot.rescue.output();
            output.iter().any(|line| line.contains(part))
        });
    }
    assert_eq!(robot.settled_state(), registered);
    eventually("the subscriber is reported as dead", || {
        names(&robot.status().unwrap()["dead_nodes"]) == ["/subscriber"]
    });
}
