//! Measures what etcd needs after a day of a robot's writes, played as fast as possible.
//!
//! No rosrescue runs here, because its leader makes etcd discard old data by the clock, which would not
//! happen during such a short run. The requests are those of a leader and two followers, at the same moments
//! of the day.

use std::{
    fs,
    os::unix::fs::MetadataExt,
    path::Path,
    sync::{
        Mutex,
        atomic::{AtomicU32, AtomicU64, Ordering},
    },
    thread::scope,
    time::Instant,
};

use base64::{Engine as _, prelude::BASE64_STANDARD};
use rescue_core::{
    checkpoint::format::{self, Checkpoint, Record, RecordContent},
    cluster::{
        journal::{self, Keys},
        machine::{EtcdAnswer, Op, Settings},
    },
};
use ros1_master::{
    master::{Master, Method, Request},
    xmlrpc::Value,
};
use rosrescue::cluster::replica::Replica;
use serde::Serialize;
use serde_json::{Value as Json, json};

use crate::{
    cluster::{COUNT, Data, Election, Engine},
    servers::{LIMIT, Servers, keys, settings},
    shared::{
        cpu::{peak_kib, resident_kib},
        nodes::topics,
        support::{Client, Wire, params, request},
    },
};

/// Number of requests under way at a time.
const AT_ONCE: u32 = 16;
/// Number of parameters that are written in turn.
const PARAMS: u32 = 50;
/// The same as `SNAPSHOT_ENTRIES` of the journal, with one record each.
const SNAPSHOT_EVERY: u32 = 1_000;
/// The same as `FORGET` of the leader, in seconds.
const FORGET_EVERY: u32 = 300;
/// The same as `SAYS_EVERY` of every computer, in seconds.
const SAY_EVERY: u32 = 5;
/// Time to live of the lease for a computer's status, in seconds: the shortest that etcd allows, so that few
/// exist at a time.
const LEASE: &str = "2";
/// Time of the robot between two lines of progress, in seconds.
const PROGRESS: u32 = 7_200;

/// The resources of the etcd member that needs most, in bytes.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(crate) struct Need {
    /// Size of the database, and of the part in use.
    pub(crate) database: u64,
    pub(crate) in_use: u64,
    /// Size of its whole folder, including the log of recent writes.
    pub(crate) folder: u64,
    /// Resident memory.
    pub(crate) memory: u64,
}

/// The results of a day. Sizes are in bytes.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Day {
    pub(crate) hours: u32,
    pub(crate) data: Data,
    pub(crate) transactions: u64,
    /// How long playing the day took.
    pub(crate) seconds: f64,
    pub(crate) before: Need,
    pub(crate) after: Need,
    /// The maximum resident memory on the way.
    pub(crate) peak_memory: u64,
}

struct Robot<'a> {
    keys: Keys,
    servers: &'a Servers,
    term: u64,
    /// The value of the key that shows that the leader is alive.
    alive: Vec<u8>,
    snapshot: Checkpoint,
    /// The next second to play.
    next: AtomicU32,
    transactions: AtomicU64,
    /// The revision up to which etcd is to discard data next time.
    old: Mutex<u64>,
}

pub(crate) fn play(hours: u32, data: Data, nodes: usize) -> Day {
    let engine = Engine::start(data, Election::Usual);
    let mut robot = Robot {
        keys: keys(),
        servers: &engine.servers,
        term: 0,
        alive: Vec::new(),
        snapshot: state(nodes),
        next: AtomicU32::new(0),
        transactions: AtomicU64::new(0),
        old: Mutex::new(0),
    };
    engine.runtime.block_on(robot.lead(&settings("pc-1")));
    let before = need(&engine.servers);
    let begin = Instant::now();
    scope(|scope| {
        for _ in 0..AT_ONCE {
            scope.spawn(|| robot.play(hours * 3_600));
        }
    });
    let seconds = begin.elapsed().as_secs_f64();
    let after = need(&engine.servers);
    let peaks = (0..COUNT).map(|index| peak_kib(engine.servers.pid(index)) << 10);
    Day {
        hours,
        data,
        transactions: robot.transactions.into_inner(),
        seconds,
        before,
        after,
        peak_memory: peaks.max().unwrap_or_default(),
    }
}

