//! After an outage the registrations are those that living nodes report, and all subscribers have been notified of
//! every change. `paper/case_2_not_yet_told.rs` has a master that dies at five points while it notifies nodes.

use std::path::Path;
use std::time::Duration;

use ros1_master::xmlrpc::{Reply, Value};

use crate::support::{
    Client, FakeMaster, FakeNode, Library, Mode, NODES, Robot, eventually, holds, names, params,
    status,
};

/// The master dies before it has notified any node, and rosrescue dies with it.
#[test]
fn subscribers_hear_of_a_change_although_master_and_rosrescue_die() {
    let program = Path::new(NODES).join("fragile_master.py");
    let mut robot = Robot::start_with(
        Mode::Core,
        &["--rosmaster", program.to_str().unwrap(), "-w", "3"],
    );
    let client = robot.client();
    let fakes = ["/subscriber0", "/subscriber1", "/subscriber2"].map(FakeNode::start);
    client.set_param("/gain", 1);
    for fake in &fakes {
        fake.subscribe(&client, "/chatter", "std_msgs/String");
        fake.watch_param(&client, "/gain");
    }
    let mut all = Vec::new();
    let mut publishers = Vec::new();
    for point in 1..=3 {
        let file = robot.scratch.path("die-at");
        std::fs::write(&file, format!("publisherUpdate {point}")).unwrap();
        let publisher = FakeNode::start(&format!("/publisher{point}"));
        publisher.publish(&client, "/chatter", "std_msgs/String");
        all.push(publisher.api.clone());
        publishers.push(publisher);
        client.set_param("/gain", point);
        robot.rescue.kill();
        robot.rescue.start_again();
        robot.rescue.wait_serving();
        robot.await_gate();
        eventually(
            &format!("all subscribers know the publishers, point {point}"),
            || {
                let mut lists = fakes.iter().map(|fake| fake.updates("/chatter"));
                lists.all(|updates| updates.last() == Some(&all))
            },
        );
        eventually(
            &format!("all subscribers know the parameter, point {point}"),
            || {
                let mut told = fakes.iter().map(|fake| fake.received("paramUpdate"));
                told.all(|told| told.last().is_some_and(|told| told[2] == point.into()))
            },
        );
        // If rosrescue was faster, the master still lives.
        let _ = std::fs::remove_file(&file);
    }
}

/// The same for parameters: nodes that cache a parameter are notified of a change that the dead master had not sent
/// yet.
#[test]
fn subscribers_hear_of_a_parameter_although_the_master_dies_at_any_callback() {
    let program = Path::new(NODES).join("fragile_master.py");
    let robot = Robot::start_with(
        Mode::Core,
        &["--rosmaster", program.to_str().unwrap(), "-w", "3"],
    );
    let client = robot.client();
    client.set_param("/gain", -1);
    let fakes = ["/user0", "/user1"].map(FakeNode::start);
    for fake in &fakes {
        fake.watch_param(&client, "/gain");
    }
    let real = [Library::Rospy, Library::Roscpp].map(|library| {
        let name = format!("__name:={library:?}");
        robot.node(library, "param_user", &["/gain", &name])
    });
    // Each run plays three of the five points.
    let odd = i32::try_from(std::process::id() % 2).unwrap();
    for point in [0, 1 + odd, 3 + odd] {
        let dead = robot.master_pid();
        let file = robot.scratch.path("die-at");
        std::fs::write(&file, format!("paramUpdate {point}")).unwrap();
        client.set_param("/gain", point);
        robot.await_recovery(dead);
        assert!(!file.exists(), "the master did not die at point {point}");
        eventually(
            &format!("all subscribers know the parameter, point {point}"),
            || {
                let told = fakes.iter().all(|fake| {
                    let heard = fake.received("paramUpdate");
                    heard.last().is_some_and(|told| {
                        told[1] == Value::from("/gain/") && told[2] == Value::Int(point)
                    })
                });
                let value = point.to_string();
                told && real
                    .iter()
                    .all(|node| node.said("value").last() == Some(&value))
            },
        );
    }
    for node in &real {
        assert_eq!(node.said("failed"), Vec::<String>::new());
    }
}

