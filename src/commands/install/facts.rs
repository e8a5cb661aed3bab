//! Looking at the computer: files, units of others, the caller's environment.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    net::{SocketAddr, TcpListener},
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use super::{
    found::{self, Found, Kind},
    manifest::{Manifest, Present},
    place::Place,
    plan::UNITS,
};
use crate::commands::Failure;

/// A longer file is no script that starts a robot.
const LARGEST_SCRIPT: u64 = 64 << 10;

/// The environment of the user who typed the command. sudo clears it, but its own process has it still.
pub(super) fn caller_environment() -> BTreeMap<String, String> {
    let own = std::env::vars_os()
        .filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)));
    let own: BTreeMap<_, _> = own.collect();
    let Some(parent) = rustix::process::getppid().filter(|_| own.contains_key("SUDO_USER")) else {
        return own;
    };
    let parent = PathBuf::from(format!("/proc/{}", parent.as_raw_pid()));
    let is_sudo = fs::read_to_string(parent.join("comm")).is_ok_and(|name| name.trim() == "sudo");
    let Some(environ) = is_sudo
        .then(|| fs::read(parent.join("environ")).ok())
        .flatten()
    else {
        return own;
    };
    let pairs = environ.split(|byte| *byte == 0).filter_map(|pair| {
        let (name, value) = std::str::from_utf8(pair).ok()?.split_once('=')?;
        Some((name.to_owned(), value.to_owned()))
    });
    // What sudo says of the caller is in our own alone.
    let mut caller: BTreeMap<_, _> = pairs.collect();
    caller.extend(
        own.into_iter()
            .filter(|(name, _)| name.starts_with("SUDO_")),
    );
    caller
}

/// The home of a user who exists.
pub(super) fn home_of(user: &str) -> Result<PathBuf, Failure> {
    let nobody = || {
        Failure::Usage(format!(
            "--run-as: there is no user `{user}` on this computer"
        ))
    };
    if user.starts_with('-') || user.is_empty() {
        return Err(nobody());
    }
    let output = Command::new("getent").args(["passwd", user]).output();
    let output =
        output.map_err(|error| Failure::Failed(format!("getent passwd {user}: {error}")))?;
    let line = String::from_utf8_lossy(&output.stdout).into_owned();
    match line.trim().split(':').nth(5) {
        Some(home) if output.status.success() => Ok(PathBuf::from(home)),
        _ => Err(nobody()),
    }
}

/// What is at `paths`.
pub(in crate::commands) fn present<'a>(
    paths: impl Iterator<Item = &'a PathBuf>,
) -> BTreeMap<PathBuf, Present> {
    let read = |path: &PathBuf| {
        let content = fs::read(path).ok()?;
        let crc = crc32c::crc32c(&content);
        let text = String::from_utf8(content).ok();
        Some((path.clone(), Present { crc, text }))
    };
    paths.filter_map(read).collect()
}

/// What an earlier installation left to know of itself.
pub(in crate::commands) fn earlier(place: &Place) -> Result<Option<Manifest>, Failure> {
    let unreadable = |error: &dyn std::fmt::Display| {
        Failure::Failed(format!("{}: {error}", place.manifest.display()))
    };
    match fs::read(&place.manifest) {
        Ok(text) => serde_json::from_slice(&text)
            .map(Some)
            .map_err(|error| unreadable(&error)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(unreadable(&error)),
    }
}

/// Units that start a master or roslaunch, of `place` and of the other systemd, `beside`.
pub(super) fn found(place: &Place, beside: Option<&Place>, port: u16) -> Vec<Found> {
    let mut all = Vec::new();
    for place in [Some(place), beside].into_iter().flatten() {
        let mut seen = BTreeSet::new();
        for folder in &place.others {
            let mut files: Vec<_> = fs::read_dir(folder)
                .into_iter()
                .flatten()
                .flatten()
                .map(|it| it.path())
                .collect();
            files.sort();
            for path in files {
                let name = path
                    .file_name()
                    .unwrap_or_default()
                    .to_string_lossy()
                    .into_owned();
                if !name.ends_with(".service")
                    || UNITS.contains(&&*name)
                    || !seen.insert(name.clone())
                {
                    continue;
                }
                let text = fs::read_to_string(&path).unwrap_or_default();
                let Some(kind) = kind_of(&text, port) else {
                    continue;
                };
                all.push(Found {
                    kind,
                    path: path.display().to_string(),
                    of_user: place.user,
                    enabled: is_enabled(place, &name),
                    active: is_active(place, &name),
                    unit: name,
                });
            }
        }
    }
    all
}

/// What the commands of a unit, or the scripts that they run, start. A master counts most.
fn kind_of(unit: &str, port: u16) -> Option<Kind> {
    let mut kinds: Vec<_> = found::commands(unit)
        .iter()
        .filter_map(|command| {
            let of_script = || found::kind(&script(command.split_whitespace().next()?)?, port);
            found::kind(command, port).or_else(of_script)
        })
        .collect();
    kinds.sort_by_key(|kind| *kind != Kind::Master);
    kinds.into_iter().next()
}

fn script(path: &str) -> Option<String> {
    let meta = fs::metadata(path).ok()?;
    let text =
        (meta.is_file() && meta.len() <= LARGEST_SCRIPT).then(|| fs::read_to_string(path).ok());
    text.flatten().filter(|text| text.starts_with("#!"))
}

/// Whether something wants `unit`, as `systemctl enable` has it.
pub(super) fn is_enabled(place: &Place, unit: &str) -> bool {
    place.others.iter().any(|folder| {
        let targets = fs::read_dir(folder)
            .into_iter()
            .flatten()
            .flatten()
            .map(|it| it.path());
        let wants = |path: &PathBuf| {
            let name = path.to_string_lossy();
            name.ends_with(".wants") || name.ends_with(".requires")
        };
        let mut targets = targets.filter(wants);
        targets.any(|target| target.join(unit).is_symlink())
    })
}

pub(super) fn is_active(place: &Place, unit: &str) -> bool {
    let words = place.systemctl(&["is-active", "--quiet", unit]);
    run(&words, Stdio::null()).is_ok_and(|status| status.success())
}

/// Whether a systemd runs that can be asked for this.
pub(in crate::commands) fn systemd_runs(place: &Place) -> bool {
    let booted = Path::new("/run/systemd/system").exists();
    let run = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from);
    booted && (!place.user || run.is_some_and(|run| run.join("systemd/private").exists()))
}

pub(super) fn is_port_taken(listen: &[SocketAddr]) -> bool {
    let in_use = |address: &SocketAddr| {
        TcpListener::bind(address).is_err_and(|error| error.kind() == std::io::ErrorKind::AddrInUse)
    };
    listen.iter().any(in_use)
}

pub(super) fn run(words: &[String], errors: Stdio) -> std::io::Result<std::process::ExitStatus> {
    let (program, arguments) = words
        .split_first()
        .ok_or(std::io::ErrorKind::InvalidInput)?;
    Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(errors)
        .status()
}
