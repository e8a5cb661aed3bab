//! Status page and metrics, by GET on the port that nodes use. Read-only.
//!
//! | path | answer |
//! |---|---|
//! | `/` | the status as text |
//! | `/status.json` | the status as JSON, with the report of the last recovery |
//! | `/metrics` | counters in Prometheus' text format |
//! | `/live` | 200 while rosrescue runs |
//! | `/ready` | 200 while calls are answered, by the master or by the mirror, else 503 |

use std::sync::Arc;

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
    status::{Board, metrics::metrics, stats::Stats, summary::Status},
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
