//! The status: plain data for people and monitors, filled by other modules. Nothing waits for it.

pub(crate) mod metrics;
pub(crate) mod report;
pub(crate) mod stats;
pub(crate) mod summary;

use std::{
    fmt,
    sync::{Mutex, MutexGuard, PoisonError},
};

use self::report::Report;

/// The health of the master and of rosrescue.
#[derive(Clone, Debug, Default)]
pub struct Facts {
    /// The master keeps dying.
    pub crash_loop: bool,
    /// Masters that have died since the start.
    pub deaths: u64,
    /// Masters examined since the start.
    pub recoveries: u64,
    pub last_recovery: Option<Report>,
    pub guarded: Guarded,
}

/// Who keeps the port and restarts rosrescue when it dies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Guarded {
    /// No known supervisor.
    #[default]
    Nobody,
    /// systemd, with a socket unit.
    Systemd,
    /// The guardian, with this process id.
    Guardian(u32),
    /// Nothing any more: the guardian, with this process id, has ended.
    NoLonger(u32),
}

impl Guarded {
    pub fn is_guarded(self) -> bool {
        matches!(self, Self::Systemd | Self::Guardian(_))
    }
}

impl fmt::Display for Guarded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nobody => f.write_str("nobody (--no-guardian)"),
            Self::Systemd => f.write_str("systemd"),
            Self::Guardian(pid) => write!(f, "process {pid}"),
            Self::NoLonger(pid) => write!(
                f,
                "NOBODY: the guardian, process {pid}, has ended; start rosrescue anew when the robot \
                 is at rest"
            ),
        }
    }
}

impl Facts {
    /// The state in a line. `open`: whether calls pass to the master. `unprotected`: why it is not recorded.
    pub fn line(&self, open: bool, unprotected: Option<String>) -> String {
        let mut line = match (unprotected, open) {
            (Some(reason), _) => format!("unprotected: {reason}"),
            (None, false) if self.crash_loop => "the master dies again and again".to_owned(),
            (None, false) => "the master is away".to_owned(),
            (None, true) => "protected".to_owned(),
        };
        if let Guarded::NoLonger(pid) = self.guarded {
            line += &format!("; unguarded: the guardian, process {pid}, has ended");
        }
        // A newline would start another assignment.
        line.replace('\n', " ")
    }
}

/// Holds the present [`Facts`].
#[derive(Debug, Default)]
pub struct Board(Mutex<Facts>);

impl Board {
    fn lock(&self) -> MutexGuard<'_, Facts> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn read(&self) -> Facts {
        self.lock().clone()
    }

    pub fn update<T>(&self, change: impl FnOnce(&mut Facts) -> T) -> T {
        change(&mut self.lock())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_says_the_worst() {
        let mut facts = Facts::default();
        assert_eq!(facts.line(false, None), "the master is away");
        facts.crash_loop = true;
        assert_eq!(facts.line(false, None), "the master dies again and again");
        assert_eq!(facts.line(true, None), "protected");
        let line = facts.line(true, Some("the disk\nis full".to_owned()));
        assert_eq!(line, "unprotected: the disk is full");
        assert_eq!(
            facts.line(false, Some("why".to_owned())),
            "unprotected: why"
        );
        facts.guarded = Guarded::NoLonger(7);
        assert!(facts.line(true, None).contains("unguarded"));
    }
}
