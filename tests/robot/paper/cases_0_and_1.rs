//! Cases 0 and 1 of the paper: nothing changes during the outage, or nodes end in it. Each case has rospy and roscpp
//! nodes that talk to each other, with a master that rosrescue restarts and with one that is restarted by others.

use crate::support::{
    FakeNode, LIBRARIES, Library, Mode, Node, Robot, Rosmaster, Scratch, State, eventually,
    in_both_modes, tree, within,
};
use rustix::process::Signal;
use std::time::Duration;

in_both_modes!(case_0_nothing_changes, case_1_nodes_end_in_the_outage);

/// Talkers publish at 20 Hz and do not print what they send.
const TALKING: [&str; 2] = ["20", "quiet"];

/// Why rosrescue exists: without it, a master that comes back knows nothing, and no node finds the old
/// publisher. The other tests in this file would fail in the same way.
#[test]
fn a_restarted_bare_master_has_forgotten_everything() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let port = master.port;
    let talker = Node::start(&scratch, Library::Rospy, port, "talker", &[]);
    let listener = Node::start(&scratch, Library::Roscpp, port, "listener", &[]);
    listener.wait_messages("/talker", 5);
    assert!(State::read(&master.client()).knows("/talker"));
    master.kill();
    let master = Rosmaster::start_at(&scratch, port);
    let late = Node::start(
        &scratch,
        Library::Roscpp,
        port,
        "listener",
        &["__name:=late"],
    );
    listener.wait_messages("/talker", 20);
    let state = State::read(&master.client());
    assert!(!state.knows("/talker") && state.knows("/late"), "{state}");
    assert!(late.messages("/talker").is_empty());
    listener.assert_no_message_lost("/talker");
    listener.assert_no_link_lost();
    talker.assert_no_link_lost();
}

/// Starts a node of each library, whose name ends with the library's suffix, without waiting for them.
fn spawn_both(robot: &Robot, node: &str, name: &str, arguments: &[&str]) -> [Node; 2] {
    LIBRARIES.map(|(library, suffix)| {
        let service = format!("who:=/{name}_{suffix}/who");
        let name = format!("__name:={name}_{suffix}");
        robot.spawn_node(library, node, &[arguments, &[&name, &service]].concat())
    })
}

/// Like [`spawn_both`], and waits until both are ready.
fn start_both(robot: &Robot, node: &str, name: &str, arguments: &[&str]) -> [Node; 2] {
    Node::all_ready(spawn_both(robot, node, name, arguments))
}

/// The names of the nodes that [`spawn_both`] starts.
fn both(name: &str) -> [String; 2] {
    LIBRARIES.map(|(_, suffix)| format!("/{name}_{suffix}"))
}

/// Panics unless each listener received every message of both talkers called `talker`.
#[track_caller]
fn assert_no_message_lost(listeners: &[Node]) {
    for listener in listeners {
        for talker in both("talker") {
            listener.assert_no_message_lost(&talker);
        }
    }
}

/// The master dies and nothing else happens.
fn case_0_nothing_changes(mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    client.set_param(
        "/arm",
        tree! { "joints" => vec!["elbow", "wrist"], "gain" => 1.0, "on" => true },
    );
    client.set_param("/use_sim_time", false);
    let talkers = start_both(&robot, "talker", "talker", &TALKING);
    let listeners = start_both(&robot, "listener", "listener", &[]);
    let _servers = start_both(&robot, "server", "server", &[]);
    Node::all_wait_messages(&listeners, &both("talker"), 20);
    let before = robot.settled_state();

    robot.crash_master();

    before.assert_same(&robot.state(), "in the next master");
    before.assert_same(
        &State::read(&client),
        "through rosrescue after the master's death",
    );
    let mut late = start_both(&robot, "listener", "late", &[]);
    Node::all_wait_messages(&late, &both("talker"), 20);
    Node::all_wait_messages(&listeners, &both("talker"), 20);
    assert_no_message_lost(&listeners);
    for node in listeners.iter().chain(&talkers) {
        node.assert_no_link_lost();
    }
    for node in &late {
        node.signal(Signal::INT);
    }
    for node in &mut late {
        node.wait();
    }
    robot.await_state(&before, "when the late subscribers have gone again");
}

