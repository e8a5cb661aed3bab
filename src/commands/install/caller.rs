//! Who calls `rosrescue install`, and the user that runs the service.

use std::{
    collections::BTreeMap,
    fs,
    path::PathBuf,
    process::{self as system, Stdio},
};

use super::{super::CommandFailure, system_changes::run_command, unit_paths::UnitPaths};
use crate::cli::InstallArgs;

/// The environment of the user who called sudo. sudo clears it, but sudo's own process still has it.
pub(super) fn caller_environment() -> BTreeMap<String, String> {
    let own = std::env::vars_os()
        .filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)));
    let own: BTreeMap<_, _> = own.collect();
    let parent = rustix::process::getppid().filter(|_| own.contains_key("SUDO_USER"));
    let of_sudo = parent.and_then(|parent| {
        let parent = PathBuf::from(format!("/proc/{}", parent.as_raw_pid()));
        let name = fs::read_to_string(parent.join("comm")).ok()?;
        (name.trim() == "sudo").then(|| fs::read(parent.join("environ")).ok())?
    });
    let Some(environ) = of_sudo else { return own };
    let pairs = environ.split(|byte| *byte == 0).filter_map(|pair| {
        let (name, value) = std::str::from_utf8(pair).ok()?.split_once('=')?;
        Some((name.to_owned(), value.to_owned()))
    });
    // Only this process's environment has sudo's variables about the caller.
    let of_caller = own.iter().filter(|(name, _)| name.starts_with("SUDO_"));
    pairs
        .chain(of_caller.map(|(name, value)| (name.clone(), value.clone())))
        .collect()
}

/// The user that runs the service, if an option or sudo names it.
pub(super) fn named_user(args: &InstallArgs, caller: &BTreeMap<String, String>) -> Option<String> {
    let of_caller = || caller.get("SUDO_USER").cloned();
    args.run_as.clone().or_else(of_caller)
}

/// The home folder of `user`, or of the caller.
pub(super) fn home(user: Option<&str>, caller: &BTreeMap<String, String>) -> Option<String> {
    let Some(user) = user else {
        return caller.get("HOME").cloned();
    };
    let getent = system::Command::new("getent")
        .args(["passwd", user])
        .output();
    let entry = String::from_utf8(getent.ok()?.stdout).ok()?;
    entry.split(':').nth(5).map(str::to_owned)
}

/// The name of the user who runs this process.
fn own_name() -> Result<String, CommandFailure> {
    let output = system::Command::new("id").arg("-un").output();
    let name = output.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned());
    let name = name.map_err(|error| CommandFailure::Failed(format!("id: {error}")))?;
    Some(name)
        .filter(|name| !name.is_empty())
        .ok_or_else(|| CommandFailure::Failed("this user has no name: use --run-as".to_owned()))
}

/// The user that runs the service. `None` for a user's own service. A dry run needs no sudo.
pub(super) fn account(
    args: &InstallArgs,
    paths: &UnitPaths,
    caller: &BTreeMap<String, String>,
) -> Result<Option<String>, CommandFailure> {
    if paths.user {
        return Ok(None);
    }
    let Some(user) = named_user(args, caller) else {
        return match args.scope.dry_run {
            true => own_name().map(Some),
            false => Err(CommandFailure::Usage(
                "name the user that runs the service, as in --run-as robot: without sudo, install cannot know it"
                    .to_owned(),
            )),
        };
    };
    let nobody = || {
        CommandFailure::Usage(format!(
            "--run-as: there is no user `{user}` on this computer"
        ))
    };
    if user.starts_with('-') {
        return Err(nobody());
    }
    let getent = ["getent", "passwd", &user].map(str::to_owned);
    let status = run_command(&getent, Stdio::null());
    let status = status.map_err(|error| CommandFailure::Failed(format!("getent: {error}")))?;
    status
        .success()
        .then_some(Some(user.clone()))
        .ok_or_else(nobody)
}
