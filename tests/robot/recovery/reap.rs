//! Dead nodes without an outage: `--reap` reports or unregisters them, and no innocent node is shut down.

use std::time::{Duration, Instant};

use rustix::process::Signal;
use serde_json::Value as Json;

use crate::support::{
    FakeNode, Library, Mode, NODES, Process, Robot, eventually, free_port, holds, page, params,
    ros_command, signal,
};

/// Longer than a master needs to tell a node to shut down.
const A_WHILE: Duration = Duration::from_secs(2);

/// The node as the page shows it. `None` if it is unknown.
pub(super) fn shown(robot: &Robot, node: &str) -> Option<Json> {
    let state = page(&robot.client(), "/state.json");
    let state: Json = serde_json::from_str(state.rsplit("\r\n").next()?).ok()?;
    let mut nodes = state["nodes"].as_array()?.iter();
    nodes.find(|of| of["name"] == node).cloned()
}

/// Waits until rosrescue watches these nodes' processes through the kernel.
pub(super) fn await_watched(robot: &Robot, nodes: &[(&str, u32)]) {
    for (node, pid) in nodes {
        eventually("the kernel watches the node's process", || {
            shown(robot, node).is_some_and(|of| of["process"] == *pid)
        });
    }
}

/// Whether the master knows the node.
#[track_caller]
fn is_known(robot: &Robot, node: &str) -> bool {
    let answer = robot.bare().status("lookupNode", params!["/test", node]);
    answer.unwrap().0 == 1
}

/// Whether rosrescue has printed a line with all of these words.
pub(super) fn has_logged(robot: &Robot, words: &[&str]) -> bool {
    let mut lines = robot.rescue.output().into_iter();
    lines.any(|line| words.iter().all(|word| line.contains(word)))
}

#[test]
fn reap_local_unregisters_a_dead_node_at_once_and_no_stopped_one() {
    let robot = Robot::start_with(Mode::Proxy, &["--reap", "local"]);
    let mut talker = robot.node(Library::Rospy, "talker", &[]);
    let listener = robot.node(Library::Roscpp, "listener", &[]);
    let pids = [("/talker", talker.pid()), ("/listener", listener.pid())];
    await_watched(&robot, &pids);
    let after = robot.settled_state().without_node("/talker");
    listener.signal(Signal::STOP);
    let killed = Instant::now();
    talker.kill();
    eventually("the dead node is unregistered", || {
        !is_known(&robot, "/talker")
    });
    println!("unregistered after {:?}", killed.elapsed());
    robot.await_state(&after, "after the node's death");
    eventually("the log and the counter say so", || {
        let line = ["unregistered /talker: its process", "no process listens"];
        has_logged(&robot, &line) && robot.counter("dead_nodes_reaped") == 1
    });
    // A node that is stopped does not answer, but lives.
    assert!(holds(A_WHILE, || is_known(&robot, "/listener")));
    listener.signal(Signal::CONT);
    let state = robot.settled_state();
    after.assert_same(&state, "the stopped node stays registered");
    assert!(shown(&robot, "/talker").is_some_and(|of| !of["removed_at"].is_null()));
}

/// Makes a dead node whose end the kernel does not prove. Another node, `/innocent`, then gets its port.
fn with_taken_port(robot: &Robot) -> FakeNode {
    let client = robot.client();
    let ghost = FakeNode::start_at("/killed", free_port());
    ghost.publish(&client, "/topic", "std_msgs/String");
    let port = ghost.port();
    drop(ghost);
    let innocent = FakeNode::start_at("/innocent", port);
    innocent.publish(&client, "/topic", "std_msgs/String");
    innocent
}

fn start_again(robot: &Robot) -> FakeNode {
    let again = FakeNode::start("/killed");
    again.publish(&robot.client(), "/topic", "std_msgs/String");
    again
}

#[test]
fn reap_local_never_lets_the_master_shut_down_an_innocent_node() {
    let robot = Robot::start_with(Mode::Proxy, &["--reap", "local"]);
    let innocent = with_taken_port(&robot);
    let _again = start_again(&robot);
    assert!(holds(A_WHILE, || innocent.received("shutdown").is_empty()));
    let state = robot.settled_state();
    assert_eq!(state.publishers_of("/topic"), ["/innocent", "/killed"]);
    assert_eq!(robot.counter("shutdowns_prevented"), 1);
    assert_eq!(robot.counter("divergences"), 0);
}

