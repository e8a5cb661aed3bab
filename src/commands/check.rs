//! `rosrescue check`: finds problems in the robot's setup before it drives.
//!
//! [`facts`] gathers and does not judge; [`findings`] judges and does not gather.

mod computers;
mod facts;
mod findings;
mod launch;
mod links;
mod planting;
mod reach;
mod robot;
mod ros;
mod shell;
pub(in crate::commands) mod units;

use std::{convert::Infallible, fmt, time::Duration};

use serde::Serialize;

use self::facts::SetupFacts;
use super::{CommandFailure, Exit, counted, eprint_line, print, running::Running};
use crate::{
    cli::{CheckArgs, OptionValue},
    printable::{Lines, Page, display_lines, line},
    ros_env::MasterUri,
};

pub(super) async fn run(args: &CheckArgs) -> Result<Exit, CommandFailure> {
    let master = args.master.as_deref().map(MasterUri::parse).transpose();
    let master = master.map_err(|error| CommandFailure::Usage(format!("--master: {error}")))?;
    if args.live {
        return finish(args, links::check_links(args).await?);
    }
    let facts = SetupFacts::gather(args, master);
    let slow = async {
        tokio::time::sleep(Duration::from_secs(1)).await;
        eprint_line("still checking: looking up unknown names takes long");
        std::future::pending::<Infallible>().await
    };
    let facts = tokio::select! {
        facts = facts => facts,
        never = slow => match never {},
    };
    let mut findings = findings::from_facts(&facts);
    findings.extend(robot(args).await?);
    findings.extend(planting::find_unsafe_folder(&facts.disk.checkpoint));
    findings.extend(sources(&args.settings));
    finish(args, findings)
}

/// What the rosrescue that runs already, if there is one, says about the robot.
async fn robot(args: &CheckArgs) -> Result<Option<Finding>, CommandFailure> {
    match find_running(args) {
        Ok(running) => Ok(robot::find_trouble(&running, args.target.uri.is_some()).await),
        // A wrong ROS_MASTER_URI is a finding of its own.
        Err(_) if args.target.uri.is_none() => Ok(None),
        Err(failure) => Err(failure),
    }
}

/// The rosrescue that `--uri` or the port stands for.
fn find_running(args: &CheckArgs) -> Result<Running, CommandFailure> {
    let mut running = Running::find(&args.target)?;
    if let (None, Some(port)) = (&args.target.uri, args.port) {
        running.address.port = port;
    }
    Ok(running)
}

fn finish(args: &CheckArgs, findings: Vec<Finding>) -> Result<Exit, CommandFailure> {
    let report = Report::new(findings, &args.settings);
    print(&report, &args.output)?;
    Ok(match report.problems {
        0 => Exit::Good,
        _ => Exit::Bad,
    })
}

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
enum Severity {
    Ok,
    /// Good to know.
    Note,
    /// Something may go wrong.
    Warning,
    /// Something will go wrong.
    Problem,
}

/// One result of the check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
struct Finding {
    severity: Severity,
    subject: &'static str,
    what: String,
    /// What to do. Empty if nothing.
    todo: String,
}

/// Where the values of the options come from.
fn sources(settings: &[OptionValue]) -> Vec<Finding> {
    let (defaults, chosen): (Vec<_>, Vec<_>) = settings
        .iter()
        .partition(|setting| setting.source == "default");
    let chosen = chosen.into_iter().map(|setting| {
        let value = setting.value.as_deref().unwrap_or("none");
        format!("{} = {value} ({})", setting.option, setting.source)
    });
    let rest = counted(defaults.len(), "option");
    chosen
        .chain([format!("{rest} with the default value")])
        .map(|what| Finding {
            severity: Severity::Ok,
            subject: "options",
            what,
            todo: String::new(),
        })
        .collect()
}

/// All findings, worst first.
#[derive(Clone, Debug, Serialize)]
struct Report<'a> {
    problems: usize,
    warnings: usize,
    findings: Vec<Finding>,
    /// All options of `core` or `proxy`.
    options: &'a [OptionValue],
}

impl<'a> Report<'a> {
    fn new(mut findings: Vec<Finding>, options: &'a [OptionValue]) -> Self {
        let count = |of| findings.iter().filter(|one| one.severity == of).count();
        let (problems, warnings) = (count(Severity::Problem), count(Severity::Warning));
        findings.sort_by_key(|finding| std::cmp::Reverse(finding.severity));
        Self {
            problems,
            warnings,
            findings,
            options,
        }
    }
}

impl Lines for Report<'_> {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        for finding in &self.findings {
            let severity = match finding.severity {
                Severity::Ok => "ok",
                Severity::Note => "note",
                Severity::Warning => "WARNING",
                Severity::Problem => "PROBLEM",
            };
            line!(f, "{severity:<9}{:<16}{}", finding.subject, finding.what)?;
            if !finding.todo.is_empty() {
                line!(f, "{:<25}> {}", "", finding.todo)?;
            }
        }
        match (self.problems, self.warnings) {
            (0, 0) => line!(f, "No problems found."),
            (problems, warnings) => {
                let (problems, warnings) =
                    (counted(problems, "problem"), counted(warnings, "warning"));
                line!(f, "{problems}, {warnings}")
            }
        }
    }
}

display_lines!(Report<'_>);
