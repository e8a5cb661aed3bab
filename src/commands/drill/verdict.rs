//! The verdict of a drill.

use std::fmt;

use serde::Serialize;

use super::{
    calls::{CallResults, Waits},
    robot::DrillDifference,
    topics,
};
use crate::{
    commands::counted,
    printable::{Lines, Page, display_lines, line},
};

/// Maximum number of sentences of one kind.
const MOST: usize = 12;

/// One kill.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Kill {
    /// The killed processes, each with its role and process id.
    pub(super) killed: Vec<(&'static str, u32)>,
    /// `SIGKILL`, or `SIGSTOP` for a process that was made to hang.
    pub(super) signal: &'static str,
    /// Time until calls passed to a living master again. `None` if that took too long.
    pub(super) recovered_ms: Option<f64>,
}

/// The result of a drill.
#[derive(Clone, Debug, Serialize)]
pub(super) struct DrillVerdict {
    pub(super) passed: bool,
    pub(super) uri: String,
    pub(super) version: String,
    pub(super) seconds: f64,
    pub(super) kills: Vec<Kill>,
    pub(super) calls: CallResults,
    pub(super) topics: Vec<topics::TopicReport>,
    /// Number of nodes that are the same processes as before the drill.
    pub(super) nodes: usize,
    pub(super) registrations_and_parameters: usize,
    /// Why the drill failed.
    pub(super) failures: Vec<String>,
    /// Other observations.
    pub(super) notes: Vec<String>,
}

impl DrillVerdict {
    /// Collects the failures.
    pub(super) fn collect_failures(
        &mut self,
        difference: DrillDifference,
        shutdown: Option<String>,
        limit: u32,
    ) {
        let mut failures = Vec::new();
        for kill in self.kills.iter().filter(|kill| kill.recovered_ms.is_none()) {
            let who = names(&kill.killed);
            failures.push(format!(
                "{limit} s after the {} of {who} calls did not pass to a living master",
                kill.signal
            ));
        }
        let CallResults {
            reads,
            writes,
            notifications,
        } = &self.calls;
        for (what, waits) in [
            ("reads", reads),
            ("writes", writes),
            ("notifications", notifications),
        ] {
            if waits.failed > 0 {
                let some = waits.failures.join("; ");
                failures.push(format!("{} {what} failed: {some}", waits.failed));
            } else if waits.calls == 0 {
                failures.push(format!("no {what} were seen"));
            }
        }
        for topic in &self.topics {
            let of = topic.failures.iter();
            failures.extend(of.map(|failure| format!("{}: {failure}", topic.topic)));
        }
        if let Some(why) = shutdown {
            failures.push(format!("the drill's node was told to shut down: {why}"));
        }
        failures.extend(shorten(difference.lost));
        self.notes.extend(shorten(difference.new));
        if self.topics.iter().all(|topic| topic.messages == 0) {
            self.notes.push(
                "no topic carried messages: only calls, nodes and state were watched".to_owned(),
            );
        }
        self.passed = failures.is_empty();
        self.failures = failures;
    }
}

/// Keeps the first sentences, and says how many more there are.
fn shorten(mut all: Vec<String>) -> Vec<String> {
    let more = all.len().saturating_sub(MOST);
    all.truncate(MOST);
    if more > 0 {
        all.push(format!("and {more} more like these"));
    }
    all
}