/// The program at the dead node's port has not registered yet.
#[test]
fn a_program_that_has_not_registered_is_not_shut_down_either() {
    let robot = Robot::start_with(Mode::Core, &["--reap", "local"]);
    let mut talker = robot.node(Library::Rospy, "talker", &[]);
    await_watched(&robot, &[("/talker", talker.pid())]);
    let api = robot.client().ok("lookupNode", params!["/test", "/talker"]);
    let port = api.as_str().unwrap().trim_end_matches('/');
    let port = port.rsplit(':').next().unwrap().parse().unwrap();
    talker.kill();
    let innocent = FakeNode::start_at("/innocent", port);
    let again = FakeNode::start("/talker");
    again.publish(&robot.client(), "/topic", "std_msgs/String");
    assert!(holds(A_WHILE, || innocent.received("shutdown").is_empty()));
    assert!(robot.settled_state().publishers_of("/topic") == ["/talker"]);
}

#[test]
fn by_default_a_shutdown_of_the_wrong_node_is_reported() {
    let robot = Robot::start_with(Mode::Core, &[]);
    let innocent = with_taken_port(&robot);
    let _again = start_again(&robot);
    eventually("the master shuts down the wrong node", || {
        innocent.received("shutdown").len() == 1
    });
    eventually("the log reports the shutdown", || {
        has_logged(
            &robot,
            &[
                "shuts down the wrong node",
                "/killed",
                "/innocent",
                "--reap local",
            ],
        )
    });
    assert_eq!(robot.counter("shutdowns_misdirected"), 1);
}

/// The two programs are started again whenever they are shut down (ros_comm issue 2018).
#[test]
fn two_programs_that_take_a_name_from_each_other_are_reported() {
    let robot = Robot::start_with(Mode::Core, &["--reap", "local"]);
    let client = robot.client();
    let mut last: Option<FakeNode> = None;
    for turn in 0..4 {
        let program = FakeNode::start("/twin");
        program.publish(&client, "/topic", "std_msgs/String");
        eventually("the kernel watches the program", || {
            let is_there =
                |of: Json| of["process"] == std::process::id() && of["api"] == program.api.as_str();
            shown(&robot, "/twin").is_some_and(is_there)
        });
        if let Some(last) = last.replace(program) {
            // This is an ordinary displacement, as with a bare master.
            eventually("the displaced program is told to shut down", || {
                last.received("shutdown").len() == 1
            });
        }
        let feuds = robot.status().unwrap_or_default()["feuds"].clone();
        assert_eq!(feuds.as_array().map(Vec::len), Some(usize::from(turn == 3)));
    }
    let status = robot.status().unwrap_or_default();
    let feud = &status["feuds"][0];
    let to = last.as_ref().unwrap().api.trim_end_matches('/');
    assert_eq!(
        (&feud["node"], &feud["times"]),
        (&"/twin".into(), &3.into())
    );
    assert_eq!(feud["to"], to);
    let action = status["condition"]["action"].as_str().unwrap();
    assert!(action.contains("another name"), "{action}");
    let from = feud["from"].as_str().unwrap();
    assert!(has_logged(
        &robot,
        &["two programs take a node name", "/twin", from, to]
    ));
    let metrics = page(&client, "/metrics");
    assert!(metrics.contains("\nrosrescue_feuds 1\n"), "{metrics}");
}

/// A node that dies and is started again displaces only its own old registration.
#[test]
fn a_node_that_restarts_repeatedly_is_not_reported_as_two_programs() {
    let robot = Robot::start_with(Mode::Core, &[]);
    for _ in 0..4 {
        let node = robot.node(Library::Roscpp, "talker", &[]);
        await_watched(&robot, &[("/talker", node.pid())]);
        signal(node.pid(), Signal::KILL);
        drop(node);
    }
    let status = robot.status().unwrap_or_default();
    assert_eq!(status["feuds"], serde_json::json!([]));
    assert_eq!(robot.counter("shutdowns_misdirected"), 0);
}

/// Many small nodes are killed, stopped, replaced and started again, some at the ports of dead ones.
#[test]
fn in_a_crowd_no_living_node_is_unregistered_or_wrongly_shut_down() {
    let variable = |name: &str, other: u64| match std::env::var(name) {
        Ok(value) => value.parse().unwrap(),
        Err(_) => other,
    };
    let rounds = variable("ROSRESCUE_ROUNDS", 150);
    let seed = variable("ROSRESCUE_SEED", u64::from(std::process::id()));
    println!("ROSRESCUE_SEED={seed}");
    let robot = Robot::start_with(Mode::Core, &["--reap", "local", "--no-rosout"]);
    let program = format!("{NODES}/crowd.py");
    let mut crowd = ros_command(&robot.scratch, "/usr/bin/python3", robot.port());
    crowd.args([program, rounds.to_string(), seed.to_string()]);
    let mut crowd = Process::start("crowd", &mut crowd);
    let ended = crowd.wait_output();
    println!("{}", crowd.output().join("\n"));
    assert!(ended.success(), "{ended}");
    println!(
        "{} shutdowns prevented, {} nodes reaped",
        robot.counter("shutdowns_prevented"),
        robot.counter("dead_nodes_reaped")
    );
    assert_eq!(robot.counter("divergences"), 0);
}
