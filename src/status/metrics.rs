//! The metrics, in Prometheus' text format.
//!
//! Written by hand: every value is one of a [`Status`], which a library would want in registers of its own.

use std::fmt::{Display, Write};

use super::{condition::Name, stats::Stats, summary::Status};

/// What `/metrics` answers.
pub(crate) fn metrics(stats: &Stats, status: &Status) -> String {
    let mut text = String::new();
    for (name, help, value) in stats.list() {
        add(&mut text, &format!("{name}_total"), help, value);
    }
    let flag = u8::from;
    let journal = &status.journal;
    #[rustfmt::skip]
    let values: [(&str, &str, Option<f64>); 22] = [
        ("calls_pass", "whether calls pass to the master", Some(flag(status.open).into())),
        ("standing_in", "whether the mirror answers, because the master is away", Some(flag(status.standing_in_since.is_some()).into())),
        ("protected", "whether the state is recorded", Some(flag(status.unprotected.is_none()).into())),
        ("crash_loop", "whether the master dies again and again", Some(flag(status.crash_loop).into())),
        ("guarded", "whether another process keeps the port when rosrescue dies", Some(flag(status.guarded).into())),
        ("action_needed", "whether somebody should look: the status says what to do", Some(flag(status.condition.action.is_some()).into())),
        ("master_deaths_total", "masters that have died", Some(status.deaths as f64)),
        ("recoveries_total", "masters examined, the first one included", Some(status.recoveries as f64)),
        ("rescues_total", "rescues: recoveries but for an ordinary start", Some(status.rescues as f64)),
        ("pending_writes", "writes answered by the mirror that the master has not run yet", Some(status.pending_writes as f64)),
        ("nodes", "nodes registered", Some(status.state.nodes as f64)),
        ("publishers", "publishers of topics, each topic counted", Some(status.state.publishers as f64)),
        ("subscribers", "subscribers of topics, each topic counted", Some(status.state.subscribers as f64)),
        ("services", "services registered", Some(status.state.services as f64)),
        ("params", "parameters set", Some(status.state.params as f64)),
        ("unreachable_nodes", "nodes that do not answer and are not known to be dead", Some(status.unreachable.len() as f64)),
        ("clients", "connections of clients, a thousand at most", Some(status.clients.len() as f64)),
        ("start_time_seconds", "when this process was started, in seconds since 1970", Some(status.started)),
        ("journal_bytes", "size of the checkpoint's journal", Some(journal.bytes as f64)),
        ("snapshot_bytes", "size of the checkpoint before its journal", Some(journal.snapshot_bytes as f64)),
        ("disk_free_bytes", "bytes free on the checkpoint's disk", journal.disk_free_bytes.map(|bytes| bytes as f64)),
        ("last_recovery_seconds", "how long calls did not pass to the master the last time", status.last_recovery.as_ref().map(|report| report.phases.total_ms / 1e3)),
    ];
    for (name, help, value) in values {
        if let Some(value) = value {
            add(&mut text, name, help, value);
        }
    }
    head(
        &mut text,
        "condition",
        "1 for what is so, as in /status.json",
        "gauge",
    );
    for name in Name::ALL {
        let value = u8::from(status.condition.name == name);
        let name = name.as_str();
        // Writing to a string does not fail.
        let _ = writeln!(text, "rosrescue_condition{{name=\"{name}\"}} {value}");
    }
    text
}

fn add(text: &mut String, name: &str, help: &str, value: impl Display) {
    let kind = match name.ends_with("_total") {
        true => "counter",
        false => "gauge",
    };
    head(text, name, help, kind);
    let _ = writeln!(text, "rosrescue_{name} {value}");
}

fn head(text: &mut String, name: &str, help: &str, kind: &str) {
    let _ = write!(
        text,
        "# HELP rosrescue_{name} {help}\n# TYPE rosrescue_{name} {kind}\n"
    );
}
