//! The status: what is known at one moment, and how it is written for people.

pub mod report;
pub mod stats;

use std::{
    fmt,
    sync::{Mutex, MutexGuard, PoisonError},
};

use serde::Serialize;
use tokio::sync::watch;

use self::report::Report;
use crate::{
    clock,
    gate::State,
    master::{Counts, Master},
    nodes::health_check::HealthCheck,
    proxy::Proxy,
    server::clients::Client,
};

/// Where those who recover the master say how it goes.
#[derive(Debug, Default)]
pub struct Board {
    inner: Mutex<Inner>,
    opened: watch::Sender<bool>,
}

/// Who keeps the port and starts rosrescue again when it dies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Guarded {
    /// Nobody that we know of.
    #[default]
    Nobody,
    /// systemd, by a socket unit.
    Systemd,
    /// The guardian, which is this process.
    Guardian(u32),
    /// Nobody since the guardian, which was this process, has ended.
    NoLonger(u32),
}

impl Guarded {
    fn is_guarded(self) -> bool {
        matches!(self, Self::Systemd | Self::Guardian(_))
    }
}

impl fmt::Display for Guarded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nobody => f.write_str("nobody (--no-guardian)"),
            Self::Systemd => f.write_str("systemd"),
            Self::Guardian(pid) => write!(f, "process {pid}"),
            Self::NoLonger(pid) => write!(
                f,
                "NOBODY: the guardian, process {pid}, has ended; start rosrescue anew when the robot \
                 is at rest"
            ),
        }
    }
}

#[derive(Debug, Default)]
struct Inner {
    open: bool,
    /// When the gate was shut, by the wall clock.
    shut_at: Option<f64>,
    guarded: Guarded,
    crash_loop: bool,
    deaths: u64,
    recoveries: u64,
    report: Option<Report>,
}

impl Board {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The gate has been opened or shut.
    pub fn set_open(&self, open: bool) {
        let mut inner = self.lock();
        inner.open = open;
        inner.shut_at = (!open).then(clock::wall_time);
        drop(inner);
        if open {
            self.opened.send_replace(true);
        }
    }

    /// Returns when the gate has been open for the first time.
    pub async fn first_opening(&self) {
        // The sender is ours and stays.
        let _ = self.opened.subscribe().wait_for(|opened| *opened).await;
    }

    /// The master dies again and again, or no longer.
    pub fn set_crash_loop(&self, crash_loop: bool) {
        self.lock().crash_loop = crash_loop;
    }

    /// Who guards this process.
    pub fn set_guarded(&self, guarded: Guarded) {
        self.lock().guarded = guarded;
    }

    /// The state in a line; `unprotected` is why it is not recorded.
    pub fn line(&self, unprotected: Option<String>) -> String {
        let inner = self.lock();
        let mut line = match (unprotected, inner.open) {
            (Some(reason), _) => format!("unprotected: {reason}"),
            (None, false) if inner.crash_loop => "the master dies again and again".to_owned(),
            (None, false) => "the master is away".to_owned(),
            (None, true) => "protected".to_owned(),
        };
        if let Guarded::NoLonger(pid) = inner.guarded {
            line += &format!("; unguarded: the guardian, process {pid}, has ended");
        }
        // A newline would begin another assignment.
        line.replace('\n', " ")
    }

    /// So many masters have died.
    pub fn set_deaths(&self, deaths: u64) {
        self.lock().deaths = deaths;
    }

    /// A master has been examined.
    pub fn set_report(&self, report: Report) {
        let mut inner = self.lock();
        inner.recoveries += 1;
        inner.report = Some(report);
    }

    /// What health check and reconciliation found after the last recovery. Answers with the whole report.
    pub fn add_to_report(
        &self,
        check: HealthCheck,
        health_check_ms: f64,
        notified: Vec<String>,
        unreachable: Vec<String>,
    ) -> Option<Report> {
        let mut inner = self.lock();
        let report = inner.report.as_mut()?;
        report.health_check_ms = Some(health_check_ms);
        report.removed = check.removed;
        report.reconciled = check.reconciled;
        report.unreachable = unreachable;
        report.notified = notified;
        Some(report.clone())
    }

