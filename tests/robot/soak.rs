//! Random deaths and stops while calls are made, on a disk that hangs, slows down, fills up and becomes read-only at
//! random. Whenever the calls pause, the state must equal the acknowledged calls.
//!
//! When rosrescue and the master end together, only recorded calls must survive: everything that was acknowledged
//! before a status said that changes are recorded.
//!
//! `ROSRESCUE_SOAK_SECONDS` is the length. `ROSRESCUE_SEED` repeats the random numbers of an earlier run.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use crate::support::links::Dice;
use crate::support::{
    Client, FailingDisk, FakeNode, Finish, PATIENCE, Rescue, Scratch, Setup, State, Trouble,
    eventually, free_port, holds, params, signal,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

const WRITERS: usize = 4;
/// Number of parameters, topics and services of each writer.
const NAMES: u64 = 4;
/// Pause before a call is repeated.
const AGAIN: Duration = Duration::from_millis(20);
/// Maximum time for which the disk stays in one state, in ms. A start waits 20 s for a disk that hangs.
const TROUBLE_MS: u64 = 8000;

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The state of one writer in the master.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Own {
    params: BTreeMap<String, i32>,
    published: BTreeSet<String>,
    subscribed: BTreeSet<String>,
    offered: BTreeSet<String>,
}

/// The effect of a call on a writer's state.
#[derive(Clone, Debug)]
enum Step {
    Set(String, i32),
    Delete(String),
    Publish(String, bool),
    Subscribe(String, bool),
    Offer(String, bool),
}

impl Own {
    fn apply(&mut self, step: &Step) {
        let turn = |set: &mut BTreeSet<String>, name: &str, on| match on {
            true => set.insert(name.to_owned()),
            false => set.remove(name),
        };
        match step {
            Step::Set(key, value) => {
                self.params.insert(key.clone(), *value);
            }
            Step::Delete(key) => {
                self.params.remove(key);
            }
            Step::Publish(name, on) => {
                turn(&mut self.published, name, *on);
            }
            Step::Subscribe(name, on) => {
                turn(&mut self.subscribed, name, *on);
            }
            Step::Offer(name, on) => {
                turn(&mut self.offered, name, *on);
            }
        }
    }

    /// The state of writer `index` in the master at `client`.
    fn read(client: &Client, index: usize) -> Self {
        let state = State::read(client);
        let (space, node) = (space(index), format!("/soaked_{index}"));
        let of = |list: &[(String, Vec<String>)]| {
            let own = list
                .iter()
                .filter(|(name, nodes)| name.starts_with(&space) && nodes.contains(&node));
            own.map(|(name, _)| name.clone()).collect()
        };
        let mut params = BTreeMap::new();
        if let Some(Value::Struct(values)) = client.param(space.trim_end_matches('/')) {
            for (key, value) in &values {
                let value = value.as_int().expect("a number");
                params.insert(format!("{space}{key}"), value);
            }
        }
        Self {
            params,
            published: of(&state.publishers),
            subscribed: of(&state.subscribers),
            offered: of(&state.services),
        }
    }
}

fn space(index: usize) -> String {
    format!("/soak/w{index}/")
}

/// The acknowledged states of a writer.
#[derive(Debug, Default)]
struct Past {
    /// The states after each call since the last pause. There is always at least one.
    states: Vec<Own>,
    last: Option<Step>,
    /// Index of the oldest state that may be restored after rosrescue and the master ended together.
    owed: usize,
}

struct Writer {
    index: usize,
    client: Client,
    node: FakeNode,
    past: Mutex<Past>,
    parked: AtomicBool,
}

/// Flags shared by all threads.
#[derive(Default)]
struct Flags {
    pause: AtomicBool,
    over: AtomicBool,
    calls: AtomicU32,
    repeated: AtomicU32,
}

impl Writer {
    fn new(index: usize, client: Client) -> Self {
        let past = Past {
            states: vec![Own::default()],
            ..Past::default()
        };
        Self {
            index,
            client,
            node: FakeNode::start(&format!("/soaked_{index}")),
            past: Mutex::new(past),
            parked: AtomicBool::new(false),
        }
    }

    fn run(&self, mut dice: Dice, flags: &Flags) {
        for value in 1.. {
            while flags.pause.load(Ordering::SeqCst) {
                self.parked.store(true, Ordering::SeqCst);
                if flags.over.load(Ordering::SeqCst) {
                    return;
                }
                sleep(Duration::from_millis(1));
            }
            self.parked.store(false, Ordering::SeqCst);
            if flags.over.load(Ordering::SeqCst) {
                return;
            }
            let name = format!("{}n{}", space(self.index), dice.below(NAMES));
            let on = dice.below(2) == 0;
            let step = match dice.below(8) {
                0..4 => Step::Set(name, value),
                4 => Step::Delete(name),
                5 => Step::Publish(name, on),
                6 => Step::Subscribe(name, on),
                _ => Step::Offer(name, on),
            };
            if !self.make(&step, flags) {
                return;
            }
            let mut past = lock(&self.past);
            let mut state = past.states.last().unwrap().clone();
            state.apply(&step);
            past.states.push(state);
            past.last = Some(step);
            drop(past);
            flags.calls.fetch_add(1, Ordering::Relaxed);
            sleep(Duration::from_micros(dice.below(4000)));
        }
    }

    /// Repeats the call of `step` until it is answered, like nodes do. Returns false at the end of the test.
    fn make(&self, step: &Step, flags: &Flags) -> bool {
        const TYPE: &str = "std_msgs/String";
        let (node, api) = (self.node.name.as_str(), self.node.api.as_str());
        let service_api = self.node.service_api();
        let (method, params) = match step {
            Step::Set(key, value) => ("setParam", params![node, key.as_str(), *value]),
            Step::Delete(key) => ("deleteParam", params![node, key.as_str()]),
            Step::Publish(topic, on) => {
                self.node.claim_publication(topic, on.then_some(TYPE));
                match on {
                    true => (
                        "registerPublisher",
                        params![node, topic.as_str(), TYPE, api],
                    ),
                    false => ("unregisterPublisher", params![node, topic.as_str(), api]),
                }
            }
            Step::Subscribe(topic, on) => {
                self.node.claim_subscription(topic, on.then_some(TYPE));
                match on {
                    true => (
                        "registerSubscriber",
                        params![node, topic.as_str(), TYPE, api],
                    ),
                    false => ("unregisterSubscriber", params![node, topic.as_str(), api]),
                }
            }
            Step::Offer(service, true) => (
                "registerService",
                params![node, service.as_str(), service_api.as_str(), api],
            ),
            Step::Offer(service, false) => (
                "unregisterService",
                params![node, service.as_str(), service_api.as_str()],
            ),
        };
        while self.client.call(method, params.clone()).is_err() {
            flags.repeated.fetch_add(1, Ordering::Relaxed);
            if flags.over.load(Ordering::SeqCst) {
                return false;
            }
            sleep(AGAIN);
        }
        true
    }

    /// Makes the node report what `state` contains, so that the health check corrects the rest.
    fn claim(&self, state: &Own) {
        const TYPE: &str = "std_msgs/String";
        for number in 0..NAMES {
            let topic = format!("{}n{number}", space(self.index));
            let of = |topics: &BTreeSet<String>| topics.contains(&topic).then_some(TYPE);
            self.node.claim_publication(&topic, of(&state.published));
            self.node.claim_subscription(&topic, of(&state.subscribed));
        }
    }

    fn state(&self) -> Own {
        lock(&self.past).states.last().unwrap().clone()
    }

    /// Whether `found` is a state that may be restored: the one after some number of recorded calls, perhaps with the
    /// call that was running then.
    fn leads_to(&self, found: &Own) -> bool {
        let past = lock(&self.past);
        past.states[past.owed..].iter().any(|state| {
            let mut with_last = state.clone();
            past.last.iter().for_each(|step| with_last.apply(step));
            state == found || with_last == *found
        })
    }

    /// Notes, during a pause, that the writer's state is `state`. States that are not recorded may still be lost, so
    /// earlier states stay possible.
    fn is_in(&self, state: Own, is_recorded: bool) {
        let mut past = lock(&self.past);
        if is_recorded {
            *past = Past::default();
        }
        past.states.push(state);
        past.last = None;
    }
}

/// rosrescue with its master, disk and callers.
struct Stage<'a> {
    scratch: &'a Scratch,
    disk: &'a FailingDisk,
    rescue: Rescue,
    bare: Client,
    writers: &'a [Writer],
    flags: &'a Flags,
    tally: BTreeMap<&'static str, u32>,
}

