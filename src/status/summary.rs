//! The status at one moment, as `/status.json` and `rosrescue status` have it.

use std::fmt;

use serde::Serialize;

use super::report::Report;
use crate::{clock, master::Counts};

/// A connection of a client.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Client {
    pub(crate) peer: String,
    /// The caller id of its last call, cut if it is long.
    pub(crate) caller_id: String,
    /// Calls on this connection.
    pub(crate) calls: u64,
}

/// The status at one moment.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Status {
    pub(crate) version: &'static str,
    /// What nodes use as `ROS_MASTER_URI`.
    pub(crate) uri: String,
    pub(crate) master: String,
    /// Whether calls pass to the master.
    pub(crate) open: bool,
    /// Whether calls are answered, by the master or the mirror.
    pub(crate) ready: bool,
    /// Since when the mirror stands in: seconds since 1970, by the wall clock.
    pub(crate) standing_in_since: Option<f64>,
    /// Writes that the mirror has answered and the master has not run yet.
    pub(crate) pending_writes: usize,
    /// Whether the master keeps dying.
    pub(crate) crash_loop: bool,
    /// Masters that have died since the start.
    pub(crate) deaths: u64,
    pub(crate) checkpoint: String,
    /// Why the state is not recorded; none if it is.
    pub(crate) unprotected: Option<String>,
    /// Whether the guardian or systemd keeps the port and restarts rosrescue when it dies.
    pub(crate) guarded: bool,
    pub(crate) guarded_by: String,
    /// Contents of the mirror.
    pub(crate) state: Counts,
    /// Nodes that do not answer and are not known to be dead.
    pub(crate) unreachable: Vec<String>,
    /// Masters examined since the start.
    pub(crate) recoveries: u64,
    pub(crate) last_recovery: Option<Report>,
    /// Connections of clients, at most a thousand.
    pub(crate) clients: Vec<Client>,
    /// Counters since the start.
    pub(crate) counters: serde_json::Map<String, serde_json::Value>,
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
