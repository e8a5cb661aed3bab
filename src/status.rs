//! The status of rosrescue as plain data for people and monitors. Other modules fill it; nothing
//! waits for it.

pub(crate) mod call_times;
pub(crate) mod cluster_facts;
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

use rescue_core::cluster::machine::Role;
use serde::{Deserialize, Serialize};

use self::report::{DIED, HealthCheck, LateAnswers, Report, STARTED};
use crate::gate::State;

/// Number of recovery reports that are kept.
const REPORTS: usize = 20;

/// Which of rosrescue's modes this process runs in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// `rosrescue core`: rosrescue starts the master.
    Core,
    /// `rosrescue proxy`: another program starts the master.
    Proxy,
}

/// State of the checkpoint's disk, as the checkpointer sees it.
#[derive(Clone, Copy, Debug)]
pub struct DiskStatus {
    /// Whether changes are recorded, and when this last changed.
    pub protected: bool,
    pub since: Instant,
    /// When the checkpoint was last rewritten as a whole, and the number of the last record in it.
    pub compacted: Option<(Instant, u64)>,
    /// Free bytes on the checkpoint's disk.
    pub free: Option<u64>,
}

impl DiskStatus {
    /// When recording stopped. The failure itself is a little older.
    fn unprotected_since(&self) -> Instant {
        match self.protected {
            true => Instant::now(),
            false => self.since,
        }
    }
}

/// What is known about the health of the master and of rosrescue.
#[derive(Clone, Debug)]
pub struct Facts {
    pub mode: Mode,
    pub started: Instant,
    /// When the crash loop began. `None` if there is none.
    pub crash_loop: Option<Instant>,
    /// When the last crash loop ended.
    pub calm_since: Option<Instant>,
    /// Number of masters that have died in this session.
    pub deaths: u64,
    /// The latest reports of this session, oldest first.
    pub reports: VecDeque<Report>,
    /// Number of masters examined since this process started.
    pub recoveries: u64,
    /// Number of rescues in this session.
    pub rescues: u64,
    /// Outages in which nothing died, since this process started.
    pub(crate) late_answers: LateAnswers,
    /// Whether a new master is being started, because the last one has ended.
    pub(crate) starts_master: bool,
    pub earlier: Earlier,
    pub guarded: Guarded,
    /// Processes, users and computers that bypass rosrescue and talk directly to the master of
    /// `proxy`.
    pub(crate) bypassing: Vec<String>,
    /// Whether the master of `proxy` runs on this computer and accepts connections from other
    /// computers.
    pub(crate) master_is_open: bool,
    pub disk: DiskStatus,
    /// The facts about the other computers. `None` without `--cluster`.
    pub cluster: Option<cluster_facts::ClusterFacts>,
}

/// What happened in this session before this process started.
#[derive(Clone, Debug, Default)]
pub struct Earlier {
    /// The reports of this session's rescues, oldest first.
    pub(crate) reports: Vec<Report>,
    pub(crate) rescues: u64,
    /// Number of masters that died.
    pub(crate) deaths: u64,
    /// Number of times rosrescue died and was restarted, this process included.
    pub(crate) worker_restarts: u64,
    /// Whether the previous process of rosrescue died.
    pub(crate) died: bool,
    /// The highest rescue number used in any session.
    pub(crate) last_number: u64,
}

/// The supervisor that keeps the port and restarts rosrescue when it dies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Guarded {
    /// There is no known supervisor.
    #[default]
    Nobody,
    /// systemd, with a socket unit.
    Systemd,
    /// The guardian is the process `pid`. `restarted` says whether something restarts it when it dies.
    Guardian { pid: u32, restarted: bool },
    /// The guardian with this process id is stopped, as by Ctrl-Z. It does nothing until it is
    /// resumed.
    Stopped(u32),
    /// The guardian with this process id has ended, and nothing has replaced it.
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
            Self::Nobody => f.write_str("nothing (--no-guardian)"),
            Self::Systemd => f.write_str("systemd"),
            Self::Guardian {
                pid,
                restarted: true,
            } => write!(f, "process {pid}"),
            Self::Guardian { pid, .. } => write!(
                f,
                "process {pid}, which nothing restarts (`sudo rosrescue install` sets up a service)"
            ),
            Self::Stopped(pid) => write!(
                f,
                "NOTHING: the guardian, process {pid}, is stopped; resume it with `fg`, `bg` or `kill -CONT {pid}`"
            ),
            Self::NoLonger(pid) => write!(
                f,
                "NOTHING: the guardian, process {pid}, has ended; restart rosrescue when the robot is at rest"
            ),
        }
    }
}

