//! The report of a rescue: what was done, and how long each part took.

use std::{fmt, time::Duration};

use ros1_master::master::Counts;
use serde::{Deserialize, Serialize};

use crate::clock;
use crate::{
    limit::{AlarmLimit, all_clear, rarely},
    printable::{Lines, Page, display_lines, line},
};

/// Limits the log lines about the beginning and the end of an outage.
pub(crate) static AWAY: AlarmLimit = AlarmLimit::new();

/// Cause of a recovery at an ordinary start of rosrescue.
pub(crate) const STARTED: &str = "rosrescue started";
/// Cause of a recovery after the previous rosrescue process died.
pub(crate) const DIED: &str = "rosrescue itself died and restarted";
/// Cause of the first recovery after this computer took over from another one.
pub(crate) const TAKEN_OVER: &str = "this computer took over";
/// Cause of the first recovery of a computer that was cut off from the leader.
pub(crate) const CUT_OFF: &str = "this computer was cut off from the others";

/// How the present master got its state.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecoveryOutcome {
    /// A new session: master and mirror were both empty.
    Begun,
    /// A new master got the mirror's state.
    Injected,
    /// The mirror was set to the state of a running master.
    Adopted,
    /// The same master as before got the changes that it had missed.
    Reconciled,
    /// The same master as before already held the right state.
    Resumed,
}

impl RecoveryOutcome {
    /// False if the same master as before continues. Otherwise the present master counts as a new one.
    pub fn is_new(self) -> bool {
        !matches!(self, Self::Reconciled | Self::Resumed)
    }
}

/// How often the same master was late or did not answer, and rosrescue answered in its place.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct LateAnswers {
    pub(crate) times: u64,
    /// How long that took in all, in seconds.
    pub(crate) seconds: f64,
    /// When it happened last, in seconds since 1970.
    pub(crate) last_at: Option<f64>,
}

impl LateAnswers {
    pub(super) fn add(&mut self, report: &Report) {
        self.times += 1;
        self.seconds += report.phases.total_ms / 1e3;
        self.last_at = Some(report.detected_at);
    }
}

/// One sentence, such as `answered in the master's place 46 times, 8.1 s in all`.
impl fmt::Display for LateAnswers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let times = match self.times {
            1 => "once".to_owned(),
            times => format!("{times} times"),
        };
        write!(
            f,
            "answered in the master's place {times}, {:.1} s in all",
            self.seconds
        )
    }
}

/// Durations in milliseconds.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Phases {
    /// From the moment calls stopped passing to the master until a master's port was open.
    pub absence_ms: f64,
    /// Time to read the master's state.
    pub inspection_ms: f64,
    /// Time to give the master the state and to read it back.
    pub injection_ms: f64,
    /// From the moment calls stopped passing to the master until they passed again.
    pub total_ms: f64,
}

/// The report of one recovery. A recovery after an outage or after a restart of rosrescue is a
/// rescue.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Report {
    /// The rescue's number, as in the names of its files; 0 for an ordinary start.
    pub number: u64,
    /// Why calls stopped passing to the master.
    pub cause: String,
    /// How the previous master's process ended. `None` if rosrescue did not see its end.
    pub ended: Option<String>,
    /// When calls stopped passing to the master, in seconds since 1970 by the wall clock, for comparison with logs.
    pub detected_at: f64,
    /// How the master got its state.
    pub outcome: RecoveryOutcome,
    /// The process id that the master reports.
    pub master_pid: i32,
    /// Whether it is the same process as before.
    pub same_master: bool,
    /// HTTP version and Python version of the master, as text.
    pub master_speaks: String,
    pub phases: Phases,
    /// Number of calls that the mirror answered during the outage.
    pub answered: u64,
    /// Number of calls that timed out during the outage, because only a master could answer them.
    pub unanswered: u64,
    /// Time from when calls passed to the master again to the end of the health check, in milliseconds. `None` until it
    /// ends.
    pub health_check_ms: Option<f64>,
    /// Number of items of each kind that the master holds after the recovery.
    pub restored: Counts,
    /// Parts of the state that could not be given to the master, with the reasons.
    pub not_restored: Vec<String>,
    /// Differences between what the master was given and what was read back. This list should be
    /// empty.
    pub mismatches: Vec<String>,
    /// Dead nodes that were unregistered.
    pub removed: Vec<String>,
    /// Registrations that were added (`+`) or removed (`-`) because the node itself reports so.
    pub reconciled: Vec<String>,
    /// Nodes that did not answer and stay registered.
    pub unreachable: Vec<String>,
    /// Topics whose publishers were sent to their subscribers again, in case the previous master died before it had
    /// sent them. This is not an error.
    pub told_again: Vec<String>,
}

impl Report {
    /// Whether the recovery is a rescue. An ordinary start is not, and no [late answer](Self::is_late) is.
    pub(crate) fn is_rescue(&self) -> bool {
        let is_ordinary_start = self.cause == STARTED
            && matches!(
                self.outcome,
                RecoveryOutcome::Begun | RecoveryOutcome::Adopted
            );
        !is_ordinary_start && !self.is_late()
    }

    /// Whether nothing has died: the master was late or did not answer, rosrescue answered in its place, and the same
    /// process continues.
    pub(crate) fn is_late(&self) -> bool {
        let is_beginning = [STARTED, DIED, TAKEN_OVER, CUT_OFF].contains(&self.cause.as_str());
        self.same_master && self.ended.is_none() && !is_beginning
    }

