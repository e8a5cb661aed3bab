//! Cases 0 and 1 of the paper: nothing changes during the outage, or nodes end in it. Each case has a pair of
//! rospy and a pair of roscpp nodes, with a master that rosrescue restarts and with one that is restarted by
//! others.

use crate::support::{
    FakeNode, Library, Mode, Node, Robot, Rosmaster, Scratch, State, eventually, everywhere,
    params, tree,
};
use rustix::process::Signal;

everywhere!(
    case_0_nothing_changes,
    case_1_nodes_die_in_the_outage,
    case_1_nodes_leave_in_the_outage,
);

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

/// The master dies and nothing else happens.
fn case_0_nothing_changes(library: Library, mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    client.set_param(
        "/arm",
        tree! { "joints" => vec!["elbow", "wrist"], "gain" => 1.0, "on" => true },
    );
    client.set_param("/use_sim_time", false);
    let talker = robot.node(library, "talker", &[]);
    let listener = robot.node(library, "listener", &[]);
    let _server = robot.node(library, "server", &[]);
    listener.wait_messages("/talker", 20);
    let before = robot.settled_state();

    robot.crash_master();

    before.assert_same(&robot.state(), "in the next master");
    before.assert_same(
        &State::read(&client),
        "through rosrescue after the master's death",
    );
    let mut late = robot.node(library, "listener", &["__name:=late"]);
    late.wait_messages("/talker", 20);
    listener.wait_messages("/talker", 20);
    listener.assert_no_message_lost("/talker");
    listener.assert_no_link_lost();
    talker.assert_no_link_lost();
    late.signal(Signal::INT);
    late.wait();
    robot.await_state(&before, "when the late subscriber has gone again");
}

/// A publisher, a subscriber and a service die together with the master, and their ports are closed.
fn case_1_nodes_die_in_the_outage(library: Library, mode: Mode) {
    nodes_end_in_the_outage(library, mode, Signal::KILL);
}

/// The same nodes end cleanly. No master gets their unregistrations, and the nodes do not repeat them.
fn case_1_nodes_leave_in_the_outage(library: Library, mode: Mode) {
    nodes_end_in_the_outage(library, mode, Signal::INT);
}

fn nodes_end_in_the_outage(library: Library, mode: Mode, how: Signal) {
    let mut robot = Robot::start_for_outages(mode);
    let client = robot.client();
    let talker = robot.node(library, "talker", &[]);
    let listener = robot.node(library, "listener", &[]);
    let mut gone = [
        robot.node(library, "talker", &["__name:=gone_talker"]),
        robot.node(library, "listener", &["__name:=gone_listener"]),
        robot.node(library, "server", &["__name:=gone_server"]),
    ];
    let observer = FakeNode::start("/observer");
    observer.subscribe(&client, "/chatter", "std_msgs/String");
    listener.wait_messages("/talker", 10);
    listener.wait_messages("/gone_talker", 10);
    gone[1].wait_messages("/talker", 10);
    let before = robot.settled_state();
    let mut after = before.clone();
    for name in ["/gone_talker", "/gone_listener", "/gone_server"] {
        assert!(before.knows(name), "{name} is not registered:\n{before}");
        after = after.without_node(name);
    }
    let talker_api = client.ok("lookupNode", params!["/test", "/talker"]);

    let dead = robot.master_pid();
    robot.take_master_away();
    for node in &gone {
        node.signal(how);
    }
    for node in &mut gone {
        node.wait();
    }
    robot.revive_master();
    robot.await_recovery(dead);

    robot.await_state(&after, "after the nodes that ended have been unregistered");
    if how == Signal::KILL {
        let rescue = &mut robot.rescue;
        rescue.wait_line("the log has each phase of the recovery", |line| {
            let parts = ["cause=\"", "absence_ms=", "inspection_ms=", "injection_ms="];
            line.contains("calls pass to the master: ")
                && parts.iter().all(|part| line.contains(part))
        });
        rescue.wait_line("the log has the result of the health check", |line| {
            let parts = ["health_check_ms=", "removed=["];
            line.contains("the rescue is complete") && parts.iter().all(|part| line.contains(part))
        });
        // On a busy computer the health check may find one of the nodes a little later.
        for name in ["/gone_listener", "/gone_server", "/gone_talker"] {
            rescue.wait_line("the log names the node that was unregistered", |line| {
                let removed = line.split("removed=[").nth(1);
                removed.is_some_and(|names| names.split(']').next().unwrap().contains(name))
            });
        }
    }
    eventually(
        "the subscribers know that only one publisher is left",
        || {
            observer
                .updates("/chatter")
                .last()
                .is_some_and(|uris| *uris == [talker_api.as_str().unwrap()])
        },
    );
    let before_end = listener.messages("/gone_talker");
    listener.wait_messages("/talker", 20);
    assert_eq!(before_end, listener.messages("/gone_talker"));
    listener.assert_no_message_lost("/talker");
    // The link to the node that ended is gone, and no other link.
    assert_eq!(listener.links().last(), Some(&1), "{:?}", listener.links());
    assert_eq!(talker.links().last(), Some(&1), "{:?}", talker.links());
    after.assert_same(&robot.state(), "at the end");
}
