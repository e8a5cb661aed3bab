//! One client's writes do not delay those of others.

use std::thread;
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::{Call, Reply, Struct, Value};

use crate::support::{
    Client, Mode, Robot, Twins, encode_call, eventually, http_request, params, unreadable,
};

fn sets(name: &str, count: i32) -> impl Iterator<Item = Call> {
    let name = name.to_owned();
    (0..count).map(move |i| Call::new("setParam", params!["/test", format!("/{name}/p{i}"), i]))
}

/// The results of a multicall.
#[track_caller]
fn results(client: &Client, calls: impl IntoIterator<Item = Call>) -> Vec<Value> {
    let Call { method, params } = Call::multicall(calls);
    match client.call(&method, params) {
        Ok(Reply::Value(Value::Array(results))) => results,
        other => panic!("{other:?}"),
    }
}

/// The times that each `setParam` takes while `load` runs, and the time that `load` takes.
fn waits_beside(client: &Client, load: impl FnOnce() + Send) -> (Vec<Duration>, Duration) {
    thread::scope(|scope| {
        let start = Instant::now();
        let load = scope.spawn(move || {
            load();
            start.elapsed()
        });
        let mut waits = Vec::new();
        while !load.is_finished() {
            let sent = Instant::now();
            // A value that does not change would not have to wait.
            client.set_param("/mine", i32::try_from(waits.len()).unwrap());
            waits.push(sent.elapsed());
        }
        (waits, load.join().unwrap())
    })
}

#[test]
fn other_writes_are_not_delayed_by_a_long_multicall() {
    let robot = Robot::start(Mode::Core);
    let client = robot.client();
    let Call { method, params } = Call::multicall(sets("long", 10_000));
    let request = http_request(&encode_call(&method, params));
    let (waits, time) = waits_beside(&client, || {
        client.exchange(&request).unwrap();
    });
    let longest = waits.iter().max().unwrap();
    // A pause of the computer delays one write.
    let prompt = waits.iter().filter(|wait| **wait < time / 4).count();
    println!(
        "{} writes, {prompt} of them promptly, {longest:?} at most, in {time:?}",
        waits.len()
    );
    assert!(prompt >= 10, "{waits:?} of {time:?}");
}

#[test]
fn a_long_multicall_is_answered_as_by_a_bare_master() {
    let twins = Twins::start();
    let of = |method: &str, params: Vec<Value>| Call::new(method, params);
    let mixed = |i: i32| {
        let name = format!("/long/{i}");
        let api = "http://127.0.0.1:1/";
        [
            of("setParam", params!["/test", name.clone(), i]),
            of("setParam", params!["/test", "/", i]),
            of("setParam", params!["/test"]),
            of("deleteParam", params!["/test", format!("/long/{}", i / 2)]),
            of("hasParam", params!["/test", name.clone()]),
            of(
                "registerService",
                params!["/test", name.clone(), "rosrpc://127.0.0.1:2", api],
            ),
            of("lookupService", params!["/test", name.clone()]),
            of(
                "unregisterService",
                params!["/test", name, "rosrpc://127.0.0.1:3"],
            ),
        ]
    };
    // More than the 200 calls that are forwarded as they come.
    let calls: Vec<_> = (0..40).flat_map(mixed).collect();
    let Reply::Value(Value::Array(results)) = ({
        let Call { method, params } = Call::multicall(calls.clone());
        twins.same_call(&method, params)
    }) else {
        panic!("no list")
    };
    assert_eq!(results.len(), calls.len());
    // Entries with results that depend on each other.
    let read = of("getParam", params!["/test", "/long"]);
    let unknown = of("no_such_method", params![]);
    let nested = Call::multicall([unknown.clone()]);
    for last in [read, unknown, nested] {
        let calls = calls.iter().cloned().chain([last]);
        let Call { method, params } = Call::multicall(calls);
        twins.same_call(&method, params);
    }
    // Together more than the 1 MiB that are forwarded as they come.
    let large: Value = "<&>".repeat(1 << 17).into();
    let calls = (0..3).map(|_| of("setParam", params!["/test", "/large", large.clone()]));
    let Call { method, params } = Call::multicall(calls);
    twins.same_call(&method, params);
    let whole = |client: &Client| client.call("getParam", params!["/test", "/"]).unwrap();
    assert_eq!(whole(&twins.behind), whole(&twins.bare));
}

/// The parts that the dead master has answered are kept, and the mirror answers the rest.
#[test]
fn a_long_multicall_survives_the_death_of_the_master() {
    const COUNT: i32 = 5_000;
    let mut robot = Robot::start(Mode::Core);
    let client = robot.client();
    let dead = robot.master_pid();
    let results = thread::scope(|scope| {
        let long = scope.spawn(|| results(&client, sets("long", COUNT)));
        let bare = robot.bare();
        eventually("a part of the multicall has run", || {
            bare.param("/long/p1000").is_some() || long.is_finished()
        });
        robot.kill_master_at_once(dead);
        long.join().unwrap()
    });
    let set = |i| {
        let done = params![1, format!("parameter /long/p{i} set"), 0];
        Value::from(vec![Value::from(done)])
    };
    assert_eq!(results, (0..COUNT).map(set).collect::<Vec<_>>());
    robot.await_recovery(dead);
    let Some(Value::Struct(long)) = robot.bare().param("/long") else {
        panic!("no parameters")
    };
    assert_eq!(long.len(), COUNT as usize);
}

/// rosrescue must read the master's state before it answers such calls. They share that read.
#[test]
fn other_writes_are_not_delayed_by_calls_that_only_the_master_understands() {
    const CALLS: i32 = 40;
    let robot = Robot::start(Mode::Core);
    let client = robot.client();
    let many = (0..5_000).map(|i| (format!("p{i}"), Value::from(format!("the value of {i}"))));
    client.set_param("/many", Value::Struct(Struct::from_iter(many)));
    let measure_alone = || {
        let start = Instant::now();
        for value in 0..100 {
            client.set_param("/mine", value);
        }
        start.elapsed() / 100
    };
    let before = measure_alone();
    let (waits, time) = waits_beside(&client, || {
        thread::scope(|scope| {
            for number in 0..CALLS {
                let request = unreadable(&format!("/unreadable_{number}"), number);
                let client = &client;
                scope.spawn(move || client.exchange(&request).unwrap());
                thread::sleep(Duration::from_millis(70));
            }
        });
    });
    // This computer may have become busy.
    let alone = before.max(measure_alone());
    println!(
        "{} writes in {time:?}; without load {alone:?} each",
        waits.len()
    );
    let possible = time.as_secs_f64() / alone.as_secs_f64();
    assert!(waits.len() as f64 > possible / 16.0, "{possible} alone");
    for number in 0..CALLS {
        let key = format!("/unreadable_{number}");
        assert_eq!(robot.bare().param(&key), Some(number.into()));
    }
}
