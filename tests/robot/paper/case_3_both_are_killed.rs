//! The paper's case 3: rosrescue, the master or both are killed again and again at random moments during a stream of
//! calls, also while the checkpoint is written. Afterwards everything that was acknowledged is there, nothing that was
//! deleted comes back, and a rospy and a roscpp node notice nothing.
//!
//! `ROSRESCUE_TEST_SECONDS` sets how long each test runs (10 by default).

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::{Struct, Value};

use crate::support::{
    Client, FakeNode, Finish, Library, Mode, PATIENCE, Robot, State, in_both_modes, params, short,
    unordered,
};

in_both_modes!(nothing_acknowledged_is_lost);

fn nothing_acknowledged_is_lost(mode: Mode) {
    let seconds = std::env::var("ROSRESCUE_TEST_SECONDS").map_or(10, |text| text.parse().unwrap());
    let end = Instant::now() + Duration::from_secs(seconds);
    let mut robot = Robot::start(mode);
    let (talking, listening) = match mode {
        Mode::Core => (Library::Rospy, Library::Roscpp),
        Mode::Proxy => (Library::Roscpp, Library::Rospy),
    };
    let talker = robot.node(talking, "talker", &[]);
    let listener = robot.node(listening, "listener", &[]);
    listener.wait_messages("/talker", 5);
    let others = robot.settled_state();
    let seed = u64::from(std::process::id()) | 1 << 40;
    let mut dice = Dice(seed);
    let mut writer = Writer {
        client: robot.client(),
        node: FakeNode::start(NODE),
        dice: Dice(seed + 1),
        count: 0,
        ledger: Ledger::default(),
    };
    let mut done = 0;
    while Instant::now() < end || done < 5 {
        let master = robot.master_pid();
        let stop = AtomicBool::new(false);
        let what = thread::scope(|scope| {
            let finish = Finish(&stop);
            let writing = scope.spawn(|| writer.write(&stop));
            let what = kill(&mut robot, master, &mut dice);
            drop(finish);
            if what != "the master" {
                robot.rescue.start_again();
            }
            if what != "rosrescue" {
                robot.revive_master();
            }
            writing.join().expect("the writer failed");
            what
        });
        match what {
            "rosrescue" => robot.await_gate(),
            _ => robot.await_recovery(master),
        }
        done += 1;
        let when = format!("after round {done} ({what} killed; seed {seed})");
        assert_ledger(&writer.ledger, &robot.state(), &when);
    }
    println!("{done} rounds");
    listener.wait_messages("/talker", 20);
    listener.assert_no_message_lost("/talker");
    listener.assert_no_link_lost();
    talker.assert_no_link_lost();
    let now = robot.state();
    for node in ["/talker", "/listener"] {
        let address = |state: &State| state.nodes.iter().find(|(name, _)| name == node).cloned();
        assert_eq!(address(&others), address(&now));
    }
}

/// Kills rosrescue, the master or both at a random moment within the next 60 ms. Returns a description.
fn kill(robot: &mut Robot, master: u32, dice: &mut Dice) -> &'static str {
    thread::sleep(Duration::from_micros(dice.below(60_000)));
    let gap = Duration::from_micros(dice.below(5_000));
    match dice.below(4) {
        0 => {
            robot.rescue.kill();
            "rosrescue"
        }
        1 => {
            robot.kill_master();
            "the master"
        }
        2 => {
            robot.kill_master();
            thread::sleep(gap);
            robot.rescue.kill();
            "the master, then rosrescue"
        }
        _ => {
            robot.rescue.kill();
            thread::sleep(gap);
            robot.kill_master_at_once(master);
            "rosrescue, then the master"
        }
    }
}

/// All acknowledged registrations and parameters.
#[derive(Clone, Debug, Default)]
struct Ledger {
    params: Struct,
    /// Topics that [`NODE`] publishes, in the order of registration.
    topics: Vec<String>,
    services: Vec<String>,
}

const NODE: &str = "/ledger_node";

