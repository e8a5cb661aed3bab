//! What a recovery did, and how long each part of it took.

use std::{fmt, time::Duration};

use serde::Serialize;
use tracing::field::debug;

use crate::master::Counts;

/// How the present master got its state.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// An empty master and an empty mirror: a new session.
    Begun,
    /// A new incarnation was brought to the mirror's state.
    Injected,
    /// The mirror took over what a running master holds.
    Adopted,
    /// The same incarnation as before was brought to the mirror's state again.
    Reconciled,
    /// The same incarnation as before, unchanged.
    Resumed,
}

impl Outcome {
    /// Whether the master is a new incarnation.
    pub fn is_new(self) -> bool {
        !matches!(self, Self::Reconciled | Self::Resumed)
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Begun => "a new master is served",
            Self::Injected => "the master has been restored",
            Self::Adopted => "a running master has been taken over",
            Self::Reconciled => "the same master goes on, and knows what was written meanwhile",
            Self::Resumed => "the same master goes on",
        })
    }
}

/// Durations in milliseconds.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Phases {
    /// From the shut gate to the master's open port.
    pub absence_ms: f64,
    /// Reading what the master holds.
    pub look_ms: f64,
    /// Injecting and reading back.
    pub injection_ms: f64,
    /// From the shut gate to the open gate.
    pub total_ms: f64,
}

#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Why the gate was shut.
    pub cause: &'static str,
    /// When the gate was shut: seconds since 1970 by the wall clock, to compare with logs.
    pub detected_at: f64,
    /// How the master got its state.
    pub outcome: Outcome,
    /// The process id that the master reports.
    pub master_pid: i32,
    pub phases: Phases,
    /// From the open gate to the end of the health check, in milliseconds; none until then.
    pub health_check_ms: Option<f64>,
    /// What the master holds now.
    pub restored: Counts,
    /// What was not injected, and why.
    pub skipped: Vec<String>,
    /// Differences between the master, read back, and what was injected. Should be empty.
    pub mismatches: Vec<String>,
    /// Nodes that were found dead and unregistered.
    pub removed: Vec<String>,
    /// Registrations that were added (`+`) or removed (`-`), because the node itself reports so.
    pub reconciled: Vec<String>,
    /// Nodes that did not answer and were kept.
    pub unreachable: Vec<String>,
    /// Topics whose subscribers were sent the full list of publishers.
    pub notified: Vec<String>,
}

impl Report {
    /// Adds the results of the health check.
    pub(crate) fn add(&mut self, check: HealthCheck) {
        self.health_check_ms = Some(ms(check.duration));
        self.removed = check.removed;
        self.reconciled = check.reconciled;
        self.unreachable = check.unreachable;
        self.notified = check.notified;
    }

    /// Logs the non-empty parts in one line.
    pub(crate) fn log(&self, message: &str) {
        let some = |list: &Vec<String>| (!list.is_empty()).then(|| debug(list.clone()));
        let Phases {
            absence_ms,
            look_ms,
            injection_ms,
            total_ms,
        } = self.phases;
        tracing::info!(
            cause = self.cause,
            absence_ms,
            look_ms,
            injection_ms,
            total_ms,
            health_check_ms = self.health_check_ms,
            master_pid = self.master_pid,
            skipped = some(&self.skipped),
            mismatches = some(&self.mismatches),
            removed = some(&self.removed),
            reconciled = some(&self.reconciled),
            notified = some(&self.notified),
            unreachable = some(&self.unreachable),
            "{message}: {}",
            self.restored
        );
    }
}

/// A duration in milliseconds, to a hundredth.
pub(crate) fn ms(duration: Duration) -> f64 {
    (duration.as_secs_f64() * 1e5).round() / 1e2
}

/// Results of the health check after a recovery.
#[derive(Debug, Default)]
pub(crate) struct HealthCheck {
    /// From the open gate to its end.
    pub duration: Duration,
    /// Dead nodes that were unregistered at the master, so that others are notified.
    pub removed: Vec<String>,
    /// Registrations that were added or removed, because the node itself reports so.
    pub reconciled: Vec<String>,
    /// Nodes that did not answer and were kept.
    pub unreachable: Vec<String>,
    /// Topics whose subscribers were sent the full list of publishers.
    pub notified: Vec<String>,
}
