//! What others can take of rosrescue is bounded: places for connections, file descriptors. Whoever has a call is
//! served all the while.

use std::fs;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    Client, Mode, PATIENCE, Process, Rescue, Robot, Scratch, Setup, Wire, behind, encode_call,
    eventually, free_port, http_request, params, ros_command, signal,
};
use rustix::process::{Pid, Resource, Rlimit, Signal, prlimit};

/// Open file descriptors.
fn files(process: &Process) -> usize {
    fs::read_dir(format!("/proc/{}/fd", process.pid()))
        .unwrap()
        .count()
}

/// Processor time so far, in hundredths of a second.
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

/// While `span` lasts, less than a fifth of a core is used.
#[track_caller]
fn assert_calm(process: &Process, span: Duration) {
    let before = ticks(process);
    thread::sleep(span);
    let used = Duration::from_millis(10 * (ticks(process) - before));
    assert!(used < span / 5, "{used:?} of the processor within {span:?}");
}

fn question() -> Vec<u8> {
    http_request(&encode_call("hasParam", params!["/c", "/x"]))
}

/// A connection that has been used and is kept.
fn used(client: &Client) -> Wire {
    let mut wire = client.connect().unwrap();
    wire.send(&question()).unwrap();
    assert_eq!(wire.response().unwrap().code, 200);
    wire
}

/// `count` connections without a request, some of them used before.
fn idle(client: &Client, count: usize) -> Vec<Wire> {
    let wire = |number| match number % 3 {
        0 => used(client),
        _ => client.connect().unwrap(),
    };
    (0..count).map(wire).collect()
}

#[test]
fn idle_connections_give_way_and_their_clients_are_served_again() {
    let robot = Robot::start_with(Mode::Proxy, &["--max-connections", "40"]);
    let client = robot.client();
    let mut wires = idle(&client, 200);
    let start = Instant::now();
    client.set_param("/x", 1);
    let took = start.elapsed();
    assert!(took < Duration::from_secs(10), "{took:?}");
    // The oldest had to go, the youngest had not.
    assert!(wires[0].closes(PATIENCE));
    wires[199].send(&question()).unwrap();
    assert_eq!(wires[199].response().unwrap().code, 200);
    // Python's client, which all of rospy uses, does not notice.
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

/// However many there are by default.
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
    eventually("rosout is at work", || {
        let node = params!["/c", "/rosout"];
        rescue.client().ask("lookupNode", node).is_some()
    });
    rescue
}

#[test]
fn with_few_files_calls_are_served_recorded_and_recovered_under_idle_connections() {
    for limit in [64, 128, 200, 1024] {
        let scratch = Scratch::new();
        let mut rescue = core_with_files(&scratch, limit);
        let client = rescue.client();
        client.set_param("/x", 1);
        let before = files(&rescue);
        let wires = idle(&client, limit + 100);
        let start = Instant::now();
        for number in 0..20 {
            client.set_param("/x", number);
        }
        let took = start.elapsed();
        assert!(took < Duration::from_secs(20), "{limit} files: {took:?}");
        assert_calm(&rescue, Duration::from_secs(1));
        // The master dies meanwhile.
        let dead = client.master_pid().unwrap();
        signal(dead, Signal::KILL);
        eventually("there is another master", || {
            client.master_pid().is_some_and(|pid| pid != dead)
                && client.ask("setParam", params!["/c", "/y", 2]).is_some()
        });
        assert_eq!(client.param("/x"), Some(19.into()));
        drop(wires);
        eventually("the files are given back", || files(&rescue) <= before);
        // It was all recorded.
        rescue.kill();
        let text = fs::read_to_string(rescue.checkpoint()).unwrap();
        assert!(text.contains("/y"), "{text}");
    }
}

/// Heads that are never ended hold all places for a while, and who waits for one costs nothing.
#[test]
fn without_places_or_files_it_waits_calmly() {
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
    eventually("the places are taken", || files(&rescue) > 650);
    assert_calm(&rescue, Duration::from_secs(2));
    drop(wires);
    client.set_param("/x", 2);
    eventually("the files are given back", || files(&rescue) <= before);
    // Somebody takes the files away.
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
    eventually("it is said", || says() > 0);
    assert_calm(&rescue, Duration::from_secs(2));
    assert!(says() <= 2, "once for each address");
    limit(Some(1000));
    client.set_param("/x", 3);
    drop(wires);
    eventually("the files are given back", || files(&rescue) <= before);
}
