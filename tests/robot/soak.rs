//! Random deaths and stops while calls are made, on a disk that hangs, slows down, fills up and becomes read-only at
//! random. Whenever the calls pause, the state must equal the acknowledged calls.
//!
//! When rosrescue and the master end together, only recorded calls must survive: everything that was acknowledged
//! before a status said that changes are recorded.
//!
//! Other tests kill at random steps of a write, on a disk that works. There every acknowledged call must survive.
//!
//! `ROSRESCUE_SOAK_SECONDS` is the length of the first test, `ROSRESCUE_SOAK_KILLS` the number of kills of the others.
//! `ROSRESCUE_SEED` repeats the random numbers of an earlier run.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use crate::support::links::Dice;
use crate::support::{
    Client, FailingDisk, FakeNode, Finish, PATIENCE, Rescue, Scratch, Setup, State, Trouble, alive,
    eventually, free_port, holds, params, signal,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

const WRITERS: usize = 4;
/// Number of combinations of processes that are killed.
const KINDS: u64 = 5;
/// Number of parameters, topics and services of each writer.
const NAMES: u64 = 4;
/// Pause before a call is repeated.
const AGAIN: Duration = Duration::from_millis(20);
/// Longest pause between two calls of a writer, in µs: on a disk that fails, and before kills.
const PAUSE_US: u64 = 4000;
const PAUSE_BEFORE_KILLS_US: u64 = 500;
/// Longest time from an answer to a kill, in µs. Most writes take less.
const STEPS_US: u64 = 1500;
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

    /// The state of writer `index` in the state of a master.
    fn of(state: &State, index: usize) -> Self {
        let (space, node) = (space(index), format!("/soaked_{index}"));
        let of = |list: &[(String, Vec<String>)]| {
            let own = list
                .iter()
                .filter(|(name, nodes)| name.starts_with(&space) && nodes.contains(&node));
            own.map(|(name, _)| name.clone()).collect()
        };
        let mut params = BTreeMap::new();
        let member = |value: &Value, name: &str| value.as_struct()?.get(name).cloned();
        let all =
            member(&state.params, "soak").and_then(|soak| member(&soak, &format!("w{index}")));
        if let Some(Value::Struct(values)) = &all {
            for (key, value) in values {
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
    /// The calls that have not been answered yet.
    open: AtomicU32,
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

    fn run(&self, mut dice: Dice, pause_us: u64, flags: &Flags) {
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
            flags.open.fetch_add(1, Ordering::Relaxed);
            let is_answered = self.make(&step, flags);
            flags.open.fetch_sub(1, Ordering::Relaxed);
            if !is_answered {
                return;
            }
            let mut past = lock(&self.past);
            let mut state = past.states.last().unwrap().clone();
            state.apply(&step);
            past.states.push(state);
            past.last = Some(step);
            drop(past);
            flags.calls.fetch_add(1, Ordering::Relaxed);
            sleep(Duration::from_micros(dice.below(pause_us)));
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

    /// The status. `None` if there is no answer.
    fn whole_status(&self) -> Option<serde_json::Value> {
        let get = b"GET /status.json HTTP/1.1\r\nHost: localhost\r\n\r\n";
        let response = self.client().exchange(get).ok()?;
        serde_json::from_slice(&response.body).ok()
    }

    /// A field of the status. `None` if there is no answer.
    fn status(&self, field: &str) -> Option<serde_json::Value> {
        Some(self.whole_status()?[field].clone())
    }

    fn worker(&self) -> Option<u32> {
        u32::try_from(self.status("pid")?.as_u64()?).ok()
    }

    /// Waits until calls pass to a master through a worker other than `dead`.
    #[track_caller]
    fn await_service(&self, dead: Option<u32>) {
        let is_so = || {
            self.whole_status().is_some_and(|status| {
                let worker = status["pid"].as_u64();
                status["open"] == true && worker.is_some() && worker != dead.map(u64::from)
            })
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
            let start = Instant::now();
            loop {
                let found = State::try_read(&client);
                let differs = match &found {
                    Ok(state) => self.writers.iter().find_map(|writer| {
                        let found = Own::of(state, writer.index);
                        let wanted = writer.state();
                        let differs = found != wanted;
                        differs.then(|| format!("{found:#?}\nacknowledged: {wanted:#?}"))
                    }),
                    Err(error) => Some(error.to_string()),
                };
                let Some(differs) = differs else {
                    break;
                };
                assert!(
                    start.elapsed() < PATIENCE,
                    "{at}: {differs}\nlog: {}",
                    self.rescue.log(),
                );
                sleep(AGAIN);
            }
        }
        let is_recorded = self.note_what_is_owed();
        for writer in self.writers {
            writer.is_in(writer.state(), is_recorded);
        }
        self.count("silences");
        self.go_on();
    }

    /// Starts rosrescue after it and its master ended together, and checks the state.
    #[track_caller]
    fn start_with_what_is_owed(&mut self) {
        // If a state was lost, the nodes' reports differ from it, and the health check must not see that.
        for writer in self.writers {
            writer.node.ignore("getPublications");
        }
        self.start_again();
        self.pause();
        self.await_service(None);
        let state = State::read(&self.client());
        for writer in self.writers {
            writer.claim(&Own::of(&state, writer.index));
            writer.node.answer_all();
        }
        eventually("all nodes have been asked", || {
            let last = self.status("last_recovery").unwrap_or_default();
            last["health_check_ms"].is_number()
        });
        let is_recorded = self.status("unprotected") == Some(serde_json::Value::Null);
        let state = State::read(&self.client());
        for writer in self.writers {
            let found = Own::of(&state, writer.index);
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
            worker.is_none_or(|pid| !alive(pid))
        });
    }

    /// Kills the processes of one of the [`KINDS`], and waits until calls pass to a master again. Half of the kills come
    /// right after an answer, which a process that answers too early would not survive; the others at a random step of a
    /// write.
    #[track_caller]
    fn kill_some(&mut self, kind: u64, dice: &mut Dice) {
        let (what, guardian, with_worker, with_master) = match kind {
            0 => ("masters killed", false, false, true),
            1 => ("workers killed", false, true, false),
            2 => ("workers and masters killed", false, true, true),
            3 => ("guardians and workers killed", true, true, false),
            _ => ("everything killed", true, true, true),
        };
        self.count(what);
        let worker = self.worker().filter(|_| with_worker);
        let master = self.bare.master_pid().filter(|_| with_master);
        let guardian = guardian.then(|| self.rescue.pid());
        // A guardian that sees its worker die starts another.
        let victims: Vec<_> = guardian.into_iter().chain(worker).chain(master).collect();
        let later = Duration::from_micros(dice.below(2) * dice.below(STEPS_US));
        let calls = || self.flags.calls.load(Ordering::SeqCst);
        let before = calls();
        let waiting = Instant::now();
        while calls() == before {
            assert!(waiting.elapsed() < PATIENCE, "no call was answered");
            thread::yield_now();
        }
        let answered = Instant::now();
        while answered.elapsed() < later {
            thread::yield_now();
        }
        victims.iter().for_each(|&pid| signal(pid, Signal::KILL));
        let open = self.flags.open.load(Ordering::SeqCst);
        *self.tally.entry("calls open at a kill").or_default() += open;
        eventually("the killed processes have ended", || {
            !victims.iter().any(|&pid| alive(pid))
        });
        if guardian.is_some() {
            self.rescue.wait();
            self.start_again();
        }
        self.await_service(worker);
    }

    /// Causes one more death or stop. The checkpoint is on `disk`.
    #[track_caller]
    fn next(&mut self, disk: &FailingDisk, dice: &mut Dice) {
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
                let is_whole = dice.below(2) == 0 && self.heal(disk);
                let master = self.bare.master_pid();
                self.kill_guardian_and_worker();
                master.into_iter().for_each(|pid| signal(pid, Signal::KILL));
                self.flags.pause.store(true, Ordering::SeqCst);
                self.start_with_what_is_owed();
                if is_whole {
                    self.count("of these with everything recorded");
                }
            }
            _ => {
                self.count("orderly stops");
                if dice.below(2) == 0 && self.heal(disk) {
                    self.count("of these with everything recorded");
                }
                self.flags.pause.store(true, Ordering::SeqCst);
                assert_eq!(self.rescue.terminate().code(), Some(0));
                self.start_with_what_is_owed();
            }
        }
    }

    /// Heals the disk. Returns whether everything is recorded afterwards.
    fn heal(&self, disk: &FailingDisk) -> bool {
        disk.heal();
        !holds(Duration::from_secs(4), || !self.note_what_is_owed())
    }
}

/// Runs the troubles of the disk until the end of the test.
fn trouble(disk: &FailingDisk, mut dice: Dice, over: &AtomicBool) -> BTreeMap<String, u32> {
    let mut tally = BTreeMap::new();
    let mut hung = false;
    while !over.load(Ordering::SeqCst) {
        let next = match dice.below(8) {
            // After 20 s of a hang, rosrescue starts without the checkpoint.
            0..2 => (!hung).then_some(Trouble::Hangs),
            2 => Some(Trouble::Slow),
            3 => Some(Trouble::Full),
            4 => Some(Trouble::ReadOnly),
            _ => None,
        };
        hung = matches!(next, Some(Trouble::Hangs));
        match next {
            Some(trouble) => {
                *tally.entry(format!("{trouble:?}")).or_default() += 1;
                disk.begin(trouble);
            }
            None => disk.heal(),
        }
        let time = Duration::from_millis(100 + dice.below(TROUBLE_MS));
        holds(time, || !over.load(Ordering::SeqCst));
    }
    disk.heal();
    tally
}

/// Runs `script` with a `core` that is started like `setup`, in front of a master at `port`, while writers make calls
/// with pauses of at most `pause_us`.
fn play(setup: Setup, port: u16, seed: u64, pause_us: u64, script: impl FnOnce(&mut Stage<'_>)) {
    let rescue = setup.arg("--no-rosout").guarded().start();
    let writer = |index| Writer::new(index, rescue.client());
    let writers: Vec<_> = (0..WRITERS).map(writer).collect();
    let flags = Flags::default();
    thread::scope(|scope| {
        let _finish = Finish(&flags.over);
        for writer in &writers {
            let dice = Dice(seed + 2 + writer.index as u64);
            let flags = &flags;
            scope.spawn(move || writer.run(dice, pause_us, flags));
        }
        let mut stage = Stage {
            rescue,
            bare: Client::new(port),
            writers: &writers,
            flags: &flags,
            tally: BTreeMap::new(),
        };
        let begin = Instant::now();
        script(&mut stage);
        flags.over.store(true, Ordering::SeqCst);
        println!(
            "{:.0?}: {} calls, {} sent again; {:?}",
            begin.elapsed(),
            flags.calls.load(Ordering::Relaxed),
            flags.repeated.load(Ordering::Relaxed),
            stage.tally,
        );
        let _ = stage.rescue.terminate();
    });
}

/// Says every 10 s what has been done.
struct Progress {
    begin: Instant,
    said: Instant,
}

impl Progress {
    fn begin() -> Self {
        let begin = Instant::now();
        Self { begin, said: begin }
    }

    fn say(&mut self, stage: &Stage<'_>) {
        if self.said.elapsed() > Duration::from_secs(10) {
            self.said = Instant::now();
            println!("{:.0?}: {:?}", self.begin.elapsed(), stage.tally);
        }
    }
}

fn seed() -> u64 {
    number("ROSRESCUE_SEED", u64::from(std::process::id()) << 20)
}

#[test]
fn the_state_always_equals_the_acknowledged_calls_whatever_dies() {
    let (seed, seconds) = (seed(), number("ROSRESCUE_SOAK_SECONDS", 20));
    println!("seed {seed}, {seconds} s");
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let port = free_port();
    let setup = disk.under(Setup::core(&scratch, port));
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let finish = Finish(&over);
        let troubles = scope.spawn(|| trouble(&disk, Dice(seed + 1), &over));
        play(setup, port, seed, PAUSE_US, |stage| {
            let (mut progress, mut dice) = (Progress::begin(), Dice(seed));
            while progress.begin.elapsed() < Duration::from_secs(seconds) {
                for _ in 0..1 + dice.below(4) {
                    sleep(Duration::from_millis(dice.below(1500)));
                    stage.next(&disk, &mut dice);
                }
                stage.assert_state();
                progress.say(stage);
            }
        });
        drop(finish);
        println!("the disk: {:?}", troubles.join().unwrap());
    });
    assert_eq!(scratch.survivors(), vec![]);
}

#[test]
fn no_acknowledged_call_is_lost_by_a_kill_at_any_step_of_a_write() {
    kills(&[]);
}

/// The disk works: if it fails right after such a write, the next process may let the master run the write again
/// (decision 53).
#[test]
fn no_acknowledged_call_is_lost_by_a_kill_if_the_mirror_answers_first() {
    kills(&["--writes", "mirror"]);
}

/// Kills processes of a `core` that has these `arguments` in addition, each kind in turn, and checks the state after each
/// kill.
fn kills(arguments: &[&str]) {
    let (seed, kills) = (seed(), number("ROSRESCUE_SOAK_KILLS", 2 * KINDS));
    println!("seed {seed}, {kills} kills");
    let scratch = Scratch::new();
    let port = free_port();
    let setup = Setup::core(&scratch, port).args(arguments);
    play(setup, port, seed, PAUSE_BEFORE_KILLS_US, |stage| {
        let (mut progress, mut dice) = (Progress::begin(), Dice(seed));
        for nth in 0..kills {
            stage.kill_some(nth % KINDS, &mut dice);
            stage.assert_state();
            progress.say(stage);
        }
    });
    assert_eq!(scratch.survivors(), vec![]);
}
