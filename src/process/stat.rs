//! Reads the state of a process without the lock of its memory (`proc_pid_stat(5)`).
//!
//! The environment and the command line do need that lock. On a busy computer reading them can take 100 ms and more.

use std::fs;

/// The state of a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stat {
    /// As in `R` for running.
    pub(super) state: char,
    pub(super) parent: u32,
    pub(crate) threads: u64,
    /// When it was started, in clock ticks since boot. Start time and id together identify the process.
    pub(crate) started: u64,
    /// Processor time, in clock ticks.
    ticks: u64,
    virtual_bytes: u64,
    resident_pages: u64,
}

impl Stat {
    /// The state of the process `pid`. `None` if there is no such process.
    pub(crate) fn read(pid: u32) -> Option<Self> {
        Self::parse(&fs::read_to_string(format!("/proc/{pid}/stat")).ok()?)
    }

    pub(super) fn parse(line: &str) -> Option<Self> {
        // The command's name in parentheses comes first and may contain anything.
        let mut fields = line.rsplit(')').next()?.split_whitespace();
        let state = fields.next()?.chars().next()?;
        let parent = fields.next()?.parse().ok()?;
        let mut number = |skipped| fields.nth(skipped)?.parse::<u64>().ok();
        let ticks = number(9)? + number(0)?;
        let threads = number(4)?;
        let started = number(1)?;
        let virtual_bytes = number(0)?;
        let resident_pages = number(0)?;
        Some(Self {
            state,
            parent,
            threads,
            started,
            ticks,
            virtual_bytes,
            resident_pages,
        })
    }

    /// Whether the process still runs. A process that ends frees its memory first, and then closes its sockets.
    pub(crate) fn is_alive(self) -> bool {
        self.virtual_bytes > 0 && !matches!(self.state, 'Z' | 'X')
    }

    /// The processor time of the process and its threads, in seconds.
    pub(crate) fn cpu_seconds(self) -> f64 {
        self.ticks as f64 / rustix::param::clock_ticks_per_second() as f64
    }

    /// The memory that the process has reserved and the memory that it uses, in bytes.
    pub(crate) fn memory(self) -> (u64, u64) {
        let resident = self.resident_pages * rustix::param::page_size() as u64;
        (self.virtual_bytes, resident)
    }

    /// Whether the process has ended, and its parent has not waited for it yet. The first thread may end before the
    /// others.
    pub(super) fn is_zombie(self) -> bool {
        matches!(self.state, 'Z' | 'X') && self.threads <= 1
    }

    /// Whether no thread of the process runs any more. The first thread may end before the others.
    pub(super) fn has_ended(self) -> bool {
        !self.is_alive() && self.threads <= 1
    }

    /// Whether the process is stopped, by Ctrl-Z, SIGSTOP or a debugger.
    pub(crate) fn is_stopped(self) -> bool {
        matches!(self.state, 'T' | 't')
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINE: &str = "7 (a) (b) S 3 7 7 0 -1 4194560 1 2 3 4 5 6 7 8 20 0 9 0 4711 8192 5 1";

    #[test]
    fn a_line_of_the_kernel_is_understood() {
        let stat = Stat::parse(LINE).unwrap();
        assert_eq!((stat.parent, stat.started, stat.ticks), (3, 4711, 11));
        assert_eq!((stat.virtual_bytes, stat.resident_pages), (8192, 5));
        assert!(stat.is_alive() && !stat.is_stopped());
        let with = |from: &str, to: &str| Stat::parse(&LINE.replace(from, to)).unwrap();
        assert!(!with(" S ", " Z ").is_alive());
        assert!(!with(" 8192 ", " 0 ").is_alive(), "it is ending");
        assert!(!with(" S ", " Z ").has_ended(), "other threads run");
        assert!(!with(" S ", " Z ").is_zombie(), "other threads run");
        assert!(!with(" 8192 ", " 0 ").is_zombie(), "its sockets are open");
        let alone = LINE.replace(" 20 0 9 ", " 20 0 1 ").replace(" S ", " Z ");
        let ended = Stat::parse(&alone).unwrap();
        assert!(ended.has_ended() && ended.is_zombie());
        for state in [" T ", " t "] {
            assert!(with(" S ", state).is_stopped());
            assert!(with(" S ", state).is_alive());
        }
        assert_eq!(Stat::parse("7 (a) S"), None);
    }

    #[test]
    fn a_process_is_alive_until_it_has_ended() {
        let own = Stat::read(std::process::id()).unwrap();
        assert!(own.is_alive());
        assert_eq!(own.parent, std::os::unix::process::parent_id());
        let mut child = std::process::Command::new("sleep")
            .arg("60")
            .spawn()
            .unwrap();
        assert!(Stat::read(child.id()).unwrap().started >= own.started);
        child.kill().unwrap();
        child.wait().unwrap();
        assert_eq!(Stat::read(child.id()), None);
    }
}
