//! The commands that do not serve nodes: each asks a running rosrescue, reads a checkpoint or looks at this
//! computer, prints what it has found, and ends with an exit status that a script can use.

mod check;
mod completions;
mod diff;
mod drill;
mod files;
mod handover;
mod history;
mod inspect;
mod install;
mod live;
mod man;
mod params;
mod report;
mod restore;
mod running;
mod status;
mod terminal;
mod top;
mod verify;
mod wait;

use std::{
    fmt::Display,
    io::{self, Write},
    process::ExitCode,
};

use serde::Serialize;
use thiserror::Error;

use crate::{
    cli::{OutputArgs, Tool},
    log::{plain, plain_json},
};

/// How a command ends. A usage error of the command line has 2, too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Exit {
    /// It is done, and what was asked for is so.
    Good = 0,
    /// It is not so: unprotected, different, not in time, …
    Bad = 1,
}

/// Why a command has no result.
#[derive(Debug, Error)]
#[non_exhaustive]
pub(crate) enum Failure {
    /// What was given makes no sense. Exit status 2.
    #[error("{0}")]
    Usage(String),
    /// No rosrescue answers. Exit status 3.
    #[error("no rosrescue at {uri}: {why}. Start `rosrescue core`, or give its address with --uri")]
    Nobody { uri: String, why: String },
    /// Something has the port and does not answer as a rosrescue. Exit status 3.
    #[error(
        "no rosrescue answers at {uri}: {why}. Something has the port: a rosrescue that is stopped or overloaded, \
         or another program; `rosrescue check` names it"
    )]
    Silent { uri: String, why: String },
    /// It began and could not be finished. Exit status 1.
    #[error("{0}")]
    Failed(String),
}

impl Failure {
    fn status(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::Nobody { .. } | Self::Silent { .. } => 3,
            Self::Failed(_) => 1,
        }
    }
}

/// Runs `tool` and says what it has found.
pub fn run(tool: &Tool) -> ExitCode {
    // Not the current thread alone: what decodes a large answer steps out of the runtime.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build();
    let ended = match runtime {
        Ok(runtime) => runtime.block_on(async {
            match tool {
                Tool::Check(args) => check::run(args).await,
                Tool::Completions(args) => completions::run(args).await,
                Tool::Diff(args) => diff::run(args).await,
                Tool::Drill(args) => drill::run(args).await,
                Tool::Handover(args) => handover::run(args).await,
                Tool::History(args) => history::run(args).await,
                Tool::Inspect(args) => inspect::run(args).await,
                Tool::Install(args) => install::run(args).await,
                Tool::Man(args) => man::run(args).await,
                Tool::Params(args) => params::run(args).await,
                Tool::Report(args) => report::run(args).await,
                Tool::Restore(args) => restore::run(args).await,
                Tool::Status(args) => status::run(args).await,
                Tool::Top(args) => top::run(args).await,
                Tool::Uninstall(args) => install::undo(args).await,
                Tool::Verify(args) => verify::run(args).await,
                Tool::Wait(args) => wait::run(args).await,
            }
        }),
        Err(error) => Err(Failure::Failed(format!("no runtime: {error}"))),
    };
    match ended {
        Ok(exit) => ExitCode::from(exit as u8),
        Err(failure) => {
            eprintln!("rosrescue: {}", plain(&failure.to_string()));
            ExitCode::from(failure.status())
        }
    }
}

/// Prints `result`, as text or JSON. A reader that has gone, as `head` does, is no failure.
fn print(result: &(impl Display + Serialize), output: &OutputArgs) -> Result<(), Failure> {
    let text = if output.json {
        let json = serde_json::to_string_pretty(result);
        plain_json(&json.map_err(|error| Failure::Failed(format!("no JSON: {error}")))?)
    } else {
        plain(&result.to_string())
    };
    print_line(text.trim_end()).map(drop)
}

/// Prints `text`. Returns whether anybody reads it.
fn print_line(text: &str) -> Result<bool, Failure> {
    match writeln!(io::stdout(), "{text}") {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(Failure::Failed(format!("cannot print: {error}"))),
    }
}

/// A number of things, as in `1 message` and `2 messages`.
fn counted(count: usize, thing: &str) -> String {
    let plural = if count == 1 { "" } else { "s" };
    format!("{count} {thing}{plural}")
}