/// Publishers, subscribers and services are killed in the outage, and their ports are closed. Others end cleanly: no
/// master gets their unregistrations, and the nodes do not repeat them. Publishers that started in the outage are killed
/// as well.
fn case_1_nodes_end_in_the_outage(mode: Mode) {
    let mut robot = Robot::start_for_outages(mode);
    let client = robot.client();
    let start = |node: &str, arguments: &[&str]| {
        let names = ["", "killed_", "left_"].map(|kind| format!("{kind}{node}"));
        let nodes = names.map(|name| spawn_both(&robot, node, &name, arguments));
        nodes.map(Node::all_ready)
    };
    let [talkers, killed_talkers, left_talkers] = start("talker", &TALKING);
    let [listeners, killed_listeners, left_listeners] = start("listener", &[]);
    let [_servers, killed_servers, left_servers] = start("server", &[]);
    let mut killed: Vec<_> = killed_talkers.into_iter().chain(killed_listeners).collect();
    killed.extend(killed_servers);
    let mut left: Vec<_> = left_talkers.into_iter().chain(left_listeners).collect();
    left.extend(left_servers);
    let names = |kind: &str| {
        let nodes = ["talker", "listener", "server"];
        nodes.map(|node| both(&format!("{kind}_{node}"))).concat()
    };
    let observer = FakeNode::start("/observer");
    observer.subscribe(&client, "/chatter", "std_msgs/String");
    let all = ["talker", "killed_talker", "left_talker"]
        .map(both)
        .concat();
    Node::all_wait_messages(&listeners, &all, 10);
    let before = robot.settled_state();
    let mut after = before.clone();
    for name in [names("killed"), names("left")].concat() {
        assert!(before.knows(&name), "{name} is not registered:\n{before}");
        after = after.without_node(&name);
    }

    let dead = robot.master_pid();
    robot.take_master_away();
    let mut brief = start_both(&robot, "talker", "brief", &TALKING);
    Node::all_wait_messages(&listeners, &both("brief"), 5);
    end(&mut brief, Signal::KILL);
    end(&mut left, Signal::INT);
    let mirror = State::read(&client);
    for name in names("left") {
        assert!(
            !mirror.knows(&name),
            "{name} is still registered:\n{mirror}"
        );
    }
    assert!(!robot.is_open(), "a master was there during the outage");
    end(&mut killed, Signal::KILL);
    robot.revive_master();
    robot.await_recovery(dead);

    robot.await_state(&after, "after the nodes that ended have been unregistered");
    let rescue = &mut robot.rescue;
    rescue.wait_line("the log has each phase of the recovery", |line| {
        let parts = ["cause=\"", "absence_ms=", "inspection_ms=", "injection_ms="];
        line.contains("calls pass to the master: ") && parts.iter().all(|part| line.contains(part))
    });
    rescue.wait_line("the log has the result of the health check", |line| {
        let parts = ["health_check_ms=", "removed=["];
        line.contains("the rescue is complete") && parts.iter().all(|part| line.contains(part))
    });
    // On a busy computer the health check may find one of the nodes a little later.
    for name in names("killed") {
        rescue.wait_line("the log names the node that was unregistered", |line| {
            let removed = line.split("removed=[").nth(1);
            removed.is_some_and(|names| names.split(']').next().unwrap().contains(&name))
        });
    }
    let left_over = both("talker").map(|name| {
        let node = after.nodes.iter().find(|(node, _)| *node == name);
        node.unwrap().clone()
    });
    eventually(
        "the subscribers know that only two publishers are left",
        || {
            let updates = observer.updates("/chatter");
            updates.last().is_some_and(|uris| {
                uris.len() == 2 && left_over.iter().all(|(_, api)| uris.contains(api))
            })
        },
    );
    let gone = ["killed_talker", "left_talker", "brief"].map(both).concat();
    let heard = || -> Vec<_> {
        let of = |listener: &Node| gone.iter().map(|name| listener.messages(name)).collect();
        listeners.iter().map(of).collect::<Vec<Vec<_>>>()
    };
    let before_end = heard();
    Node::all_wait_messages(&listeners, &both("talker"), 20);
    assert_eq!(before_end, heard());
    assert_no_message_lost(&listeners);
    // The links to the nodes that ended are gone, and no other links.
    for node in listeners.iter().chain(&talkers) {
        assert_eq!(node.links().last(), Some(&2), "{:?}", node.links());
    }
    after.assert_same(&robot.state(), "at the end");
}

/// Ends nodes. They must not wait for the master.
fn end(nodes: &mut [Node], how: Signal) {
    for node in &*nodes {
        node.signal(how);
    }
    within(Duration::from_secs(20), "the end of the nodes", || {
        for node in nodes {
            node.wait();
        }
    });
}
