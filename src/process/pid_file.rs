//! PID files next to the checkpoint, one for the last rosmaster and one for the last rosout.
//!
//! A new worker uses them to find the processes that the last worker left running, without searching all processes.

use std::{
    fs,
    io::{self, Read, Write},
    path::{Path, PathBuf},
    thread,
};

use checkpoint_store::{beside, regular_file};

use super::{Stat, boot_id, output};
use crate::wait;

/// Largest PID file, in bytes.
const LONGEST: u64 = 1024;

/// A file that identifies one process.
#[derive(Clone, Debug)]
pub(super) struct PidFile(PathBuf);

/// The content of a PID file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Last {
    /// The process runs. It was given this port.
    Running { pid: u32, port: u16 },
    /// The process has ended.
    Ended,
    /// There is no complete file: the disk was full or does not answer, or rosrescue was killed while it started the
    /// process.
    Unknown,
}

impl PidFile {
    /// The file for the process `name` next to `checkpoint`.
    pub(super) fn beside(checkpoint: &Path, name: &str) -> Self {
        Self(beside(checkpoint, &format!(".{name}-pid")))
    }

    /// Removes the file. This must happen before a process is started. If rosrescue is killed before [`Self::write`],
    /// that process is found by a search. A slow disk delays this for [`output::LIMIT`] at most.
    pub(super) async fn clear(&self) {
        let file = self.clone();
        wait::within(output::LIMIT, move || file.remove()).await;
    }

    /// Records the process `pid`, which was given `port`. If writing fails, that process is found by a search. Does not
    /// wait for the disk.
    pub(super) fn write(&self, pid: u32, port: u16) {
        let file = self.clone();
        thread::spawn(move || file.record(pid, port));
    }

    /// Like [`Self::clear`], but waits for the disk.
    pub(super) fn remove(&self) {
        let _ = fs::remove_file(&self.0);
    }

    /// Like [`Self::write`], but waits for the disk.
    pub(super) fn record(&self, pid: u32, port: u16) {
        if let Some(stat) = Stat::read(pid) {
            // Each boot reuses process ids and start times.
            let line = format!("{pid} {} {port} {}\n", stat.started, boot_id());
            let created = regular_file::create(&self.0);
            if let Err(error) = created.and_then(|mut file| file.write_all(line.as_bytes())) {
                tracing::debug!(%error, path = %self.0.display(), "no PID file");
                self.remove();
            }
        }
    }

    /// Reads the file, and checks whether the process still runs. Waits at most [`output::LIMIT`] for the disk.
    pub(super) fn last(&self) -> Last {
        let file = self.clone();
        wait::blocking_within(output::LIMIT, move || file.read()).unwrap_or(Last::Unknown)
    }

    fn read(&self) -> Last {
        let file = regular_file::open_ours(&self.0);
        let line = file.and_then(|file| io::read_to_string(file.take(LONGEST)));
        let line = line.unwrap_or_default();
        let fields: Vec<_> = line.split(' ').collect();
        let (&[pid, started, port, boot], true) = (&*fields, line.ends_with('\n')) else {
            return Last::Unknown;
        };
        let (Ok(pid), Ok(started), Ok(port)) = (pid.parse(), started.parse::<u64>(), port.parse())
        else {
            return Last::Unknown;
        };
        let runs = |stat: Stat| stat.started == started && stat.is_alive();
        match Stat::read(pid).is_some_and(runs) && boot.trim_end() == boot_id() {
            true => Last::Running { pid, port },
            false => Last::Ended,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_is_found_as_long_as_it_runs() {
        let folder = tempfile::tempdir().unwrap();
        let file = PidFile::beside(&folder.path().join("checkpoint"), "sleep");
        assert_eq!(file.read(), Last::Unknown, "there is no file");
        let mut child = std::process::Command::new("sleep")
            .arg("60")
            .spawn()
            .unwrap();
        let pid = child.id();
        file.record(pid, 7);
        assert_eq!(file.read(), Last::Running { pid, port: 7 });
        let whole = fs::read_to_string(&file.0).unwrap();
        let after = |text: String| {
            fs::write(&file.0, text).unwrap();
            file.read()
        };
        for half in ["", &whole[..whole.len() - 1], &whole[..3]] {
            assert_eq!(after(half.to_owned()), Last::Unknown, "{half}");
        }
        let started = Stat::read(pid).unwrap().started.to_string();
        assert_eq!(after(whole.replacen(&started, "1", 1)), Last::Ended);
        assert_eq!(after(whole.replace(&boot_id(), "another")), Last::Ended);
        assert_eq!(after(whole), Last::Running { pid, port: 7 });
        child.kill().unwrap();
        child.wait().unwrap();
        assert_eq!(file.read(), Last::Ended);
        file.remove();
        assert_eq!(file.read(), Last::Unknown);
    }
}
