//! Status page and metrics, by GET on the port that nodes use. Read-only.
//!
//! | path | answer |
//! |---|---|
//! | `/` | the status as text |
//! | `/status.json` | the status as JSON, with the report of the last recovery |
//! | `/metrics` | counters in Prometheus' text format |
//! | `/live` | 200 while rosrescue runs |
//! | `/ready` | 200 while calls are answered, by the master or by the mirror, else 503 |

use bytes::Bytes;
use http_body_util::Full;
use hyper::{
    Response, StatusCode,
    header::{CONTENT_TYPE, HeaderValue},
};

use super::service::HttpReply;
use crate::{proxy::Proxy, status::Status};

/// The page at `path`.
pub fn page(proxy: &Proxy, path: &str) -> HttpReply {
    const TEXT: &str = "text/plain; charset=utf-8";
    let status = Status::of(proxy);
    let (code, kind, body) = match path {
        "/" => (StatusCode::OK, TEXT, status.to_string()),
        "/status.json" => match serde_json::to_string_pretty(&status) {
            Ok(json) => (StatusCode::OK, "application/json", json + "\n"),
            Err(error) => (
                StatusCode::INTERNAL_SERVER_ERROR,
                TEXT,
                format!("{error}\n"),
            ),
        },
        "/metrics" => (
            StatusCode::OK,
            "text/plain; version=0.0.4",
            metrics(proxy, &status),
        ),
        "/live" => (StatusCode::OK, TEXT, "live\n".to_owned()),
        "/ready" if status.ready => (StatusCode::OK, TEXT, "ready\n".to_owned()),
        "/ready" => (
            StatusCode::SERVICE_UNAVAILABLE,
            TEXT,
            "no master was ever seen: calls wait for one\n".to_owned(),
        ),
        _ => (
            StatusCode::NOT_FOUND,
            TEXT,
            "no such page; there are /, /status.json, /metrics, /live and /ready\n".to_owned(),
        ),
    };
    let mut reply = Response::new(Full::new(Bytes::from(body)));
    *reply.status_mut() = code;
    reply
        .headers_mut()
        .insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    reply
}

fn metrics(proxy: &Proxy, status: &Status) -> String {
    use std::fmt::Write;

    let mut text = String::new();
    let mut add = |name: &str, kind: &str, help: &str, value: f64| {
        // Writing to a string does not fail.
        let _ = write!(
            text,
            "# HELP rosrescue_{name} {help}\n# TYPE rosrescue_{name} {kind}\nrosrescue_{name} {value}\n"
        );
    };
    for (name, help, value) in proxy.stats.list() {
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
