//! Where the files of a service are: of the computer, or of a user.

use std::path::{Path, PathBuf};

use crate::ros_env::Lookup;

#[derive(Clone, Debug)]
pub(in crate::commands) struct Place {
    pub(super) user: bool,
    pub(super) units: PathBuf,
    /// The program, if it has to be copied to be out of harm's way.
    pub(super) program: PathBuf,
    /// The settings of a person, as the unit names them.
    pub(super) environment: &'static str,
    pub(in crate::commands) manifest: PathBuf,
    /// Folders with units of others, the first goes before.
    pub(super) others: Vec<PathBuf>,
    /// The user's services run without a login.
    pub(super) lingers: bool,
}

impl Place {
    pub(in crate::commands) fn system() -> Self {
        let others = ["/etc", "/run", "/usr/local/lib", "/lib", "/usr/lib"];
        Self {
            user: false,
            units: PathBuf::from("/etc/systemd/system"),
            program: PathBuf::from("/usr/local/bin/rosrescue"),
            environment: "/etc/default/rosrescue",
            manifest: PathBuf::from("/etc/rosrescue/installed.json"),
            others: others
                .map(|folder| Path::new(folder).join("systemd/system"))
                .into(),
            lingers: true,
        }
    }

    /// Of the user whose environment is `env`.
    pub(in crate::commands) fn user(env: Lookup<'_>) -> Option<Self> {
        let home = PathBuf::from(env("HOME").filter(|home| home.starts_with('/'))?);
        let given = env("XDG_CONFIG_HOME").filter(|folder| folder.starts_with('/'));
        let config = given.map_or_else(|| home.join(".config"), PathBuf::from);
        let name = env("USER").or_else(|| env("LOGNAME")).unwrap_or_default();
        Some(Self {
            user: true,
            units: config.join("systemd/user"),
            program: home.join(".local/bin/rosrescue"),
            environment: "%E/rosrescue/environment",
            manifest: config.join("rosrescue/installed.json"),
            others: vec![
                config.join("systemd/user"),
                PathBuf::from("/etc/systemd/user"),
                PathBuf::from("/usr/lib/systemd/user"),
            ],
            lingers: Path::new("/var/lib/systemd/linger").join(name).exists(),
        })
    }

    pub(super) fn systemctl(&self, words: &[&str]) -> Vec<String> {
        let manager: &[&str] = if self.user {
            &["systemctl", "--user"]
        } else {
            &["systemctl"]
        };
        manager
            .iter()
            .chain(words)
            .map(|word| (*word).to_owned())
            .collect()
    }
}
