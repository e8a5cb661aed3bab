//! Status page and metrics, by GET on the port that nodes use. Read-only.
//!
//! | path | answer |
//! |---|---|
//! | `/` | the status as text |
//! | `/status.json` | the status as JSON, with the report of the last recovery |
//! | `/metrics` | counters in Prometheus' text format |
//! | `/live` | 200 while rosrescue runs |
//! | `/ready` | 200 while calls are answered, by the master or by the mirror, else 503 |

use std::{fmt, sync::Arc};

use hyper::StatusCode;
use serde::Serialize;

use super::{
    clients::{Client, Clients},
    replies::{HttpReply, page, text},
};
use crate::{
    clock,
    gate::{self, State},
    ledger::Ledger,
    master::{Counts, Master},
    nodes::Nodes,
    status::{Board, report::Report, stats::Stats},
    upstream::Upstream,
};

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
        let stands_in = matches!(gate, State::StandingIn | State::Injecting);
        let shut_since = self.gate.shut_since().filter(|_| stands_in);
        let facts = self.board.read();
        Status {
            version: env!("CARGO_PKG_VERSION"),
            uri: self.uri.clone(),
            master: self.upstream.address().to_string(),
            open: gate.is_open(),
            ready: gate != State::Unknown,
            standing_in_since: shut_since
                .map(|since| clock::wall_time() - since.elapsed().as_secs_f64()),
            pending_writes: self.ledger.pending(),
            crash_loop: facts.crash_loop,
            deaths: facts.deaths,
            checkpoint: self.checkpoint.clone(),
            unprotected: self.ledger.unprotected(),
            guarded: facts.guarded.is_guarded(),
            guarded_by: facts.guarded.to_string(),
            state: self.ledger.with_mirror(Master::counts),
            unreachable: self.nodes.unreachable(),
            recoveries: facts.recoveries,
            last_recovery: facts.last_recovery,
            clients: self.clients.list(),
            counters: counters.collect(),
        }
    }
}

/// The status at one moment.
#[derive(Clone, Debug, Serialize)]
struct Status {
    version: &'static str,
    /// What nodes use as `ROS_MASTER_URI`.
    uri: String,
    master: String,
    /// Whether calls pass to the master.
    open: bool,
    /// Whether calls are answered, by the master or the mirror.
    ready: bool,
    /// Since when the mirror stands in: seconds since 1970, by the wall clock.
    standing_in_since: Option<f64>,
    /// Writes that the mirror has answered and the master has not run yet.
    pending_writes: usize,
    /// Whether the master keeps dying.
    crash_loop: bool,
    /// Masters that have died since the start.
    deaths: u64,
    checkpoint: String,
    /// Why the state is not recorded; none if it is.
    unprotected: Option<String>,
    /// Whether the guardian or systemd keeps the port and restarts rosrescue when it dies.
    guarded: bool,
    guarded_by: String,
    /// Contents of the mirror.
    state: Counts,
    /// Nodes that do not answer and are not known to be dead.
    unreachable: Vec<String>,
    /// Masters examined since the start.
    recoveries: u64,
    last_recovery: Option<Report>,
    /// Connections of clients, at most a thousand.
    clients: Vec<Client>,
    /// Counters since the start.
    counters: serde_json::Map<String, serde_json::Value>,
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "rosrescue {}", self.version)?;
        writeln!(f, "ROS_MASTER_URI  {}", self.uri)?;
        let gate = match (self.standing_in_since, self.ready) {
            (Some(since), _) => format!(
                "away, standing in since {}, {} pending writes",
                clock::wall_text(since),
                self.pending_writes
            ),
            (None, true) => "calls pass".to_owned(),
            (None, false) => "not seen yet, calls wait".to_owned(),
        };
        writeln!(f, "master          {} ({gate})", self.master)?;
        if self.crash_loop {
            writeln!(
                f,
                "                crash loop: the master dies again and again"
            )?;
        }
        let protection = self.unprotected.as_deref().map_or_else(
            || "protected".to_owned(),
            |reason| format!("UNPROTECTED: {reason}"),
        );
        writeln!(f, "checkpoint      {} ({protection})", self.checkpoint)?;
        writeln!(f, "guarded by      {}", self.guarded_by)?;
        writeln!(f, "state           {}", self.state)?;
        if !self.unreachable.is_empty() {
            writeln!(f, "unreachable     {}", self.unreachable.join(", "))?;
        }
        if let Some(report) = &self.last_recovery {
            writeln!(
                f,
                "last recovery   {} ms after {}",
                report.phases.total_ms.round(),
                report.cause
            )?;
            for (what, names) in [
                ("not injected", &report.skipped),
                ("differs", &report.mismatches),
                ("removed", &report.removed),
                ("reconciled", &report.reconciled),
                ("unreachable", &report.unreachable),
                ("notified", &report.notified),
            ] {
                if !names.is_empty() {
                    writeln!(f, "  {what:<14}{}", names.join(", "))?;
                }
            }
        }
        for (name, value) in &self.counters {
            writeln!(f, "{name:<16}{value}")?;
        }
        Ok(())
    }
}

fn metrics(stats: &Stats, status: &Status) -> String {
    use std::fmt::Write;

    let mut text = String::new();
    let mut add = |name: &str, kind: &str, help: &str, value: f64| {
        // Writing to a string does not fail.
        let _ = write!(
            text,
            "# HELP rosrescue_{name} {help}\n# TYPE rosrescue_{name} {kind}\nrosrescue_{name} {value}\n"
        );
    };
    for (name, help, value) in stats.list() {
        add(&format!("{name}_total"), "counter", help, value as f64);
    }
    let flag = |truth: bool| f64::from(u8::from(truth));
    add(
        "gate_open",
        "gauge",
        "whether calls pass to the master",
        flag(status.open),
    );
    add(
        "standing_in",
        "gauge",
        "whether the mirror answers, because the master is away",
        flag(status.standing_in_since.is_some()),
    );
    add(
        "pending_writes",
        "gauge",
        "writes answered by the mirror that the master has not run yet",
        status.pending_writes as f64,
    );
    add(
        "protected",
        "gauge",
        "whether the state is recorded",
        flag(status.unprotected.is_none()),
    );
    add(
        "crash_loop",
        "gauge",
        "whether the master dies again and again",
        flag(status.crash_loop),
    );
    add(
        "guarded",
        "gauge",
        "whether another process keeps the port when rosrescue dies",
        flag(status.guarded),
    );
    add(
        "recoveries_total",
        "counter",
        "masters examined",
        status.recoveries as f64,
    );
    add(
        "master_deaths_total",
        "counter",
        "masters that have died",
        status.deaths as f64,
    );
    let counts = status.state;
    add("nodes", "gauge", "nodes registered", counts.nodes as f64);
    add("params", "gauge", "parameters set", counts.params as f64);
    let unreachable = status.unreachable.len();
    add(
        "unreachable_nodes",
        "gauge",
        "nodes that do not answer and are not known to be dead",
        unreachable as f64,
    );
    if let Some(report) = &status.last_recovery {
        let seconds = report.phases.total_ms / 1e3;
        add(
            "last_recovery_seconds",
            "gauge",
            "from the shut gate to the open one",
            seconds,
        );
    }
    text
}
