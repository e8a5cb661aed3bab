//! Measures which times of `rosrescue core` grow with its state.

use std::{
    fs,
    os::unix::fs::MetadataExt,
    path::Path,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};

use rustix::process::Signal;
use serde::Serialize;

use crate::{
    calls::{Call, many},
    shared::{
        cpu::{family, resident_kib},
        load::Load,
        numbers::at,
        support::{
            Client, FakeNode, Finish, Rescue, Scratch, Setup, encode_call, eventually,
            eventually_some, free_port, http_request, params, signal, status,
        },
    },
};

/// Numbers of parameters and nodes. Each node has ten registrations.
pub(crate) const STATES: [(usize, usize); 5] = [
    (10, 1),
    (1_000, 1),
    (100_000, 1),
    (10, 1_000),
    (10_000, 1_000),
];
/// Number of compactions to observe.
const COMPACTIONS: usize = 3;
/// Size in bytes of the value that is set again and again until the journal is compacted.
const VALUE: usize = 8 << 10;
/// Pause between two checks of the checkpoint.
const LOOK: Duration = Duration::from_micros(200);
/// How long before the first sign of a compaction in the folder rosrescue may begin to copy the mirror.
const LEAD: Duration = Duration::from_millis(200);
/// Maximum time for all compactions together.
const PATIENCE: Duration = Duration::from_secs(20);
/// Number of kills of rosrescue, and of the master.
const KILLS: usize = 3;

/// The results for one state. Times are medians in milliseconds, except for the longest calls.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Row {
    pub(crate) params: usize,
    pub(crate) nodes: usize,
    pub(crate) write_ms: f64,
    pub(crate) read_ms: f64,
    pub(crate) compactions_ms: Vec<f64>,
    /// The longest read and the longest write during a compaction.
    pub(crate) longest_ms: [f64; 2],
    /// The longest read and the longest write without a compaction.
    pub(crate) otherwise_ms: [f64; 2],
    pub(crate) restarts_ms: Vec<f64>,
    /// Times from the shut gate to the open one.
    pub(crate) recoveries_ms: Vec<f64>,
    /// The part of each of these times that was not spent waiting for the new master.
    pub(crate) injections_ms: Vec<f64>,
    pub(crate) memory_kib: u64,
    /// Memory use after restarts and recoveries.
    pub(crate) memory_after_kib: u64,
}

pub(crate) fn measure(seconds: f64) -> Vec<Row> {
    STATES
        .map(|(params, nodes)| row(params, nodes, seconds))
        .into()
}

fn row(count: usize, nodes: usize, seconds: f64) -> Row {
    eprintln!("{count} parameters, {nodes} nodes");
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).arg("--no-rosout");
    let mut rescue = setup.guarded().start();
    let client = rescue.client();
    many(&client, "/scale", count);
    let _nodes = register(&client, nodes);
    let memory_kib = resident_kib(&family(rescue.pid()));
    let time = Duration::from_secs_f64(seconds / 2.0);
    let median = |call: Call| {
        let mut load = Load::connect(client.port(), vec![call.script(0)]).expect("a connection");
        let mut times = load.run(time).expect("answers").calls;
        times.sort();
        at(&times, 0.5)
    };
    let write_ms = median(Call::SetParam);
    client.set_param("/compare/small", 1);
    let read_ms = median(Call::GetParam);
    let (compactions_ms, longest_ms, otherwise_ms) = compactions(&client, &rescue.checkpoint());
    let restarts_ms = (0..KILLS).map(|_| restart(&mut rescue)).collect();
    let (recoveries_ms, injections_ms) = (0..KILLS).map(|_| recovery(&client)).unzip();
    let row = Row {
        params: count,
        nodes,
        write_ms,
        read_ms,
        compactions_ms,
        longest_ms,
        otherwise_ms,
        restarts_ms,
        recoveries_ms,
        injections_ms,
        memory_kib,
        memory_after_kib: resident_kib(&family(rescue.pid())),
    };
    eprintln!("{row:.2?}");
    row
}

/// Registers `count` nodes that answer, with ten registrations each.
fn register(client: &Client, count: usize) -> Vec<FakeNode> {
    let start = |number: usize| {
        let name = format!("/scale_{number}");
        let node = FakeNode::start(&name);
        for topic in 0..4 {
            node.publish(client, &format!("{name}/topic_{topic}"), "std_msgs/String");
            let other = (number + 1) % count;
            let topic = format!("/scale_{other}/topic_{topic}");
            node.subscribe(client, &topic, "std_msgs/String");
        }
        for service in ["get_loggers", "set_logger_level"] {
            node.offer(client, &format!("{name}/{service}"));
        }
        node
    };
    (0..count).map(start).collect()
}

/// When a call began, and how long it took.
type Timed = (Instant, Duration);