fn assert_ledger(ledger: &Ledger, state: &State, when: &str) {
    let params = state.params.as_struct().unwrap().get("ledger");
    let params = params
        .and_then(Value::as_struct)
        .cloned()
        .unwrap_or_default();
    for (key, value) in &ledger.params {
        let found = params.get(key);
        let (is, was) = (short(found), short(value));
        assert!(
            found == Some(value),
            "lost {when}: /ledger/{key} is {is}, not {was}"
        );
    }
    // Lists of an unordered master are read in alphabetical order.
    let in_order = |names: Vec<String>| match unordered() {
        true => names
            .into_iter()
            .collect::<BTreeSet<_>>()
            .into_iter()
            .collect(),
        false => names,
    };
    let keys: Vec<_> = params.keys().cloned().collect();
    let wanted = in_order(ledger.params.keys().cloned().collect());
    assert_eq!(keys, wanted, "the keys or their order differ {when}");
    let of_node = |table: &[(String, Vec<String>)]| -> Vec<String> {
        let own = table
            .iter()
            .filter(|(_, nodes)| nodes.iter().any(|node| node == NODE));
        own.map(|(name, _)| name.clone()).collect()
    };
    assert_eq!(
        of_node(&state.publishers),
        in_order(ledger.topics.clone()),
        "publications {when}"
    );
    let services = in_order(ledger.services.clone());
    assert_eq!(of_node(&state.services), services, "services {when}");
}

/// A small random number generator (xorshift) for the moments of kills.
struct Dice(u64);

impl Dice {
    fn below(&mut self, end: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % end
    }
}

/// Makes calls that change the master's state, one after another, as fast as they are answered.
struct Writer {
    client: Client,
    node: FakeNode,
    dice: Dice,
    count: i32,
    ledger: Ledger,
}

impl Writer {
    /// Makes calls until `stop` is set and the last call has been acknowledged.
    fn write(&mut self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            self.count += 1;
            self.one_call();
        }
    }

    /// Makes one call, repeated until it is answered as nodes do, and records it.
    fn one_call(&mut self) {
        let (name, api, count) = (NODE, self.node.api.clone(), self.count);
        let key = format!("k{}", self.dice.below(40));
        let path = format!("/ledger/{key}");
        let (service_api, path_text) = (self.node.service_api(), path.as_str());
        match self.dice.below(8) {
            0 if self.ledger.params.contains_key(&key) => {
                self.insist("deleteParam", params![name, path_text]);
                self.ledger.params.shift_remove(&key);
            }
            1 => {
                // The value is so large that it is written in several pieces.
                let value = Value::String(format!("{count} {}", "x".repeat(200_000)));
                self.insist("setParam", params![name, "/ledger/ballast", value.clone()]);
                self.ledger.params.insert("ballast".to_owned(), value);
            }
            2 if self.ledger.topics.contains(&path) => {
                self.node.claim_publication(&path, None);
                self.insist("unregisterPublisher", params![name, path_text, api]);
                self.ledger.topics.retain(|topic| *topic != path);
            }
            2 | 3 => {
                self.node.claim_publication(&path, Some("std_msgs/String"));
                let params = params![name, path_text, "std_msgs/String", api];
                self.insist("registerPublisher", params);
                enter(&mut self.ledger.topics, path);
            }
            4 if self.ledger.services.contains(&path) => {
                self.insist("unregisterService", params![name, path_text, service_api]);
                self.ledger.services.retain(|service| *service != path);
            }
            4 => {
                let params = params![name, path_text, service_api, api];
                self.insist("registerService", params);
                enter(&mut self.ledger.services, path);
            }
            _ => {
                self.insist("setParam", params![name, path_text, count]);
                self.ledger.params.insert(key, count.into());
            }
        }
    }

    /// Repeats a call until it is answered. Any answer of the master counts as success, except for the second
    /// deletion of a parameter: the first one may have been done and its answer lost.
    fn insist(&self, method: &str, params: Vec<Value>) {
        let start = Instant::now();
        for attempt in 0.. {
            match self.client.status(method, params.clone()) {
                Ok((1, ..)) => return,
                Ok((-1, text, _)) if method == "deleteParam" && attempt > 0 => {
                    assert!(text.ends_with("is not set"), "{text}");
                    return;
                }
                Ok(other) => panic!("{method}{}: {other:?}", short(&params)),
                Err(error) => {
                    let waited = start.elapsed();
                    assert!(waited < PATIENCE, "{method}{}: {error}", short(&params));
                    thread::sleep(Duration::from_millis(5));
                }
            }
        }
    }
}

fn enter(list: &mut Vec<String>, name: String) {
    if !list.contains(&name) {
        list.push(name);
    }
}
