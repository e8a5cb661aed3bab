//! What happens around an outage beside the paper's cases: calls in the gap, parameter subscriptions
//! and services of real nodes, a master that hangs, restarts that nobody saw, and rosrescue's own
//! restarts.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod support;

use std::fs;
use std::thread;
use std::time::{Duration, Instant};

use rosrescue::xmlrpc::{Call, Reply, Value};
use rustix::process::Signal;
use support::{
    FakeNode, Library, Mode, Node, Robot, Rosmaster, Scratch, Setup, State, alive, encode_call,
    eventually, free_port, holds, http_request, params, tree,
};

/// Options with which a master that hangs is found within a second.
const QUICK_PROBES: [&str; 6] = [
    "--probe-interval",
    "100",
    "--probe-timeout",
    "300",
    "--probe-count",
    "2",
];

#[test]
fn cached_parameters_of_rospy_follow_after_the_crash() {
    cached_parameters_follow(Library::Rospy, Mode::Core);
    cached_parameters_follow(Library::Rospy, Mode::Proxy);
}

#[test]
fn cached_parameters_of_roscpp_follow_after_the_crash() {
    cached_parameters_follow(Library::Roscpp, Mode::Core);
    cached_parameters_follow(Library::Roscpp, Mode::Proxy);
}

fn cached_parameters_follow(library: Library, mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    client.set_param("/speed", 1);
    let node = robot.node(library, "param_user", &["/speed"]);
    let says = |value: &str| {
        eventually(&format!("the node's cache says {value}"), || {
            node.said("value").last().is_some_and(|last| last == value)
        });
    };
    says("1");
    client.set_param("/speed", 2);
    says("2");
    robot.crash_master();
    client.set_param("/speed", 3);
    says("3");
    robot.crash_master();
    client.set_param("/speed", 4);
    says("4");
    assert_eq!(
        node.said("value"),
        ["1", "2", "3", "4"],
        "a crash changes no value"
    );
    assert_eq!(node.said("failed"), Vec::<String>::new());
}

#[test]
fn services_of_rospy_are_found_all_through_an_outage() {
    services_are_found(Library::Rospy);
}

#[test]
fn services_of_roscpp_are_found_all_through_an_outage() {
    services_are_found(Library::Roscpp);
}

/// The client looks the service up for every call.
fn services_are_found(library: Library) {
    let mut robot = Robot::start(Mode::Proxy);
    let server = robot.node(library, "server", &[]);
    let user = robot.node(library, "client", &["10"]);
    let replies = || user.said("reply").len();
    eventually("the client got answers", || replies() >= 3);
    let dead = robot.master_pid();
    robot.kill_master();
    let before = replies();
    eventually("the client gets answers while there is no master", || {
        replies() >= before + 10
    });
    robot.revive_master();
    robot.await_recovery(dead);
    let before = replies();
    eventually("the client gets answers after the outage", || {
        replies() >= before + 10
    });
    assert_eq!(user.said("failed"), Vec::<String>::new());
    assert!(user.said("reply").iter().all(|name| name == "/server"));
    assert!(server.said("called").len() >= replies());
}

