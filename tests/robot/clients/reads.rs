//! Reads that the mirror answers while there is a master.

use std::sync::atomic::{AtomicI32, Ordering};
use std::thread;

use ros1_master::xmlrpc::Value;

use crate::support::{Mode, Robot, eventually, tree};

const WRITERS: usize = 6;
const READERS: usize = 4;

/// This holds whichever connection makes the read, and for small and large answers.
fn a_read_returns_every_acknowledged_write(mode: Mode) {
    let robot = Robot::start_with(mode, &["--reads", "mirror"]);
    for (bytes, rounds) in [(10, 60), (200_000, 20)] {
        robot
            .client()
            .set_param("/writer", tree! {"filler" => "x".repeat(bytes)});
        write_and_read(&robot, rounds);
    }
    assert!(robot.counter("calls_from_mirror") > 100);
}

fn write_and_read(robot: &Robot, rounds: i32) {
    let acknowledged = [const { AtomicI32::new(0) }; WRITERS];
    let is_over = || {
        acknowledged
            .iter()
            .all(|last| last.load(Ordering::SeqCst) == rounds)
    };
    thread::scope(|scope| {
        for (number, last) in acknowledged.iter().enumerate() {
            let client = robot.client();
            scope.spawn(move || {
                for round in 1..=rounds {
                    client.set_param(&format!("/writer/{number}"), round);
                    last.store(round, Ordering::SeqCst);
                }
            });
        }
        for _ in 0..READERS {
            let client = robot.client();
            let acknowledged = &acknowledged;
            scope.spawn(move || {
                while !is_over() {
                    let before: Vec<_> = acknowledged
                        .iter()
                        .map(|last| last.load(Ordering::SeqCst))
                        .collect();
                    let tree = client.param("/writer");
                    let tree = tree.as_ref().and_then(Value::as_struct);
                    for (number, before) in before.into_iter().enumerate().filter(|(_, n)| *n > 0) {
                        let value = tree.and_then(|tree| tree.get(&number.to_string()));
                        let value = value.and_then(Value::as_int);
                        assert!(value >= Some(before), "{value:?} after {before}");
                    }
                }
            });
        }
    });
}

#[test]
fn a_core_answers_reads_while_its_master_hangs() {
    let robot = Robot::start(Mode::Core);
    let client = robot.client();
    client.set_param("/gain", 7);
    let before = robot.counter("calls_from_mirror");
    crate::support::stop(robot.master_pid());
    assert_eq!(client.param("/gain"), Some(7.into()));
    // rosout may make some of the reads.
    assert!(robot.counter("calls_from_mirror") > before);
}

/// With this option a core forwards reads like a proxy, behind which others may write directly to the master.
#[test]
fn a_core_forwards_reads_if_asked_to() {
    let robot = Robot::start_with(Mode::Core, &["--reads", "master"]);
    let client = robot.client();
    client.set_param("/gain", 7);
    let past = robot.bare();
    past.set_param("/gain", 8);
    // On a busy computer the mirror may answer once for a late master.
    eventually("the master answers", || {
        client.param("/gain") == Some(8.into())
    });
    assert_eq!(robot.counter("calls_from_mirror"), 0);
}

crate::support::in_both_modes!(a_read_returns_every_acknowledged_write);