    /// What has happened to the master, in words.
    fn outcome(&self) -> &'static str {
        match self.outcome {
            RecoveryOutcome::Begun => "a new session started with a new master",
            RecoveryOutcome::Injected if self.same_master => {
                "the same master continues, and got the whole state again"
            }
            RecoveryOutcome::Injected => "a new master got the whole state",
            RecoveryOutcome::Adopted => "a running master was taken over with its state",
            RecoveryOutcome::Reconciled => {
                "the same master continues, and got the changes it missed"
            }
            RecoveryOutcome::Resumed => "the same master continues, unchanged",
        }
    }

    /// Adds the results of the health check.
    pub(crate) fn add(&mut self, check: HealthCheck) {
        self.health_check_ms = Some(ms(check.duration));
        self.removed = check.removed;
        self.reconciled = check.reconciled;
        self.unreachable = check.unreachable;
        self.told_again = check.notified;
    }

    /// The lists that are not empty, each with its title.
    fn lists(&self) -> impl Iterator<Item = (&'static str, &[String])> {
        let lists: [(_, &[String]); 6] = [
            ("could not be restored", &self.not_restored),
            ("differs from what was restored", &self.mismatches),
            ("unregistered dead nodes", &self.removed),
            ("corrected after asking the nodes", &self.reconciled),
            ("nodes without an answer", &self.unreachable),
            ("topics announced again", &self.told_again),
        ];
        lists.into_iter().filter(|(_, list)| !list.is_empty())
    }

    /// What nodes noticed during the outage.
    fn felt(&self) -> String {
        match (self.answered, self.unanswered) {
            (0, 0) => "no calls meanwhile".to_owned(),
            (answered, 0) => format!("{answered} calls answered meanwhile, none lost"),
            (answered, lost) => {
                format!("{answered} calls answered meanwhile, {lost} timed out")
            }
        }
    }

    /// Logs that calls pass to the master again.
    pub(crate) fn log(&self) {
        let phases = &self.phases;
        all_clear!(
            info,
            AWAY,
            cause = self.cause,
            ended = self.ended,
            absence_ms = phases.absence_ms,
            inspection_ms = phases.inspection_ms,
            injection_ms = phases.injection_ms,
            total_ms = phases.total_ms,
            master_pid = self.master_pid,
            "calls pass to the master: {} ({})",
            self.outcome(),
            self.restored
        );
        if !self.not_restored.is_empty() {
            let list = &self.not_restored;
            rarely!(
                warn,
                ?list,
                "the new master cannot hold these parameters, or could not return them; set them again"
            );
        }
    }

    /// Logs what the health check found.
    pub(crate) fn log_check(&self) {
        if !self.is_rescue() && self.lists().next().is_none() {
            return;
        }
        let some =
            |list: &Vec<String>| (!list.is_empty()).then(|| tracing::field::debug(list.clone()));
        rarely!(
            info,
            total_ms = self.phases.total_ms,
            health_check_ms = self.health_check_ms,
            removed = some(&self.removed),
            reconciled = some(&self.reconciled),
            told_again = some(&self.told_again),
            unreachable = some(&self.unreachable),
            "every node was checked: {}",
            if self.is_rescue() {
                "the rescue is complete"
            } else {
                "all is done"
            }
        );
    }
}

impl Report {
    /// The report in one line.
    pub(crate) fn line(&self) -> String {
        let at = clock::wall_text(self.detected_at);
        let Self { number, cause, .. } = self;
        let (outcome, total) = (self.outcome(), self.phases.total_ms);
        format!("{number:>3}  {at}  {total:.0} ms: {outcome} ({cause})")
    }
}

/// The report in a few lines.
impl Lines for Report {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let Phases {
            absence_ms,
            inspection_ms,
            injection_ms,
            total_ms,
        } = self.phases;
        if self.number > 0 {
            write!(f, "{}  ", self.number)?;
        }
        write!(f, "{}  {}", clock::wall_text(self.detected_at), self.cause)?;
        if let Some(ended) = &self.ended {
            write!(f, " ({ended})")?;
        }
        line!(f, "; {} after {total_ms:.0} ms", self.outcome())?;
        let without = match self.same_master {
            true => "without an answer",
            false => "without a master",
        };
        line!(
            f,
            "  {absence_ms:.0} ms {without}, {inspection_ms:.0} ms to read it, \
             {injection_ms:.0} ms to restore it; {}",
            self.felt()
        )?;
        line!(f, "  master process {}: {}", self.master_pid, self.restored)?;
        for (what, list) in self.lists() {
            line!(f, "  {what}: {}", list.join(", "))?;
        }
        Ok(())
    }
}

display_lines!(Report);

/// Converts a duration to milliseconds, rounded to hundredths.
pub(crate) fn ms(duration: Duration) -> f64 {
    (duration.as_secs_f64() * 1e5).round() / 1e2
}

/// Results of the health check after a recovery.
#[derive(Debug, Default)]
pub(crate) struct HealthCheck {
    /// Time from when calls passed to the master again to the end of the health check.
    pub duration: Duration,
    /// Dead nodes that were unregistered with the master, so that it notifies other nodes.
    pub removed: Vec<String>,
    /// Registrations that were added or removed because the node itself reports so.
    pub reconciled: Vec<String>,
    /// Nodes that did not answer and stay registered.
    pub unreachable: Vec<String>,
    /// Topics whose subscribers were sent the complete list of publishers.
    pub notified: Vec<String>,
}