#[test]
fn no_node_hears_of_the_injection() {
    for mode in [Mode::Core, Mode::Proxy] {
        let mut robot = Robot::start(mode);
        let client = robot.client();
        let nodes: Vec<_> = (0..4)
            .map(|i| FakeNode::start(&format!("/fake{i}")))
            .collect();
        for node in &nodes {
            node.publish(&client, "/shared", "std_msgs/String");
            node.publish(&client, &format!("{}/own", node.name), "std_msgs/UInt64");
            node.offer(&client, &format!("{}/service", node.name));
        }
        for node in &nodes {
            node.subscribe(&client, "/shared", "std_msgs/String");
            node.subscribe(&client, "/fake0/own", "*");
            node.subscribe(&client, "/nobody/publishes", "std_msgs/Bool");
            node.watch_param(&client, "/gains");
        }
        client.set_param("/gains/p", 1.5);
        for node in &nodes {
            eventually("the nodes are told of the parameter", || {
                node.heard("paramUpdate").len() == 1
            });
        }
        let before = robot.settled_state();
        let heard = |method: &str| -> Vec<_> { nodes.iter().map(|n| n.heard(method)).collect() };
        let (params, updates) = (heard("paramUpdate"), heard("publisherUpdate"));
        robot.crash_master();
        before.assert_same(&robot.state(), "after the crash");
        // The census may tell a subscriber the whole truth again, but never a part of it.
        let all: Vec<_> = nodes.iter().map(|node| node.api.clone()).collect();
        let quiet = holds(Duration::from_secs(2), || {
            nodes.iter().zip(&updates).all(|(node, updates)| {
                node.updates("/shared")[..]
                    .iter()
                    .skip(updates.len())
                    .all(|uris| *uris == all)
                    && node.heard("publisherUpdate").len() <= updates.len() + 3
            })
        });
        assert!(quiet, "{:?}", heard("publisherUpdate"));
        assert_eq!(params, heard("paramUpdate"), "{mode:?}");
        assert!(heard("shutdown").iter().all(Vec::is_empty), "{mode:?}");
        client.set_param("/gains/p", 2.5);
        for (node, before) in nodes.iter().zip(&params) {
            eventually(
                "the nodes are told of the parameter after the crash too",
                || node.heard("paramUpdate").len() == before.len() + 1,
            );
        }
    }
}

#[test]
fn calls_in_the_gap_get_what_their_senders_need() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    client.set_param("/gain", 7);
    let node = FakeNode::start("/fake");
    node.publish(&client, "/topic", "std_msgs/String");
    let dead = robot.master_pid();
    robot.kill_master();

    // roslaunch waits five seconds for getPid, then it starts a master of its own on this port.
    let start = Instant::now();
    assert_eq!(client.master_pid(), Some(dead));
    assert_eq!(
        client.ok("getUri", params!["/test"]),
        Value::from(client.uri())
    );
    // A roscpp node whose getParam fails goes on with its default.
    assert_eq!(client.param("/gain"), Some(Value::Int(7)));
    let state = State::read(&client);
    assert_eq!(state.publishers_of("/topic"), ["/fake"]);
    // rospy says these only once.
    node.unpublish(&client, "/topic");
    assert!(!State::read(&client).knows("/fake"));
    assert!(
        start.elapsed() < Duration::from_secs(4),
        "{:?}",
        start.elapsed()
    );

    // The rest waits, in order, and is done when the master is there.
    let setters: Vec<_> = (0..5)
        .map(|i| {
            let client = client.clone();
            let waiting =
                thread::spawn(move || client.status("setParam", params!["/test", "/last", i]));
            // Sent one after the other, so that there is an order.
            thread::sleep(Duration::from_millis(50));
            waiting
        })
        .collect();
    assert!(holds(Duration::from_secs(1), || setters
        .iter()
        .all(|setter| !setter.is_finished())));
    robot.revive_master();
    for setter in setters {
        assert_eq!(setter.join().unwrap().expect("the call is answered").0, 1);
    }
    robot.await_recovery(dead);
    let state = robot.state();
    assert_eq!(robot.bare().param("/last"), Some(Value::Int(4)));
    assert!(
        !state.knows("/fake"),
        "what was unregistered in the gap is back:\n{state}"
    );
}

#[test]
fn a_call_is_not_held_for_ever_and_never_answered_falsely() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--hold", "1.5"]);
    robot.kill_master();
    let body = encode_call("setParam", params!["/test", "/late", 1]);
    let start = Instant::now();
    let error = robot
        .client()
        .exchange(&http_request(&body))
        .expect_err("no answer is right here");
    let waited = start.elapsed();
    // Closed without a byte: that is what nodes take for a lost connection and try again.
    assert!(error.to_string().contains("closed after []"), "{error}");
    assert!(
        waited >= Duration::from_millis(1400),
        "it was held only {waited:?}"
    );
    robot.revive_master();
    robot.await_gate();
    robot.client().set_param("/late", 2);
    assert_eq!(robot.bare().param("/late"), Some(Value::Int(2)));
}

#[test]
fn a_core_replaces_a_master_that_hangs() {
    let robot = Robot::start_with(Mode::Core, &QUICK_PROBES);
    let client = robot.client();
    client.set_param("/kept", "yes");
    let before = robot.settled_state();
    let hung = robot.master_pid();
    support::signal(hung, Signal::STOP);
    robot.await_recovery(hung);
    eventually("the master that hangs is ended", || !alive(hung));
    before.assert_same(&robot.state(), "after the hung master was replaced");
}

