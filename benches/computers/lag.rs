//! Measures how long after the answer to a write the mirrors of the followers have it.
//!
//! A follower forwards reads, so no read shows its mirror. But it appends a record to its checkpoint under
//! the same lock under which it applies it to the mirror, so this bench watches the length of that file.

use std::{
    fs::{self, File},
    io::{Read, Seek, SeekFrom},
    path::Path,
    sync::atomic::{AtomicBool, Ordering},
    thread::{scope, sleep},
    time::{Duration, Instant},
};

use serde::Serialize;

use crate::{
    cluster::{Cluster, Data, Sync},
    cost::{Call, script},
    shared::{
        load::Load,
        numbers::at,
        support::{Wire, encode_call, http_request, params},
    },
};

/// Pause between two checks, which is the accuracy of the results.
const LOOK: Duration = Duration::from_micros(50);
/// Pause between two writes.
const PAUSE: Duration = Duration::from_millis(10);
/// Number of writes. With `interval` each takes 200 ms, so there are fewer.
const WRITES: u32 = 200;
const WRITES_AT_INTERVALS: u32 = 40;
/// Number of other clients that write at the same time.
const OTHERS: usize = 64;
/// Maximum time for a follower to have a write.
const LIMIT: Duration = Duration::from_secs(10);

/// The results in milliseconds. 0 if a mirror had the write before it was answered.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Lag {
    pub(crate) sync: Sync,
    pub(crate) data: Data,
    /// Number of other clients that write at the same time.
    pub(crate) others: usize,
    pub(crate) median: f64,
    pub(crate) p99: f64,
    pub(crate) largest: f64,
}

/// Measures without other clients and with some.
pub(crate) fn measure(cluster: &Cluster, seconds: f64) -> [Lag; 2] {
    [0, OTHERS].map(|others| {
        let done = AtomicBool::new(false);
        let leader = cluster.client(cluster.leader());
        let mut lags = scope(|scope| {
            let load = scope.spawn(|| {
                let scripts = (0..others).map(|number| script(Call::Write, number));
                let mut load =
                    Load::connect(leader.port(), scripts.collect()).expect("connections");
                while others > 0 && !done.load(Ordering::Relaxed) {
                    let turn = Duration::from_secs_f64(seconds.min(0.2));
                    load.run(turn).expect("answers");
                }
            });
            let lags = writes(cluster);
            done.store(true, Ordering::Relaxed);
            load.join().expect("the other clients failed");
            lags
        });
        lags.sort();
        let lag = Lag {
            sync: cluster.sync,
            data: cluster.data,
            others,
            median: at(&lags, 0.5),
            p99: at(&lags, 0.99),
            largest: at(&lags, 1.0),
        };
        eprintln!("{lag:.2?}");
        lag
    })
}

/// The time of each write at each follower.
fn writes(cluster: &Cluster) -> Vec<Duration> {
    let leader = cluster.leader();
    let files = Cluster::followers(leader).map(|index| cluster.checkpoint(index));
    let mut wire = cluster.client(leader).connect().expect("a connection");
    let mut lags = Vec::new();
    let count = match cluster.sync {
        Sync::Always => WRITES,
        Sync::Interval => WRITES_AT_INTERVALS,
    };
    for number in 0..count {
        let mark = format!("computers-{}-{number}-end", lags_id());
        let call = encode_call("setParam", params!["/lag", "/computers/lag", mark.as_str()]);
        let (mark, wire) = (mark.as_str(), &mut wire);
        lags.extend(scope(|scope| {
            let seen = files.each_ref().map(|file| {
                let from = length(file);
                scope.spawn(move || seen_at(file, from, mark))
            });
            let answered = answer(wire, &call);
            seen.map(|seen| {
                let seen = seen.join().expect("a follower");
                seen.saturating_duration_since(answered)
            })
        }));
        sleep(PAUSE);
    }
    lags
}

fn answer(wire: &mut Wire, call: &[u8]) -> Instant {
    wire.send(&http_request(call)).expect("a call");
    wire.response().expect("an answer");
    Instant::now()
}

/// The moment at which `file` contains `mark` somewhere after `from`.
fn seen_at(file: &Path, mut from: u64, mark: &str) -> Instant {
    let begin = Instant::now();
    let mut known = from;
    while begin.elapsed() < LIMIT {
        let (now, is) = (Instant::now(), length(file));
        if is < known {
            // The file was compacted, so the mark may be anywhere in it.
            from = 0;
        }
        if is != known {
            known = is;
            if rest(file, from).contains(mark) {
                return now;
            }
        }
        sleep(LOOK);
    }
    panic!("{} lacks a write for {LIMIT:?}", file.display());
}

fn length(file: &Path) -> u64 {
    fs::metadata(file).map_or(0, |metadata| metadata.len())
}

fn rest(file: &Path, from: u64) -> String {
    let mut bytes = Vec::new();
    let read = File::open(file).and_then(|mut file| {
        file.seek(SeekFrom::Start(from))?;
        file.read_to_end(&mut bytes)
    });
    read.expect("a checkpoint");
    String::from_utf8_lossy(&bytes).into_owned()
}

/// A new number each time, so that a mark is never found in what an earlier measurement has written.
fn lags_id() -> u64 {
    use std::sync::atomic::AtomicU64;
    static NEXT: AtomicU64 = AtomicU64::new(0);
    NEXT.fetch_add(1, Ordering::Relaxed)
}
