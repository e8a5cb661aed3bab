//! The driver's reports: log lines, status, and the recovery report.

use std::time::{Duration, Instant};

use rescue_core::lifecycle::Cause;
use tracing::Instrument;

use super::{
    Driver,
    examine::Examination,
    master_process::MasterProcess,
    report_file::{self, ReportRecord},
};
use crate::{
    clock,
    limit::all_clear,
    nodes::health_check,
    status::{
        report::{AWAY, Phases, RecoveryOutcome, Report, ms},
        stats::Stats,
    },
};

/// Pause before the same message is logged again. It doubles with each repetition.
const REPEAT: Duration = Duration::from_secs(10);
/// Longest pause before the same message is logged again.
const LONGEST_REPEAT: Duration = Duration::from_secs(600);

/// A period in which calls did not pass to the master.
#[derive(Clone, Debug)]
pub(super) struct Outage {
    pub cause: &'static str,
    pub since: Instant,
    wall: f64,
    port_open: Option<Instant>,
    stats: &'static Stats,
    /// The numbers of [`counted`] when the outage began.
    before: (u64, u64),
}

/// Number of calls that the mirror has answered, and number of calls that timed out.
fn counted(stats: &Stats) -> (u64, u64) {
    (
        stats.calls_without_master.value(),
        stats.calls_unanswered.value(),
    )
}

impl Outage {
    /// Begins an outage at `now`.
    pub(super) fn begin(now: Instant, cause: &'static str, stats: &'static Stats) -> Self {
        Self {
            stats,
            before: counted(stats),
            cause,
            since: now,
            wall: clock::wall_time(),
            port_open: None,
        }
    }

    /// Notes that the master's port is open again.
    pub(super) fn port_open(&mut self, now: Instant) {
        self.port_open = Some(now);
    }

    /// The report of an outage that ends at `now` with this `examination`. `speaks` names the master's versions of HTTP and
    /// Python.
    pub(super) fn report(&self, now: Instant, examination: Examination, speaks: String) -> Report {
        let total = now.duration_since(self.since);
        let absence = self
            .port_open
            .map_or(total, |open| open.duration_since(self.since));
        let (answered, unanswered) = counted(self.stats);
        Report {
            number: 0,
            cause: self.cause.to_owned(),
            ended: None,
            answered: answered - self.before.0,
            unanswered: unanswered - self.before.1,
            detected_at: self.wall,
            outcome: examination.outcome,
            master_pid: examination.pid,
            same_master: false,
            master_speaks: speaks,
            phases: Phases {
                absence_ms: ms(absence),
                inspection_ms: ms(examination.inspection),
                injection_ms: ms(examination.injection),
                total_ms: ms(total),
            },
            health_check_ms: None,
            restored: examination.counts,
            not_restored: examination.skipped,
            mismatches: examination.mismatches,
            removed: Vec::new(),
            reconciled: Vec::new(),
            unreachable: Vec::new(),
            told_again: Vec::new(),
        }
    }
}

/// The last message of [`Driver::log_once`].
pub(super) struct LastMessage {
    text: String,
    pause: Duration,
    /// When the message may be logged again.
    next: Instant,
}

impl Driver {
    /// Reports what an examination of a master found and did, in the log, the status and the recovery report. The
    /// health check adds its results when it ends.
    pub(super) fn report(&mut self, mut examination: Examination, speaks: String) {
        let is_new_session = self.course.lifecycle().is_new_session();
        if is_new_session && examination.outcome == RecoveryOutcome::Injected {
            // The master holds only the session's initial state.
            examination.outcome = RecoveryOutcome::Begun;
        }
        let (cause, since) = (self.outage.cause, self.outage.since);
        let mut report = self.outage.report(Instant::now(), examination, speaks);
        report.ended = self.process.as_mut().and_then(MasterProcess::take_end);
        self.examiner.ledger.set_master_pid(report.master_pid);
        let quiet = [Cause::ConnectionLost, Cause::ThreadEnded].map(Cause::as_str);
        if report.ended.is_some() && quiet.contains(&cause) {
            // What was noticed first, such as a closed connection, was part of the end of the master's process.
            report.cause = Cause::Exited.as_str().into();
        }
        if report.outcome == RecoveryOutcome::Resumed && quiet.contains(&cause) {
            // This is normal: a master with `-t` closes each idle connection, and the threads of a master that is being
            // stopped end before the process.
            all_clear!(
                info,
                AWAY,
                "calls pass to the master: the same master continues"
            );
            return;
        }
        let report = self.board.update(|facts| facts.add(report));
        report.log();
        let session = self.examiner.ledger.session().id;
        let store = self.examiner.ledger.seen_store();
        let works = store.filter(|store| store.unprotected.is_none() && report.is_rescue());
        let checkpoint = works.map(|store| store.path);
        if let (Some(checkpoint), RecoveryOutcome::Resumed) = (&checkpoint, report.outcome) {
            report_file::save(
                checkpoint.clone(),
                ReportRecord::new(&self.board, &session, report.clone()),
            );
        }
        let is_restored = report.outcome == RecoveryOutcome::Injected && report.is_rescue();
        self.restored = is_restored.then_some(report.number);
        let news = self.course.examined(Instant::now(), report.outcome);
        if news.all {
            self.examiner.ledger.with_activity(|mirror, activity| {
                activity.notice_all(mirror, Instant::now());
            });
        }
        let number = report.number;
        if let Some(telling) = news.telling {
            let (nodes, board) = (self.nodes.clone(), self.board.clone());
            let check = async move {
                let check = health_check::after_recovery(nodes, since, telling).await;
                let Some(check) = check else { return };
                if let Some(report) = board.update(|facts| facts.add_check(number, check)) {
                    report.log_check();
                    if let Some(checkpoint) = checkpoint {
                        report_file::save(checkpoint, ReportRecord::new(&board, &session, report));
                    }
                }
            };
            crate::task::spawn(check.instrument(tracing::debug_span!("health_check")));
        }
    }

    /// Logs why the master cannot be used yet. `may_be_absent` says that no program may listen at its address.
    pub(super) fn log_waiting(&mut self, what: &str, may_be_absent: bool) {
        // Waiting for a child that is about to listen needs no message.
        if self.process.is_none() && self.outage.since.elapsed() > Duration::from_millis(500)
            || self.outage.since.elapsed() > REPEAT
        {
            match self.process {
                None if may_be_absent => self.log_once(format!(
                    "waiting for the master, which you must start: {what}"
                )),
                _ => self.log_once(format!("waiting for the master: {what}")),
            }
        }
    }

    /// Logs a warning. Repeats the same text only after growing pauses.
    pub(super) fn log_once(&mut self, text: String) {
        let now = Instant::now();
        let pause = match &self.last_message {
            Some(said) if said.text == text && now < said.next => return,
            Some(said) if said.text == text => (said.pause * 2).min(LONGEST_REPEAT),
            _ => REPEAT,
        };
        tracing::warn!("{text}");
        AWAY.note_reported();
        let next = now + pause;
        self.last_message = Some(LastMessage { text, pause, next });
    }
}