#[test]
fn a_proxy_waits_for_a_master_that_hangs() {
    let robot = Robot::start_with(Mode::Proxy, &QUICK_PROBES);
    let client = robot.client();
    client.set_param("/kept", "yes");
    let before = robot.settled_state();
    let pid = robot.master_pid();
    support::signal(pid, Signal::STOP);
    let waiting = thread::spawn({
        let client = client.clone();
        move || client.status("setParam", params!["/test", "/waits", 1])
    });
    assert!(holds(Duration::from_secs(2), || !waiting.is_finished()));
    support::signal(pid, Signal::CONT);
    assert_eq!(waiting.join().unwrap().expect("the call is answered").0, 1);
    client.ok("deleteParam", params!["/test", "/waits"]);
    before.assert_same(&robot.state(), "after the master went on");
    assert_eq!(client.master_pid(), Some(pid));
}

#[test]
fn a_restart_that_nobody_saw_is_found() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    client.set_param("/kept", "yes");
    let node = FakeNode::start("/fake");
    node.publish(&client, "/topic", "std_msgs/String");
    let before = robot.settled_state();
    let dead = robot.master_pid();
    robot.rescue.signal(Signal::STOP);
    robot.kill_master();
    robot.revive_master();
    robot.rescue.signal(Signal::CONT);
    robot.await_recovery(dead);
    before.assert_same(&robot.state(), "after the restart that nobody saw");
    assert_eq!(node.heard("shutdown"), Vec::<Vec<_>>::new());
}

#[test]
fn every_sub_call_of_a_multicall_is_recorded_for_itself() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let set = |key: &str, value: i32| Call::new("setParam", params!["/test", key, value]);
    let delete = |key: &str| Call::new("deleteParam", params!["/test", key]);
    client.set_param("/old", 1);
    let inner = Call::multicall([set("/nested", 3), delete("/not/there"), set("/nested2", 4)]);
    let calls = [
        set("/a", 1),
        delete("/old"),
        delete("/not/there"),
        inner,
        set("/b", 2),
    ];
    let Reply::Value(Value::Array(answers)) = client
        .call("system.multicall", Call::multicall(calls).params)
        .unwrap()
    else {
        panic!("no answer to a multicall");
    };
    assert_eq!(answers.len(), 5);
    // A malformed entry fails the whole call after the entries before it have been done.
    let bad = Value::Array(vec![
        tree! { "methodName" => "setParam", "params" => params!["/test", "/before", 5] },
        tree! { "no method name" => 1 },
        tree! { "methodName" => "setParam", "params" => params!["/test", "/behind", 6] },
    ]);
    let answer = client.call("system.multicall", vec![bad]).unwrap();
    assert!(matches!(answer, Reply::Fault { .. }), "{answer:?}");
    let before = robot.settled_state();
    for (key, value) in [
        ("/a", Some(1)),
        ("/b", Some(2)),
        ("/nested", Some(3)),
        ("/nested2", Some(4)),
        ("/before", Some(5)),
        ("/behind", None),
        ("/old", None),
    ] {
        assert_eq!(robot.bare().param(key), value.map(Value::Int), "{key}");
    }
    robot.crash_master();
    before.assert_same(&robot.state(), "after the crash");
}

#[test]
fn parameters_of_every_kind_come_back() {
    for mode in [Mode::Core, Mode::Proxy] {
        let mut robot = Robot::start(mode);
        let client = robot.client();
        client.set_param("/kinds", kinds());
        client.set_param(
            "/robot_description",
            "<robot name=\"r\">\n\t<link/>\n</robot>\n".repeat(20_000),
        );
        client.set_param("/empty", tree! {});
        client.set_param("/kinds/deeper/still", vec![1, 2, 3]);
        client.ok("deleteParam", params!["/test", "/kinds/deeper/still"]);
        let before = robot.settled_state();
        robot.crash_master();
        before.assert_same(&robot.state(), "after the crash");
        robot.rescue.kill();
        let dead = robot.master_pid();
        robot.kill_master_at_once(dead);
        robot.revive_master();
        robot.rescue.start_again();
        robot.rescue.wait_serving();
        robot.await_gate();
        before.assert_same(&robot.state(), "after the crash of both");
    }
}

