//! The status reports dead nodes, long before a rescue or `--reap` unregisters them.

use crate::support::{
    FakeNode, Library, Mode, Robot, Tool, eventually, free_port, in_both_modes, names, page, params,
};

in_both_modes!(killed_nodes_are_reported_as_dead_and_stay_registered);

fn killed_nodes_are_reported_as_dead_and_stay_registered(mode: Mode) {
    let robot = Robot::start_with(mode, &["--node-timeout", "300"]);
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
    let nodes = status()["state"]["nodes"].clone();

    talker.kill();
    listener.kill();
    eventually("the killed nodes are reported as dead", || {
        names(&status()["dead_nodes"]) == ["/listener", "/talker"]
    });
    assert_eq!(
        status()["state"]["nodes"],
        nodes,
        "the dead nodes must stay registered"
    );
    assert_eq!(status()["unreachable"], serde_json::json!([]));
    let shown = Tool::rosrescue(&robot.scratch, robot.port(), &["status"]).ended(1);
    for part in [
        "NODES DIED, since 2",
        "2 dead but registered: /listener since 2",
        ", /talker since 2",
        "; 1 not checked: /lost since 2",
    ] {
        assert!(shown.contains(part), "{part}: {shown}");
    }
    let metrics = page(&client, "/metrics");
    assert!(metrics.contains("\nrosrescue_dead_nodes 2\n"), "{metrics}");
    assert!(
        metrics.contains("\nrosrescue_unchecked_nodes 1\n"),
        "{metrics}"
    );
    let state = page(&client, "/state.json");
    let state: serde_json::Value =
        serde_json::from_str(state.rsplit("\r\n").next().unwrap_or(&state)).unwrap();
    let node = |name: &str| {
        let mut nodes = state["nodes"].as_array().unwrap().iter();
        nodes.find(|node| node["name"] == name).unwrap().clone()
    };
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
    publisher.publish(&client, "/topic", "std_msgs/String");
    eventually("the master has notified the subscriber", || {
        !node.updates("/topic").is_empty()
    });
    drop(node);
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
