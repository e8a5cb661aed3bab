//! Writers, readers, subscribers and publishers on each computer. They record what they see.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::Value;

use super::checker::{End, History, Loss, Op, Sample, Says, Time, Told, What};
use crate::computer::{NAMES, PORT};
use crate::fleet::Fleet;
use crate::network::{COUNT, enter};
use crate::support::links::Dice;
use crate::support::{Client, Finish, ReceivedCall, State, eventually, params, request};
use crate::traffic::{Named, TYPE};

/// Pause between two calls of a client.
const PAUSE: Duration = Duration::from_millis(50);
/// Pause between two requests for a computer's role.
const SAMPLE: Duration = Duration::from_millis(80);
/// Time limit of such a request.
const ANSWER: Duration = Duration::from_millis(300);
/// How many parameters all computers write. Each computer also has a parameter of its own.
const SHARED: usize = 2;

/// All clients of one history. They call until this is dropped.
#[derive(Debug)]
pub(crate) struct Clients {
    subscribers: Vec<Named>,
    publishers: Vec<Named>,
    shared: Arc<Shared>,
    writers: Vec<JoinHandle<()>>,
    others: Vec<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    start: Instant,
    /// The name of the history and of the namespace of its parameters.
    name: String,
    written: AtomicI32,
    /// How often etcd was set up again. Its terms then start over.
    etcds: AtomicU64,
    /// When older copies of etcd were restored.
    restored: Mutex<Vec<Time>>,
    quiet: AtomicBool,
    finish: AtomicBool,
    ops: Mutex<Vec<Op>>,
    samples: Mutex<Vec<Sample>>,
    /// Whether each computer's publisher is registered, according to its last answer.
    publishes: [AtomicBool; COUNT],
}

impl Shared {
    fn now(&self) -> Time {
        self.start.elapsed().as_micros() as Time
    }

    fn own(&self, computer: usize) -> String {
        format!("/{}/own_{computer}", self.name)
    }

    fn keys(&self) -> Vec<String> {
        let shared = (0..SHARED).map(|number| format!("/{}/shared_{number}", self.name));
        let own = (0..COUNT).map(|computer| self.own(computer));
        own.chain(shared).collect()
    }

    fn topic(&self) -> String {
        format!("/{}/topic", self.name)
    }
}

impl Clients {
    /// Subscribes to all parameters and the topic, and starts the clients. `seed` decides what they call.
    #[track_caller]
    pub(crate) fn start(fleet: &Fleet, name: &str, seed: u64) -> Self {
        let shared = Arc::new(Shared {
            start: Instant::now(),
            name: name.to_owned(),
            written: AtomicI32::new(0),
            etcds: AtomicU64::new(0),
            restored: Mutex::default(),
            quiet: AtomicBool::new(false),
            finish: AtomicBool::new(false),
            ops: Mutex::default(),
            samples: Mutex::default(),
            publishes: Default::default(),
        });
        let named = |of: &str| -> Vec<Named> {
            let computers = fleet.computers.iter();
            computers
                .map(|computer| Named::new(computer, &format!("/{of}_{}_{name}", computer.name)))
                .collect()
        };
        let (subscribers, publishers) = (named("subscriber"), named("publisher"));
        for (computer, node) in fleet.computers.iter().zip(&subscribers) {
            computer.within(|| {
                for key in shared.keys() {
                    node.it().watch_param(&computer.client(), &key);
                }
                let topic = shared.topic();
                node.it().subscribe(&computer.client(), &topic, TYPE);
            });
        }
        let mut clients = Self {
            subscribers,
            publishers,
            shared,
            writers: Vec::new(),
            others: Vec::new(),
        };
        for index in 0..COUNT {
            let namespace = fleet.computers[index].namespace.clone();
            let spawn = |work: fn(&Shared, usize, &Named, Dice), turn: usize| {
                let (shared, namespace) = (Arc::clone(&clients.shared), namespace.clone());
                let node = clients.publishers[index].clone();
                let dice = Dice(seed + (turn * COUNT + index) as u64);
                thread::spawn(move || {
                    enter(&namespace);
                    work(&shared, index, &node, dice);
                })
            };
            let writers = [write as fn(&Shared, usize, &Named, Dice), publish];
            let others = [read as fn(&Shared, usize, &Named, Dice), sample];
            let turns = writers.iter().enumerate();
            clients.writers.extend(
                turns
                    .map(|(turn, work)| spawn(*work, turn))
                    .collect::<Vec<_>>(),
            );
            let turns = others.iter().enumerate();
            let others: Vec<_> = turns.map(|(turn, work)| spawn(*work, turn + 2)).collect();
            clients.others.extend(others);
        }
        clients
    }

