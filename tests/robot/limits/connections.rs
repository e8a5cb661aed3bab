//! Clients can take only a limited number of connections and file descriptors of rosrescue. A client that
//! makes a call is served all the time.

use std::fs;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    Client, Mode, PATIENCE, Process, Rescue, Robot, Scratch, Setup, Wire, behind, encode_call,
    eventually, free_port, http_request, params, ros_command, signal, within,
};
use rustix::process::{Pid, Resource, Rlimit, Signal, prlimit};

/// Number of open file descriptors.
fn files(process: &Process) -> usize {
    fs::read_dir(format!("/proc/{}/fd", process.pid()))
        .unwrap()
        .count()
}

/// Processor time used so far, in hundredths of a second.
fn ticks(process: &Process) -> u64 {
    let stat = fs::read_to_string(format!("/proc/{}/stat", process.pid())).unwrap();
    let fields: Vec<_> = stat
        .rsplit(')')
        .next()
        .unwrap()
        .split_whitespace()
        .collect();
    fields[11..13]
        .iter()
        .map(|field| field.parse::<u64>().unwrap())
        .sum()
}

/// Panics if the process uses more than a fifth of a core during `span`.
#[track_caller]
fn assert_calm(process: &Process, span: Duration) {
    let (start, before) = (Instant::now(), ticks(process));
    thread::sleep(span);
    let used = Duration::from_millis(10 * (ticks(process) - before));
    let span = start.elapsed();
    assert!(used < span / 5, "{used:?} of the processor within {span:?}");
}

fn question() -> Vec<u8> {
    http_request(&encode_call("hasParam", params!["/c", "/x"]))
}

/// A connection that has been used and is kept open.
fn used(client: &Client) -> Wire {
    let mut wire = client.connect().unwrap();
    wire.send(&question()).unwrap();
    assert_eq!(wire.response().unwrap().code, 200);
    wire
}

/// `count` connections without a pending request. Some of them have been used before.
fn idle(client: &Client, count: usize) -> Vec<Wire> {
    let wire = |number| match number % 3 {
        0 => used(client),
        _ => client.connect().unwrap(),
    };
    (0..count).map(wire).collect()
}

#[test]
fn idle_connections_are_closed_to_make_room_and_their_clients_served_again() {
    let robot = Robot::start_with(Mode::Proxy, &["--max-connections", "40"]);
    let client = robot.client();
    let mut wires = idle(&client, 200);
    within(Duration::from_secs(10), "a write", || {
        client.set_param("/x", 1);
    });
    // The oldest one had to be closed, the newest one did not.
    assert!(wires[0].closes(PATIENCE));
    wires[199].send(&question()).unwrap();
    assert_eq!(wires[199].response().unwrap().code, 200);
    // Python's client, which rospy uses, does not notice.
    const NODE: &str = "
import os, select, socket, xmlrpc.client
master = xmlrpc.client.ServerProxy(os.environ['ROS_MASTER_URI'])
print(master.getParam('/c', '/x'))
kept = master('transport')._connection[1].sock
address = ('127.0.0.1', int(os.environ['ROS_MASTER_URI'].rsplit(':', 1)[1].strip('/')))
others = [socket.create_connection(address) for _ in range(100)]
assert select.select([kept], [], [], 60)[0], 'it was not closed'
print(master.setParam('/c', '/x', 2))
";
    let mut node = ros_command(&robot.scratch, "/usr/bin/python3", robot.port());
    let mut node = Process::start("a Python client", node.args(["-c", NODE]));
    assert!(node.wait().success());
    assert_eq!(robot.bare().param("/x"), Some(2.into()));
}

/// This uses the default limit of connections.
#[test]
fn two_thousand_idle_connections_take_little_memory() {
    let robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let wires = idle(&client, 2500);
    client.set_param("/x", 1);
    eventually("2,000 are left", || files(&robot.rescue) < 2050);
    assert!(files(&robot.rescue) > 2000);
    let memory = robot.rescue.kib("VmRSS") / 1000;
    assert!(memory < 64, "{memory} MB");
    drop(wires);
}

fn core_with_files(scratch: &Scratch, limit: usize) -> Rescue {
    let setup = Setup::core(scratch, free_port()).args(["--master-connections", "1"]);
    let setup = setup.wrapped(|own| {
        let mut shell = Command::new("sh");
        shell.args(["-c", &format!("ulimit -n {limit}; exec \"$0\" \"$@\"")]);
        behind(shell, own)
    });
    let rescue = setup.start();
    eventually("rosout is running", || {
        let node = params!["/c", "/rosout"];
        rescue.client().ask("lookupNode", node).is_some()
    });
    rescue
}

#[test]
fn with_few_file_descriptors_calls_are_served_and_recorded_beside_idle_connections() {
    for limit in [64, 1024] {
        let scratch = Scratch::new();
        let mut rescue = core_with_files(&scratch, limit);
        let client = rescue.client();
        client.set_param("/x", 1);
        let before = files(&rescue);
        let wires = idle(&client, limit + 100);
        within(Duration::from_secs(20), &format!("{limit} files"), || {
            for number in 0..20 {
                client.set_param("/x", number);
            }
        });
        assert_calm(&rescue, Duration::from_secs(1));
        // The master dies in the meantime.
        let dead = client.master_pid().unwrap();
        signal(dead, Signal::KILL);
        eventually("another master answers", || {
            client.master_pid().is_some_and(|pid| pid != dead)
                && client.ask("setParam", params!["/c", "/y", 2]).is_some()
        });
        assert_eq!(client.param("/x"), Some(19.into()));
        drop(wires);
        eventually("the file descriptors are closed again", || {
            files(&rescue) <= before
        });
        // All of it was recorded.
        rescue.kill();
        let text = fs::read_to_string(rescue.checkpoint()).unwrap();
        assert!(text.contains("/y"), "{text}");
    }
}

/// Incomplete request heads hold all connections for a while. Clients that wait for one must cost nothing.
#[test]
fn without_free_connections_or_file_descriptors_rosrescue_waits_without_busy_looping() {
    let scratch = Scratch::new();
    let rescue = core_with_files(&scratch, 1000);
    let client = rescue.client();
    client.set_param("/x", 1);
    let begun = |count| {
        let begin = |_| {
            let mut wire = client.connect().unwrap();
            wire.send(b"P").unwrap();
            wire
        };
        (0..count).map(begin).collect::<Vec<_>>()
    };
    let before = files(&rescue);
    let wires = begun(900);
    eventually("all connections are taken", || files(&rescue) > 650);
    assert_calm(&rescue, Duration::from_secs(2));
    drop(wires);
    client.set_param("/x", 2);
    eventually("the file descriptors are closed again", || {
        files(&rescue) <= before
    });
    // Another process lowers the limit of file descriptors.
    let pid = Pid::from_raw(i32::try_from(rescue.pid()).unwrap());
    let limit = |current| {
        let limit = Rlimit {
            current,
            maximum: Some(1000),
        };
        prlimit(pid, Resource::Nofile, limit).unwrap();
    };
    limit(Some(4));
    let wires = begun(5);
    let says = || {
        let log = rescue.output();
        log.iter()
            .filter(|line| line.contains("cannot accept"))
            .count()
    };
    eventually(
        "the log reports that connections cannot be accepted",
        || says() > 0,
    );
    assert_calm(&rescue, Duration::from_secs(2));
    assert!(says() <= 2, "the error must be logged once per address");
    limit(Some(1000));
    client.set_param("/x", 3);
    drop(wires);
    eventually("the file descriptors are closed again", || {
        files(&rescue) <= before
    });
}
