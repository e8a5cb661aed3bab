//! Status page and metrics, by GET on the port that nodes use. Read-only.
//!
//! | path | answer |
//! |---|---|
//! | `/` | the status as text |
//! | `/status.json` | the status as JSON, with the report of the last recovery |
//! | `/metrics` | counters in Prometheus' text format |
//! | `/live` | 200 while rosrescue runs |
//! | `/ready` | 200 while calls are answered, by the master or by the mirror, else 503 |

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::Instant,
};

use hyper::StatusCode;

use super::{
    clients::Clients,
    replies::{HttpReply, page, text},
};
use crate::{
    clock,
    gate::{self, State},
    ledger::Ledger,
    master::Master,
    nodes::Nodes,
    status::{
        Board, Disk,
        condition::{Situation, condition},
        metrics::metrics,
        stats::Stats,
        summary::{Journal, SCHEMA, Status},
    },
    upstream::Upstream,
};

/// Shortest time over which calls a second are counted.
const SAMPLE: f64 = 1.0;
/// Callers listed as the slowest.
const SLOWEST: usize = 20;

pub struct Pages {
    /// What nodes use as `ROS_MASTER_URI`.
    pub uri: String,
    pub checkpoint: String,
    pub upstream: Arc<Upstream>,
    pub gate: gate::Rx,
    pub ledger: Arc<Ledger>,
    pub nodes: Arc<Nodes>,
    pub board: Arc<Board>,
    pub clients: Arc<Clients>,
    pub stats: &'static Stats,
    pub rate: Rate,
}

/// Calls a second, counted from one time that somebody asks to the next: at rest it costs nothing.
#[derive(Debug)]
pub struct Rate(Mutex<Sample>);

#[derive(Debug)]
struct Sample {
    at: Instant,
    calls: u64,
    rate: f64,
}

impl Rate {
    pub fn new(now: Instant) -> Self {
        Self(Mutex::new(Sample {
            at: now,
            calls: 0,
            rate: 0.0,
        }))
    }

    /// The rate at `now`, after so many `calls` in all.
    fn at(&self, now: Instant, calls: u64) -> f64 {
        let mut last = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let seconds = now.saturating_duration_since(last.at).as_secs_f64();
        if seconds >= SAMPLE {
            let new = calls.saturating_sub(last.calls) as f64;
            *last = Sample {
                at: now,
                calls,
                rate: new / seconds,
            };
        }
        (last.rate * 10.0).round() / 10.0
    }
}

impl Pages {
    pub fn page(&self, path: &str) -> HttpReply {
        let status = self.status();
        match path {
            "/" => text(StatusCode::OK, status.to_string()),
            "/status.json" => match serde_json::to_string_pretty(&status) {
                Ok(json) => page(StatusCode::OK, "application/json", json + "\n"),
                Err(error) => text(StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")),
            },
            "/metrics" => page(
                StatusCode::OK,
                "text/plain; version=0.0.4",
                metrics(self.stats, &status),
            ),
            "/live" => text(StatusCode::OK, "live\n".to_owned()),
            "/ready" if status.ready => text(StatusCode::OK, "ready\n".to_owned()),
            "/ready" => text(
                StatusCode::SERVICE_UNAVAILABLE,
                "no master was ever seen: calls wait for one\n".to_owned(),
            ),
            _ => text(
                StatusCode::NOT_FOUND,
                "no such page; there are /, /status.json, /metrics, /live and /ready\n".to_owned(),
            ),
        }
    }

    fn status(&self) -> Status {
        let counters = self.stats.list().into_iter();
        let counters = counters.map(|(name, _, value)| (name.to_owned(), value.into()));
        let gate = self.gate.state();
        let gate_since = self.gate.since().into_std();
        let stands_in = matches!(gate, State::StandingIn | State::Injecting);
        let facts = self.board.read();
        let unprotected = self.ledger.unprotected();
        let master = self.upstream.address().to_string();
        let situation = Situation {
            gate,
            gate_since,
            unprotected: unprotected.clone(),
            master: master.clone(),
        };
        let rescues = facts.reports.iter().filter(|report| report.is_rescue());
        let last = facts.reports.back();
        Status {
            schema: SCHEMA,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            mode: facts.mode,
            pid: std::process::id(),
            started: clock::wall_time_of(facts.started),
            uptime: facts.started.elapsed().as_secs_f64(),
            uri: self.uri.clone(),
            condition: condition(&situation, &facts),
            master,
            master_pid: last.map(|report| report.master_pid),
            open: gate.is_open(),
            ready: gate != State::Unknown,
            standing_in_since: stands_in.then(|| clock::wall_time_of(gate_since)),
            pending_writes: self.ledger.pending(),
            crash_loop: facts.crash_loop.is_some(),
            deaths: facts.deaths,
            checkpoint: self.checkpoint.clone(),
            unprotected,
            journal: self.journal(&facts.disk),
            guarded: facts.guarded.is_guarded(),
            guarded_by: facts.guarded.to_string(),
            state: self.ledger.with_mirror(Master::counts),
            unreachable: self.nodes.unreachable(),
            recoveries: facts.recoveries,
            last_recovery: last.cloned(),
            rescues: facts.rescues,
            last_rescues: rescues.cloned().collect(),
            calls_per_second: self.rate.at(Instant::now(), self.stats.calls.value()),
            slowest_callers: self.clients.slowest(SLOWEST),
            clients: self.clients.list(),
            counters: counters.collect(),
        }
    }

    fn journal(&self, disk: &Disk) -> Journal {
        let sizes = self
            .ledger
            .with_store(|store, _| (store.seq(), store.journal_bytes(), store.snapshot_bytes()));
        let (seq, bytes, snapshot_bytes) = sizes.unwrap_or_default();
        let (at, from) = disk.compacted.unzip();
        Journal {
            records: seq.saturating_sub(from.unwrap_or(seq)),
            bytes,
            snapshot_bytes,
            last_compaction: at.map(clock::wall_time_of),
            disk_free_bytes: disk.free,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn calls_a_second_are_counted_between_two_that_ask() {
        let start = Instant::now();
        let rate = Rate::new(start);
        let at = |ms, calls| rate.at(start + Duration::from_millis(ms), calls);
        assert_eq!(at(100, 50), 0.0, "too early to say");
        assert_eq!(at(2_000, 100), 50.0);
        assert_eq!(at(2_500, 900), 50.0, "what was said last");
        assert_eq!(at(4_000, 200), 50.0);
        assert_eq!(at(14_000, 201), 0.1);
    }
}
