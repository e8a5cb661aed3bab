//! A master that speaks HTTP/1.0, and so closes each connection after one answer: every rosmaster before
//! 1.14, and later ones on a kernel before 4.16. With `ROSRESCUE_HTTP_1_0=1` the masters of all other tests
//! do so too.

use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    Client, FakeNode, Mode, NODES, Relay, Robot, Rosmaster, Scratch, Setup, State, alive,
    encode_call, eventually, holds, http_request, in_both_modes, params, signal, status, stop,
    tree, unreadable,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

const PROGRAM: &str = "http10_rosmaster.py";
const START_LIMIT: Duration = Duration::from_secs(5);

in_both_modes!(
    a_healthy_http_1_0_master_is_left_alone,
    the_state_survives_deaths_and_a_hang_of_such_a_master,
);

/// Checks that calls of each kind are answered as by the master itself.
fn assert_exact(client: &Client, bare: &Client) {
    let value = tree! { "list" => vec![Value::from(1), Value::from(2.5)], "text" => "<&>" };
    let calls = [
        ("setParam", params!["/n", "/tree", value]),
        ("getParam", params!["/n", "/tree"]),
        ("getParam", params!["/n", "/missing"]),
        ("hasParam", params!["/n", "/tree/text"]),
        (
            "subscribeParam",
            params!["/n", "http://127.0.0.1:9", "/tree"],
        ),
        (
            "registerPublisher",
            params!["/n", "/topic", "a/B", "http://127.0.0.1:9"],
        ),
        (
            "registerSubscriber",
            params!["/n", "/topic", "a/B", "http://127.0.0.1:9"],
        ),
        ("lookupNode", params!["/n", "/n"]),
        ("getSystemState", params!["/n"]),
        ("getTopicTypes", params!["/n"]),
        ("setParam", params!["/n"]),
        ("system.listMethods", params![]),
    ];
    for (method, params) in calls {
        let request = http_request(&encode_call(method, params));
        let through = client.exchange(&request).unwrap();
        let own = bare.exchange(&request).unwrap();
        assert!(own.status.starts_with("HTTP/1.0"), "{}", own.status);
        assert_eq!(through.text(), own.text(), "{method}");
    }
    let set = client.exchange(&unreadable("/unreadable", 5)).unwrap();
    assert_eq!(set.code, 200);
    assert_eq!(bare.param("/unreadable"), Some(Value::Int(5)));
    assert_eq!(client.param("/unreadable"), Some(Value::Int(5)));
}

/// `core` gives a master a while to become usable, and replaces it if it does not.
fn a_healthy_http_1_0_master_is_left_alone(mode: Mode) {
    let limit = format!("{}", START_LIMIT.as_secs());
    let (options, span) = match mode {
        Mode::Core => (vec!["--start-limit", &limit], 2 * START_LIMIT),
        Mode::Proxy => (Vec::new(), Duration::from_secs(2)),
    };
    // A busy computer is no reason to doubt it.
    let options = [&["--probe-timeout", "30000"][..], &options].concat();
    let robot = Robot::start_under_with(mode, PROGRAM, &[], &options);
    let pid = robot.master_pid();
    assert_exact(&robot.client(), &robot.bare());
    let mut number = 0;
    assert!(
        holds(span, || {
            thread::sleep(Duration::from_millis(50));
            number += 1;
            robot.client().set_param("/number", number);
            let kept = robot.client().param("/number") == Some(Value::Int(number));
            kept && robot.is_open()
        }),
        "after {number} writes"
    );
    assert_eq!(robot.master_pid(), pid);
    assert_eq!(robot.bare().param("/number"), Some(Value::Int(number)));
    assert_eq!(robot.status().unwrap()["recoveries"], 1);
    assert_eq!(robot.counter("calls_unanswered"), 0);
    let status = robot.status().unwrap();
    let speaks = status["master_speaks"].as_str().unwrap();
    assert!(
        speaks.starts_with("HTTP/1.0 (a connection for each call), Python 3."),
        "{speaks}"
    );
}

