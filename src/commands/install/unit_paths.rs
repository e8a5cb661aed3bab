//! Where the unit files go, and the systemd that runs the service.

use std::{
    path::{Path, PathBuf},
    process::Stdio,
};

use super::{
    super::{
        CommandFailure,
        check::units::{self as others},
    },
    system_changes::run_command,
};
use crate::cli::ScopeArgs;

pub(super) const UNITS: [&str; 2] = ["rosrescue.service", "rosrescue.socket"];

/// Where the unit files go, and which systemd runs the service.
pub(super) struct UnitPaths {
    /// Whether the service is a user's own, and not the system's.
    pub(super) user: bool,
    units: PathBuf,
}

impl UnitPaths {
    pub(super) fn new(args: &ScopeArgs) -> Result<Self, CommandFailure> {
        let (user, units) = (args.user, PathBuf::from("/etc/systemd/system"));
        if !user {
            return Ok(Self { user, units });
        }
        if rustix::process::geteuid().is_root() && std::env::var_os("SUDO_USER").is_some() {
            let text = "--user: run it as yourself, without sudo";
            return Err(CommandFailure::Usage(text.to_owned()));
        }
        let folder = |name: &str| {
            let folder = std::env::var_os(name).map(PathBuf::from);
            folder.filter(|folder| folder.is_absolute())
        };
        let config = folder("XDG_CONFIG_HOME").or_else(|| Some(folder("HOME")?.join(".config")));
        let config =
            config.ok_or_else(|| CommandFailure::Usage("--user: HOME is not set".to_owned()))?;
        let units = config.join("systemd/user");
        Ok(Self { user, units })
    }

    /// Whether the Debian package provides the units: only for the system's systemd, and only if `program` is the
    /// package's.
    pub(super) fn is_packaged(&self, program: &Path) -> bool {
        let unit = Path::new("/usr/lib/systemd/system").join(UNITS[0]);
        !self.user && program == Path::new("/usr/bin/rosrescue") && unit.exists()
    }

    /// The two units and their drop-ins.
    pub(super) fn files(&self) -> [PathBuf; 4] {
        let [service, socket] = UNITS.map(|unit| self.units.join(unit));
        let dropins = UNITS.map(|unit| self.units.join(format!("{unit}.d/install.conf")));
        let [service_dropin, socket_dropin] = dropins;
        [service, socket, service_dropin, socket_dropin]
    }

    pub(super) fn systemctl(&self, words: &[&str]) -> Vec<String> {
        let manager: &[&str] = match self.user {
            true => &["systemctl", "--user"],
            false => &["systemctl"],
        };
        let words = manager.iter().chain(words);
        words.map(|&word| word.to_owned()).collect()
    }

    /// Whether systemctl confirms `question`, such as `is-active`, for `unit`.
    pub(super) fn systemctl_confirms(&self, question: &str, unit: &str) -> bool {
        let command = self.systemctl(&[question, "--quiet", unit]);
        run_command(&command, Stdio::null()).is_ok_and(|status| status.success())
    }

    /// Whether systemd runs and can start the service.
    pub(super) fn systemd_runs(&self) -> bool {
        let run = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from);
        Path::new("/run/systemd/system").exists()
            && (!self.user || run.is_some_and(|run| run.join("systemd/private").exists()))
    }

    /// The systemctl option that starts or stops a unit at once, if systemd runs.
    pub(super) fn now_option(&self) -> &'static [&'static str] {
        if self.systemd_runs() { &["--now"] } else { &[] }
    }

    pub(super) fn other_units(&self) -> Vec<others::Unit> {
        let user = [self.units.clone(), "/etc/systemd/user".into()];
        let folders = if self.user { &user[..] } else { &[] };
        others::in_folders(folders, !self.user)
    }
}
