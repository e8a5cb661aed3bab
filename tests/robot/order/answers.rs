//! A node gets the answer to its own call before any later notification. These tests send raw requests: a call that
//! changes something and a call that asks for it, within 2 ms of each other.

use std::collections::BTreeMap;
use std::io::{self, BufReader, Write};
use std::mem::MaybeUninit;
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::{self, Call, Reply, Value};
use socket2::SockRef;

use crate::support::links::Dice;
use crate::support::{
    Client, FakeMaster, Mode, Robot, Wire, encode_call, eventually, http_request, params,
    read_request,
};

/// Possible times between the two calls, in microseconds.
const APART: [u64; 4] = [50, 200, 500, 2_000];
/// How long each kind of pair is tried. Each pair takes some 5 to 20 ms.
const TIME: Duration = Duration::from_millis(600);
/// Number of pairs at the same time, after each kind was tried alone.
const PAIRS: usize = 6;
const TYPE: &str = "std_msgs/String";
/// `MSG_PEEK | MSG_DONTWAIT` of Linux: looks at what has arrived without waiting.
const LOOK: i32 = 0x02 | 0x40;

/// The subject that one node asks about and another node changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Subject {
    /// `registerSubscriber`, while a publisher registers.
    Comes,
    /// `registerSubscriber`, while a publisher unregisters.
    Goes,
    /// `subscribeParam`, while the parameter is set.
    Param,
    /// `registerSubscriber`, while another node of the same name registers.
    Namesake,
}

const SUBJECTS: [Subject; 4] = [
    Subject::Comes,
    Subject::Goes,
    Subject::Param,
    Subject::Namesake,
];

#[test]
fn no_notification_overtakes_an_older_answer_beside_a_living_master() {
    let robot = Robot::start(Mode::Proxy);
    no_notification_overtakes_an_answer(&robot.client());
}

#[test]
fn no_notification_overtakes_an_older_answer_while_standing_in() {
    let mut robot = Robot::start(Mode::Proxy);
    robot.take_master_away();
    no_notification_overtakes_an_answer(&robot.client());
}

#[track_caller]
fn no_notification_overtakes_an_answer(master: &Client) {
    let seed = u64::from(std::process::id()) << 20;
    println!("seed {seed}");
    let mut overtaken = Vec::new();
    for subject in SUBJECTS {
        for pairs in [1, PAIRS] {
            let run = |pair: usize| {
                let mut dice = Dice(seed + pair as u64);
                let mut pair = Pair::connect(master, &format!("{subject:?}_{pairs}_{pair}"));
                let (begin, mut asked, mut rounds) = (Instant::now(), Vec::new(), 0);
                while begin.elapsed() < TIME {
                    rounds += 1;
                    asked.extend(pair.round(subject, rounds, &mut dice));
                }
                (rounds, pair.judge(asked))
            };
            let (mut rounds, mut told) = (0, Vec::new());
            thread::scope(|scope| {
                let threads = (0..pairs).map(|pair| scope.spawn(move || run(pair)));
                let threads: Vec<_> = threads.collect();
                for thread in threads {
                    let (more, found) = thread.join().unwrap();
                    rounds += more;
                    told.extend(found);
                }
            });
            let count = told.len();
            let (mut after, mut early) = (Vec::new(), Vec::new());
            for told in told {
                match told {
                    Ok(time) => after.push(time),
                    Err(text) => early.push(text),
                }
            }
            after.sort();
            println!(
                "{subject:?}, {pairs} at once: {} of {count} notifications came before the answer ({rounds} rounds); the \
                 others first {:.0?} after it",
                early.len(),
                after.iter().take(5).collect::<Vec<_>>()
            );
            overtaken.extend(early);
        }
    }
    assert!(
        overtaken.is_empty(),
        "{} answers were overtaken:\n{}",
        overtaken.len(),
        overtaken.join("\n")
    );
}

/// Everything that the asking node has received.
#[derive(Debug, Default)]
struct Inbox {
    /// The subject about which an answer is expected, and the connection of that answer. `None` after it has
    /// arrived.
    waits: Option<(String, TcpStream)>,
    /// For each subject, the time of the first notification, and whether that came before the answer.
    heard: BTreeMap<String, (Instant, bool)>,
    /// The topics to which its nodes have subscribed.
    topics: Vec<String>,
}

