//! A master that hangs, and one that is only slow. Probes find the hung one; the mirror stands in, `core` replaces it,
//! and `proxy` waits for it. If it continues, it gets all writes that it missed. The slow one is left alone.

use std::fs;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    FakeNode, Finish, Library, Mode, NODES, Robot, State, alive, encode_call, eventually, holds,
    params, request, within,
};
use ros1_master::xmlrpc::Value;
use rustix::process::{Pid, Signal, kill_process};

/// Options that make a master count as hung when it has not answered for a second.
const PROBES: [&str; 8] = [
    "--stand-in-after",
    "100",
    "--probe-interval",
    "100",
    "--probe-timeout",
    "500",
    "--probe-count",
    "2",
];

/// The values of a parameter in a node's notifications, in order, each with whether it came from rosrescue.
fn told(node: &FakeNode, key: &str) -> Vec<(i32, bool)> {
    let calls = node.calls().into_iter();
    let updates = calls.filter(|call| call.method == "paramUpdate");
    let of_key = updates.filter(|call| {
        let told = call.params[1].as_str();
        told.map(|key| key.trim_end_matches('/')) == Some(key)
    });
    of_key
        .map(|call| (call.params[2].as_int().unwrap(), call.from_rosrescue))
        .collect()
}

/// rosmaster answers such a call with 404, and runs nothing.
#[test]
fn a_call_to_a_path_that_rosmaster_does_not_have_never_takes_effect() {
    let options = ["--stand-in-after", "100", "--probe-timeout", "500"];
    let robot = Robot::start_with(Mode::Proxy, &options);
    let client = robot.client();
    client.set_param("/before", 1);
    let pid = robot.master_pid();
    crate::support::stop(pid);
    let call = encode_call("setParam", params!["/c", "/wrong", 1]);
    let wires: Vec<_> = ["/foo", "//foo", "/RPC2/", "/RPC2?x"]
        .into_iter()
        .map(|path| {
            let mut wire = client.connect().unwrap();
            let bytes = request(&format!("POST {path} HTTP/1.1"), &[], &call);
            wire.send(&bytes).unwrap();
            wire
        })
        .collect();
    // The mirror answers in place of the hung master.
    client.set_param("/after", 2);
    assert_eq!(client.param("/after"), Some(2.into()));
    assert_eq!(client.param("/wrong"), None);
    crate::support::signal(pid, Signal::CONT);
    robot.await_gate();
    assert_eq!(client.param("/after"), Some(2.into()));
    assert_eq!(client.param("/wrong"), None);
    drop(wires);
}

/// The gate shuts, the mirror answers and rosrescue notifies nodes. When the same master continues, it gets all writes
/// that it missed, and does not notify nodes of them.
#[test]
fn a_proxy_stands_in_for_a_hung_master_and_later_gives_it_the_missed_writes() {
    // Three seconds pass before the master counts as hung.
    let probes = [
        "--stand-in-after",
        "100",
        "--probe-timeout",
        "1500",
        "--probe-count",
        "2",
    ];
    let robot = Robot::start_with(Mode::Proxy, &probes);
    let client = robot.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    client.set_param("/gain", 7);
    for key in ["/flying", "/standing"] {
        node.watch_param(&client, key);
    }
    let watcher = FakeNode::start("/watcher");
    watcher.subscribe(&client, "/topic", "std_msgs/String");
    let before = State::read(&client);
    let pid = robot.master_pid();
    let injections = robot.counter("masters_restored");
    // A busy computer may have made the master late before.
    let late = || robot.status().expect("a status")["late_answers"]["times"].as_u64();
    let late_before = late();

    crate::support::stop(pid);
    // The master has received this call but not run it.
    let flying = thread::spawn({
        let client = client.clone();
        move || client.set_param("/flying", 1)
    });
    // Clients do not wait until the master counts as hung.
    assert_eq!(client.param("/gain"), Some(Value::Int(7)));
    client.set_param("/gain", 7);
    node.watch_param(&client, "/standing");
    flying.join().unwrap();
    assert!(!robot.is_open());
    let coming = FakeNode::start("/coming");
    let after = within(Duration::from_secs(10), "calls", || {
        for number in 1..=3 {
            client.set_param("/standing", number);
        }
        coming.publish(&client, "/topic", "std_msgs/String");
        let after = State::read(&client);
        assert_eq!(client.param("/gain"), Some(Value::Int(7)));
        assert_eq!(client.master_pid(), Some(pid));
        after
    });
    before.assert_same(
        &after.without_node("/coming").with_params_of(&before),
        "except for the running calls",
    );
    let both = [node.api.clone(), coming.api.clone()];
    eventually("the subscriber knows the new publisher", || {
        watcher
            .updates("/topic")
            .last()
            .is_some_and(|it| *it == both)
    });
    // The node need not get outdated values.
    eventually("the node gets the last value", || {
        told(&node, "/standing").last() == Some(&(3, true))
    });
    let heard = told(&node, "/standing");
    assert!(heard.is_sorted(), "{heard:?}");
    // This value comes when the master counts as hung. Until then the master itself may notify the node.
    eventually("the node gets the value that was under way", || {
        told(&node, "/flying").contains(&(1, true))
    });

    crate::support::signal(pid, Signal::CONT);
    robot.await_gate();
    assert_eq!(robot.master_pid(), pid, "the same master stays in use");
    assert_eq!(robot.counter("masters_restored"), injections + 1);
    // Nothing has died, so this does not count as a rescue.
    let status = robot.status().expect("a status");
    assert_eq!(status["rescues"], 0, "{status}");
    assert_eq!(late(), late_before.map(|times| times + 1), "{status}");
    assert_eq!(status["last_recovery"]["same_master"], true, "{status}");
    let shown = crate::support::page(&client, "/");
    assert!(shown.contains("answered in the master's place "), "{shown}");
    after.assert_same(&robot.state(), "in the master that continues");
    after.assert_same(&State::read(&client), "through rosrescue");
    // The node never gets an older value or an incomplete list of publishers.
    assert!(holds(Duration::from_secs(1), || {
        let standing = told(&node, "/standing");
        standing.starts_with(&heard) && standing[heard.len()..].iter().all(|(value, _)| *value == 3)
    }));
    assert!(told(&node, "/flying").iter().all(|(value, _)| *value == 1));
    let updates = watcher.updates("/topic");
    let first = updates.iter().position(|uris| *uris == both).unwrap();
    assert!(
        updates[first..].iter().all(|uris| *uris == both),
        "{updates:?}"
    );
    // The master notifies the subscribers of its parameters as before.
    client.set_param("/standing", 4);
    eventually("the master notifies the node", || {
        told(&node, "/standing").contains(&(4, false))
    });
    for node in [&node, &watcher, &coming] {
        assert_eq!(node.received("shutdown"), Vec::<Vec<Value>>::new());
    }
}

