//! `rosrescue history`: lists the kept checkpoints.

use std::fmt;

use serde::Serialize;

use super::{CommandFailure, Exit, files, print};
use crate::{
    cli::HistoryArgs,
    clock,
    printable::{Lines, Page, display_lines, line},
    recovery::report_file::{self, ReportRecord},
    status::summary::size,
};

pub(super) async fn run(args: &HistoryArgs) -> Result<Exit, CommandFailure> {
    let present = files::present(&args.checkpoint).await;
    files::require_access(&present)?;
    let reports = report_file::read(&present);
    let rows = files::list(&present)
        .into_iter()
        .zip(1..)
        .map(|(listed, number)| {
            let opened = files::open(&listed.path);
            let counts = opened.as_ref().ok().map(|opened| opened.state.counts());
            Row {
                number,
                what: describe_file(&listed.name),
                rescue: Rescue::from_reports(&listed.name, &reports),
                name: listed.name,
                written: clock::wall_text(listed.written as f64),
                bytes: std::fs::metadata(&listed.path).map_or(0, |metadata| metadata.len()),
                nodes: counts.map(|counts| counts.nodes),
                parameters: counts.map(|counts| counts.params),
                problem: match opened {
                    Ok(opened) => opened.damage.first().cloned(),
                    Err(error) => Some(error.to_string()),
                },
                path: listed.path.display().to_string(),
            }
        });
    let history = History {
        checkpoint: present.display().to_string(),
        kept: rows.collect(),
    };
    print(&history, &args.output)?;
    Ok(if history.kept.is_empty() {
        Exit::Bad
    } else {
        Exit::Good
    })
}

fn describe_file(name: &str) -> &'static str {
    match name.split('-').next() {
        Some("rescue") => "restored in a rescue",
        Some("session") => "end of an earlier session",
        _ => "the checkpoint in use",
    }
}

#[derive(Serialize)]
struct History {
    checkpoint: String,
    kept: Vec<Row>,
}

/// The part of a rescue's report that the list shows.
#[derive(Serialize)]
struct Rescue {
    cause: String,
    /// How the previous master ended, if known.
    ended: Option<String>,
    /// How long calls did not pass to the master, in milliseconds.
    total_ms: f64,
}

impl Rescue {
    fn from_reports(name: &str, reports: &[ReportRecord]) -> Option<Self> {
        let number: u64 = name.strip_prefix("rescue-")?.parse().ok()?;
        let mut reports = reports.iter().map(|kept| &kept.report);
        let report = reports.find(|report| report.number == number)?;
        Some(Self {
            cause: report.cause.clone(),
            ended: report.ended.clone(),
            total_ms: report.phases.total_ms,
        })
    }
}

#[derive(Serialize)]
struct Row {
    number: usize,
    name: String,
    what: &'static str,
    /// The report of the rescue. `None` if there is no report.
    rescue: Option<Rescue>,
    /// Wall time of the last change.
    written: String,
    bytes: u64,
    /// Number of nodes. `None` if the checkpoint cannot be read.
    nodes: Option<usize>,
    parameters: Option<usize>,
    problem: Option<String>,
    path: String,
}

impl Lines for History {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        if self.kept.is_empty() {
            return line!(f, "no checkpoint at {} or beside it", self.checkpoint);
        }
        for row in &self.kept {
            let (name, written, what) = (&row.name, &row.written, row.what);
            let [nodes, params] = [row.nodes, row.parameters]
                .map(|count| count.map_or_else(|| "?".to_owned(), |count| count.to_string()));
            let size = size(row.bytes);
            write!(
                f,
                "{:>3}  {name:<11} {written}  {nodes:>4} nodes {params:>5} parameters {size:>10}  {what}",
                row.number
            )?;
            if let Some(Rescue {
                cause,
                ended,
                total_ms,
            }) = &row.rescue
            {
                let ended = ended
                    .as_ref()
                    .map_or_else(String::new, |how| format!(" ({how})"));
                write!(f, " after {total_ms:.0} ms: {cause}{ended}")?;
            }
            line!(f)?;
            line!(f, "     {}", row.path)?;
            if let Some(problem) = &row.problem {
                line!(f, "     {problem}")?;
            }
        }
        Ok(())
    }
}

display_lines!(History);