fn the_state_survives_deaths_and_a_hang_of_such_a_master(mode: Mode) {
    let probes = ["--probe-timeout", "500"];
    let mut robot = Robot::start_under_with(mode, PROGRAM, &[], &probes);
    robot.stay_away();
    let client = robot.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "a/B");
    node.watch_param(&client, "/gain");
    client.set_param("/gain", 1);

    // New nodes start while there is no master.
    let dead = robot.master_pid();
    robot.take_master_away();
    let coming = FakeNode::start("/coming");
    coming.subscribe(&client, "/topic", "a/B");
    client.set_param("/gain", 2);
    let wanted = State::read(&client);
    robot.revive_master();
    robot.await_recovery(dead);
    robot.await_state(&wanted, "after the master's death");

    // Only the worker dies, so the same master stays in use.
    let pid = robot.master_pid();
    robot.rescue.kill();
    robot.rescue.start_again();
    robot.await_gate();
    assert_eq!(robot.master_pid(), pid);
    robot.await_state(&wanted, "after rosrescue's death");
    client.set_param("/gain", 3);
    let wanted = robot.state();

    // The worker and the master die.
    robot.rescue.kill();
    robot.kill_master();
    robot.rescue.start_again();
    robot.revive_master();
    robot.await_recovery(pid);
    robot.await_state(&wanted, "after the death of both");

    // The master hangs: one write is under way, and another one is answered without the master.
    let pid = robot.master_pid();
    stop(pid);
    let flying = thread::spawn({
        let client = client.clone();
        move || client.set_param("/flying", 1)
    });
    flying.join().unwrap();
    client.set_param("/gain", 4);
    signal(pid, Signal::CONT);
    match mode {
        Mode::Core => robot.await_recovery(pid),
        Mode::Proxy => robot.await_gate(),
    }
    assert_eq!(alive(pid) && robot.master_pid() == pid, mode == Mode::Proxy);
    let state = robot.state();
    assert_eq!(robot.bare().param("/gain"), Some(Value::Int(4)));
    assert_eq!(robot.bare().param("/flying"), Some(Value::Int(1)));
    wanted.assert_same(&state.with_params_of(&wanted), "after a hang");
    State::read(&client).assert_same(&state, "through rosrescue");
}

/// Behind a tunnel the sentinel proves nothing, but the token does. The tunnel is switched to an empty master
/// while writes are under way.
#[test]
fn behind_a_tunnel_the_answer_of_another_master_is_never_accepted() {
    let scratch = Scratch::new();
    let program = format!("{NODES}/{PROGRAM}");
    let start = |port| {
        Rosmaster::start_with(&scratch, port, |command| {
            *command = std::process::Command::new(&program);
            scratch.prepare(command);
            command.args(["--core", "-p", &port.to_string()]);
        })
    };
    let masters = [1, 2].map(|_| start(crate::support::free_port()));
    let relay = Relay::to(masters[0].port);
    let rescue = Setup::proxy(&scratch, relay.port()).start();
    let client = rescue.client();
    assert_exact(&client, &masters[0].client());
    let begin = Instant::now();
    let mut number = 0;
    for turn in 0..4 {
        let master = &masters[turn % 2];
        relay.turn_to(master.port);
        let end = Instant::now() + Duration::from_millis(100);
        while Instant::now() < end {
            number += 1;
            client.set_param("/number", number);
            assert_eq!(client.param("/number"), Some(Value::Int(number)));
        }
        eventually("calls pass to the master", || {
            status(&client)["open"] == true && master.client().param("/number").is_some()
        });
        let now = master.client().param("/number");
        assert_eq!(now, Some(Value::Int(number)), "turn {turn}");
        // The health check may unregister the dead node between the two reads.
        eventually("rosrescue and the master report the same state", || {
            let states = [&master.client(), &client].map(|of| State::try_read(of).ok());
            states[0].is_some() && states[0] == states[1]
        });
    }
    println!("{number} writes in {:?}", begin.elapsed());
}
