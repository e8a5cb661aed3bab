//! The status says which nodes are dead, long before a rescue or `--reap-dead-nodes` takes them out.

use crate::support::{
    FakeNode, Library, Mode, Robot, Tool, eventually, free_port, in_both_modes, names, page, params,
};

in_both_modes!(nodes_that_are_killed_are_dead_in_the_status_and_stay_registered);

fn nodes_that_are_killed_are_dead_in_the_status_and_stay_registered(mode: Mode) {
    let robot = Robot::start_with(mode, &["--node-timeout", "300"]);
    let client = robot.client();
    let mut talker = robot.node(Library::Roscpp, "talker", &[]);
    let mut listener = robot.node(Library::Rospy, "listener", &[]);
    let fakes = ["/a", "/b", "/c"].map(FakeNode::start);
    for node in &fakes {
        node.publish(&client, "/topic", "std_msgs/String");
    }
    // Nobody can be asked there.
    let lost = "http://nobody.invalid:4711/";
    client.ok("registerSubscriber", params!["/lost", "/topic", "*", lost]);
    let status = || robot.status().unwrap_or_default();
    let unchecked = || names(&status()["unchecked_nodes"]);
    eventually("all others are known to live", || {
        let all = status()["state"]["nodes"].as_u64();
        unchecked() == ["/lost"] && status()["alive_nodes"].as_u64().map(|alive| alive + 1) == all
    });
    assert_eq!(names(&status()["dead_nodes"]), Vec::<String>::new());
    let nodes = status()["state"]["nodes"].clone();

    talker.kill();
    listener.kill();
    eventually("the killed ones are dead", || {
        names(&status()["dead_nodes"]) == ["/listener", "/talker"]
    });
    assert_eq!(status()["state"]["nodes"], nodes, "they stay registered");
    assert_eq!(status()["unreachable"], serde_json::json!([]));
    let shown = Tool::rosrescue(&robot.scratch, robot.port(), &["status"]).ended(0);
    assert!(
        shown.contains("2 dead but registered: /listener, /talker; 1 not checked: /lost"),
        "{shown}"
    );
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
    // For its process id, when it was new.
    assert!(fakes[0].calls().len() <= 1, "{:?}", fakes[0].calls());

    let _again = robot.node(Library::Roscpp, "talker", &[]);
    eventually("one is started again", || {
        names(&status()["dead_nodes"]) == ["/listener"]
    });
}

/// Also one that was never there.
#[test]
fn a_node_at_a_port_where_nobody_listens_is_dead() {
    let robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let api = format!("http://127.0.0.1:{}/", free_port());
    let call = params!["/dead", "/a", "std_msgs/String", api.as_str()];
    robot.client().ok("registerPublisher", call);
    eventually("it is dead", || {
        names(&robot.status().unwrap_or_default()["dead_nodes"]) == ["/dead"]
    });
    let said = |line: &String| line.contains("a registered node is dead") && line.contains("/dead");
    eventually("the log says so", || robot.rescue.output().iter().any(said));
}
