//! The same master comes back, or an older one: after rosrescue was killed and started again, after a hang or a cut
//! link, or after an address has moved. The master and the mirror then have everything that was acknowledged.

use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    Client, FakeNode, Mode, Relay, Rescue, Robot, Rosmaster, Scratch, Setup, State, eventually,
    free_port, params, signal, status, stop,
};
use ros1_master::xmlrpc::{Struct, Value};
use rustix::process::Signal;

/// Options that make a master count as hung when it has not answered for 0.3 s.
const PROBES: [&str; 6] = [
    "--probe-interval",
    "100",
    "--probe-timeout",
    "100",
    "--probe-count",
    "2",
];

/// Waits until the master equals the mirror and its state passes `check`.
#[track_caller]
fn settles(master: &Client, rescue: &Rescue, check: impl Fn(&State) -> bool) {
    let client = rescue.client();
    eventually("the gate is open", || status(&client)["open"] == true);
    eventually("the acknowledged state is in the master", || {
        State::try_read(master).is_ok_and(|state| check(&state))
    });
    State::read(master).assert_same(&State::read(&client), "through rosrescue");
    assert_eq!(status(&client)["counters"]["divergences"], 0);
}

/// A service is unregistered while the master is stopped, and rosrescue is killed before the master
/// continues.
#[test]
fn a_service_unregistered_during_a_hang_stays_unregistered_if_rosrescue_is_killed() {
    for killed_at_its_start in [false, true] {
        let mut robot = Robot::start_with(Mode::Proxy, &PROBES);
        let client = robot.client();
        let [leaving, staying] = ["/leaving", "/staying"].map(FakeNode::start);
        for node in [&leaving, &staying] {
            node.offer(&client, &format!("{}/service", node.name));
            node.publish(&client, "/topic", "std_msgs/String");
        }
        let pid = robot.master_pid();
        stop(pid);
        if killed_at_its_start {
            robot.rescue.kill();
            robot.rescue.start_again();
        }
        // The mirror answers, either because the hang has been noticed, or as soon as the checkpoint has been
        // read.
        eventually("rosrescue answers", || client.master_pid().is_some());
        leaving.withdraw(&client, "/leaving/service");
        leaving.unpublish(&client, "/topic");
        client.set_param("/set", 7);
        robot.rescue.kill();
        signal(pid, Signal::CONT);
        robot.rescue.start_again();
        robot.rescue.wait_serving();
        settles(&robot.bare(), &robot.rescue, |state| {
            !state.knows("/leaving") && state.publishers_of("/topic") == ["/staying"]
        });
        assert_eq!(robot.master_pid(), pid, "the same master stays in use");
        assert_eq!(robot.bare().param("/set"), Some(Value::Int(7)));
        assert_eq!(staying.received("shutdown"), Vec::<Vec<Value>>::new());
    }
}

/// A call of the killed rosrescue still runs in the master when the next rosrescue gets a newer value.
#[test]
fn a_newer_value_wins_over_a_long_call_of_a_killed_rosrescue() {
    const KEYS: i32 = 60_000;
    let long: Struct = (0..KEYS)
        .map(|key| (format!("k{key}"), Value::Int(1)))
        .collect();
    for delay in [60, 180] {
        let mut robot = Robot::start(Mode::Proxy);
        let client = robot.client();
        let body = crate::support::encode_call(
            "setParam",
            params!["/test", "/many", Value::Struct(long.clone())],
        );
        let request = crate::support::http_request(&body);
        let sender = thread::spawn({
            let client = client.clone();
            move || client.exchange(&request).is_ok()
        });
        thread::sleep(Duration::from_millis(delay));
        robot.rescue.kill();
        let answered = sender.join().unwrap();
        robot.rescue.start_again();
        eventually("a newer value is acknowledged", || {
            client
                .ask("setParam", params!["/test", "/many/k5", 2])
                .is_some()
        });
        println!("after {delay} ms, answered: {answered}");
        robot.rescue.wait_serving();
        settles(&robot.bare(), &robot.rescue, |_| {
            robot.bare().param("/many/k5") == Some(Value::Int(2))
        });
        if answered {
            assert_eq!(client.param("/many/k6"), Some(Value::Int(1)));
        }
    }
}

/// One address has two masters in turn: the first one, an empty second one that gets the state and then changes, and
/// the first one again with its old state.
#[test]
fn the_old_state_of_a_superseded_master_is_not_adopted() {
    let scratch = Scratch::new();
    let [first, second] = [Rosmaster::start(&scratch), Rosmaster::start(&scratch)];
    let relay = Relay::to(first.port);
    let rescue = Setup::proxy(&scratch, relay.port()).args(PROBES).start();
    let client = rescue.client();
    let [leaving, staying] = ["/leaving", "/staying"].map(FakeNode::start);
    for node in [&leaving, &staying] {
        node.publish(&client, "/topic", "std_msgs/String");
        node.subscribe(&client, "/topic", "std_msgs/String");
        node.offer(&client, &format!("{}/service", node.name));
    }
    client.set_param("/old", 1);
    client.set_param("/gone", 1);

    relay.turn_to(second.port);
    settles(&second.client(), &rescue, |state| state.knows("/leaving"));
    leaving.unpublish(&client, "/topic");
    leaving.unsubscribe(&client, "/topic");
    leaving.withdraw(&client, "/leaving/service");
    client.set_param("/old", 2);
    client.set_param("/new", 3);
    client.ok("deleteParam", params!["/test", "/gone"]);
    let coming = FakeNode::start("/coming");
    coming.publish(&client, "/topic", "std_msgs/String");
    let wanted = State::read(&client);

    for master in [&first, &second, &first] {
        relay.turn_to(master.port);
        settles(&master.client(), &rescue, |state| *state == wanted);
        wanted.assert_same(&State::read(&client), "after all");
    }
    for node in [&staying, &coming] {
        assert_eq!(node.received("shutdown"), Vec::<Vec<Value>>::new());
        // Each list contains the publisher that stays.
        let updates = node.updates("/topic");
        assert!(
            updates.iter().all(|uris| uris.contains(&staying.api)),
            "{updates:?}"
        );
    }
}