/// What YAML, XML and Python tend to spoil.
fn kinds() -> Value {
    let texts = [
        "",
        " ",
        "  two  ",
        "no",
        "on",
        "yes",
        "null",
        "~",
        "=",
        "<<",
        "1:30",
        "0x1f",
        "0o17",
        "1_000",
        "1.0",
        "1e3",
        ".inf",
        "2001-01-01",
        "- a",
        "a: b",
        "# c",
        "'",
        "\"",
        "\\n",
        "%d",
        "&amp;",
        "]]>",
        "<b>&lt;</b>",
        "tab\there",
        "line\nbreak\n",
        "\n",
        "naïve ☃ 𝄞",
        "\u{85}\u{2028}",
        "trailing ",
    ];
    tree! {
        "texts" => texts.to_vec(),
        "one" => 1, "one point" => 1.0, "truth" => true, "falsehood" => false,
        "largest" => i32::MAX, "least" => i32::MIN,
        "third" => 1.0 / 3.0, "tiny" => 5e-324, "huge" => 1.797_693_134_862_315_7e308, "zero" => -0.0,
        "infinite" => f64::INFINITY, "not a number" => f64::NAN,
        "bytes" => Value::Base64((0..=255).collect()),
        "when" => Value::DateTime("20260101T12:00:00".to_owned()),
        "nothing" => Value::Array(vec![]),
        "mixed" => Value::Array(vec![1.into(), "two".into(), 3.0.into(), vec!["four"].into()]),
        "on" => "a key that YAML 1.1 takes for a truth", "1" => "a number", "" => "no key",
        "with/slash" => "unreachable by its path",
    }
}

#[test]
fn rosrescue_that_was_killed_adopts_the_living_master() {
    for mode in [Mode::Core, Mode::Proxy] {
        let mut robot = Robot::start(mode);
        let client = robot.client();
        let talker = robot.node(Library::Roscpp, "talker", &[]);
        let listener = robot.node(Library::Rospy, "listener", &[]);
        let node = FakeNode::start("/fake");
        client.set_param("/watched", 1);
        node.watch_param(&client, "/watched");
        node.subscribe(&client, "/chatter", "std_msgs/String");
        listener.wait_messages("/talker", 5);
        let before = robot.settled_state();
        let master = robot.master_pid();
        let updates = node.heard("publisherUpdate").len();

        robot.rescue.kill();
        robot.rescue.start_again();
        robot.rescue.wait_serving();
        robot.await_gate();
        assert_eq!(
            robot.master_pid(),
            master,
            "the living master is adopted, not replaced"
        );
        before.assert_same(&robot.state(), "after rosrescue's own restart");
        assert_eq!(
            node.heard("publisherUpdate").len(),
            updates,
            "nothing is injected"
        );

        // What it adopted it can restore; parameter subscriptions it knows from the checkpoint.
        robot.crash_master();
        before.assert_same(&robot.state(), "after the master's crash that followed");
        client.set_param("/watched", 2);
        eventually("the parameter's subscriber is told", || {
            node.heard("paramUpdate")
                .last()
                .is_some_and(|call| call[2] == Value::Int(2))
        });
        assert_eq!(node.heard("shutdown"), Vec::<Vec<_>>::new());
        listener.wait_messages("/talker", 5);
        listener.assert_no_message_lost("/talker");
        talker.assert_no_link_lost();
    }
}

#[test]
fn rosrescue_that_was_killed_fills_an_empty_master() {
    let mut robot = Robot::start(Mode::Proxy);
    robot.client().set_param("/kept", "yes");
    let listener = robot.node(Library::Rospy, "listener", &[]);
    let talker = robot.node(Library::Rospy, "talker", &[]);
    listener.wait_messages("/talker", 5);
    let before = robot.settled_state();
    robot.rescue.kill();
    robot.kill_master();
    robot.revive_master();
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    before.assert_same(&robot.state(), "after the restart of both");
    listener.assert_no_message_lost("/talker");
    talker.assert_no_link_lost();
}