    /// Ends all writers, and waits for their calls that are under way.
    #[track_caller]
    pub(crate) fn quiet(&mut self) {
        self.shared.quiet.store(true, Ordering::Relaxed);
        for writer in self.writers.drain(..) {
            eventually("a writer ends", || writer.is_finished());
            writer.join().expect("a writer");
        }
    }

    /// Notes that etcd was set up again, so its terms start over.
    pub(crate) fn forget_terms(&self) {
        self.shared.etcds.fetch_add(1, Ordering::Relaxed);
    }

    /// Notes that an older copy of etcd is restored.
    pub(crate) fn restore(&self) {
        self.forget_terms();
        self.shared.restored.lock().unwrap().push(self.shared.now());
    }

    /// The number of answered calls.
    pub(crate) fn answered(&self) -> usize {
        let ops = self.shared.ops.lock().unwrap();
        ops.iter().filter(|op| op.end.is_some()).count()
    }

    /// What the clients have recorded up to now.
    pub(crate) fn history(&self, fleet: &Fleet) -> History {
        History {
            ops: self.shared.ops.lock().unwrap().clone(),
            losses: losses(fleet, &self.shared.keys()),
            samples: self.shared.samples.lock().unwrap().clone(),
            restored: self.shared.restored.lock().unwrap().clone(),
        }
    }

    /// The final state and each subscriber's last notifications.
    pub(crate) fn end(&self, state: &State) -> End {
        let mut values = BTreeMap::new();
        for key in self.shared.keys() {
            let mut names = key.split('/').skip(1);
            let found = names.try_fold(&state.params, |at, name| at.as_struct()?.get(name));
            values.extend(found.and_then(Value::as_int).map(|value| (key, value)));
        }
        let told = self.subscribers.iter().flat_map(|node| {
            let mut updates = node.it().calls();
            updates.retain(|call| call.method == "paramUpdate");
            self.shared.keys().into_iter().map(move |key| {
                let of_key = |update: &&ReceivedCall| {
                    let name = update.params[1].as_str().unwrap_or_default();
                    name.trim_end_matches('/') == key
                };
                let updates: Vec<_> = updates.iter().filter(of_key).collect();
                let last = updates.last();
                Told {
                    subscriber: node.it().name.clone(),
                    value: last.and_then(|update| update.params[2].as_int()),
                    trail: trail(updates.iter().rev().take(8).rev()),
                    key,
                }
            })
        });
        let told = told.collect();
        End { values, told }
    }