/// The times of compactions of the journal, and the longest read and write during them and otherwise.
fn compactions(client: &Client, checkpoint: &Path) -> (Vec<f64>, [f64; 2], [f64; 2]) {
    let over = AtomicBool::new(false);
    let read = encode_call("getParam", params!["/compare", "/compare/small"]);
    let value = "x".repeat(VALUE);
    let write = encode_call("setParam", params!["/compare", "/compare/value", value]);
    thread::scope(|scope| {
        let callers = [read, write].map(|body| {
            let over = &over;
            scope.spawn(move || call_until(client, &http_request(&body), over))
        });
        let spans = {
            let _finish = Finish(&over);
            watch(checkpoint)
        };
        let calls = callers.map(|caller| caller.join().expect("a client"));
        let longest = |calls: &[Timed], during: bool| {
            let is_during = |(begin, time): &&Timed| {
                let (begin, end) = (*begin, *begin + *time);
                let mut spans = spans.iter();
                spans.any(|(from, to)| end > *from - LEAD && begin < *to) == during
            };
            let times = calls.iter().filter(is_during).map(|(_, time)| *time);
            times
                .max()
                .map_or(f64::NAN, |time| time.as_secs_f64() * 1e3)
        };
        let each = |during: bool| [0, 1].map(|caller: usize| longest(&calls[caller], during));
        let times = spans.iter().map(|(from, to)| (*to - *from).as_secs_f64());
        (
            times.map(|seconds| seconds * 1e3).collect(),
            each(true),
            each(false),
        )
    })
}

fn call_until(client: &Client, request: &[u8], over: &AtomicBool) -> Vec<Timed> {
    let mut wire = client.connect().expect("a connection");
    let mut calls = Vec::new();
    while !over.load(Ordering::Relaxed) {
        let begin = Instant::now();
        wire.send(request).expect("a call");
        assert_eq!(wire.response().expect("an answer").code, 200);
        calls.push((begin, begin.elapsed()));
    }
    calls
}

/// Measures compactions: from the first sight of a new generation's file until it has become the checkpoint.
fn watch(checkpoint: &Path) -> Vec<(Instant, Instant)> {
    let begin = Instant::now();
    let inode = || fs::metadata(checkpoint).map_or(0, |found| found.ino());
    let folder = checkpoint.parent().expect("a folder");
    let is_new = || {
        let names = fs::read_dir(folder).into_iter().flatten().flatten();
        let mut names = names.map(|entry| entry.file_name());
        names.any(|name| name.to_string_lossy().contains(".new-"))
    };
    let (mut spans, mut last, mut from) = (Vec::new(), inode(), None);
    while spans.len() < COMPACTIONS && begin.elapsed() < PATIENCE {
        let now = inode();
        if now != last {
            // A compaction that was too quick to be seen took less than one pause.
            let to = Instant::now();
            spans.push((from.take().unwrap_or(to - LOOK), to));
            last = now;
        } else if from.is_none() && is_new() {
            from = Some(Instant::now());
        }
        thread::sleep(LOOK);
    }
    spans
}

/// Kills both processes of rosrescue and starts it again. Returns the time from the start to its first answer
/// to a read, in milliseconds. The master lives on.
fn restart(rescue: &mut Rescue) -> f64 {
    let family = family(rescue.pid());
    // The guardian first, because it would start another worker.
    for pid in &family {
        signal(*pid, Signal::KILL);
    }
    rescue.wait();
    let client = rescue.client();
    eventually("the port is free", || client.connect().is_err());
    let read = http_request(&encode_call(
        "getParam",
        params!["/compare", "/compare/small"],
    ));
    let begin = Instant::now();
    rescue.start_again();
    let answer = eventually_soon(|| client.exchange(&read).ok());
    let time = begin.elapsed();
    assert_eq!(answer.code, 200);
    rescue.wait_serving();
    eventually("calls pass", || {
        status(&client)["open"].as_bool() == Some(true)
    });
    time.as_secs_f64() * 1e3
}

/// Like `eventually_some`, with shorter pauses.
fn eventually_soon<T>(mut look: impl FnMut() -> Option<T>) -> T {
    let begin = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(begin.elapsed() < PATIENCE, "no answer");
        thread::sleep(LOOK);
    }
}

/// Kills the master. Returns the time from the shut gate to the open one, and the part of it after the new
/// master's port was open, as reported by rosrescue.
fn recovery(client: &Client) -> (f64, f64) {
    let recoveries = status(client)["recoveries"].as_u64();
    let master = client.master_pid().expect("a process id");
    signal(master, Signal::KILL);
    let status = eventually_some("the recovery has a report", || {
        Some(status(client)).filter(|status| status["recoveries"].as_u64() > recoveries)
    });
    let phases = &status["last_recovery"]["phases"];
    let phase = |name: &str| phases[name].as_f64().expect("milliseconds");
    let total = phase("total_ms");
    (total, total - phase("absence_ms"))
}
