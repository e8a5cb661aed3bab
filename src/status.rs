//! The status: plain data for people and monitors, filled by other modules. Nothing waits for it.

pub(crate) mod cluster;
pub(crate) mod computers;
pub(crate) mod condition;
pub(crate) mod metrics;
pub(crate) mod report;
pub(crate) mod software;
pub(crate) mod stats;
pub(crate) mod summary;

use std::{
    collections::VecDeque,
    fmt,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Instant,
};

use serde::{Deserialize, Serialize};

use self::report::{DIED, HealthCheck, Report, STARTED};
use crate::{cluster::machine::Role, gate::State};

/// Reports that are kept.
const REPORTS: usize = 20;

/// Who starts masters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// rosrescue.
    Core,
    /// Somebody else.
    Proxy,
}

/// What the checkpointer knows.
#[derive(Clone, Copy, Debug)]
pub struct Disk {
    /// Whether changes are recorded, and since when it is so.
    pub protected: bool,
    pub since: Instant,
    /// When the checkpoint was written as a whole, and the journal's last record then.
    pub compacted: Option<(Instant, u64)>,
    /// Bytes that are free for the checkpoint.
    pub free: Option<u64>,
}

impl Disk {
    /// Since when changes are not recorded. It is noticed a little later than it is so.
    fn unprotected_since(&self) -> Instant {
        match self.protected {
            true => Instant::now(),
            false => self.since,
        }
    }
}

/// The health of the master and of rosrescue.
#[derive(Clone, Debug)]
pub struct Facts {
    pub mode: Mode,
    pub started: Instant,
    /// Since when the master keeps dying.
    pub crash_loop: Option<Instant>,
    /// When it no longer did.
    pub calm_since: Option<Instant>,
    /// Masters that have died in this session.
    pub deaths: u64,
    /// The latest reports of this session, the oldest first.
    pub reports: VecDeque<Report>,
    /// Masters examined since the start.
    pub recoveries: u64,
    /// Rescues in this session.
    pub rescues: u64,
    pub earlier: Earlier,
    pub guarded: Guarded,
    /// What talks to the master of `proxy` past rosrescue.
    pub(crate) bypassing: Vec<String>,
    /// Whether the master of `proxy` is on this computer and takes connections from others.
    pub(crate) master_is_open: bool,
    pub disk: Disk,
    /// None without other computers.
    pub cluster: Option<cluster::ClusterFacts>,
}

/// What this session was before this process.
#[derive(Clone, Debug, Default)]
pub struct Earlier {
    /// The reports of its rescues, the oldest first.
    pub(crate) reports: Vec<Report>,
    pub(crate) rescues: u64,
    /// Masters that had died.
    pub(crate) deaths: u64,
    /// Times that rosrescue has died and was started again, this process included.
    pub(crate) worker_restarts: u64,
    /// Whether the process before this one died.
    pub(crate) died: bool,
    /// The last number of a rescue, in any session.
    pub(crate) last_number: u64,
}

/// Who keeps the port and restarts rosrescue when it dies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Guarded {
    /// No known supervisor.
    #[default]
    Nobody,
    /// systemd, with a socket unit.
    Systemd,
    /// The guardian, with this process id. `restarted`: whether something starts it again when it dies, too.
    Guardian { pid: u32, restarted: bool },
    /// The guardian, with this process id, was stopped, as by Ctrl-Z. It does nothing until it is continued.
    Stopped(u32),
    /// Nothing any more: the guardian, with this process id, has ended.
    NoLonger(u32),
}

impl Guarded {
    pub fn is_guarded(self) -> bool {
        matches!(self, Self::Systemd | Self::Guardian { .. })
    }
}

impl fmt::Display for Guarded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nobody => f.write_str("nobody (--no-guardian)"),
            Self::Systemd => f.write_str("systemd"),
            Self::Guardian {
                pid,
                restarted: true,
            } => write!(f, "process {pid}"),
            Self::Guardian { pid, .. } => write!(
                f,
                "process {pid}, which nothing starts again (`sudo rosrescue install` makes a service)"
            ),
            Self::Stopped(pid) => write!(
                f,
                "NOBODY: the guardian, process {pid}, is stopped; `fg`, `bg` or `kill -CONT {pid}` \
                 continues it"
            ),
            Self::NoLonger(pid) => write!(
                f,
                "NOBODY: the guardian, process {pid}, has ended; start rosrescue anew when the robot \
                 is at rest"
            ),
        }
    }
}

impl Facts {
    /// What is known at the start.
    pub fn new(mode: Mode) -> Self {
        let started = Instant::now();
        Self {
            mode,
            started,
            crash_loop: None,
            calm_since: None,
            deaths: 0,
            reports: VecDeque::new(),
            recoveries: 0,
            rescues: 0,
            earlier: Earlier::default(),
            guarded: Guarded::Nobody,
            bypassing: Vec::new(),
            master_is_open: false,
            disk: Disk {
                protected: true,
                since: started,
                compacted: None,
                free: None,
            },
            cluster: None,
        }
    }

    /// Since when there is nothing to complain of, if there is nothing now and calls pass.
    fn settled_since(&self) -> Instant {
        self.disk.since.max(self.calm_since.unwrap_or(self.started))
    }

    /// Whether calls are answered: by the master, the mirror, or another computer.
    pub(crate) fn answers(&self, gate: State) -> bool {
        match gate {
            State::Open { .. } | State::StandingIn | State::Late | State::Injecting => true,
            State::Elsewhere => {
                let cluster = self.cluster.as_ref();
                cluster.is_some_and(|cluster| cluster.role != Role::Joining)
            }
            State::Unknown => false,
        }
    }

    /// Goes on from what the session was before this process.
    pub(crate) fn go_on(&mut self, mut earlier: Earlier) {
        self.reports.extend(earlier.reports.drain(..));
        self.deaths = earlier.deaths;
        self.rescues = earlier.rescues;
        self.earlier = earlier;
    }

    /// The masters that this process has seen die, beside those before it.
    pub(crate) fn set_deaths(&mut self, deaths: u64) {
        self.deaths = self.earlier.deaths + deaths;
    }

    /// Adds a report and returns it with its number.
    pub fn add(&mut self, mut report: Report) -> Report {
        self.recoveries += 1;
        if report.cause == STARTED && std::mem::take(&mut self.earlier.died) {
            DIED.clone_into(&mut report.cause);
        }
        if report.is_rescue() {
            self.rescues += 1;
            self.earlier.last_number += 1;
            report.number = self.earlier.last_number;
        }
        if self.reports.len() >= REPORTS {
            self.reports.pop_front();
        }
        self.reports.push_back(report.clone());
        report
    }

    /// Adds the health check after the recovery of that number, and returns the whole report.
    pub(crate) fn add_check(&mut self, number: u64, check: HealthCheck) -> Option<Report> {
        // The last one: all ordinary starts have the same number.
        let mut reports = self.reports.iter_mut().rev();
        let report = reports.find(|report| report.number == number)?;
        report.add(check);
        Some(report.clone())
    }
}

/// Holds the present [`Facts`].
#[derive(Debug)]
pub struct Board(Mutex<Facts>);

impl Board {
    pub fn new(mode: Mode) -> Self {
        Self(Mutex::new(Facts::new(mode)))
    }

    fn lock(&self) -> MutexGuard<'_, Facts> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn read(&self) -> Facts {
        self.lock().clone()
    }

    pub fn update<T>(&self, change: impl FnOnce(&mut Facts) -> T) -> T {
        change(&mut self.lock())
    }
}