impl Facts {
    /// The facts known when rosrescue starts.
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
            late_answers: LateAnswers::default(),
            starts_master: false,
            earlier: Earlier::default(),
            guarded: Guarded::Nobody,
            bypassing: Vec::new(),
            master_is_open: false,
            disk: DiskStatus {
                protected: true,
                since: started,
                compacted: None,
                free: None,
            },
            cluster: None,
        }
    }

    /// Since when changes have been recorded and there has been no crash loop. Must be called only while this is so and
    /// calls pass to the master.
    fn settled_since(&self) -> Instant {
        self.disk.since.max(self.calm_since.unwrap_or(self.started))
    }

    /// Whether calls are answered by the master, the mirror, or another computer.
    pub(crate) fn answers_calls(&self, gate: State) -> bool {
        match gate {
            State::Open { .. }
            | State::StandingIn
            | State::Late
            | State::Injecting
            | State::Frozen => true,
            State::Elsewhere => {
                let cluster = self.cluster.as_ref();
                cluster.is_some_and(|cluster| cluster.role != Role::Joining)
            }
            State::Unknown => false,
        }
    }

    /// Adds the counts and reports of the session's earlier processes.
    pub(crate) fn go_on(&mut self, mut earlier: Earlier) {
        self.reports.extend(earlier.reports.drain(..));
        self.deaths = earlier.deaths;
        self.rescues = earlier.rescues;
        self.earlier = earlier;
    }

    /// Sets how many masters have died under this process. Deaths counted by earlier processes are added.
    pub(crate) fn set_deaths(&mut self, deaths: u64) {
        self.deaths = self.earlier.deaths + deaths;
    }

    /// Numbers and stores a report, and returns it with its number.
    pub fn add(&mut self, mut report: Report) -> Report {
        self.recoveries += 1;
        if report.cause == STARTED && std::mem::take(&mut self.earlier.died) {
            DIED.clone_into(&mut report.cause);
        }
        let last = self.reports.back().map(|last| last.master_pid);
        report.same_master = report.ended.is_none() && last == Some(report.master_pid);
        // Only the last late answer is kept, so that none takes the place of a rescue.
        self.reports.retain(|report| !report.is_late());
        if report.is_late() {
            self.late_answers.add(&report);
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

    /// Adds the health check to the recovery with this number, and returns the complete report.
    pub(crate) fn add_check(&mut self, number: u64, check: HealthCheck) -> Option<Report> {
        // Search from the end, because all ordinary starts share the number 0.
        let mut reports = self.reports.iter_mut().rev();
        let report = reports.find(|report| report.number == number)?;
        report.add(check);
        Some(report.clone())
    }
}

/// Shares the present [`Facts`] between modules.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::status::report::{Phases, RecoveryOutcome};
    use rescue_core::lifecycle::Cause;

    fn report(cause: &str, outcome: RecoveryOutcome, master_pid: i32) -> Report {
        Report {
            number: 0,
            cause: cause.to_owned(),
            ended: (cause == Cause::Exited.as_str()).then(|| "signal 9".to_owned()),
            detected_at: 0.0,
            outcome,
            master_pid,
            same_master: false,
            master_speaks: String::new(),
            phases: Phases {
                total_ms: 250.0,
                ..Phases::default()
            },
            answered: 0,
            unanswered: 0,
            health_check_ms: None,
            restored: Default::default(),
            not_restored: Vec::new(),
            mismatches: Vec::new(),
            removed: Vec::new(),
            reconciled: Vec::new(),
            unreachable: Vec::new(),
            told_again: Vec::new(),
        }
    }

    #[test]
    fn late_answers_are_counted_apart_and_evict_no_report_of_a_death() {
        let mut facts = Facts::new(Mode::Core);
        facts.add(report(STARTED, RecoveryOutcome::Begun, 1));
        let dead = facts.add(report(Cause::Exited.as_str(), RecoveryOutcome::Injected, 2));
        assert!(dead.is_rescue() && dead.line().contains("a new master got the whole state"));
        for (cause, outcome) in [
            (Cause::Late, RecoveryOutcome::Reconciled),
            (Cause::Hung, RecoveryOutcome::Resumed),
            (Cause::Late, RecoveryOutcome::Injected),
        ] {
            for _ in 0..2 * REPORTS {
                let late = facts.add(report(cause.as_str(), outcome, 2));
                assert!(!late.is_rescue() && late.number == 0, "{late:?}");
                let said = late.to_string();
                assert!(said.contains("the same master continues"), "{said}");
                assert!(!said.contains("without a master"), "{said}");
            }
        }
        assert_eq!(facts.rescues, 1);
        let count = |is: fn(&Report) -> bool| facts.reports.iter().filter(|it| is(it)).count();
        assert_eq!((count(Report::is_rescue), count(Report::is_late)), (1, 1));
        assert_eq!(
            facts.late_answers.to_string(),
            "answered in the master's place 120 times, 30.0 s in all"
        );
        // A hung master that was replaced has died, and so has rosrescue itself.
        let hung = facts.add(report(Cause::Hung.as_str(), RecoveryOutcome::Injected, 3));
        let died = facts.add(report(DIED, RecoveryOutcome::Resumed, 3));
        assert_eq!((hung.number, died.number), (2, 3));
    }
}
