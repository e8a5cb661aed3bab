//! Real nodes and tools that read while there is no master.

use crate::support::{
    Client, LIBRARIES, Mode, Node, Robot, Tool, eventually, in_both_modes, params, port_of,
};
use ros1_master::xmlrpc::Value;

/// Starts a node of each library, named with the library's suffix, without waiting for it.
fn spawn_both(robot: &Robot, node: &str, name: &str, arguments: &[&str]) -> [Node; 2] {
    LIBRARIES.map(|(library, suffix)| {
        let name = format!("__name:={name}_{suffix}");
        robot.spawn_node(library, node, &[arguments, &[name.as_str()]].concat())
    })
}

in_both_modes!(nodes_and_tools_that_read_do_not_notice_an_outage);

/// A node whose `getParam` failed would continue with its default value, and the robot would drive with wrong
/// gains.
fn nodes_and_tools_that_read_do_not_notice_an_outage(mode: Mode) {
    let mut robot = Robot::start_for_outages(mode);
    let client = robot.client();
    client.set_param("/gain", 7);
    let readers = spawn_both(&robot, "reader", "reader", &["/gain", "20"]);
    let servers = spawn_both(&robot, "server", "server", &[]);
    let (readers, _servers) = (Node::all_ready(readers), Node::all_ready(servers));
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
    let run_all = |robot: &Robot, runs: &[&[&str]]| {
        let tools = Tool::run_all(&robot.scratch, robot.port(), runs);
        for (run, tool) in runs.iter().zip(&tools) {
            assert!(tool.status.success(), "{run:?}: {}", tool.stderr);
        }
        let printed = tools.into_iter().map(|tool| tool.stdout);
        printed.collect::<Vec<_>>()
    };
    let before = robot.settled_state();
    if mode == Mode::Core {
        let server = Client::new(port_of(&client, "/server_cpp"));
        eventually("rosout has a link to the node that is listed", || {
            server.ok("getBusInfo", params!["/test"]) != Value::Array(Vec::new())
        });
    }
    let listed = run_all(&robot, &listings);
    assert!(!listed.contains(&String::new()), "{listed:?}");
    let dead = robot.master_pid();

    robot.kill_master();
    read_on(&readers, 20);
    let set: &[&str] = &["rosparam", "set", "/gain", "8"];
    let runs = [&listings[..], &[set]].concat();
    let mut printed = run_all(&robot, &runs);
    printed.pop();
    assert_eq!(listed, printed, "the output of the tools has changed");
    let late = spawn_both(&robot, "reader", "late", &["/gain", "20"]);
    let late = Node::all_ready(late);
    read_on(&late, 20);
    read_on(&readers, 20);
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