impl Stage<'_> {
    fn client(&self) -> Client {
        self.rescue.client()
    }

    /// A field of the status. `None` if there is no answer.
    fn status(&self, field: &str) -> Option<serde_json::Value> {
        let get = b"GET /status.json HTTP/1.1\r\nHost: localhost\r\n\r\n";
        let response = self.client().exchange(get).ok()?;
        let status: serde_json::Value = serde_json::from_slice(&response.body).ok()?;
        Some(status[field].clone())
    }

    fn worker(&self) -> Option<u32> {
        u32::try_from(self.status("pid")?.as_u64()?).ok()
    }

    /// Waits until calls pass to a master through a worker other than `dead`.
    #[track_caller]
    fn await_service(&self, dead: Option<u32>) {
        let is_so = || {
            self.status("open") == Some(true.into())
                && self.worker().is_some_and(|pid| Some(pid) != dead)
        };
        // Masters and workers start slowly on a computer that is busy with other tests.
        let never = holds(3 * PATIENCE, || !is_so());
        assert!(!never, "no calls pass to a master: {}", self.rescue.log());
    }

    /// Marks everything acknowledged so far as required after a loss, if rosrescue reports that it is recorded.
    fn note_what_is_owed(&self) -> bool {
        let of = |writer: &Writer| lock(&writer.past).states.len() - 1;
        let counts: Vec<_> = self.writers.iter().map(of).collect();
        let is_recorded = self.status("unprotected") == Some(serde_json::Value::Null);
        if is_recorded {
            for (writer, count) in self.writers.iter().zip(counts) {
                lock(&writer.past).owed = count;
            }
        }
        is_recorded
    }

    /// Pauses the calls. No call is running when this returns.
    #[track_caller]
    fn pause(&self) {
        self.flags.pause.store(true, Ordering::SeqCst);
        eventually("all calls have been answered", || {
            let parked = |writer: &Writer| writer.parked.load(Ordering::SeqCst);
            self.writers.iter().all(parked)
        });
    }

    fn go_on(&self) {
        self.flags.pause.store(false, Ordering::SeqCst);
        for writer in self.writers {
            writer.parked.store(false, Ordering::SeqCst);
        }
    }

    fn count(&mut self, what: &'static str) {
        *self.tally.entry(what).or_default() += 1;
    }

    /// Checks, during a pause, that the state is that of the acknowledged calls.
    #[track_caller]
    fn assert_state(&mut self) {
        self.pause();
        self.await_service(None);
        for (client, at) in [
            (self.client(), "through rosrescue"),
            (self.bare.clone(), "in the master"),
        ] {
            for writer in self.writers {
                let wanted = writer.state();
                let is_so = || {
                    State::try_read(&client).is_ok() && Own::read(&client, writer.index) == wanted
                };
                let start = Instant::now();
                while !is_so() {
                    assert!(
                        start.elapsed() < PATIENCE,
                        "{at}: {:#?}\nacknowledged: {wanted:#?}\nlog: {}",
                        Own::read(&client, writer.index),
                        self.rescue.log(),
                    );
                    sleep(AGAIN);
                }
            }
        }
        let is_recorded = self.note_what_is_owed();
        for writer in self.writers {
            writer.is_in(writer.state(), is_recorded);
        }
        self.count("silences");
        self.go_on();
    }

    /// Checks the state after rosrescue and its master ended together and were started again.
    #[track_caller]
    fn assert_what_is_owed(&mut self) {
        self.pause();
        self.await_service(None);
        // If a state was lost, the nodes' reports differ from it.
        eventually("all nodes have been asked", || {
            for writer in self.writers {
                writer.claim(&Own::read(&self.client(), writer.index));
            }
            let last = self.status("last_recovery").unwrap_or_default();
            last["health_check_ms"].is_number()
        });
        let is_recorded = self.status("unprotected") == Some(serde_json::Value::Null);
        for writer in self.writers {
            let found = Own::read(&self.client(), writer.index);
            assert!(
                writer.leads_to(&found),
                "found: {found:#?}\nowed: {:#?}\nlog: {}",
                lock(&writer.past),
                self.rescue.log(),
            );
            if found != writer.state() {
                self.count("states that went back");
            }
            writer.is_in(found, is_recorded);
        }
        self.go_on();
    }

    #[track_caller]
    fn start_again(&mut self) {
        self.rescue.start_again();
        self.rescue.wait_serving();
    }

    fn kill_guardian_and_worker(&mut self) {
        let worker = self.worker();
        self.rescue.kill();
        worker.into_iter().for_each(|pid| signal(pid, Signal::KILL));
        eventually("the worker has ended", || {
            worker.is_none_or(|pid| !crate::support::alive(pid))
        });
    }

    /// Causes one more death or stop.
    #[track_caller]
    fn next(&mut self, dice: &mut Dice) {
        self.note_what_is_owed();
        match dice.below(10) {
            0..3 => {
                self.count("masters killed");
                if let Some(pid) = self.bare.master_pid() {
                    signal(pid, Signal::KILL);
                    // The worker must notice the death first, or both would die together.
                    let is_other = || self.bare.master_pid().is_some_and(|it| it != pid);
                    let never = holds(3 * PATIENCE, || !is_other());
                    assert!(!never, "no other master: {}", self.rescue.log());
                }
                self.await_service(None);
            }
            3..6 => {
                self.count("workers killed");
                let worker = self.worker();
                worker.into_iter().for_each(|pid| signal(pid, Signal::KILL));
                self.await_service(worker);
            }
            6..8 => {
                self.count("guardians and workers killed");
                self.kill_guardian_and_worker();
                self.start_again();
                self.await_service(None);
            }
            8 => {
                self.count("everything killed");
                let is_whole = dice.below(2) == 0 && self.heal();
                let master = self.bare.master_pid();
                self.kill_guardian_and_worker();
                master.into_iter().for_each(|pid| signal(pid, Signal::KILL));
                self.flags.pause.store(true, Ordering::SeqCst);
                self.start_again();
                self.assert_what_is_owed();
                if is_whole {
                    self.count("of these with everything recorded");
                }
            }
            _ => {
                self.count("orderly stops");
                if dice.below(2) == 0 && self.heal() {
                    self.count("of these with everything recorded");
                }
                self.flags.pause.store(true, Ordering::SeqCst);
                assert_eq!(self.rescue.terminate().code(), Some(0));
                self.start_again();
                self.assert_what_is_owed();
            }
        }
    }

    /// Heals the disk. Returns whether everything is recorded afterwards.
    fn heal(&self) -> bool {
        self.disk.heal();
        !holds(Duration::from_secs(4), || !self.note_what_is_owed())
    }
}