    /// Broken promises of the topic: the final state has the registered publishers, and each subscriber knows them.
    pub(crate) fn topic_wrongs(&self, state: &State) -> Vec<String> {
        let topic = self.shared.topic();
        let mut wrong = Vec::new();
        let registered = state.publishers_of(&topic);
        let mut apis = BTreeSet::new();
        for (node, publishes) in self.publishers.iter().zip(&self.shared.publishes) {
            let (node, is) = (node.it(), registered.contains(&node.it().name));
            let claims = publishes.load(Ordering::Relaxed);
            if claims != is {
                wrong.push(format!(
                    "{} is a publisher: {is}, and should be: {claims}",
                    node.name
                ));
            }
            if is {
                apis.insert(node.api.clone());
            }
        }
        for node in &self.subscribers {
            let node = node.it();
            let told: BTreeSet<_> = node
                .updates(&topic)
                .pop()
                .unwrap_or_default()
                .into_iter()
                .collect();
            if told != apis {
                let mut updates = node.calls();
                updates.retain(|call| call.method == "publisherUpdate");
                let updates: Vec<_> = updates.iter().collect();
                let trail = trail(updates.iter().rev().take(12).rev());
                let name = &node.name;
                wrong.push(format!(
                    "{name} was told {told:?}, and there are {apis:?}: {trail}"
                ));
            }
            let calls = node.received("shutdown");
            if !calls.is_empty() {
                wrong.push(format!("{} is told to end: {calls:?}", node.name));
            }
        }
        wrong
    }
}

impl Drop for Clients {
    fn drop(&mut self) {
        self.shared.quiet.store(true, Ordering::Relaxed);
        drop(Finish(&self.shared.finish));
        if thread::panicking() {
            return;
        }
        for thread in self.writers.drain(..).chain(self.others.drain(..)) {
            thread.join().expect("a client panicked");
        }
    }
}

/// Writes parameters one after the other. A failed write is not repeated, because it may have taken effect.
fn write(shared: &Shared, computer: usize, _: &Named, mut dice: Dice) {
    let (client, keys) = (Client::new(PORT), shared.keys());
    let own = shared.own(computer);
    while !shared.quiet.load(Ordering::Relaxed) {
        let key = match dice.below(2) {
            0 => &own,
            _ => &keys[COUNT + dice.below(SHARED as u64) as usize],
        };
        let value = shared.written.fetch_add(1, Ordering::Relaxed) + 1;
        let start = shared.now();
        let answer = client.status("setParam", params!["/writer", key.as_str(), value]);
        let end = matches!(answer, Ok((1, _, _))).then(|| shared.now());
        shared.ops.lock().unwrap().push(Op {
            computer,
            key: key.clone(),
            what: What::Write(value),
            start,
            end,
        });
        thread::sleep(PAUSE);
    }
}

fn read(shared: &Shared, computer: usize, _: &Named, mut dice: Dice) {
    let (client, keys) = (Client::new(PORT), shared.keys());
    while !shared.finish.load(Ordering::Relaxed) {
        let key = &keys[dice.below(keys.len() as u64) as usize];
        let start = shared.now();
        let answer = client.status("getParam", params!["/reader", key.as_str()]);
        let end = Some(shared.now());
        let value = match answer {
            Ok((1, _, value)) => Some(value.as_int()),
            // The parameter is not set.
            Ok((-1, _, _)) => Some(None),
            _ => None,
        };
        if let Some(value) = value {
            shared.ops.lock().unwrap().push(Op {
                computer,
                key: key.clone(),
                what: What::Read(value),
                start,
                end,
            });
        }
        thread::sleep(PAUSE / 2);
    }
}

/// Registers and unregisters a publisher in turns. Each call is repeated until it is answered.
fn publish(shared: &Shared, computer: usize, node: &Named, mut dice: Dice) {
    let (client, topic, node) = (Client::new(PORT), shared.topic(), node.it());
    let mut is = false;
    while !shared.quiet.load(Ordering::Relaxed) {
        is = !is;
        node.claim_publication(&topic, is.then_some(TYPE));
        let (method, params) = match is {
            true => {
                let params = params![node.name.as_str(), topic.as_str(), TYPE, node.api.as_str()];
                ("registerPublisher", params)
            }
            false => {
                let params = params![node.name.as_str(), topic.as_str(), node.api.as_str()];
                ("unregisterPublisher", params)
            }
        };
        while client.ask(method, params.clone()).is_none() {
            thread::sleep(PAUSE);
        }
        shared.publishes[computer].store(is, Ordering::Relaxed);
        thread::sleep(PAUSE * (1 + dice.below(8) as u32));
    }
}