/// Some hangs are too short to be noticed and some are long enough. Writes are under way all the time.
#[test]
fn hangs_under_writes_lose_nothing() {
    const HANGS: u64 = 4;
    let robot = Robot::start_with(Mode::Proxy, &PROBES);
    let client = robot.client();
    let pid = robot.master_pid();
    let injections = robot.counter("masters_restored");
    let watcher = FakeNode::start("/watcher");
    let keys = ["/first", "/second"];
    for key in keys {
        watcher.watch_param(&client, key);
    }
    let done = AtomicBool::new(false);
    let seed = std::process::id();
    println!("seed {seed}");
    let written = thread::scope(|scope| {
        let finish = Finish(&done);
        let writers = keys.map(|key| {
            let (client, done) = (&client, &done);
            scope.spawn(move || {
                let mut number = 0;
                while !done.load(Ordering::Relaxed) {
                    number += 1;
                    // This panics if the call is answered with anything but success, or not at all.
                    client.set_param(key, number);
                    thread::sleep(Duration::from_millis(20));
                }
                number
            })
        });
        let mut dice = u64::from(seed);
        let mut roll = |most: u64| {
            dice = dice
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (dice >> 33) % most
        };
        for round in 0..HANGS {
            crate::support::stop(pid);
            // The length of the hang is random. A master that hangs for a second is noticed.
            let length = match round % 3 {
                0 => 1800 + roll(800),
                _ => 10 + roll(700),
            };
            thread::sleep(Duration::from_millis(length));
            crate::support::signal(pid, Signal::CONT);
            robot.await_gate();
            thread::sleep(Duration::from_millis(roll(200)));
        }
        drop(finish);
        writers.map(|it| it.join().unwrap())
    });
    assert_eq!(robot.master_pid(), pid, "the same master stays in use");
    // At least one hang was noticed. A busy rosrescue may see too little of another one.
    assert!(robot.counter("masters_restored") > injections);
    for (key, written) in keys.into_iter().zip(written) {
        // The last write may have been answered in place of a late master.
        robot.await_gate();
        assert_eq!(robot.bare().param(key), Some(Value::Int(written)), "{key}");
        // rosrescue leaves out outdated values. The last value may come from rosrescue before the master sends the
        // value before that; then it is sent again.
        eventually("the node's last value is the newest", || {
            told(&watcher, key)
                .last()
                .is_some_and(|(value, _)| *value == written)
        });
        // The master sends each value once and in order.
        let told = told(&watcher, key);
        let by_master: Vec<_> = told.iter().filter(|(_, ours)| !ours).collect();
        assert!(by_master.is_sorted_by(|a, b| a.0 < b.0), "{key}: {told:?}");
    }
    let state = robot.state();
    state.assert_same(&State::read(&client), "through rosrescue");
    assert_eq!(watcher.received("shutdown"), Vec::<Vec<Value>>::new());
}

