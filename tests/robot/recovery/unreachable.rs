//! Nodes that could not be reached get all pending notifications as soon as they can be reached.
//! `tests/timing/unreachable.rs` tests which nodes they delay.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use ros1_master::xmlrpc::Reply;

use crate::support::{
    Client, FakeMaster, FakeNode, Library, Mode, Netns, Node, Robot, Scratch, Setup, eventually,
    free_port, holds, names, params, status,
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
    let mut robot = Robot::start_with(Mode::Proxy, &["--node-timeout", "6000"]);
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

/// A master does not look at answers. Boards search what they get for texts that every rosmaster sends.
#[test]
fn boards_that_answer_in_their_own_words_are_told_each_change_as_by_a_master() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--node-timeout", "6000"]);
    let client = robot.client();
    let answers = [
        FakeMaster::proper(&Reply::Value("hmm".into())),
        b"HTTP/1.1 200 OK\r\nContent-Length: 7\r\n\r\n<broken".to_vec(),
    ];
    let boards = answers.map(|answer| {
        let told = Arc::new(Mutex::new(String::new()));
        let last = told.clone();
        let board = FakeMaster::start(move |body| {
            let body = String::from_utf8_lossy(body);
            if body.contains("publisherUpdate") {
                *last.lock().unwrap() = body.into_owned();
            }
            answer.clone()
        });
        (board, told)
    });
    for (index, (board, _)) in boards.iter().enumerate() {
        let (name, api) = (format!("/board{index}"), Client::new(board.port()).uri());
        let subscription = params![name, "/topic", "std_msgs/String", api];
        client.ok("registerSubscriber", subscription);
    }
    robot.take_master_away();
    let mut publishers = Vec::new();
    for number in 1..=3 {
        let publisher = FakeNode::start(&format!("/publisher{number}"));
        publisher.publish(&client, "/topic", "std_msgs/String");
        publishers.push(publisher);
        let all: String = publishers
            .iter()
            .map(|publisher| format!("<value><string>{}</string></value>\n", publisher.api))
            .collect();
        for (_, told) in &boards {
            eventually(&format!("a board is told publisher {number}"), || {
                let told = told.lock().unwrap();
                told.contains("<value><string>/master</string></value>") && told.contains(&all)
            });
        }
    }
    let unreachable = names(&status(&client)["unreachable"]);
    assert_eq!(unreachable, Vec::<String>::new());
}

#[test]
fn a_dead_node_is_notified_of_nothing_until_it_answers_again() {
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    let client = robot.client();
    let dead = FakeNode::start("/subscriber");
    let port = dead.port();
    dead.subscribe(&client, "/topic", "std_msgs/String");
    robot.take_master_away();
    drop(dead);
    let publishers: Vec<_> = (0..10)
        .map(|number| FakeNode::start(&format!("/publisher{number}")))
        .collect();
    let (first, later) = publishers.split_first().unwrap();
    first.publish(&client, "/topic", "std_msgs/String");
    eventually("the node does not answer", || {
        let status = status(&client);
        ["unreachable", "dead_nodes"]
            .iter()
            .any(|list| names(&status[*list]) == ["/subscriber"])
            && robot.counter("notifications_sent") > 0
    });
    let sent = robot.counter("notifications_sent");
    for publisher in later {
        publisher.publish(&client, "/topic", "std_msgs/String");
    }
    assert!(holds(Duration::from_secs(1), || {
        robot.counter("notifications_sent") == sent
    }));
    let back = FakeNode::start_at("/subscriber", port);
    let all: Vec<_> = publishers.iter().map(|node| node.api.clone()).collect();
    eventually("the node knows all publishers", || {
        back.updates("/topic").last() == Some(&all)
    });
}
