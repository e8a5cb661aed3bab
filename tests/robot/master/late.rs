//! A master that does not answer for a while. Writers do not wait until it counts as hung, it gets the writes that it
//! missed, and it is killed only if its process shows that it hangs.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    FakeNode, Finish, Mode, Robot, Scratch, State, alive, eventually, signal, status, stop,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

/// With these options a master never counts as hung within a test.
const NO_VERDICT: [&str; 4] = ["--stand-in-after", "100", "--probe-count", "1000"];

/// The values in a node's notifications, in order, each with whether it came from rosrescue.
fn told(node: &FakeNode) -> Vec<(i32, bool)> {
    let calls = node.calls().into_iter();
    let updates = calls.filter(|call| call.method == "paramUpdate");
    updates
        .map(|call| (call.params[2].as_int().unwrap(), call.from_rosrescue))
        .collect()
}

/// Clients that set parameters, register and unregister wait only once, for `--stand-in-after`. The same
/// master continues and has everything.
#[test]
fn writers_do_not_wait_until_a_stopped_master_counts_as_hung() {
    for mode in [Mode::Proxy, Mode::Core] {
        let robot = Robot::start_with(mode, &NO_VERDICT);
        let client = robot.client();
        let [first, second] = ["/first", "/second"].map(FakeNode::start);
        first.subscribe(&client, "/both", "std_msgs/String");
        let pid = robot.master_pid();
        let restored = robot.counter("masters_restored");
        stop(pid);
        for pass in 1..=20 {
            client.set_param("/pass", pass);
            second.publish(&client, "/both", "std_msgs/String");
            second.offer(&client, "/service");
            second.unpublish(&client, "/both");
            second.withdraw(&client, "/service");
        }
        first.publish(&client, "/only", "std_msgs/String");
        assert!(!robot.is_open(), "the master is stopped");
        let after = State::read(&client);
        assert_eq!(client.param("/pass"), Some(Value::Int(20)));
        signal(pid, Signal::CONT);
        robot.await_gate();
        assert_eq!(robot.master_pid(), pid, "the same master stays in use");
        assert_eq!(robot.bare().param("/pass"), Some(Value::Int(20)));
        robot.await_state(&after, "in the master that continues");
        // A node would be notified twice of the topic that came and went, so the state was injected.
        assert_eq!(robot.counter("masters_restored"), restored + 1);
        assert_eq!(status(&client)["deaths"], 0);
        robot.rescue.assert_no_panic();
    }
}

/// The master runs the writes that it missed, and nothing else is done to it.
#[test]
fn a_master_that_was_only_late_is_not_injected() {
    let robot = Robot::start_with(Mode::Proxy, &NO_VERDICT);
    let client = robot.client();
    let [node, watcher] = ["/node", "/watcher"].map(FakeNode::start);
    watcher.subscribe(&client, "/topic", "std_msgs/String");
    watcher.watch_param(&client, "/watched");
    let pid = robot.master_pid();
    let mut caught_up = 0;
    for number in 1..=12 {
        let restored = robot.counter("masters_restored");
        stop(pid);
        // This write is under way in the master.
        client.set_param("/late", number);
        // The master misses these writes.
        client.set_param("/missed", number);
        client.set_param("/watched", number);
        match number % 2 {
            0 => node.unpublish(&client, "/topic"),
            _ => node.publish(&client, "/topic", "std_msgs/String"),
        }
        assert!(!robot.is_open());
        let after = State::read(&client);
        signal(pid, Signal::CONT);
        robot.await_gate();
        for key in ["/late", "/missed", "/watched"] {
            assert_eq!(robot.bare().param(key), Some(Value::Int(number)), "{key}");
        }
        after.assert_same(&robot.state(), "in the master");
        // On a very busy computer the master takes too long to catch up, and is injected instead.
        if robot.counter("masters_restored") == restored {
            caught_up += 1;
            // A master that is stopped before it notifies does so when it continues.
            eventually("the master notifies the node", || {
                told(&watcher).contains(&(number, false))
            });
        }
        if caught_up == 3 {
            break;
        }
    }
    assert_eq!(
        caught_up, 3,
        "the master was injected instead of catching up"
    );
    assert_eq!(robot.master_pid(), pid);
    eventually("the watcher knows the publishers", || {
        let publishers = robot.state().publishers_of("/topic").len();
        let last = watcher.updates("/topic").last().map(Vec::len);
        last == Some(publishers)
    });
    let values = told(&watcher);
    assert!(values.is_sorted_by_key(|(value, _)| *value), "{values:?}");
    assert_eq!(status(&client)["counters"]["divergences"], 0);
    // The master notifies nodes itself, as before.
    client.set_param("/watched", 99);
    eventually("the master notifies the node", || {
        told(&watcher).contains(&(99, false))
    });
}

