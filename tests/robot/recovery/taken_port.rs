//! Another node now has a dead node's port. `--reap all` unregisters the dead node before its name moves, so that
//! the master cannot mistake the other one for it (ros_comm issue 2241).

use std::time::{Duration, Instant};

use ros1_master::xmlrpc::Value;

use crate::support::{
    Client, FakeNode, Mode, Node, Robot, Rosmaster, Scratch, State, eventually, free_port, holds,
    in_both_modes, params, ros_command,
};

/// A rospy node at a given port.
const INNOCENT: &str = "
import sys, rospy
from std_msgs.msg import String
rospy.init_node('innocent', xmlrpc_port=int(sys.argv[1]))
publisher = rospy.Publisher('topic', String, queue_size=1)
print('ready /innocent', flush=True)
rospy.spin()
";

/// Longer than a master needs to tell a node to shut down.
const A_WHILE: Duration = Duration::from_secs(2);
/// Time from the start to the first regular health check.
const FIRST_CHECK: Duration = Duration::from_secs(30);

fn innocent(scratch: &Scratch, master: u16, port: u16) -> Node {
    let mut command = ros_command(scratch, "/usr/bin/python3", master);
    Node::run(command.args(["-c", INNOCENT, &port.to_string()]))
}

/// A node with registrations of every kind, one of them taken over by another node, that dies. Returns its
/// port.
fn dead_node(master: &Client, heir: &FakeNode) -> u16 {
    // No other program on this computer can get this port in the meantime.
    let node = FakeNode::start_at("/killed", free_port());
    node.publish(master, "/topic", "std_msgs/String");
    node.subscribe(master, "/other", "std_msgs/String");
    node.watch_param(master, "/gain");
    node.offer(master, "/own");
    node.offer(master, "/shared");
    heir.offer(master, "/shared");
    node.port()
}

/// Starts the dead node again, at another port.
fn started_again(master: &Client) -> FakeNode {
    let node = FakeNode::start("/killed");
    node.publish(master, "/topic", "std_msgs/String");
    node
}

#[test]
fn a_bare_master_shuts_down_the_wrong_node() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let client = master.client();
    let port = dead_node(&client, &FakeNode::start("/heir"));
    let mut innocent = innocent(&scratch, master.port, port);
    assert!(State::read(&client).knows("/killed"));
    let _again = started_again(&client);
    innocent.wait();
}

in_both_modes!(a_node_that_took_the_port_of_a_dead_node_is_not_shut_down);

fn a_node_that_took_the_port_of_a_dead_node_is_not_shut_down(mode: Mode) {
    let begun = Instant::now();
    let mut robot = Robot::start_with(mode, &["--reap", "all"]);
    let client = robot.client();
    let [heir, watcher] = ["/heir", "/watcher"].map(FakeNode::start);
    watcher.subscribe(&client, "/topic", "std_msgs/String");
    let port = dead_node(&client, &heir);
    let mut innocent = innocent(&robot.scratch, robot.port(), port);
    // Another name at its port proves nothing about the dead node. Only a health check finds out.
    let state = robot.settled_state();
    let is_checked = begun.elapsed() > FIRST_CHECK;
    assert!(state.knows("/killed") || is_checked, "{state}");
    let again = started_again(&client);
    assert!(holds(A_WHILE, || innocent.exited().is_none()));
    // The dead node was unregistered before its name moved, and subscribers were notified of both.
    let state = robot.settled_state();
    assert_eq!(state.publishers_of("/topic"), ["/innocent", "/killed"]);
    assert_eq!(
        client.ok("lookupNode", params!["/test", "/killed"]),
        Value::from(again.api.as_str())
    );
    let shared = state
        .service_apis
        .iter()
        .find(|(name, _)| name == "/shared");
    assert_eq!(shared.unwrap().1, heir.service_api());
    eventually("the subscriber has heard of both nodes", || {
        let updates = watcher.updates("/topic");
        updates.last().is_some_and(|last| last.len() == 2)
    });
    // All this is in the journal.
    robot.rescue.kill();
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.crash_master();
    state.assert_same(&robot.settled_state(), "after everything was killed");
    assert!(innocent.exited().is_none());
    assert_eq!(watcher.received("shutdown"), Vec::<Vec<_>>::new());
    assert_eq!(robot.counter("divergences"), 0);
}

#[test]
fn a_node_that_took_the_port_is_not_shut_down_during_an_outage_either() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--reap", "all"]);
    let client = robot.client();
    let heir = FakeNode::start("/heir");
    let port = dead_node(&client, &heir);
    robot.settled_state();
    robot.take_master_away();
    let mut innocent = innocent(&robot.scratch, robot.port(), port);
    let again = started_again(&client);
    assert!(holds(A_WHILE, || innocent.exited().is_none()));
    assert!(!robot.is_open());
    robot.revive_master();
    robot.await_gate();
    let api = client.ok("lookupNode", params!["/test", "/killed"]);
    assert_eq!(api, Value::from(again.api.as_str()));
    let state = robot.settled_state();
    assert_eq!(state.publishers_of("/topic"), ["/innocent", "/killed"]);
    assert!(innocent.exited().is_none());
}

/// Anybody can register any address. A client registers another name at a living node's address and then moves it.
#[test]
fn a_living_node_stays_when_another_name_at_its_address_moves() {
    let robot = Robot::start_with(Mode::Core, &["--reap", "all"]);
    let client = robot.client();
    let victim = FakeNode::start("/victim");
    victim.publish(&client, "/topic", "std_msgs/String");
    for turn in 0..4 {
        let name = format!("/thief{turn}");
        let elsewhere = format!("http://127.0.0.1:{}/", free_port());
        for api in [&victim.api, &elsewhere] {
            let params = params![name.as_str(), "/other", "std_msgs/String", api.as_str()];
            client.ok("registerPublisher", params);
        }
    }
    assert!(holds(A_WHILE, || victim.received("shutdown").is_empty()));
    let state = robot.settled_state();
    assert_eq!(state.publishers_of("/topic"), ["/victim"]);
    assert_eq!(robot.counter("shutdowns_misdirected"), 0);
    assert_eq!(robot.counter("shutdowns_prevented"), 4);
}
