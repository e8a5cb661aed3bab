//! Changes to the computer: planned, shown, and made.

use std::{
    fmt, fs,
    io::{self, IsTerminal},
    path::PathBuf,
    process::{self as system, Stdio},
};

use serde::Serialize;

use super::super::{CommandFailure, Exit, agrees, eprint_line, print};
use crate::{
    cli::ScopeArgs,
    printable::{Lines, Page, display_lines, line},
};

/// One change to the computer.
#[derive(Debug, Serialize)]
#[serde(tag = "change", rename_all = "snake_case")]
pub(super) enum Change {
    Write { path: PathBuf, text: String },
    Remove { path: PathBuf },
    Run { command: Vec<String> },
}

/// All changes in order, and notes for the operator.
#[derive(Debug, Default, Serialize)]
pub(super) struct SystemChanges {
    pub(super) changes: Vec<Change>,
    pub(super) notes: Vec<String>,
    /// Reasons not to make the changes.
    pub(super) obstacles: Vec<String>,
}

impl SystemChanges {
    /// Adds a command.
    pub(super) fn run(&mut self, command: Vec<String>) {
        self.changes.push(Change::Run { command });
    }
}

/// Shows the plan, asks, and makes the changes.
pub(super) fn carry_out(plan: &SystemChanges, args: &ScopeArgs) -> Result<Exit, CommandFailure> {
    if args.dry_run || plan.changes.is_empty() || !plan.obstacles.is_empty() {
        print(plan, &args.output)?;
        return Ok(if plan.obstacles.is_empty() {
            Exit::Good
        } else {
            Exit::Bad
        });
    }
    if args.yes {
        print(plan, &args.output)?;
    } else if args.output.json || !io::stdin().is_terminal() {
        let text = "cannot ask here: look at the changes with --dry-run, then make them with --yes";
        return Err(CommandFailure::Usage(text.to_owned()));
    } else {
        plan.to_string().lines().for_each(eprint_line);
        if !agrees("Make these changes?").unwrap_or(false) {
            return Err(CommandFailure::Failed("changed nothing".to_owned()));
        }
    }
    for change in &plan.changes {
        change.apply(args.user)?;
    }
    Ok(Exit::Good)
}

impl Change {
    fn apply(&self, user: bool) -> Result<(), CommandFailure> {
        match self {
            Self::Write { path, text } => {
                let folder = path.parent().unwrap_or(path);
                let written = fs::create_dir_all(folder).and_then(|()| fs::write(path, text));
                written.map_err(|error| {
                    CommandFailure::Failed(format!("cannot write {}: {error}", path.display()))
                })
            }
            Self::Remove { path } => {
                let removed = fs::remove_file(path);
                // The folder may hold drop-ins of others.
                if let Some(folder) = path
                    .parent()
                    .filter(|it| it.extension().is_some_and(|end| end == "d"))
                {
                    let _ = fs::remove_dir(folder);
                }
                removed.map_err(|error| {
                    CommandFailure::Failed(format!("cannot remove {}: {error}", path.display()))
                })
            }
            Self::Run { command } => {
                let said = command.join(" ");
                let (journal, undo) = match user {
                    true => (
                        "journalctl --user -u rosrescue",
                        "rosrescue uninstall --user",
                    ),
                    false => ("journalctl -u rosrescue", "sudo rosrescue uninstall"),
                };
                match run_command(command, Stdio::inherit()) {
                    Ok(status) if status.success() => Ok(()),
                    Ok(status) => Err(CommandFailure::Failed(format!(
                        "`{said}` failed ({status}): see above, or `{journal}`. `{undo}` undoes what was done"
                    ))),
                    Err(error) => Err(CommandFailure::Failed(format!("`{said}`: {error}"))),
                }
            }
        }
    }
}

impl Lines for SystemChanges {
    fn lines(&self, f: &mut Page) -> fmt::Result {
        if self.changes.is_empty() {
            line!(f, "nothing to change")?;
        }
        for change in &self.changes {
            match change {
                Change::Write { path, text } => {
                    line!(f, "write   {}", path.display())?;
                    for line in text.lines() {
                        line!(f, "        {line}")?;
                    }
                }
                Change::Remove { path } => line!(f, "remove  {}", path.display())?,
                Change::Run { command } => line!(f, "run     {}", command.join(" "))?,
            }
        }
        for note in &self.notes {
            line!(f, "note    {note}")?;
        }
        for obstacle in &self.obstacles {
            line!(f, "cannot  {obstacle}")?;
        }
        Ok(())
    }
}

display_lines!(SystemChanges);

pub(super) fn run_command(words: &[String], errors: Stdio) -> io::Result<system::ExitStatus> {
    let (program, arguments) = words.split_first().ok_or(io::ErrorKind::InvalidInput)?;
    let mut command = system::Command::new(program);
    let command = command.args(arguments).stdin(Stdio::null());
    command.stdout(Stdio::null()).stderr(errors).status()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_command_is_undone_where_it_was_done() {
        let change = Change::Run {
            command: vec!["false".to_owned()],
        };
        for (user, undo) in [
            (true, "`rosrescue uninstall --user` undoes"),
            (false, "`sudo rosrescue uninstall` undoes"),
        ] {
            let failed = change.apply(user).unwrap_err().to_string();
            assert!(failed.contains(undo), "{failed}");
            assert_eq!(failed.contains("journalctl --user"), user, "{failed}");
        }
    }
}
