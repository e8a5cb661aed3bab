//! Real nodes and tools while there is no master: nodes that read, nodes that start and end in the meantime, and nodes
//! that register and set everything that is possible.

use std::time::Duration;

use crate::support::{
    LIBRARIES, Mode, Node, Process, Robot, State, Tool, eventually, holds, in_both_modes,
    ros_command, within,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

/// Starts a node of each library, named with the library's suffix, without waiting for it.
fn spawn_both(robot: &Robot, node: &str, name: &str, arguments: &[&str]) -> [Node; 2] {
    LIBRARIES.map(|(library, suffix)| {
        let name = format!("__name:={name}_{suffix}");
        robot.spawn_node(library, node, &[arguments, &[name.as_str()]].concat())
    })
}

fn await_ready(nodes: &mut [Node]) {
    for node in nodes {
        node.wait_line("`ready`", |line| line.starts_with("ready "));
    }
}

in_both_modes!(nodes_and_tools_that_read_do_not_notice_an_outage);

/// A node whose `getParam` failed would continue with its default value, and the robot would drive with wrong
/// gains.
fn nodes_and_tools_that_read_do_not_notice_an_outage(mode: Mode) {
    let mut robot = Robot::start_for_outages(mode);
    let client = robot.client();
    client.set_param("/gain", 7);
    let mut readers = spawn_both(&robot, "reader", "reader", &["/gain"]);
    let mut others = spawn_both(&robot, "server", "server", &[]);
    await_ready(&mut readers);
    await_ready(&mut others);
    let count = |node: &Node| node.said("reads").last().map_or(0, |n| n.parse().unwrap());
    let read_on = |nodes: &[Node], more: u64| {
        for node in nodes {
            let before: u64 = count(node);
            eventually("a node reads more values", || count(node) >= before + more);
        }
    };
    let listings: [&[&str]; 3] = [
        &["rosnode", "info", "/server_cpp"],
        &["rostopic", "list", "-v"],
        &["rosparam", "get", "/gain"],
    ];
    let list = |robot: &Robot| {
        listings.map(|run| {
            let tool = Tool::run(&robot.scratch, robot.port(), run[0], &run[1..]);
            assert!(tool.status.success(), "{run:?}: {}", tool.stderr);
            assert!(!tool.stdout.is_empty(), "{run:?}");
            tool.stdout
        })
    };
    let before = robot.settled_state();
    let listed = list(&robot);
    let dead = robot.master_pid();

    robot.kill_master();
    read_on(&readers, 50);
    assert_eq!(listed, list(&robot), "the output of the tools has changed");
    let mut late = spawn_both(&robot, "reader", "late", &["/gain"]);
    await_ready(&mut late);
    read_on(&late, 20);
    let mut command = ros_command(&robot.scratch, "rosparam", robot.port());
    let mut setting = Process::start("rosparam set", command.args(["set", "/gain", "8"]));
    assert_eq!(setting.wait().code(), Some(0));
    read_on(&readers, 50);
    assert!(!robot.is_open(), "a master was there during the outage");

    robot.revive_master();
    robot.await_recovery(dead);
    assert_eq!(robot.bare().param("/gain"), Some(Value::Int(8)));
    read_on(&readers, 20);
    read_on(&late, 20);
    for node in readers.iter().chain(&late) {
        assert_eq!(node.said("failed"), Vec::<String>::new(), "{}", node.log());
    }
    let now = robot.settled_state();
    let now = now.without_node("/late_py").without_node("/late_cpp");
    assert_eq!(before.nodes, now.nodes);
    assert_eq!(before.publishers, now.publishers);
    assert_eq!(before.services, now.services);
}

in_both_modes!(nodes_that_start_and_end_during_an_outage_leave_no_registrations);

/// Nodes that start, end or die while there is no master are registered only as long as they live.
fn nodes_that_start_and_end_during_an_outage_leave_no_registrations(mode: Mode) {
    let mut robot = Robot::start_for_outages(mode);
    let mut leaving = spawn_both(&robot, "talker", "leaving", &[]);
    let mut staying = spawn_both(&robot, "listener", "staying", &[]);
    await_ready(&mut leaving);
    await_ready(&mut staying);
    for node in &staying {
        node.wait_messages("/leaving_py", 5);
        node.wait_messages("/leaving_cpp", 5);
    }
    let before = robot.settled_state();
    let after = before
        .without_node("/leaving_py")
        .without_node("/leaving_cpp");
    let dead = robot.master_pid();
    robot.kill_master();
    eventually("the gate is shut", || !robot.is_open());

    // A node from before the outage that ends unregisters, and rosrescue believes it.
    for node in &mut leaving {
        end(node, Signal::INT);
    }
    let now = State::read(&robot.client());
    assert!(
        !now.knows("/leaving_py") && !now.knows("/leaving_cpp"),
        "{now}"
    );

    // Nodes that start in the meantime find each other, and are then killed or asked to end.
    let mut brief = [
        spawn_both(&robot, "talker", "killed", &[]),
        spawn_both(&robot, "talker", "ended", &[]),
    ];
    let names = ["/killed_py", "/killed_cpp", "/ended_py", "/ended_cpp"];
    for nodes in &mut brief {
        await_ready(nodes);
    }
    for node in &staying {
        for name in names {
            node.wait_messages(name, 5);
        }
    }
    for (nodes, signal) in brief.iter_mut().zip([Signal::KILL, Signal::INT]) {
        for node in nodes {
            end(node, signal);
        }
    }
    let now = State::read(&robot.client());
    assert!(!now.knows("/ended_py") && !now.knows("/ended_cpp"), "{now}");
    assert!(!robot.is_open(), "a master was there during the outage");
    robot.revive_master();
    robot.await_recovery(dead);
    let mut last = None;
    eventually("the killed nodes are unregistered", || {
        last = State::try_read(&robot.bare()).ok();
        last.as_ref()
            .is_some_and(|now| names.iter().all(|name| !now.knows(name)))
    });
    after_types(&after, &robot).assert_same(&last.unwrap(), "after all nodes have ended");
    assert!(holds(Duration::from_secs(2), || {
        let now = robot.state();
        names.iter().all(|name| !now.knows(name))
    }));
}

/// `state` with the topic types that the master has now, because a node that ended may have left a type
/// behind.
fn after_types(state: &State, robot: &Robot) -> State {
    State {
        topic_types: robot.state().topic_types,
        ..state.clone()
    }
}

/// Ends a node. It must not wait for the master.
fn end(node: &mut Node, signal: Signal) {
    node.signal(signal);
    within(Duration::from_secs(20), "the end of a node", || node.wait());
}
