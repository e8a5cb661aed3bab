//! This computer's clock.

use std::path::Path;

use crate::{clock, process};

/// Names of services that set the clock.
const CLOCKS: [&str; 6] = [
    "systemd-timesyn",
    "chronyd",
    "ntpd",
    "openntpd",
    "ptp4l",
    "phc2sys",
];

#[derive(Clone, Debug)]
pub(crate) struct Clock {
    /// The clock's time, in seconds since 1970.
    pub(crate) now: f64,
    /// When the newest known file was changed, in seconds since 1970.
    pub(crate) newest: f64,
    /// The service that sets the clock.
    pub(crate) service: Option<String>,
}

impl Clock {
    pub(super) fn read(checkpoint: &Path) -> Self {
        let own = std::env::current_exe().unwrap_or_default();
        let changed = [
            checkpoint,
            &own,
            Path::new("/var/log/syslog"),
            Path::new("/etc/passwd"),
        ]
        .into_iter()
        .filter_map(|path| rustix::fs::stat(path).ok())
        .map(|stat| stat.st_mtime as f64);
        let synchronized = Path::new("/run/systemd/timesync/synchronized").exists();
        let service = process::all_pids()
            .map(process::name_of)
            .find(|name| CLOCKS.contains(&&**name));
        Self {
            now: clock::wall_time(),
            newest: changed.fold(0.0, f64::max),
            service: match (synchronized, service) {
                (true, _) => Some("systemd-timesyncd".to_owned()),
                (false, service) => service,
            },
        }
    }
}