/// The master has lost one registration, and has not received one unregistration. A roscpp node cannot report its
/// master, so nothing is added for it.
#[test]
fn registrations_are_corrected_by_what_living_nodes_report() {
    for library in [Library::Rospy, Library::Roscpp] {
        let mut robot = Robot::start(Mode::Proxy);
        let client = robot.client();
        let talker = robot.node(library, "talker", &[]);
        let listener = robot.node(library, "listener", &[]);
        listener.wait_messages("/talker", 5);
        // The health check of this crash finds out the process ids of the nodes.
        robot.crash_master();
        let before = robot.settled_state();
        eventually("the health check has finished", || {
            status(&client)["last_recovery"]["health_check_ms"].is_number()
        });
        let api = |node: &str| {
            let api = client.ok("lookupNode", params!["/test", node]);
            api.as_str().unwrap().to_owned()
        };
        let (talks, listens) = (api("/talker"), api("/listener"));
        // The order matters: a listener that gets an empty list of publishers rightly drops its link.
        client.ok(
            "unregisterSubscriber",
            params!["/listener", "/chatter", listens.as_str()],
        );
        client.ok(
            "unregisterPublisher",
            params!["/talker", "/chatter", talks.as_str()],
        );
        let ghost = params!["/talker", "/ghost", "std_msgs/String", talks.as_str()];
        client.ok("registerPublisher", ghost);
        let ghost = params!["/listener", "/haunted", "std_msgs/String", listens.as_str()];
        client.ok("registerSubscriber", ghost);
        robot.crash_master();
        let reconciled = [
            "+ /listener subscribes /chatter",
            "+ /talker publishes /chatter",
            "- /listener subscribes /haunted",
            "- /talker publishes /ghost",
        ];
        let reconciled = match library {
            Library::Rospy => &reconciled[..],
            Library::Roscpp => &reconciled[2..],
        };
        eventually("the report has the corrections", || {
            names(&status(&client)["last_recovery"]["reconciled"]) == reconciled
        });
        let after = robot.settled_state();
        assert_eq!(after.publishers_of("/ghost"), Vec::<String>::new());
        assert_eq!(after.subscribers_of("/haunted"), Vec::<String>::new());
        // This node lives until the links have been checked.
        let late;
        if library == Library::Rospy {
            let after = after.without_type("/ghost").without_type("/haunted");
            before.assert_same(&after, "after the registrations were reconciled");
            late = robot.node(Library::Roscpp, "listener", &["__name:=late"]);
            late.wait_messages("/talker", 5);
        } else {
            assert_eq!(after.publishers_of("/chatter"), Vec::<String>::new());
            assert_eq!(after.subscribers_of("/chatter"), Vec::<String>::new());
        }
        for node in [&talker, &listener] {
            node.assert_no_link_lost();
        }
    }
}

/// All nodes report that they publish two topics. The master knows one of them.
#[test]
fn a_reported_topic_is_registered_only_if_rosrescue_is_the_nodes_master_and_knew_it() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let nodes = ["/ours", "/foreign", "/cannot_say", "/never_told"].map(FakeNode::start);
    let [ours, foreign, _, never_told] = &nodes;
    ours.claim_master(&client.uri());
    foreign.claim_master("http://127.0.0.1:1/");
    never_told.claim_master(&client.uri());
    for node in &nodes {
        node.publish(&client, &format!("{}/topic", node.name), "std_msgs/String");
        let more = format!("{}/more", node.name);
        node.claim_publication(&more, Some("std_msgs/String"));
        if node.name != never_told.name {
            node.publish(&client, &more, "std_msgs/String");
            let params = params![node.name.as_str(), more, node.api.as_str()];
            assert_eq!(client.ok("unregisterPublisher", params), Value::Int(1));
        }
    }
    let dead = robot.master_pid();
    robot.crash_master();
    eventually("the health check has finished", || {
        let report = status(&client)["last_recovery"].clone();
        report["master_pid"] != dead && report["health_check_ms"].is_number()
    });
    let reconciled = names(&status(&client)["last_recovery"]["reconciled"]);
    assert_eq!(reconciled, ["+ /ours publishes /ours/more"]);
    let state = robot.state();
    for node in &nodes {
        let more = state.publishers_of(&format!("{}/more", node.name));
        assert_eq!(more.len(), usize::from(node.name == ours.name), "{more:?}");
    }
}

/// Nodes that cannot be asked, or give malformed answers, keep their registrations.
#[test]
fn nodes_with_malformed_answers_are_left_alone() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let answers = [
        Value::Array(vec![1.into(), "".into(), Value::Int(7)]),
        Value::Array(vec![1.into(), "".into(), params![params!["x", "y"]].into()]),
        Value::Array(vec![1.into(), "".into(), params![params!["/a", 1]].into()]),
        Value::Array(vec![0.into(), "no".into(), Value::Array(Vec::new())]),
        Value::Array(Vec::new()),
        Value::from("what?"),
    ];
    let mut answers = answers
        .map(|it| FakeMaster::proper(&Reply::Value(it)))
        .to_vec();
    answers.push(b"garbage\r\n\r\n".to_vec());
    let nodes: Vec<_> = answers
        .into_iter()
        .map(|bytes| FakeMaster::start(move |_| bytes.clone()))
        .collect();
    for (i, node) in nodes.iter().enumerate() {
        let (name, api) = (format!("/odd{i}"), Client::new(node.port()).uri());
        let topic = format!("/topic{i}");
        let params = params![name.as_str(), topic.as_str(), "std_msgs/String", api];
        client.ok("registerPublisher", params);
    }
    // An answer that is not HTTP may count as that of another program at the port.
    let garbage = format!("/odd{}", nodes.len() - 1);
    let before = robot.settled_state().without_node(&garbage);
    robot.crash_master();
    let mut last = None;
    let same = holds(Duration::from_secs(5), || {
        last = Some(robot.state().without_node(&garbage));
        last.as_ref() == Some(&before)
    });
    if !same {
        before.assert_same(&last.unwrap(), "after the health check");
    }
}
