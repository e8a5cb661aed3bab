//! Carrying a plan out.

use std::{
    fs,
    io::{self, IsTerminal, Write},
    os::unix::fs::PermissionsExt,
    path::Path,
    process::Stdio,
};

use super::{
    facts,
    place::Place,
    plan::{Change, Plan},
};
use crate::{cli::ScopeArgs, commands::Failure};

/// Whether `plan` is to be carried out: `--yes`, or the word of somebody at the terminal.
pub(in crate::commands) fn is_wanted(plan: &Plan, args: &ScopeArgs) -> Result<bool, Failure> {
    if args.yes {
        return Ok(true);
    }
    if args.output.json || !io::stdin().is_terminal() {
        return Err(Failure::Usage(
            "nobody can be asked here: look at it with --dry-run, and do it with --yes".to_owned(),
        ));
    }
    eprint!("{plan}\nDo it? [y/N] ");
    let _ = io::stderr().flush();
    let mut answer = String::new();
    let _ = io::stdin().read_line(&mut answer);
    Ok(["y", "yes"].contains(&answer.trim().to_lowercase().as_str()))
}

/// Does all that is in `plan`. What it has done is known to `uninstall` before a unit is started.
pub(in crate::commands) fn apply(
    plan: &Plan,
    place: &Place,
    remembers: bool,
) -> Result<(), Failure> {
    let mut remembered = !remembers;
    for change in &plan.changes {
        match change {
            Change::Write {
                path,
                content,
                mode,
                ..
            } => write(path, content, *mode)?,
            Change::Remove { path } => remove(path)?,
            Change::Run { command, .. } => {
                if !remembered {
                    remember(plan, place)?;
                    remembered = true;
                }
                let said = command.join(" ");
                let status = facts::run(command, Stdio::inherit());
                match status {
                    Ok(status) if status.success() => {}
                    Ok(status) => {
                        return Err(Failure::Failed(format!(
                            "`{said}` has failed ({status}): it says why above, or `journalctl -u rosrescue` does. \
                             `rosrescue uninstall` takes back what was done"
                        )));
                    }
                    Err(error) => return Err(Failure::Failed(format!("`{said}`: {error}"))),
                }
            }
        }
    }
    if !remembered {
        remember(plan, place)?;
    }
    Ok(())
}

fn remember(plan: &Plan, place: &Place) -> Result<(), Failure> {
    let text = serde_json::to_vec_pretty(&plan.manifest)
        .map_err(|error| Failure::Failed(format!("{}: {error}", place.manifest.display())))?;
    write(&place.manifest, &text, 0o644)
}

/// Replaces a file as a whole, since it may be a program that runs.
fn write(path: &Path, content: &[u8], mode: u32) -> Result<(), Failure> {
    let replace = || {
        let folder = path.parent().unwrap_or_else(|| Path::new("/"));
        fs::create_dir_all(folder)?;
        let new = path.with_extension("rosrescue-new");
        fs::write(&new, content)?;
        fs::set_permissions(&new, fs::Permissions::from_mode(mode))?;
        fs::rename(&new, path)
    };
    replace().map_err(|error| Failure::Failed(format!("cannot write {}: {error}", path.display())))
}

/// Removes a file, and its folder if that is ours and empty.
fn remove(path: &Path) -> Result<(), Failure> {
    fs::remove_file(path)
        .or_else(|error| {
            if error.kind() == io::ErrorKind::NotFound {
                Ok(())
            } else {
                Err(error)
            }
        })
        .map_err(|error| Failure::Failed(format!("cannot remove {}: {error}", path.display())))?;
    if let Some(folder) = path.parent().filter(|folder| folder.ends_with("rosrescue")) {
        let _ = fs::remove_dir(folder);
    }
    Ok(())
}