impl Robot<'_> {
    fn replica(&self) -> Replica {
        Replica {
            client: self.servers.client(),
            keys: self.keys.clone(),
            limit: LIMIT,
        }
    }

    async fn lead(&mut self, settings: &Settings) {
        let replica = self.replica();
        let view = replica.client.view(&self.keys, LIMIT).await.expect("keys");
        let claim = Op::Claim {
            guard: view.guard(),
            claim: 1,
            begins: Some(1),
            seq: 0,
            settled: true,
        };
        let answer = replica
            .run(settings, &claim, None, None)
            .await
            .expect("an answer");
        let EtcdAnswer::Applied { revision, .. } = answer else {
            panic!("{answer:?}");
        };
        self.term = revision;
        let found = replica.client.range(&self.keys.small(), LIMIT).await;
        let found = found.expect("all keys").kvs.into_iter();
        let mut alive = found.filter(|kv| kv.key == self.keys.alive());
        self.alive = alive.next().expect("the key must exist").value;
    }

    /// Plays the seconds of the day until `end`.
    fn play(&self, end: u32) {
        let authority = self.servers.endpoints(0)[0].clone();
        let port = authority
            .rsplit(':')
            .next()
            .and_then(|port| port.parse().ok());
        let client = Client::new(port.expect("a port"));
        let mut wire = client.connect().expect("a connection");
        loop {
            let second = self.next.fetch_add(1, Ordering::Relaxed);
            if second >= end {
                return;
            }
            let seq = u64::from(second) + 1;
            // A write is a sign of life as well. The next one is due half a second later.
            let revision = self.beat(&mut wire, Some(&record(seq)));
            self.beat(&mut wire, None);
            if second.is_multiple_of(SAY_EVERY) {
                (1..=COUNT).for_each(|number| self.say(&mut wire, number, seq));
            }
            if second % SNAPSHOT_EVERY == SNAPSHOT_EVERY - 1 {
                self.write_snapshot(seq);
            }
            if second % FORGET_EVERY == FORGET_EVERY - 1 {
                self.forget(&mut wire, revision);
            }
            if second % PROGRESS == PROGRESS - 1 {
                let now = need(self.servers);
                eprintln!("hour {}: {now:?}", (second + 1) / 3_600);
            }
        }
    }

    /// Makes a transaction of the leader and returns its revision. Its comparison with the last sign of life
    /// has the same form as the leader's, but holds for all transactions that are under way at the same time.
    fn beat(&self, wire: &mut Wire, record: Option<&Record>) -> u64 {
        let (leader, alive) = (self.keys.leader(), self.keys.alive());
        let mut puts = Vec::new();
        if let Some(record) = record {
            let batch = journal::pack(&self.keys, std::slice::from_ref(record));
            let entry = batch.expect("a batch").entry.expect("an entry");
            puts.push(put(&entry.key, &entry.value));
        }
        puts.push(put(&alive, &self.alive));
        let answer = self.post(
            wire,
            "kv/txn",
            &json!({
                "compare": [
                    { "key": text(&leader), "target": "MOD", "mod_revision": self.term.to_string() },
                    { "key": text(&alive), "target": "MOD", "result": "GREATER", "mod_revision": "0" },
                ],
                "success": puts,
                "failure": [],
            }),
        );
        assert_eq!(answer["succeeded"], true, "{answer}");
        let revision = answer["header"]["revision"].as_str().expect("a revision");
        revision.parse().expect("a number")
    }

    /// Writes the status of a computer.
    fn say(&self, wire: &mut Wire, number: usize, seq: u64) {
        let lease = self.post(wire, "lease/grant", &json!({ "TTL": LEASE }));
        let name = format!("pc-{number}");
        let said = json!({
            "uri": format!("http://{name}:11311/"),
            "version": env!("CARGO_PKG_VERSION"),
            "role": "following",
            "seq": seq,
        });
        let value = BASE64_STANDARD.encode(said.to_string());
        let key = text(&self.keys.member(&name));
        let body = json!({ "key": key, "value": value, "lease": lease["ID"] });
        self.post(wire, "kv/put", &body);
    }

    fn write_snapshot(&self, seq: u64) {
        let checkpoint = Checkpoint {
            seq,
            ..self.snapshot.clone()
        };
        let encoded = format::encode_checkpoint(&checkpoint, 1).expect("a snapshot");
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build();
        let replica = self.replica();
        let written = runtime.expect("a runtime").block_on(replica.write_snapshot(
            self.term,
            seq,
            &encoded.bytes,
        ));
        assert!(written.expect("a snapshot"), "the robot does not lead");
    }

    /// Makes etcd discard what is older than at the previous time.
    fn forget(&self, wire: &mut Wire, revision: u64) {
        let mut old = self.old.lock().expect("the revision");
        if *old > 0 {
            self.post(
                wire,
                "kv/compaction",
                &json!({ "revision": old.to_string() }),
            );
        }
        // Requests that are under way at the same time arrive in any order.
        *old = revision.max(*old);
    }

    fn post(&self, wire: &mut Wire, path: &str, body: &Json) -> Json {
        let first = format!("POST /v3/{path} HTTP/1.1");
        wire.send(&request(&first, &[], body.to_string().as_bytes()))
            .expect("a request");
        let answer = wire.response().expect("an answer");
        assert_eq!(answer.code, 200, "{path}: {}", answer.text());
        self.transactions.fetch_add(1, Ordering::Relaxed);
        serde_json::from_slice(&answer.body).expect("JSON")
    }
}