pub(super) fn names(killed: &[(&'static str, u32)]) -> String {
    let names = killed
        .iter()
        .map(|(name, pid)| format!("the {name} ({pid})"));
    names.collect::<Vec<_>>().join(" and ")
}

impl Lines for DrillVerdict {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        let verdict = if self.passed { "PASSED" } else { "FAILED" };
        let what = match self.kills.as_slice() {
            [] => "killed nothing".to_owned(),
            all @ [first, ..] => {
                let names: Vec<_> = first.killed.iter().map(|(name, _)| *name).collect();
                let how = match first.signal {
                    "SIGSTOP" => "made to hang",
                    _ => "killed",
                };
                format!(
                    "{} {how} {}",
                    names.join(" and "),
                    counted(all.len(), "time")
                )
            }
        };
        let Self {
            uri,
            version,
            seconds,
            ..
        } = self;
        line!(
            f,
            "{verdict}: {what} in {seconds:.1} s, rosrescue {version} at {uri}"
        )?;
        for failure in &self.failures {
            line!(f, "  failed        {failure}")?;
        }
        for kill in &self.kills {
            let after = match kill.recovered_ms {
                Some(ms) => format!("calls passed to the master again after {ms:.0} ms"),
                None => "calls did not pass again".to_owned(),
            };
            line!(f, "  {:<14}{}: {after}", kill.signal, names(&kill.killed))?;
        }
        for (what, waits) in [
            ("reads", &self.calls.reads),
            ("writes", &self.calls.writes),
            ("notifications", &self.calls.notifications),
        ] {
            line!(f, "  {what:<14}{waits}")?;
        }
        for topic in &self.topics {
            line!(f, "  topic         {topic}")?;
        }
        let (nodes, facts) = (self.nodes, self.registrations_and_parameters);
        if self.passed {
            line!(
                f,
                "  nodes         {nodes} nodes are the same processes as before"
            )?;
            line!(
                f,
                "  state         {facts} registrations, types and parameters are there as before"
            )?;
        }
        for note in &self.notes {
            line!(f, "  note          {note}")?;
        }
        Ok(())
    }
}

display_lines!(DrillVerdict);

impl fmt::Display for Waits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let failed = match self.failed {
            0 => "none failed".to_owned(),
            failed => format!("{failed} FAILED"),
        };
        write!(
            f,
            "{}, {failed}, the longest took {:.0} ms",
            self.calls, self.longest_ms
        )?;
        match self.again {
            0 => Ok(()),
            again => write!(
                f,
                "; {again} were sent again over a new connection, as ROS does"
            ),
        }
    }
}

impl fmt::Display for topics::TopicReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lost = match self.lost {
            Some(0) => "none lost",
            Some(_) => "some LOST",
            None => "without numbers",
        };
        let Self {
            topic,
            messages,
            longest_gap_ms,
            ..
        } = self;
        let publishers = counted(self.publishers, "publisher");
        write!(
            f,
            "{topic}: {messages} messages of {publishers}, {lost}, longest pause {longest_gap_ms:.0} ms"
        )?;
        match self.normal_gap_ms {
            Some(normal) => write!(f, " ({normal:.0} ms before)"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verdict() -> DrillVerdict {
        let fine = Waits {
            calls: 10,
            longest_ms: 7.0,
            ..Waits::default()
        };
        DrillVerdict {
            passed: false,
            uri: "http://robot:11311/".to_owned(),
            version: "1".to_owned(),
            seconds: 7.0,
            kills: vec![Kill {
                killed: vec![("master", 7)],
                signal: "SIGKILL",
                recovered_ms: Some(90.0),
            }],
            calls: CallResults {
                reads: fine.clone(),
                writes: fine.clone(),
                notifications: fine,
            },
            topics: Vec::new(),
            nodes: 2,
            registrations_and_parameters: 9,
            failures: Vec::new(),
            notes: Vec::new(),
        }
    }

    #[test]
    fn it_has_passed_if_nothing_failed() {
        let mut passed = verdict();
        passed.collect_failures(DrillDifference::default(), None, 30);
        assert!(passed.passed && passed.to_string().starts_with("PASSED: "));
        // The verdict also says what the drill could not see.
        assert!(passed.notes[0].contains("no topic carried messages"));
    }

    #[test]
    fn each_failure_is_said() {
        let fails = |spoil: &dyn Fn(&mut DrillVerdict) -> (DrillDifference, Option<String>),
                     said: &str| {
            let mut failed = verdict();
            let (difference, shutdown) = spoil(&mut failed);
            failed.collect_failures(difference, shutdown, 30);
            let text = failed.to_string();
            assert!(!failed.passed && text.starts_with("FAILED: "), "{text}");
            assert!(text.contains(said), "{text}");
        };
        let same = DrillDifference::default;
        fails(
            &|verdict| {
                verdict.kills[0].recovered_ms = None;
                (same(), None)
            },
            "30 s after the SIGKILL of the master (7) calls did not pass",
        );
        fails(
            &|verdict| {
                verdict.calls.reads.failed = 1;
                verdict.calls.reads.failures = vec!["getParam(/k) was refused".to_owned()];
                (same(), None)
            },
            "1 reads failed: getParam(/k) was refused",
        );
        fails(
            &|verdict| {
                verdict.calls.notifications.calls = 0;
                (same(), None)
            },
            "no notifications were seen",
        );
        fails(
            &|_| (same(), Some("new node".to_owned())),
            "told to shut down: new node",
        );
        let lost = (0..20)
            .map(|number| format!("the node /n{number} is gone"))
            .collect();
        let lost = DrillDifference {
            lost,
            ..DrillDifference::default()
        };
        fails(&|_| (lost.clone(), None), "and 8 more like these");
    }
}