#[test]
fn a_core_of_which_everything_was_killed_restores_from_the_file() {
    let mut robot = Robot::start(Mode::Core);
    robot.client().set_param("/kept", "yes");
    let talker = robot.node(Library::Rospy, "talker", &[]);
    let listener = robot.node(Library::Roscpp, "listener", &[]);
    listener.wait_messages("/talker", 5);
    let before = robot.settled_state();
    let master = robot.master_pid();
    robot.rescue.kill();
    robot.kill_master_at_once(master);
    eventually("the master is dead", || !alive(master));
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    // rosout may have been started anew; its address is its own affair.
    let (before, now) = (before.without_node("/rosout"), robot.settled_state());
    before.assert_same(&now.without_node("/rosout"), "after both were killed");
    let late = robot.node(Library::Roscpp, "listener", &["__name:=late"]);
    late.wait_messages("/talker", 5);
    listener.assert_no_message_lost("/talker");
    talker.assert_no_link_lost();
}

#[test]
fn yesterdays_parameters_do_not_wake_up_tomorrow() {
    let mut robot = Robot::start(Mode::Core);
    robot.client().set_param("/use_sim_time", true);
    let run_id = robot.client().param("/run_id").expect("a run id");
    assert_eq!(robot.rescue.terminate().code(), Some(0));
    let yesterday = fs::read_to_string(robot.rescue.checkpoint()).expect("a closing snapshot");
    assert!(yesterday.contains("use_sim_time"), "{yesterday}");

    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    assert_eq!(robot.client().param("/use_sim_time"), None);
    assert_ne!(robot.client().param("/run_id"), Some(run_id));
    let kept = fs::read_dir(robot.rescue.checkpoint().parent().unwrap())
        .unwrap()
        .flatten()
        .filter(|entry| entry.path() != robot.rescue.checkpoint() && entry.path().is_file())
        .filter_map(|entry| fs::read_to_string(entry.path()).ok())
        .any(|text| text.contains("use_sim_time"));
    assert!(kept, "the old checkpoint is kept under another name");
}

#[test]
fn a_stopped_session_is_restored_when_told_so() {
    let scratch = Scratch::new();
    let (port, master_port) = (free_port(), free_port());
    let start = |restore: &str| {
        let master_port = master_port.to_string();
        let port_text = port.to_string();
        let arguments = [
            "core",
            "-p",
            &port_text,
            "--master-port",
            &master_port,
            "--restore",
            restore,
        ];
        Setup::bare(&scratch, arguments).at_port(port).start()
    };
    let mut rescue = start("auto");
    rescue.client().set_param("/kept", "yes");
    assert_eq!(rescue.terminate().code(), Some(0));
    let mut rescue = start("always");
    assert_eq!(rescue.client().param("/kept"), Some("yes".into()));
    rescue.kill();
    let mut rescue = start("never");
    // With --restore never even the living master of the killed rosrescue is no reason to inject,
    // but what that master holds is the truth.
    assert_eq!(rescue.client().param("/kept"), Some("yes".into()));
    assert_eq!(rescue.terminate().code(), Some(0));
    let rescue = start("never");
    assert_eq!(rescue.client().param("/kept"), None);
}

#[test]
fn a_running_system_is_taken_over() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let bare = master.client();
    bare.set_param("/gain", 3);
    let talker = Node::start(&scratch, Library::Rospy, master.port, "talker", &[]);
    let listener = Node::start(&scratch, Library::Roscpp, master.port, "listener", &[]);
    let _server = Node::start(&scratch, Library::Roscpp, master.port, "server", &[]);
    listener.wait_messages("/talker", 5);
    let mut before = State::read(&bare);
    eventually("the state is at rest", || {
        thread::sleep(Duration::from_millis(300));
        let last = std::mem::replace(&mut before, State::read(&bare));
        last == before
    });

    let rescue = Setup::proxy(&scratch, master.port).start();
    before.assert_same(&State::read(&rescue.client()), "when it was taken over");
    let dead = master.pid();
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    let client = rescue.client();
    eventually("rosrescue names the new master", || {
        client.master_pid().is_some_and(|pid| pid != dead)
    });
    eventually("the state is back", || {
        State::try_read(&master.client()).is_ok_and(|now| now == before)
    });
    listener.wait_messages("/talker", 5);
    listener.assert_no_message_lost("/talker");
    talker.assert_no_link_lost();
}
