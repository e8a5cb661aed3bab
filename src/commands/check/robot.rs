//! What a running rosrescue says about the robot.

use super::{Finding, Severity};
use crate::{
    commands::{CommandFailure, running::Running},
    status::condition::Condition,
};

const SUBJECT: &str = "robot";

/// The condition of the robot, unless all is well. `must_run` says whether a rosrescue has to answer.
pub(super) async fn find_trouble(running: &Running, must_run: bool) -> Option<Finding> {
    match running.status().await {
        Ok(status) => judge_condition(&status.condition),
        // A bare master has no status.
        Err(CommandFailure::Nobody { .. } | CommandFailure::Silent { .. }) if !must_run => None,
        Err(failure) => Some(Finding {
            severity: Severity::Warning,
            subject: SUBJECT,
            what: failure.to_string(),
            todo: String::new(),
        }),
    }
}

fn judge_condition(condition: &Condition) -> Option<Finding> {
    // Calls pass and are recorded, but there is something to do, such as for a guardian that has ended.
    let works = condition.is_protected() && condition.name == condition.apart_from_nodes;
    // What passes by itself, such as a rescue, has no action.
    let is_warning = works || condition.action.is_none();
    (!condition.is_good()).then(|| Finding {
        severity: match is_warning {
            true => Severity::Warning,
            false => Severity::Problem,
        },
        subject: SUBJECT,
        what: format!("{}: {}", condition.title(), condition.text),
        todo: condition.action.clone().unwrap_or_default(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::status::condition::ConditionName;

    #[test]
    fn what_the_status_says_is_a_finding() {
        let finding = |name, apart_from_nodes, action: Option<&str>| {
            judge_condition(&Condition {
                name,
                apart_from_nodes,
                since: 0.0,
                text: "Nodes work as usual.".to_owned(),
                action: action.map(str::to_owned),
            })
        };
        let good = ConditionName::Protected;
        assert_eq!(finding(good, good, None), None);
        let warning = finding(good, good, Some("restart it.")).unwrap();
        assert_eq!(warning.severity, Severity::Warning);
        let of = ConditionName::CrashLoop;
        let problem = finding(of, of, Some("find the reason.")).unwrap();
        assert_eq!(problem.severity, Severity::Problem);
        assert_eq!(
            (&*problem.what, &*problem.todo),
            (
                "master crash loop: Nodes work as usual.",
                "find the reason."
            )
        );
        let dead = finding(ConditionName::NodesDead, good, Some("restart it.")).unwrap();
        assert_eq!(dead.severity, Severity::Problem);
    }
}
