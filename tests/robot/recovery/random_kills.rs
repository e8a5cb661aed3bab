//! The paper's case 3: rosrescue, the master or both are killed again and again at any instant, while
//! the checkpoint is written too, under a stream of calls. What was acknowledged is there afterwards,
//! nothing that was deleted comes back, and a rospy or roscpp pair notices nothing.
//!
//! `ROSRESCUE_TEST_SECONDS` says how long each test goes on (15 if it is not set).

use std::sync::{Arc, Condvar, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::{
    Client, FakeNode, Library, Mode, PATIENCE, Robot, State, eventually, params, short,
};
use rosrescue::xmlrpc::{Struct, Value};

#[test]
fn rospy_core() {
    rounds(Library::Rospy, Mode::Core);
}

#[test]
fn rospy_proxy() {
    rounds(Library::Rospy, Mode::Proxy);
}

#[test]
fn roscpp_core() {
    rounds(Library::Roscpp, Mode::Core);
}

#[test]
fn roscpp_proxy() {
    rounds(Library::Roscpp, Mode::Proxy);
}

fn rounds(library: Library, mode: Mode) {
    let seconds = std::env::var("ROSRESCUE_TEST_SECONDS").map_or(15, |text| text.parse().unwrap());
    let end = Instant::now() + Duration::from_secs(seconds);
    let mut robot = Robot::start(mode);
    let talker = robot.node(library, "talker", &[]);
    let listener = robot.node(library, "listener", &[]);
    listener.wait_messages("/talker", 5);
    let others = robot.settled_state();
    let seed = u64::from(std::process::id()) | 1 << 40;
    let mut dice = Dice(seed);
    let writer = Writer::start(robot.client(), Dice(seed + 1));
    let mut done = 0;
    while Instant::now() < end || done < 5 {
        writer.go();
        thread::sleep(Duration::from_micros(dice.below(60_000)));
        let gap = Duration::from_micros(dice.below(5_000));
        let what = match dice.below(4) {
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
                let master = robot.master_pid();
                robot.rescue.kill();
                thread::sleep(gap);
                robot.kill_master_at_once(master);
                "rosrescue, then the master"
            }
        };
        writer.stop();
        if what != "the master" {
            robot.rescue.start_again();
        }
        if what != "rosrescue" {
            robot.revive_master();
        }
        // The writer says its last call again until it is acknowledged, as nodes do; then it rests.
        let ledger = writer.resting();
        robot.await_gate();
        done += 1;
        let when = format!("after round {done} ({what} killed; seed {seed})");
        assert_ledger(&ledger, &robot.state(), &when);
    }
    drop(writer);
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

/// What has been acknowledged.
#[derive(Clone, Debug, Default)]
struct Ledger {
    params: Struct,
    /// Topics that [`NODE`] publishes, in the order of their registration.
    topics: Vec<String>,
    services: Vec<String>,
}

const NODE: &str = "/ledger_node";

fn assert_ledger(ledger: &Ledger, state: &State, when: &str) {
    let params = state.params.as_struct().unwrap();
    let params = params
        .get("ledger")
        .and_then(Value::as_struct)
        .cloned()
        .unwrap_or_default();
    for (key, value) in &ledger.params {
        let found = params.get(key);
        assert!(
            found == Some(value),
            "lost {when}: /ledger/{key} is {}, not {}",
            short(found),
            short(value)
        );
    }
    for key in params.keys() {
        assert!(
            ledger.params.contains_key(key),
            "back {when}: /ledger/{key} was deleted"
        );
    }
    let of_node = |table: &[(String, Vec<String>)]| -> Vec<String> {
        let own = table
            .iter()
            .filter(|(_, nodes)| nodes.iter().any(|node| node == NODE));
        own.map(|(name, _)| name.clone()).collect()
    };
    assert_eq!(
        of_node(&state.publishers),
        ledger.topics,
        "publications {when}"
    );
    assert_eq!(of_node(&state.services), ledger.services, "services {when}");
    let keys: Vec<_> = params.keys().collect();
    assert_eq!(
        keys,
        ledger.params.keys().collect::<Vec<_>>(),
        "order of the parameters {when}"
    );
}

/// A small generator (xorshift): the instants must differ, nothing more.
struct Dice(u64);

impl Dice {
    fn below(&mut self, end: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % end
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Order {
    Go,
    Stop,
    End,
}

#[derive(Debug)]
struct Shared {
    order: Order,
    rests: bool,
    ledger: Ledger,
}

/// A thread that changes the master's state as fast as it can, one call after the other.
struct Writer {
    shared: Arc<(Mutex<Shared>, Condvar)>,
    thread: Option<thread::JoinHandle<()>>,
}

impl Writer {
    fn start(client: Client, dice: Dice) -> Self {
        let shared = Arc::new((
            Mutex::new(Shared {
                order: Order::Stop,
                rests: true,
                ledger: Ledger::default(),
            }),
            Condvar::new(),
        ));
        let theirs = Arc::clone(&shared);
        let thread = thread::spawn(move || write(&theirs, &client, dice));
        Self {
            shared,
            thread: Some(thread),
        }
    }

    fn order(&self, order: Order) {
        let (shared, changed) = &*self.shared;
        let mut shared = shared.lock().unwrap();
        shared.order = order;
        if order == Order::Go {
            shared.rests = false;
        }
        drop(shared);
        changed.notify_all();
    }

    fn go(&self) {
        self.order(Order::Go);
    }

    fn stop(&self) {
        self.order(Order::Stop);
    }

    /// The ledger, once the last call is acknowledged.
    fn resting(&self) -> Ledger {
        eventually("the writer's last call is acknowledged", || {
            self.shared.0.lock().unwrap().rests
        });
        self.shared.0.lock().unwrap().ledger.clone()
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.order(Order::End);
        let ended = self.thread.take().unwrap().join();
        if !thread::panicking() {
            ended.expect("the writer failed");
        }
    }
}

fn write(shared: &(Mutex<Shared>, Condvar), client: &Client, mut dice: Dice) {
    let node = FakeNode::start(NODE);
    let mut count = 0;
    loop {
        let (lock, changed) = shared;
        let mut now = lock.lock().unwrap();
        while now.order == Order::Stop {
            now.rests = true;
            now = changed.wait(now).unwrap();
        }
        if now.order == Order::End {
            return;
        }
        drop(now);
        count += 1;
        one_call(shared, client, &node, &mut dice, count);
    }
}

/// One call, said again until it is answered, and entered in the ledger.
fn one_call(
    shared: &(Mutex<Shared>, Condvar),
    client: &Client,
    node: &FakeNode,
    dice: &mut Dice,
    count: i32,
) {
    let (name, api) = (node.name.as_str(), node.api.as_str());
    let key = format!("k{}", dice.below(40));
    let path = format!("/ledger/{key}");
    let ledger = shared.0.lock().unwrap().ledger.clone();
    let enter = |change: &dyn Fn(&mut Ledger)| change(&mut shared.0.lock().unwrap().ledger);
    match dice.below(8) {
        0 if ledger.params.contains_key(&key) => {
            insist(client, shared, "deleteParam", params![name, path.as_str()]);
            enter(&|ledger| {
                ledger.params.shift_remove(&key);
            });
        }
        1 => {
            // So large that it is written in pieces.
            let value = Value::String(format!("{count} {}", "x".repeat(200_000)));
            let params = [params![name, "/ledger/ballast"], vec![value.clone()]].concat();
            insist(client, shared, "setParam", params);
            enter(&|ledger| {
                ledger.params.insert("ballast".to_owned(), value.clone());
            });
        }
        2 if ledger.topics.contains(&path) => {
            node.claim_publication(&path, None);
            insist(
                client,
                shared,
                "unregisterPublisher",
                params![name, path.as_str(), api],
            );
            enter(&|ledger| ledger.topics.retain(|topic| *topic != path));
        }
        2 | 3 => {
            node.claim_publication(&path, Some("std_msgs/String"));
            let params = params![name, path.as_str(), "std_msgs/String", api];
            insist(client, shared, "registerPublisher", params);
            enter(&|ledger| {
                if !ledger.topics.contains(&path) {
                    ledger.topics.push(path.clone());
                }
            });
        }
        4 if ledger.services.contains(&path) => {
            let params = params![name, path.as_str(), node.service_api()];
            insist(client, shared, "unregisterService", params);
            enter(&|ledger| ledger.services.retain(|service| *service != path));
        }
        4 => {
            let params = params![name, path.as_str(), node.service_api(), api];
            insist(client, shared, "registerService", params);
            enter(&|ledger| {
                if !ledger.services.contains(&path) {
                    ledger.services.push(path.clone());
                }
            });
        }
        _ => {
            insist(
                client,
                shared,
                "setParam",
                params![name, path.as_str(), count],
            );
            enter(&|ledger| {
                ledger.params.insert(key.clone(), count.into());
            });
        }
    }
}

/// Sends a call until it is answered. Any answer of the master is a success here, but for the second
/// deletion of a parameter: the first one may have been done and its answer lost.
fn insist(client: &Client, shared: &(Mutex<Shared>, Condvar), method: &str, params: Vec<Value>) {
    let start = Instant::now();
    for attempt in 0.. {
        match client.status(method, params.clone()) {
            Ok((1, ..)) => return,
            Ok((-1, text, _)) if method == "deleteParam" && attempt > 0 => {
                assert!(text.ends_with("is not set"), "{text}");
                return;
            }
            Ok(other) => panic!("{method}{}: {other:?}", short(&params)),
            Err(error) => {
                assert!(
                    start.elapsed() < PATIENCE,
                    "{method}{}: {error}",
                    short(&params)
                );
                if shared.0.lock().unwrap().order == Order::End {
                    return;
                }
                thread::sleep(Duration::from_millis(5));
            }
        }
    }
}
