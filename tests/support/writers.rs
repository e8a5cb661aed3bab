//! Writes that cause notifications, and the nodes that receive these. Each writer has a parameter that only grows and a
//! publisher that comes and goes.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::{self, Reply, Value};

use super::fake::{FakeMaster, is_from_rosrescue};
use super::links::Dice;
use super::params;
use super::rpc::{Client, encode_call, http_request};

pub(crate) const WRITERS: usize = 6;
pub(crate) const SUBSCRIBERS: usize = 4;
/// How long a node takes to answer.
const ANSWER: Duration = Duration::from_millis(1);

/// A notification of a parameter's value.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ParamUpdate {
    pub(crate) value: i32,
    pub(crate) from_rosrescue: bool,
    pub(crate) at: Instant,
}

/// All notifications of a subscriber, by parameter and by topic, in order.
#[derive(Debug, Default)]
pub(crate) struct Told {
    pub(crate) values: BTreeMap<String, Vec<ParamUpdate>>,
    pub(crate) publishers: BTreeMap<String, Vec<Value>>,
}

/// A node that subscribes to all parameters and topics.
#[derive(Debug)]
pub(crate) struct Subscriber {
    told: Arc<Mutex<Told>>,
    _server: FakeMaster,
}

/// The parameter that a writer sets.
pub(crate) fn key(writer: usize) -> String {
    format!("/order/value_{writer}")
}

/// The topic on which a writer publishes.
pub(crate) fn topic(writer: usize) -> String {
    format!("/order/topic_{writer}")
}

fn lock(told: &Mutex<Told>) -> MutexGuard<'_, Told> {
    told.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Subscriber {
    /// Starts all [`SUBSCRIBERS`].
    #[track_caller]
    pub(crate) fn start_all(master: &Client) -> Vec<Self> {
        (0..SUBSCRIBERS)
            .map(|number| Self::start(master, number))
            .collect()
    }

    #[track_caller]
    fn start(master: &Client, number: usize) -> Self {
        let told = Arc::new(Mutex::new(Told::default()));
        let theirs = Arc::clone(&told);
        let server = FakeMaster::start_with_heads(move |head, body| {
            answer(&theirs, is_from_rosrescue(head), body)
        });
        let (name, api) = (
            format!("/hears_{number}"),
            format!("http://127.0.0.1:{}/", server.port()),
        );
        let (name, api) = (name.as_str(), api.as_str());
        for writer in 0..WRITERS {
            master.ok("subscribeParam", params![name, api, key(writer)]);
            let params = params![name, topic(writer), "std_msgs/String", api];
            master.ok("registerSubscriber", params);
        }
        Self {
            told,
            _server: server,
        }
    }

    /// Number of notifications that have been received.
    pub(crate) fn count(&self) -> usize {
        let told = self.told();
        let values = told.values.values().map(Vec::len);
        values.chain(told.publishers.values().map(Vec::len)).sum()
    }

    pub(crate) fn told(&self) -> MutexGuard<'_, Told> {
        lock(&self.told)
    }
}

fn answer(told: &Mutex<Told>, from_rosrescue: bool, body: &[u8]) -> Vec<u8> {
    let call = xmlrpc::decode_call(body).expect("a call");
    if let [_, Value::String(name), value] = call.params.as_slice() {
        let mut told = lock(told);
        match (call.method.as_str(), value) {
            ("paramUpdate", Value::Int(value)) => {
                let key = name.trim_end_matches('/').to_owned();
                told.values.entry(key).or_default().push(ParamUpdate {
                    value: *value,
                    from_rosrescue,
                    at: Instant::now(),
                });
            }
            ("publisherUpdate", list) => {
                told.publishers
                    .entry(name.clone())
                    .or_default()
                    .push(list.clone());
            }
            _ => {}
        }
    }
    thread::sleep(ANSWER);
    // rosrescue does not check a node that does not report its subscriptions.
    let (code, value) = match call.method.as_str() {
        "getPid" => (1, i32::try_from(std::process::id()).unwrap()),
        "getSubscriptions" | "getPublications" => (0, 0),
        _ => (1, 0),
    };
    FakeMaster::proper(&Reply::Value(params![code, "", value].into()))
}

/// Sets a writer's parameter to ever larger values and registers and unregisters its publisher for `time`,
/// with random pauses of up to `pause` between calls. Returns how long each call took.
#[track_caller]
pub(crate) fn write(
    master: &Client,
    writer: usize,
    seed: u64,
    pause: Duration,
    time: Duration,
) -> Vec<Duration> {
    let mut dice = Dice(seed + writer as u64);
    let (begin, mut calls) = (Instant::now(), Vec::new());
    let (name, api) = (
        format!("/writes_{writer}"),
        format!("http://127.0.0.1:1/{writer}"),
    );
    let (name, api) = (name.as_str(), api.as_str());
    let pause = u64::try_from(pause.as_micros()).unwrap();
    let mut wire = master.connect().unwrap();
    for value in 1.. {
        let publisher = match value % 2 {
            0 => encode_call("unregisterPublisher", params![name, topic(writer), api]),
            _ => {
                let params = params![name, topic(writer), "std_msgs/String", api];
                encode_call("registerPublisher", params)
            }
        };
        for body in [
            encode_call("setParam", params![name, key(writer), value]),
            publisher,
        ] {
            let sent = Instant::now();
            wire.send(&http_request(&body)).unwrap();
            let reply = wire.response().unwrap().reply();
            calls.push(sent.elapsed());
            assert!(
                matches!(&reply, Reply::Value(Value::Array(fields)) if fields[0] == Value::Int(1)),
                "{reply:?}"
            );
            thread::sleep(Duration::from_micros(dice.below(pause)));
        }
        if begin.elapsed() > time {
            break;
        }
    }
    calls
}