fn text(key: &str) -> String {
    BASE64_STANDARD.encode(key)
}

fn put(key: &str, value: &[u8]) -> Json {
    json!({ "request_put": { "key": text(key), "value": BASE64_STANDARD.encode(value) } })
}

/// The record of a node that sets a parameter.
fn record(seq: u64) -> Record {
    let key = format!("/robot/part_{}/state", seq % u64::from(PARAMS));
    let params = params!["/robot_state", key, seq as f64 * 0.1];
    Record {
        seq,
        entry: RecordContent::call(Request::new(Method::SetParam, params)),
    }
}

/// The state of a robot with this many nodes, with seven registrations each.
fn state(nodes: usize) -> Checkpoint {
    let mut master = Master::default();
    let mut apply = |method: Method, params: Vec<Value>| {
        master.apply(&Request::new(method, params));
    };
    for number in 0..nodes {
        let name = format!("/node_{number:03}");
        let api = format!("http://127.0.0.1:{}/", 40_000 + number);
        let [published, subscribed] = topics(number, nodes);
        let rosout = "/rosout".to_owned();
        for topic in published.into_iter().chain([rosout]) {
            let params = params![name.as_str(), topic, "std_msgs/String", api.as_str()];
            apply(Method::RegisterPublisher, params);
        }
        for topic in subscribed {
            let params = params![name.as_str(), topic, "std_msgs/String", api.as_str()];
            apply(Method::RegisterSubscriber, params);
        }
        for service in ["get_loggers", "set_logger_level"] {
            let service = format!("{name}/{service}");
            let params = params![name.as_str(), service, "rosrpc://127.0.0.1:5", api.as_str()];
            apply(Method::RegisterService, params);
        }
    }
    for seq in 0..u64::from(PARAMS) {
        if let RecordContent::Call { call, .. } = record(seq).entry {
            master.apply(&call);
        }
    }
    Checkpoint {
        snapshot: master.snapshot(),
        ..Checkpoint::default()
    }
}

fn need(servers: &Servers) -> Need {
    let mut most = Need::default();
    for index in 0..COUNT {
        let status = servers.post_to(index, "maintenance/status", &json!({}));
        let bytes = |name: &str| {
            let number = status[name]
                .as_str()
                .and_then(|text| text.parse::<u64>().ok());
            number.unwrap_or_else(|| panic!("{name}: {status}"))
        };
        let folder = servers.scratch.path(Servers::folder(index));
        most = Need {
            database: most.database.max(bytes("dbSize")),
            in_use: most.in_use.max(bytes("dbSizeInUse")),
            folder: most.folder.max(allocated(&folder)),
            memory: most.memory.max(resident_kib(&[servers.pid(index)]) << 10),
        };
    }
    most
}

/// The space that a folder takes on its disk, in bytes.
fn allocated(folder: &Path) -> u64 {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let sizes = entries.map(|entry| match entry.metadata() {
        Ok(metadata) if metadata.is_dir() => allocated(&entry.path()),
        // A file that was removed in the meantime takes no space.
        metadata => metadata.map_or(0, |metadata| metadata.blocks() * 512),
    });
    sizes.sum()
}
