//! The metrics, in Prometheus' text format.

use super::{stats::Stats, summary::Status};

/// What `/metrics` answers.
pub(crate) fn metrics(stats: &Stats, status: &Status) -> String {
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
