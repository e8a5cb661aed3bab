//! After an outage the registrations are what the living nodes say, and everybody has heard of every
//! change. `paper/case_2_not_yet_told.rs` has a master that dies at every point of its work on one.

use std::path::Path;
use std::time::Duration;

use crate::support::{
    Client, FakeMaster, FakeNode, Library, Mode, NODES, Robot, State, eventually, holds, names,
    params, status,
};
use rosrescue::xmlrpc::{Reply, Value};

/// The master dies before it tells anybody, and rosrescue with it.
#[test]
fn both_die_between_the_change_and_its_news() {
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
        eventually(&format!("all know the publishers, point {point}"), || {
            let mut lists = fakes.iter().map(|fake| fake.updates("/chatter"));
            lists.all(|updates| updates.last() == Some(&all))
        });
        eventually(&format!("all know the parameter, point {point}"), || {
            let mut told = fakes.iter().map(|fake| fake.heard("paramUpdate"));
            told.all(|told| told.last().is_some_and(|told| told[2] == point.into()))
        });
        // Where rosrescue was faster, the master lives.
        let _ = std::fs::remove_file(&file);
    }
}

/// The same for parameters: who has cached one is told of a change that the dead master still owed.
#[test]
fn the_master_dies_at_every_callback_of_a_parameter() {
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
    for point in 0..=4 {
        let dead = robot.master_pid();
        let file = robot.scratch.path("die-at");
        std::fs::write(&file, format!("paramUpdate {point}")).unwrap();
        client.set_param("/gain", point);
        robot.await_recovery(dead);
        assert!(!file.exists(), "the master did not die at point {point}");
        eventually(&format!("all know the parameter, point {point}"), || {
            let told = fakes.iter().all(|fake| {
                let heard = fake.heard("paramUpdate");
                heard.last().is_some_and(|told| {
                    told[1] == Value::from("/gain/") && told[2] == Value::Int(point)
                })
            });
            let value = point.to_string();
            told && real
                .iter()
                .all(|node| node.said("value").last() == Some(&value))
        });
    }
    for node in &real {
        assert_eq!(node.said("failed"), Vec::<String>::new());
    }
}

/// A registration that the master lost, and one whose end it never heard of.
#[test]
fn what_living_nodes_say_is_mended() {
    for library in [Library::Rospy, Library::Roscpp] {
        let mut robot = Robot::start(Mode::Proxy);
        let client = robot.client();
        let talker = robot.node(library, "talker", &[]);
        let listener = robot.node(library, "listener", &[]);
        let server = robot.node(library, "server", &[]);
        listener.wait_messages("/talker", 5);
        // The health check of this one gets to know who is who.
        robot.crash_master();
        let before = robot.settled_state();
        eventually("the health check is over", || {
            status(&client)["last_recovery"]["health_check_ms"].is_number()
        });
        let api = |node: &str| {
            let api = client.ok("lookupNode", params!["/test", node]);
            api.as_str().unwrap().to_owned()
        };
        let (talks, listens) = (api("/talker"), api("/listener"));
        // In this order: a listener that is told of no publisher rightly drops its link.
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
        eventually("the registrations are what the nodes say", || {
            let Ok(state) = State::try_read(&robot.bare()) else {
                return false;
            };
            state.publishers_of("/chatter") == ["/talker"]
                && state.subscribers_of("/chatter") == ["/listener"]
                && state.publishers_of("/ghost").is_empty()
                && state.subscribers_of("/haunted").is_empty()
        });
        let after = robot.settled_state();
        let after = after.without_type("/ghost").without_type("/haunted");
        before.assert_same(&after, "when the registrations have been reconciled");
        let reconciled = [
            "+ /listener subscribes /chatter",
            "+ /talker publishes /chatter",
            "- /listener subscribes /haunted",
            "- /talker publishes /ghost",
        ];
        eventually("the report says so", || {
            names(&status(&client)["last_recovery"]["reconciled"]) == reconciled
        });
        let late = robot.node(library, "listener", &["__name:=late"]);
        late.wait_messages("/talker", 5);
        for node in [&talker, &listener, &server] {
            node.assert_no_link_lost();
        }
    }
}

/// Nodes that cannot be asked, or answer nonsense, are left as they are.
#[test]
fn nodes_that_answer_nonsense_are_left_alone() {
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
    // What is no HTTP may count as another program's port.
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
