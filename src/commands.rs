//! The commands that do not serve nodes. Each asks a running rosrescue, reads a checkpoint or examines this computer,
//! prints the result, and ends with an exit status for scripts.

#![deny(clippy::print_stderr)]

mod check;
mod completions;
mod diff;
mod drill;
mod end_signals;
mod files;
mod handover;
mod history;
mod inspect;
mod install;
mod live;
mod log;
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
    io::{self, Write},
    pin::Pin,
    process::ExitCode,
};

use serde::Serialize;
use thiserror::Error;

use crate::{
    cli::{OutputArgs, Tool},
    printable::{Lines, Printable},
    status::summary::counted,
};

/// Exit status of a command that has a result. [`CommandFailure`] has the other statuses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Exit {
    /// The command worked, and its answer is yes. For example, the robot is protected, the states are equal, or the
    /// wait ended in time.
    Good = 0,
    /// The command worked, and its answer is no. For example, the robot is unprotected, the states differ, or the wait
    /// took too long.
    Bad = 1,
}

/// Why a command has no result.
#[derive(Debug, Error)]
#[non_exhaustive]
pub(crate) enum CommandFailure {
    /// The arguments make no sense. Exit status 2.
    #[error("{0}")]
    Usage(String),
    /// No program answers at the address. Exit status 3.
    #[error("no rosrescue at {uri}: {why}. Start `rosrescue core`, or give its address with --uri")]
    Nobody { uri: String, why: String },
    /// Nothing answers in time, or a process listens at the port but does not answer as rosrescue does. Exit status 3.
    #[error(
        "no rosrescue answers at {uri}: {why}. Its computer is out of reach, or something has the port: a rosrescue \
         that is stopped or overloaded, or another program; `rosrescue check` names it"
    )]
    Silent { uri: String, why: String },
    /// The command started and could not finish. Exit status 1.
    #[error("{0}")]
    Failed(String),
}

impl CommandFailure {
    fn status(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::Nobody { .. } | Self::Silent { .. } => 3,
            Self::Failed(_) => 1,
        }
    }
}

/// Runs `tool` and prints the result.
pub fn run(tool: &Tool) -> ExitCode {
    // Decoding a large answer blocks a worker thread, which a current-thread runtime does not allow.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build();
    // Boxed, so that the compiler generates each command once and not within each way to run a future.
    let work: Pin<Box<dyn Future<Output = _>>> = match tool {
        Tool::Check(args) => Box::pin(check::run(args)),
        Tool::Completions(args) => Box::pin(completions::run(args)),
        Tool::Diff(args) => Box::pin(diff::run(args)),
        Tool::Drill(args) => Box::pin(drill::run(args)),
        Tool::Handover(args) => Box::pin(handover::run(args)),
        Tool::History(args) => Box::pin(history::run(args)),
        Tool::Inspect(args) => Box::pin(inspect::run(args)),
        Tool::Install(args) => Box::pin(install::run(args)),
        Tool::Log(args) => Box::pin(log::run(args)),
        Tool::Man(args) => Box::pin(man::run(args)),
        Tool::Params(args) => Box::pin(params::run(args)),
        Tool::Report(args) => Box::pin(report::run(args)),
        Tool::Restore(args) => Box::pin(restore::run(args)),
        Tool::Status(args) => Box::pin(status::run(args)),
        Tool::Top(args) => Box::pin(top::run(args)),
        Tool::Uninstall(args) => Box::pin(install::undo(args)),
        Tool::Verify(args) => Box::pin(verify::run(args)),
        Tool::Wait(args) => Box::pin(wait::run(args)),
    };
    let ended = match runtime {
        Ok(runtime) => runtime.block_on(work),
        Err(error) => Err(CommandFailure::Failed(format!("no runtime: {error}"))),
    };
    match ended {
        Ok(exit) => ExitCode::from(exit as u8),
        Err(failure) => {
            note(&failure.to_string());
            ExitCode::from(failure.status())
        }
    }
}

/// Prints `result` as text or JSON. A reader that has closed the pipe, such as `head`, is not an error.
fn print(result: &(impl Lines + Serialize), output: &OutputArgs) -> Result<(), CommandFailure> {
    let text = match output.json {
        true => json(result, true)?,
        false => Printable::lines(result),
    };
    print_line(&text).map(drop)
}

/// `value` as JSON, on several lines if `pretty`.
fn json(value: &impl Serialize, pretty: bool) -> Result<Printable, CommandFailure> {
    let text = Printable::json(value, pretty);
    text.map_err(|error| CommandFailure::Failed(format!("no JSON: {error}")))
}

/// Prints a sentence to standard error.
fn note(sentence: &str) {
    eprint_line(&format!("rosrescue: {sentence}"));
}

/// Prints a line to standard error. No command prints there in another way. A closed terminal or pipe is not an error:
/// `drill` still has to clean up.
fn eprint_line(line: &str) {
    let _ = writeln!(io::stderr(), "{}", Printable::line(line));
}

/// Asks a question at the terminal. Returns whether the answer is yes.
fn agrees(question: &str) -> io::Result<bool> {
    write!(io::stderr(), "{} [y/N] ", Printable::line(question))?;
    let mut answer = String::new();
    io::stdin().read_line(&mut answer)?;
    Ok(["y", "yes"].contains(&answer.trim().to_lowercase().as_str()))
}

/// Prints `text` without empty lines at its end. Returns false if the reader has closed the pipe.
fn print_line(text: &Printable) -> Result<bool, CommandFailure> {
    match writeln!(io::stdout(), "{}", text.as_str().trim_end()) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(CommandFailure::Failed(format!("cannot print: {error}"))),
    }
}