impl Inbox {
    /// Whether the expected answer has not arrived at the socket yet.
    fn is_early(&self) -> bool {
        let Some((_, stream)) = &self.waits else {
            return false;
        };
        let mut byte = [MaybeUninit::uninit(); 1];
        let seen = SockRef::from(stream).recv_with_flags(&mut byte, LOOK);
        matches!(seen, Err(error) if error.kind() == io::ErrorKind::WouldBlock)
    }
}

/// The subject of a notification: a topic, a parameter, or the name of a node.
fn subject_of(call: &Call) -> Option<String> {
    let text = call.params.get(1)?.as_str()?;
    let text = match call.method.as_str() {
        "shutdown" => text.strip_prefix('[')?.split(']').next()?,
        _ => text.trim_end_matches('/'),
    };
    Some(text.to_owned())
}

fn lock(inbox: &Mutex<Inbox>) -> MutexGuard<'_, Inbox> {
    inbox.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Number of threads that wait for connections to the asking node, so that none has to be started first.
const THREADS: usize = 3;

/// Runs a thread that accepts one connection.
fn take_one(listener: &Arc<TcpListener>, inbox: &Arc<Mutex<Inbox>>) {
    let (listener, inbox) = (Arc::clone(listener), Arc::clone(inbox));
    thread::spawn(move || {
        let Ok((stream, _)) = listener.accept() else {
            return;
        };
        let mut stream = BufReader::new(stream);
        let mut first = true;
        while let Some((_, body)) = read_request(&mut stream) {
            let mut held = lock(&inbox);
            // This must be read first, because the answer may arrive at any moment.
            let (early, at) = (held.is_early(), Instant::now());
            let call = xmlrpc::decode_call(&body).unwrap();
            // While there is no master, rosrescue asks a displaced node for its topics.
            let answer = match call.method.as_str() {
                "getPublications" => Value::Array(Vec::new()),
                "getSubscriptions" => {
                    let topics = held.topics.iter();
                    let topics = topics.map(|topic| params![topic.as_str(), TYPE].into());
                    Value::Array(topics.collect())
                }
                _ => Value::Int(0),
            };
            if let Some(subject) = subject_of(&call) {
                let early = early
                    && held
                        .waits
                        .as_ref()
                        .is_some_and(|(waits, _)| *waits == subject);
                held.heard.entry(subject).or_insert((at, early));
            }
            drop(held);
            let reply = FakeMaster::proper(&Reply::Value(params![1, "", answer].into()));
            let sent = stream.get_mut().write_all(&reply);
            if std::mem::take(&mut first) {
                take_one(&listener, &inbox);
            }
            if sent.is_err() {
                return;
            }
        }
        if first {
            take_one(&listener, &inbox);
        }
    });
}

/// An answer to a node that does not show the other node's change yet.
struct Asked {
    subject: String,
    /// The time at which the answer arrived.
    arrived: Instant,
    text: String,
}

/// Two nodes: one asks, and one makes changes.
struct Pair {
    master: Client,
    name: String,
    inbox: Arc<Mutex<Inbox>>,
    port: u16,
    asks: Wire,
    changes: Wire,
}

impl Pair {
    fn connect(master: &Client, name: &str) -> Self {
        let inbox = Arc::new(Mutex::new(Inbox::default()));
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let port = listener.local_addr().unwrap().port();
        let listener = Arc::new(listener);
        (0..THREADS).for_each(|_| take_one(&listener, &inbox));
        Self {
            master: master.clone(),
            name: name.to_owned(),
            inbox,
            port,
            asks: master.connect().unwrap(),
            changes: master.connect().unwrap(),
        }
    }

