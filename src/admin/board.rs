//! The status: what is known at one moment, and how it is written for people.

use std::{
    fmt,
    sync::{Mutex, MutexGuard, PoisonError},
};

use serde::Serialize;
use tokio::sync::watch;

use crate::{
    master::{Counts, Master},
    proxy::{Proxy, clients::Client},
    recovery::{census::Census, report::Report},
};

/// Most records set aside that are named.
const SET_ASIDE_MOST: usize = 1000;

/// Where those who recover the master say how it goes.
#[derive(Debug, Default)]
pub struct Board {
    inner: Mutex<Inner>,
    opened: watch::Sender<bool>,
}

#[derive(Debug, Default)]
struct Inner {
    open: bool,
    crash_loop: bool,
    deaths: u64,
    recoveries: u64,
    set_aside: Vec<String>,
    report: Option<Report>,
}

impl Board {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The gate has been opened or shut.
    pub fn set_open(&self, open: bool) {
        self.lock().open = open;
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

    /// So many masters have died.
    pub fn set_deaths(&self, deaths: u64) {
        self.lock().deaths = deaths;
    }

    /// A record has been set aside because each new master died of it.
    pub fn add_set_aside(&self, record: String) {
        let set_aside = &mut self.lock().set_aside;
        if set_aside.len() < SET_ASIDE_MOST {
            set_aside.push(record);
        }
    }

    /// A master has been examined.
    pub fn set_report(&self, report: Report) {
        let mut inner = self.lock();
        inner.recoveries += 1;
        inner.report = Some(report);
    }

    /// What census and healing found after the last recovery. Answers with the whole report.
    pub fn add_to_report(
        &self,
        census: Census,
        census_ms: f64,
        healed: Vec<String>,
        suspects: Vec<String>,
    ) -> Option<Report> {
        let mut inner = self.lock();
        let report = inner.report.as_mut()?;
        report.census_ms = Some(census_ms);
        report.removed = census.removed;
        report.mended = census.mended;
        report.suspects = suspects;
        report.healed = healed;
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
    /// Whether it dies again and again.
    pub crash_loop: bool,
    /// Masters that have died since the start.
    pub deaths: u64,
    /// What was set aside since the start because each new master died of it; kept in files beside
    /// the checkpoint.
    pub set_aside: Vec<String>,
    /// The checkpoint file.
    pub checkpoint: String,
    /// Why the state is not recorded; none if all is well.
    pub unprotected: Option<String>,
    /// What the mirror holds.
    pub state: Counts,
    /// Nodes that do not answer now and are not known to be dead.
    pub suspects: Vec<String>,
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
        let unprotected = proxy.shadow.unprotected();
        let state = proxy.shadow.with_mirror(Master::counts);
        let suspects = proxy.nodes.suspects(&proxy.shadow);
        let inner = proxy.board.lock();
        Self {
            version: env!("CARGO_PKG_VERSION"),
            uri: proxy.uri.clone(),
            master: proxy.upstream.address().to_string(),
            open: inner.open,
            crash_loop: inner.crash_loop,
            deaths: inner.deaths,
            set_aside: inner.set_aside.clone(),
            checkpoint: proxy.config.checkpoint.display().to_string(),
            unprotected,
            state,
            suspects,
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
        let gate = if self.open {
            "open"
        } else {
            "shut: the master is away"
        };
        writeln!(f, "master          {} (gate {gate})", self.master)?;
        if self.crash_loop {
            writeln!(
                f,
                "                crash loop: the master dies again and again"
            )?;
        }
        if !self.set_aside.is_empty() {
            writeln!(f, "set aside       {}", self.set_aside.join(", "))?;
        }
        let protection = self.unprotected.as_deref().map_or_else(
            || "protected".to_owned(),
            |reason| format!("UNPROTECTED: {reason}"),
        );
        writeln!(f, "checkpoint      {} ({protection})", self.checkpoint)?;
        writeln!(f, "state           {}", self.state)?;
        if !self.suspects.is_empty() {
            writeln!(f, "suspect         {}", self.suspects.join(", "))?;
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
                ("mended", &report.mended),
                ("suspect", &report.suspects),
                ("healed", &report.healed),
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
