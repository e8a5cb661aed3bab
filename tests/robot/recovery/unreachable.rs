//! Nodes that could not be reached get all pending notifications as soon as they can be reached.
//! `tests/timing/unreachable.rs` tests which nodes they delay.

use std::time::Duration;

use crate::support::{
    FakeNode, Library, Mode, Netns, Node, Robot, Scratch, Setup, eventually, free_port, holds,
    names, status,
};

/// Real nodes behind a cable that is cut during an outage and repaired later.
#[test]
fn a_node_that_can_be_reached_again_is_told_everything() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).env("ROS_IP", net.near());
    let rescue = setup.args(["--node-timeout", "1000"]).start();
    let client = rescue.client();
    let port = rescue.port();
    let nodes = [(2, Library::Rospy), (3, Library::Roscpp)].map(|(host, library)| {
        let mut command = library.command(&scratch, port, "listener");
        let name = format!("__name:={}", format!("{library:?}").to_lowercase());
        command
            .arg(name)
            .env("ROS_IP", net.far(host))
            .env("ROS_MASTER_URI", format!("http://{}:{port}", net.near()));
        Node::run(&mut net.inside(&command))
    });
    for host in [2, 3] {
        net.cut(host);
    }
    let dead = client.master_pid().expect("a master");
    crate::support::signal(dead, rustix::process::Signal::KILL);
    let publisher = FakeNode::start("/publisher");
    publisher.publish(&client, "/chatter", "std_msgs/String");
    let unreachable = || names(&status(&client)["unreachable"]);
    eventually("both nodes are unreachable", || {
        unreachable() == ["/roscpp", "/rospy"]
    });
    let knows = |node: &Node| {
        let updates = node.updates("/chatter");
        updates.last() == Some(&vec![publisher.api.clone()])
    };
    // The wait is longer than the rosmaster in this test keeps trying.
    assert!(holds(Duration::from_secs(7), || !nodes.iter().any(knows)));
    for host in [2, 3] {
        net.mend(host);
    }
    eventually("both nodes know the publisher", || nodes.iter().all(knows));
    eventually("no node is unreachable any more", || {
        unreachable().is_empty()
    });
}

/// Nodes of rosnodejs do not answer `paramUpdate`, but answer all other calls.
#[test]
fn a_node_that_never_answers_param_update_still_hears_of_publishers() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--node-timeout", "2000"]);
    let client = robot.client();
    client.set_param("/gain", 0);
    let node = FakeNode::start("/node");
    node.ignore("paramUpdate");
    node.subscribe(&client, "/topic", "std_msgs/String");
    node.watch_param(&client, "/gain");
    robot.take_master_away();
    let mut publishers = Vec::new();
    for value in 1..=3 {
        client.set_param("/gain", value);
        eventually("the node is notified of the parameter", || {
            let told = node.received("paramUpdate");
            told.iter().any(|told| told[2] == value.into())
        });
        let publisher = FakeNode::start(&format!("/publisher{value}"));
        publisher.publish(&client, "/topic", "std_msgs/String");
        publishers.push(publisher);
        let all: Vec<_> = publishers.iter().map(|node| node.api.clone()).collect();
        let reachable = holds(Duration::from_secs(30), || {
            names(&status(&client)["unreachable"]).is_empty()
                && node.updates("/topic").last() != Some(&all)
        });
        assert!(!reachable, "the node was not notified of publisher {value}");
        let unreachable = names(&status(&client)["unreachable"]);
        assert_eq!(unreachable, Vec::<String>::new(), "publisher {value}");
    }
}