/// Writes by others while rosrescue could not reach the master are kept, unless rosrescue has acknowledged a newer
/// write.
#[test]
fn writes_that_bypassed_rosrescue_are_found_and_kept() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let relay = Relay::to(master.port);
    let mut rescue = Setup::proxy(&scratch, relay.port()).args(PROBES).start();
    let client = rescue.client();
    for key in ["/both", "/theirs", "/ours"] {
        client.set_param(key, 1);
    }
    let unused_port = free_port();
    relay.turn_to(unused_port);
    client.set_param("/both", 2);
    client.set_param("/ours", 2);
    let past_us = FakeNode::start("/past_us");
    let bare = master.client();
    bare.set_param("/both", 3);
    bare.set_param("/theirs", 3);
    bare.set_param("/new", 3);
    past_us.publish(&bare, "/topic", "std_msgs/String");
    relay.turn_to(master.port);
    let is = |key: &str, value: i32| bare.param(key) == Some(Value::Int(value));
    settles(&bare, &rescue, |state| {
        is("/both", 2) && is("/ours", 2) && is("/theirs", 3) && state.knows("/past_us")
    });
    assert!(is("/new", 3));

    // The same holds after a restart, when the checkpoint may be older than the master.
    rescue.kill();
    bare.set_param("/both", 4);
    bare.set_param("/newer", 4);
    rescue.start_again();
    rescue.wait_serving();
    settles(&bare, &rescue, |state| {
        is("/both", 4) && is("/newer", 4) && state.knows("/past_us")
    });
    assert_eq!(past_us.received("shutdown"), Vec::<Vec<Value>>::new());
}

/// Number of rounds of the random test. `ROSRESCUE_RETURNS` changes it.
fn rounds() -> u64 {
    let given = std::env::var("ROSRESCUE_RETURNS").ok();
    given.map_or(3, |rounds| rounds.parse().expect("ROSRESCUE_RETURNS"))
}

/// The same incarnation comes back after 1, 10 or 100 writes, one of which was under way when it went away.
/// It then equals a master that was there all the time.
#[test]
fn the_same_master_returns_after_any_number_of_pending_writes() {
    let seed = u64::from(std::process::id());
    println!("seed {seed}");
    let mut dice = seed;
    let mut roll = |most: usize| {
        dice = dice
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        usize::try_from(dice >> 33).unwrap() % most
    };
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let model = Rosmaster::start(&scratch);
    let rescue = Setup::proxy(&scratch, master.port).args(PROBES).start();
    let (client, bare, model) = (rescue.client(), master.client(), model.client());
    let nodes: Vec<_> = (0..4).map(|n| FakeNode::start(&format!("/n{n}"))).collect();
    // The nodes must not answer, because their reports would count for more than the registrations made here.
    nodes.iter().for_each(FakeNode::hold);
    let mut write = || {
        let node = &nodes[roll(nodes.len())];
        let (name, api) = (node.name.as_str(), node.api.as_str());
        let topic = format!("/t{}", roll(4));
        let key = format!("/p{}", roll(6));
        let service = format!("/s{}", roll(3));
        let uri = format!("rosrpc://{name}");
        // A topic may get another type.
        let kind = ["a/B", "a/C"][roll(2)];
        match roll(10) {
            0 | 1 => ("registerPublisher", params![name, topic, kind, api]),
            2 => ("unregisterPublisher", params![name, topic, api]),
            3 => ("registerSubscriber", params![name, topic, kind, api]),
            4 => ("unregisterSubscriber", params![name, topic, api]),
            5 => ("registerService", params![name, service, uri, api]),
            6 => ("unregisterService", params![name, service, uri]),
            7 => ("deleteParam", params![name, key]),
            8 => ("subscribeParam", params![name, api, key]),
            _ => (
                "setParam",
                params![name, key, i32::try_from(roll(1000)).unwrap()],
            ),
        }
    };
    let start = Instant::now();
    for round in 0..rounds() {
        for _ in 0..5 {
            let (method, params) = write();
            let expected = model.call(method, params.clone()).unwrap();
            assert_eq!(client.call(method, params).unwrap(), expected, "{method}");
        }
        stop(master.pid());
        let count = [1, 10, 100][usize::try_from(round % 3).unwrap()];
        for number in 0..count {
            // The first write is on its way to the master when that stops answering.
            let (method, params) = write();
            let expected = model.call(method, params.clone()).unwrap();
            let answer = client.call(method, params.clone()).unwrap();
            assert_eq!(
                answer, expected,
                "round {round}, write {number}, {method} {params:?}"
            );
        }
        signal(master.pid(), Signal::CONT);
        eventually("the master serves calls again", || {
            status(&client)["open"] == true
        });
        let wanted = State::read(&model);
        wanted.assert_same(&State::read(&client), &format!("round {round}, the mirror"));
        wanted.assert_same(&State::read(&bare), &format!("round {round}, the master"));
    }
    println!("{} rounds, {:?}", rounds(), start.elapsed());
    assert_eq!(status(&client)["counters"]["divergences"], 0);
    let shut_down = nodes
        .iter()
        .flat_map(|node| node.received("shutdown"))
        .count();
    assert_eq!(shut_down, 0);
}