/// The call is under way in the master when the master hangs, and the mirror answers the call. If the hung master dies,
/// the next one does not know the node either.
#[test]
fn an_unregistration_under_way_in_a_hung_master_is_not_forgotten() {
    let mut robot = Robot::start_with(Mode::Proxy, &PROBES);
    let client = robot.client();
    let [leaving, staying] = ["/leaving", "/staying"].map(FakeNode::start);
    for node in [&leaving, &staying] {
        node.publish(&client, "/topic", "std_msgs/String");
    }
    // The master may have been late.
    robot.await_gate();
    let after = robot.settled_state().without_node("/leaving");
    let dead = robot.master_pid();
    crate::support::stop(dead);
    leaving.unpublish(&client, "/topic");
    after.assert_same(&State::read(&client), "in the mirror");
    robot.kill_master();
    robot.revive_master();
    robot.await_recovery(dead);
    robot.await_state(&after, "in the next master");
    after.assert_same(&State::read(&client), "through rosrescue");
}

/// `core` detects a hung master, kills it and starts another one. The streams of its nodes continue.
#[test]
fn a_core_replaces_a_hung_master_under_its_nodes() {
    let robot = Robot::start_with(Mode::Core, &PROBES);
    let client = robot.client();
    let talker = robot.node(Library::Rospy, "talker", &[]);
    let listener = robot.node(Library::Roscpp, "listener", &[]);
    listener.wait_messages("/talker", 5);
    // The master may have been late.
    robot.await_gate();
    let before = robot.settled_state();
    let hung = robot.master_pid();
    crate::support::stop(hung);
    let waiting = thread::spawn({
        let client = client.clone();
        move || client.status("setParam", params!["/test", "/waits", 1])
    });
    eventually("the mirror answers reads while the master does not", || {
        !robot.is_open() && State::read(&client).knows("/talker")
    });
    robot.await_recovery(hung);
    assert!(!alive(hung), "the hung master is still running");
    assert_eq!(
        waiting
            .join()
            .unwrap()
            .expect("the call was not answered")
            .0,
        1
    );
    client.ok("deleteParam", params!["/test", "/waits"]);
    // The next master may have been late, too.
    robot.await_gate();
    before.assert_same(&robot.state(), "after the hung master was replaced");
    let status = robot.status().unwrap();
    // The last recovery may be that of a late master. It does not count as a rescue.
    assert_eq!(
        status["last_rescues"][0]["cause"],
        "the master stopped answering"
    );
    listener.wait_messages("/talker", 10);
    listener.assert_no_message_lost("/talker");
    listener.assert_no_link_lost();
    talker.assert_no_link_lost();
}

/// A master that takes five seconds per call, with a time limit of eight, is left alone. One that takes twenty seconds
/// is replaced. The master may get no processor for three seconds.
#[test]
fn a_slow_master_is_left_alone_if_it_answers_within_the_time_limit() {
    let program = format!("{NODES}/slow_rosmaster.py");
    let options = [
        "--rosmaster",
        &program,
        "--no-rosout",
        "--probe-interval",
        "100",
        "--probe-timeout",
        "4000",
        "--probe-count",
        "2",
        // Writes wait for the master here.
        "--stand-in-after",
        "60000",
    ];
    let robot = Robot::start_with(Mode::Core, &options);
    let client = robot.client();
    client.set_param("/kept", 0);
    let pid = robot.master_pid();
    let slow = robot.scratch.path("slow");

    // The first value is almost as long as a probe may take, and the second one is longer.
    for (number, seconds) in (1..).zip(["3.5", "5"]) {
        fs::write(&slow, seconds).unwrap();
        let start = Instant::now();
        client.set_param("/kept", number);
        let delay = Duration::from_secs_f64(seconds.parse().unwrap());
        assert!(
            start.elapsed() >= delay,
            "the master was not slow: {:?}",
            start.elapsed()
        );
        // Reads do not have to wait so long, unless the computer itself is slow.
        let value = within(delay.max(Duration::from_secs(1)), "a read", || {
            client.param("/kept")
        });
        assert_eq!(value, Some(Value::Int(number)));
        // Several probes have run in this time.
        let probes = Duration::from_secs(10);
        assert!(holds(probes, || robot.is_open()), "{seconds} s a call");
    }
    // roslaunch waits for this.
    let found = within(Duration::from_secs(2), "getPid", || client.master_pid());
    assert_eq!(found, Some(pid));
    let status = robot.status().unwrap();
    assert_eq!(status["recoveries"], 1, "{status}");
    assert!(robot.is_open());

    fs::write(&slow, "20").unwrap();
    eventually("the gate is shut", || !robot.is_open());
    // On a busy computer a sleeping process could look starved, so it is stopped.
    let _ = kill_process(Pid::from_raw(pid.cast_signed()).unwrap(), Signal::STOP);
    eventually("the master is ended", || !alive(pid));
    fs::remove_file(&slow).unwrap();
    robot.await_recovery(pid);
    assert_eq!(robot.bare().param("/kept"), Some(Value::Int(2)));
}
