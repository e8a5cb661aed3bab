//! What the driver reports: log lines, status and the recovery report.

use std::time::{Duration, Instant};

use super::{Driver, examine::Examination};
use crate::lifecycle::Cause;
use crate::{
    nodes::health_check,
    status::report::{Outage, Outcome},
};

/// A message about a state that lasts is repeated after this time.
const REPEAT: Duration = Duration::from_secs(10);

impl Driver {
    /// Reports what an examination came to; health check and reconciliation add to the report when they end.
    pub(super) fn report(&mut self, mut examination: Examination) {
        if self.begins() && examination.outcome == Outcome::Injected {
            // Nothing but what the session begins with.
            examination.outcome = Outcome::Begun;
        }
        let Outage { cause, since, .. } = self.outage;
        let report = self.outage.report(Instant::now(), examination);
        let uri = self.proxy.uri.clone();
        self.proxy.ledger.set_identity(report.master_pid, uri);
        let quiet = [Cause::ConnectionLost, Cause::ThreadEnded].map(Cause::as_str);
        if report.outcome == Outcome::Resumed && quiet.contains(&cause) {
            // Such as after each idle connection that a master with `-t` closes; or it is being
            // stopped, and its threads end before it does.
            tracing::debug!("the same master goes on");
            return;
        }
        report.log(&report.outcome.to_string());
        let outcome = report.outcome;
        self.proxy.board.set_report(report);
        if self.served.is_none() {
            // What happened just before we died ourselves, nobody knows any more.
            self.proxy.ledger.with_activity(|mirror, activity| {
                activity.notice_all(mirror, Instant::now());
            });
        }
        if outcome != Outcome::Resumed {
            tokio::spawn(health_check::after_recovery(
                self.proxy.clone(),
                since,
                outcome,
            ));
        }
    }

    pub(super) fn say_waiting(&mut self, what: &str) {
        // A child that is about to listen needs no message.
        if self.process.is_none() && self.outage.since.elapsed() > Duration::from_millis(500)
            || self.outage.since.elapsed() > REPEAT
        {
            self.say(format!("waiting for the master: {what}"));
        }
    }

    /// Warns, at most once in [`REPEAT`] for the same text.
    pub(super) fn say(&mut self, text: String) {
        let now = Instant::now();
        let again = self
            .said
            .as_ref()
            .is_none_or(|(said, at)| *said != text || now.duration_since(*at) >= REPEAT);
        if again {
            tracing::warn!("{text}");
            self.said = Some((text, now));
        }
    }
}
