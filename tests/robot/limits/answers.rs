//! Large answers that clients do not read take a limited part of the memory and do not delay answers to
//! others.

use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    Mode, Robot, Wire, encode_call, eventually_some, http_request, in_both_modes, params,
};

/// Size of the answer in bytes.
const LARGE: usize = 5_000_000;
/// Number of clients. Their answers take more than three times the memory that is available.
const CLIENTS: usize = 90;
/// Maximum memory that these clients may use, in MB: the 128 MB reserved for answers, plus the answers that are being
/// encoded. It once was 240 MB.
const COST: u64 = (CLIENTS * LARGE / 1_000_000) as u64 * 2 / 3;

in_both_modes!(large_answers_that_are_not_read_take_limited_memory_and_delay_no_other);

fn large_answers_that_are_not_read_take_limited_memory_and_delay_no_other(mode: Mode) {
    let robot = Robot::start(mode);
    let client = robot.client();
    client.set_param("/large", "x".repeat(LARGE));
    client.set_param("/other", "y".repeat(LARGE));
    client.set_param("/small", 1);
    let memory = |name| robot.rescue.kib(name) / 1000;
    let before = memory("VmRSS");
    // Two answers in turn, because equal answers in a row share their bytes.
    let questions = ["/large", "/other"]
        .map(|key| http_request(&encode_call("getParam", params!["/hostile", key])));
    let ask = |number: usize| {
        let mut wire = client.connect().unwrap();
        wire.send(&questions[number % 2]).unwrap();
        wire
    };
    let start = Instant::now();
    let wires: Vec<Wire> = (0..CLIENTS).map(ask).collect();
    // During this load, other clients make a small call and read a large answer.
    let read = || {
        let start = Instant::now();
        assert_eq!(client.param("/small"), Some(1.into()));
        let small = start.elapsed();
        // Like ROS clients, the test repeats the call after a lost connection. Only the answer counts: how soon it
        // arrives depends on how fast this build encodes the other answers.
        let answer = eventually_some("a large answer", || client.param("/large"));
        assert_eq!(answer.as_str().map(str::len), Some(LARGE));
        (small, start.elapsed())
    };
    let at_once = read();
    thread::sleep(Duration::from_secs(10).saturating_sub(start.elapsed()));
    let later = read();
    let (peak, now) = (memory("VmHWM"), memory("VmRSS"));
    println!(
        "{mode:?}: {before} MB before, {now} MB while {CLIENTS} do not read, {peak} MB at most; \
         others have got their answers (a small one, then a large one) after {at_once:?} and {later:?}"
    );
    assert!(
        peak < before + COST,
        "memory grew from {before} MB to {peak} MB"
    );
    drop(wires);
}

/// A client that reads slowly is not disconnected while there is memory.
#[test]
fn a_slow_reader_gets_its_complete_answer() {
    let robot = Robot::start(Mode::Core);
    let client = robot.client();
    client.set_param("/large", "x".repeat(LARGE));
    let mut wire = client.connect().unwrap();
    let question = http_request(&encode_call("getParam", params!["/slow", "/large"]));
    wire.send(&question).unwrap();
    thread::sleep(Duration::from_secs(2));
    let answer = wire.response().unwrap();
    assert_eq!(answer.code, 200);
    assert!(answer.text().len() > LARGE);
}