    /// The process id of the last master that was examined.
    pub fn master_pid(&self) -> Option<i32> {
        self.lock().report.as_ref().map(|report| report.master_pid)
    }

    /// The report of the last recovery.
    pub fn report(&self) -> Option<Report> {
        self.lock().report.clone()
    }
}

/// The status at one moment.
#[derive(Clone, Debug, Serialize)]
pub struct Status {
    /// Version of rosrescue.
    pub version: &'static str,
    /// What nodes use as `ROS_MASTER_URI`.
    pub uri: String,
    /// The real master.
    pub master: String,
    /// Whether calls pass to it.
    pub open: bool,
    /// Whether calls are answered, by it or by the mirror.
    pub ready: bool,
    /// Since when the mirror stands in for it: seconds since 1970 by the wall clock.
    pub standing_in_since: Option<f64>,
    /// Writes that the mirror has answered and the master has not run yet.
    pub pending_writes: usize,
    /// Whether it dies again and again.
    pub crash_loop: bool,
    /// Masters that have died since the start.
    pub deaths: u64,
    /// The checkpoint file.
    pub checkpoint: String,
    /// Why the state is not recorded; none if all is well.
    pub unprotected: Option<String>,
    /// Whether another process keeps the port, and starts rosrescue again, when it dies.
    pub guarded: bool,
    /// In words, which one.
    pub guarded_by: String,
    /// What the mirror holds.
    pub state: Counts,
    /// Nodes that do not answer now and are not known to be dead.
    pub unreachable: Vec<String>,
    /// Masters examined since the start.
    pub recoveries: u64,
    /// The last one.
    pub last_recovery: Option<Report>,
    /// Connections of clients, at most a thousand of them.
    pub clients: Vec<Client>,
    /// What was counted since the start.
    pub counters: serde_json::Map<String, serde_json::Value>,
}

impl Status {
    /// The status now.
    pub fn of(proxy: &Proxy) -> Self {
        let counters = proxy.stats.list();
        let counters = counters
            .into_iter()
            .map(|(name, _, value)| (name.to_owned(), value.into()));
        let unprotected = proxy.ledger.unprotected();
        let state = proxy.ledger.with_mirror(Master::counts);
        let unreachable = proxy.nodes.unreachable(&proxy.ledger);
        let pending_writes = proxy.ledger.pending();
        let state_of_gate = proxy.gate.state();
        let stands_in = matches!(state_of_gate, State::StandingIn | State::Injecting);
        let inner = proxy.board.lock();
        Self {
            version: env!("CARGO_PKG_VERSION"),
            uri: proxy.uri.clone(),
            master: proxy.upstream.address().to_string(),
            open: inner.open,
            ready: state_of_gate != State::Unknown,
            standing_in_since: inner.shut_at.filter(|_| stands_in),
            pending_writes,
            crash_loop: inner.crash_loop,
            deaths: inner.deaths,
            checkpoint: proxy.config.checkpoint.display().to_string(),
            unprotected,
            guarded: inner.guarded.is_guarded(),
            guarded_by: inner.guarded.to_string(),
            state,
            unreachable,
            recoveries: inner.recoveries,
            last_recovery: inner.report.clone(),
            clients: proxy.clients.list(),
            counters: counters.collect(),
        }
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_says_the_worst() {
        let board = Board::default();
        assert_eq!(board.line(None), "the master is away");
        board.set_crash_loop(true);
        assert_eq!(board.line(None), "the master dies again and again");
        board.set_open(true);
        assert_eq!(board.line(None), "protected");
        let line = board.line(Some("the disk\nis full".to_owned()));
        assert_eq!(line, "unprotected: the disk is full");
        board.set_open(false);
        assert_eq!(board.line(Some("why".to_owned())), "unprotected: why");
        board.set_open(true);
        board.set_guarded(Guarded::NoLonger(7));
        assert!(board.line(None).contains("unguarded"));
    }
}