/// Records the computer's role again and again.
fn sample(shared: &Shared, computer: usize, _: &Named, _: Dice) {
    let get = request("GET /status.json HTTP/1.1", &[], b"");
    let ask = || -> Option<serde_json::Value> {
        let mut wire = Client::new(PORT).connect().ok()?;
        wire.set_patience(ANSWER);
        wire.send(&get).ok()?;
        serde_json::from_slice(&wire.response().ok()?.body).ok()
    };
    // The process that answered last, how often it had been alone, when it answered, and whether it was alone then.
    let mut before = (None, 0, 0, false);
    while !shared.finish.load(Ordering::Relaxed) {
        let from = shared.now();
        let page = ask();
        let to = shared.now();
        if let Some(page) = page {
            let cluster = &page["cluster"];
            let (pid, times) = (page["pid"].as_u64(), cluster["times_cut_off"].as_u64());
            let known = if pid == before.0 { before.1 } else { 0 };
            let is_alone = cluster["role"] == "alone";
            if times > Some(known) || before.3 && !is_alone {
                // The computer may be back already, and was alone until it was.
                shared.samples.lock().unwrap().push(Sample {
                    computer,
                    from: before.2,
                    to,
                    says: Says::Alone,
                });
            }
            before = (pid, times.unwrap_or(0), to, is_alone);
            let says = match cluster["role"].as_str() {
                Some("alone") => Says::Alone,
                Some("leading") if page["open"] == true => {
                    // For a moment the page may still name the previous leader.
                    let leader = &cluster["leader"];
                    let term = leader["term"].as_u64();
                    let term = term.filter(|_| leader["name"] == NAMES[computer]);
                    Says::Leads(
                        term.map(|term| (shared.etcds.load(Ordering::Relaxed) << 32) + term),
                    )
                }
                _ => Says::Other,
            };
            shared.samples.lock().unwrap().push(Sample {
                computer,
                from,
                to,
                says,
            });
        }
        thread::sleep(SAMPLE);
    }
}

/// When and by whom a subscriber was notified, as in `2026-11-26T07:03:01.250Z by rosrescue at 10.77.0.1: Int(7)`.
fn trail<'a>(updates: impl Iterator<Item = &'a &'a ReceivedCall>) -> String {
    let line = |update: &&ReceivedCall| {
        let at = rosrescue::clock::wall_text_millis(update.at);
        let by = if update.from_rosrescue {
            "rosrescue"
        } else {
            "rosmaster"
        };
        let from = update.from.map(|from| from.to_string()).unwrap_or_default();
        let value = &update.params[2];
        format!("\n  {at} by {by} at {from}: {value:?}")
    };
    updates.map(line).collect()
}

/// The writes of these parameters of which a computer has reported that they are lost, or are in a file and not sent.
fn losses(fleet: &Fleet, keys: &[String]) -> Vec<Loss> {
    let mut losses = Vec::new();
    for computer in &fleet.computers {
        let mut lose = |key: &String, value| {
            losses.push(Loss {
                computer: computer.index,
                key: key.clone(),
                value,
            });
        };
        for line in computer.ever_logged("while this computer was cut off") {
            let key = keys.iter().find(|key| line.contains(&format!("`{key}`")));
            let value = line.split("alone=").nth(1);
            let value = value.and_then(|rest| rest.split_whitespace().next()?.parse().ok());
            if let (Some(key), Some(value), true) = (key, value, line.contains("others=")) {
                lose(key, value);
            }
        }
        // After a start at which it reached no other computer's node.
        for line in computer.ever_logged("they are kept in a file, not sent") {
            let file = line.split("kept=").nth(1).expect("the file's path");
            let records = fs::read_to_string(file.trim()).unwrap();
            for key in keys {
                let set = format!("\"/writer\", \"{key}\", ");
                let values = records.split(&set).skip(1);
                let values = values.map(|rest| rest.split(']').next()?.parse().ok());
                values.for_each(|value| lose(key, value.expect("the value of a write")));
            }
        }
    }
    losses
}