    /// Asks for one subject and changes it at about the same time.
    fn round(&mut self, subject: Subject, nth: usize, dice: &mut Dice) -> Option<Asked> {
        let topic = format!("/order/{}/{nth}", self.name);
        let names = ["asks", "changes"].map(|name| match subject {
            Subject::Namesake => format!("/namesake/{}/{nth}", self.name),
            _ => format!("/{name}/{}", self.name),
        });
        let [asker, changer] = names.each_ref().map(String::as_str);
        let topic = topic.as_str();
        let api = format!("http://127.0.0.1:{}/", self.port);
        let other = format!("http://127.0.0.1:1/{}/{nth}", self.name);
        let (api, other, kind) = (api.as_str(), other.as_str(), TYPE);
        let publish = request("registerPublisher", params![changer, topic, kind, other]);
        let subscribe = request("registerSubscriber", params![asker, topic, kind, api]);
        let (ask, change, last) = match subject {
            Subject::Comes => (subscribe, publish, params![other].into()),
            Subject::Goes => {
                exchange(&mut self.changes, &publish);
                let leave = request("unregisterPublisher", params![changer, topic, other]);
                (subscribe, leave, Value::Array(Vec::new()))
            }
            Subject::Param => (
                request("subscribeParam", params![asker, api, topic]),
                request("setParam", params![changer, topic, 7]),
                Value::Int(7),
            ),
            // The other node of the same name publishes another topic.
            Subject::Namesake => {
                let params = params![changer, format!("{topic}/else"), kind, other];
                (
                    subscribe,
                    request("registerPublisher", params),
                    Value::Int(0),
                )
            }
        };
        let topic_or_name = match subject {
            Subject::Namesake => asker,
            _ => topic,
        };
        let mut inbox = lock(&self.inbox);
        inbox.topics.push(topic.to_owned());
        inbox.waits = Some((topic_or_name.to_owned(), self.asks.stream()));
        drop(inbox);
        let apart = dice.below(APART[nth % APART.len()]);
        let asks_first = dice.below(2) == 0;
        let begin = Instant::now();
        let mut calls = [(&mut self.asks, &ask), (&mut self.changes, &change)];
        if !asks_first {
            calls.reverse();
        }
        for (nth, (wire, request)) in calls.into_iter().enumerate() {
            if nth > 0 {
                thread::sleep(Duration::from_micros(apart));
            }
            wire.send(request).unwrap();
        }
        // The answer has arrived. It is read only after the inbox knows this.
        self.asks.stream().peek(&mut [0]).unwrap();
        let arrived = Instant::now();
        lock(&self.inbox).waits = None;
        let answer = value(&self.asks.response().unwrap().reply());
        value(&self.changes.response().unwrap().reply());
        let first = if asks_first { "asked" } else { "changed" };
        let is_news = match subject {
            // If the node that asked came second, it has displaced the other one.
            Subject::Namesake => {
                let node = params!["/test", asker];
                self.master.ask("lookupNode", node) == Some(other.into())
            }
            // If the answer already shows the change, no notification is expected.
            _ => answer != last,
        };
        let asked = is_news.then(|| Asked {
            subject: topic_or_name.to_owned(),
            arrived,
            text: format!(
                "{topic_or_name}, before the answer {answer:?}, which came after {:.1?}; {first} first, {apart} us apart",
                arrived - begin
            ),
        });
        // While there is no master, a displaced node is not told to shut down if another node is at its address by
        // then.
        match (subject, &asked) {
            (Subject::Namesake, Some(asked)) => self.await_heard(asked),
            (Subject::Namesake, None) => {
                let leave = request("unregisterSubscriber", params![asker, topic, api]);
                exchange(&mut self.asks, &leave);
            }
            _ => {}
        }
        asked
    }

    fn await_heard(&self, asked: &Asked) {
        eventually(&format!("a notification of {}", asked.text), || {
            lock(&self.inbox).heard.contains_key(&asked.subject)
        });
    }

    /// The time from each answer to the notification of the change. `Err` if the notification came first.
    fn judge(&self, asked: Vec<Asked>) -> Vec<Result<Duration, String>> {
        let judge = |asked: Asked| {
            self.await_heard(&asked);
            match lock(&self.inbox).heard[&asked.subject] {
                (_, true) => Err(asked.text),
                (at, false) => Ok(at.saturating_duration_since(asked.arrived)),
            }
        };
        asked.into_iter().map(judge).collect()
    }
}

fn request(method: &str, params: Vec<Value>) -> Vec<u8> {
    http_request(&encode_call(method, params))
}

fn exchange(wire: &mut Wire, request: &[u8]) {
    wire.send(request).unwrap();
    value(&wire.response().unwrap().reply());
}

/// The value of an answer that reports success, or that there was nothing to do.
#[track_caller]
fn value(reply: &Reply) -> Value {
    match reply {
        Reply::Value(Value::Array(fields)) if fields[0] == Value::Int(1) => fields[2].clone(),
        other => panic!("{other:?}"),
    }
}