/// Runs the troubles of the disk until the end of the test.
fn trouble(disk: &FailingDisk, mut dice: Dice, flags: &Flags) -> BTreeMap<String, u32> {
    let mut tally = BTreeMap::new();
    while !flags.over.load(Ordering::SeqCst) {
        let next = match dice.below(8) {
            0..2 => Some(Trouble::Hangs),
            2 => Some(Trouble::Slow),
            3 => Some(Trouble::Full),
            4 => Some(Trouble::ReadOnly),
            _ => None,
        };
        match next {
            Some(trouble) => {
                *tally.entry(format!("{trouble:?}")).or_default() += 1;
                disk.begin(trouble);
            }
            None => disk.heal(),
        }
        let time = Duration::from_millis(100 + dice.below(TROUBLE_MS));
        holds(time, || !flags.over.load(Ordering::SeqCst));
    }
    disk.heal();
    tally
}

#[test]
fn the_state_always_equals_the_acknowledged_calls_whatever_dies() {
    soak(&[], true);
}

/// The disk works: if it fails right after such a write, the next process may let the master run the write again
/// (decision 53).
#[test]
fn the_state_always_equals_the_acknowledged_calls_if_the_mirror_answers_them_first() {
    soak(&["--writes", "mirror"], false);
}

/// Plays a while with a `core` that has these `arguments` in addition, on a disk that fails now and then or never.
fn soak(arguments: &[&str], disk_fails: bool) {
    let seconds = number("ROSRESCUE_SOAK_SECONDS", 30);
    let seed = number("ROSRESCUE_SEED", u64::from(std::process::id()) << 20);
    println!("seed {seed}, {seconds} s");
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let port = free_port();
    let setup = Setup::core(&scratch, port).arg("--no-rosout").guarded();
    let setup = setup.args(arguments);
    let rescue = disk.under(setup).start();
    let writer = |index| Writer::new(index, rescue.client());
    let writers: Vec<_> = (0..WRITERS).map(writer).collect();
    let flags = Flags::default();
    thread::scope(|scope| {
        let _finish = Finish(&flags.over);
        for writer in &writers {
            let dice = Dice(seed + 2 + writer.index as u64);
            let flags = &flags;
            scope.spawn(move || writer.run(dice, flags));
        }
        let troubles = scope.spawn(|| match disk_fails {
            true => trouble(&disk, Dice(seed + 1), &flags),
            false => BTreeMap::new(),
        });
        let mut stage = Stage {
            scratch: &scratch,
            disk: &disk,
            rescue,
            bare: Client::new(port),
            writers: &writers,
            flags: &flags,
            tally: BTreeMap::new(),
        };
        let (begin, mut dice) = (Instant::now(), Dice(seed));
        let mut said = begin;
        while begin.elapsed() < Duration::from_secs(seconds) {
            for _ in 0..1 + dice.below(4) {
                sleep(Duration::from_millis(dice.below(1500)));
                stage.next(&mut dice);
            }
            stage.assert_state();
            if said.elapsed() > Duration::from_secs(10) {
                said = Instant::now();
                println!("{:.0?}: {:?}", begin.elapsed(), stage.tally);
            }
        }
        flags.over.store(true, Ordering::SeqCst);
        println!(
            "{:.0?}: {} calls, {} sent again; {:?}; the disk: {:?}",
            begin.elapsed(),
            flags.calls.load(Ordering::Relaxed),
            flags.repeated.load(Ordering::Relaxed),
            stage.tally,
            troubles.join().unwrap(),
        );
        let _ = stage.rescue.terminate();
        assert_eq!(stage.scratch.survivors(), vec![]);
    });
}