/// A master that is stopped keeps the notifications that waited for a slow node. It sends them when it continues, so a
/// newer value does not come before them, whether the master itself sends it or rosrescue.
#[test]
fn a_node_hears_what_a_stopped_master_still_has_to_send_before_newer_values() {
    for under_way in ["/other", "/watched"] {
        let robot = Robot::start_with(Mode::Core, &NO_VERDICT);
        let client = robot.client();
        let watcher = FakeNode::start("/watcher");
        watcher.watch_param(&client, "/watched");
        watcher.hold();
        client.set_param("/watched", 1);
        eventually("the node has its first value", || {
            told(&watcher) == [(1, false)]
        });
        client.set_param("/watched", 2);
        let pid = robot.master_pid();
        stop(pid);
        // This write is under way in the master. If it is of the same parameter, the state is injected.
        client.set_param(under_way, 3);
        // The master misses this write.
        client.set_param("/watched", 4);
        watcher.release();
        let stopped = Instant::now();
        while stopped.elapsed() < Duration::from_millis(600) {
            assert_eq!(told(&watcher), [(1, false)], "the master is stopped");
            thread::sleep(Duration::from_millis(10));
        }
        signal(pid, Signal::CONT);
        robot.await_gate();
        eventually("the node has the last value", || {
            let values = told(&watcher);
            values.contains(&(2, false)) && values.last().is_some_and(|(value, _)| *value == 4)
        });
        let values = told(&watcher);
        assert!(values.is_sorted_by_key(|(value, _)| *value), "{values:?}");
    }
}

/// The master gets five percent of the processor time that it needs.
#[test]
fn a_starved_master_is_not_killed() {
    const ATTEMPTS: usize = 5;
    if !(0..ATTEMPTS).any(|_| starves_a_master()) {
        println!("this computer was too busy to stop a master for a moment only, {ATTEMPTS} times");
    }
}

/// Returns false if this test itself waited for the processor, so that the master was really stopped for long.
fn starves_a_master() -> bool {
    let probes = [
        "--probe-interval",
        "50",
        "--probe-timeout",
        "100",
        "--probe-count",
        "1",
    ];
    let robot = Robot::start_with(Mode::Core, &probes);
    let client = robot.client();
    let pid = robot.master_pid();
    let done = AtomicBool::new(false);
    let mut longest = Duration::ZERO;
    let last = thread::scope(|scope| {
        let finish = Finish(&done);
        let writer = scope.spawn(|| {
            let mut number = 0;
            while !done.load(Ordering::Relaxed) {
                number += 1;
                client.set_param("/number", number);
                thread::sleep(Duration::from_millis(20));
            }
            number
        });
        let start = Instant::now();
        while start.elapsed() < Duration::from_secs(6) {
            let stopped = Instant::now();
            signal(pid, Signal::STOP);
            thread::sleep(Duration::from_millis(285));
            signal(pid, Signal::CONT);
            longest = longest.max(stopped.elapsed());
            thread::sleep(Duration::from_millis(15));
        }
        drop(finish);
        writer.join().unwrap()
    });
    if longest > Duration::from_millis(500) {
        return false;
    }
    robot.await_gate();
    assert_eq!(robot.master_pid(), pid);
    assert_eq!(status(&client)["deaths"], 0);
    assert_eq!(robot.bare().param("/number"), Some(Value::Int(last)));
    assert!(
        robot.rescue.log().contains("but is not killed"),
        "no probe was missed: {}",
        robot.rescue.log()
    );
    // A master that really hangs is killed.
    stop(pid);
    robot.await_recovery(pid);
    assert!(!alive(pid));
    true
}

/// The master uses the processor for longer than `--start-limit` before it listens.
#[test]
fn a_master_that_starts_slowly_is_started_only_once() {
    let scratch = Scratch::new();
    let [program, starts] = ["slow_to_start", "starts"].map(|name| scratch.path(name));
    let script = format!(
        "#!/bin/bash\necho >>'{}'\nend=$((SECONDS + 3))\nwhile [ $SECONDS -lt $end ]; do :; done\n\
         exec rosmaster \"$@\"\n",
        starts.display()
    );
    fs::write(&program, script).unwrap();
    fs::set_permissions(&program, Permissions::from_mode(0o755)).unwrap();
    let options = [
        "--rosmaster",
        program.to_str().unwrap(),
        "--no-rosout",
        "--start-limit",
        "1",
    ];
    let robot = Robot::start_with(Mode::Core, &options);
    robot.client().set_param("/kept", 1);
    assert_eq!(robot.bare().param("/kept"), Some(Value::Int(1)));
    assert_eq!(status(&robot.client())["deaths"], 0);
    assert_eq!(fs::read_to_string(&starts).unwrap().lines().count(), 1);
}
