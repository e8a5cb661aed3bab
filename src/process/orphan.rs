//! Orphans: rosmasters and rosouts that a killed rosrescue left running.
//!
//! They are identified by their process and not by their port, which another program may have taken, even another
//! rosmaster. A [`PidFile`](super::PidFile) names the process that was started last. Without that file all processes
//! are searched: each process started by rosrescue has the checkpoint's path in its environment. No other program sets
//! that variable, and the kernel shows it as long as the process lives.

use std::{
    ffi::{OsStr, OsString},
    fs, io,
    os::unix::{ffi::OsStrExt, process::parent_id},
    path::{Path, PathBuf},
};

use rustix::process::PidfdFlags;

use super::{Rosmaster, listeners, output, pid_file::Last, pidfd, runs, unsent};
use crate::wait;

/// Environment variable that names the checkpoint of the rosrescue that started the process.
pub(super) const OWNER: &str = "ROSRESCUE_OWNER";

/// The value of [`OWNER`] in processes started by the rosrescue that uses `checkpoint`. Symbolic links are followed if
/// the disk answers within [`output::LIMIT`].
pub(super) fn owner(checkpoint: &Path) -> OsString {
    let absolute = std::path::absolute(checkpoint).unwrap_or_else(|_| checkpoint.to_owned());
    // The checkpoint file may not exist yet.
    let folder = absolute.parent().map(Path::to_owned);
    let folder = folder
        .and_then(|path| wait::blocking_within(output::LIMIT, move || path.canonicalize())?.ok());
    match (folder, absolute.file_name()) {
        (Some(folder), Some(name)) => folder.join(name).into(),
        _ => absolute.into(),
    }
}

/// A rosmaster that an earlier rosrescue left running.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Orphan {
    /// Its process id.
    pub(crate) pid: u32,
    /// The port at which it listens or will listen.
    pub(crate) port: u16,
    /// Whether it listens. Otherwise it has no state yet.
    pub(crate) serves: bool,
}

impl Rosmaster {
    /// Finds the rosmaster that an earlier rosrescue with this checkpoint left running for `port`, and kills its other
    /// rosmasters. If it is not known where the session's last master listened, `port` is `None`: then a rosmaster that
    /// listens anywhere is the only one that may have the state. `writable` says whether the PID file can be written;
    /// otherwise it may name an earlier rosmaster. Blocks for long if it has to search all processes.
    pub(crate) fn claim_orphan(&self, port: Option<u16>, writable: bool) -> Option<Orphan> {
        self.claim(self.last(writable), port)
    }

    /// Kills the rosmasters that an earlier rosrescue with this checkpoint left running. Blocks like
    /// [`Self::claim_orphan`], with the same `writable`.
    pub(crate) fn kill_orphans(&self, writable: bool) {
        let all = self.orphans(self.last(writable));
        self.kill(&all, "they may have an old state");
    }

    /// The content of the PID file, if it is that of the last rosmaster.
    fn last(&self, writable: bool) -> Last {
        match writable {
            true => self.pid_file.last(),
            false => Last::Unknown,
        }
    }

    /// See [`Self::claim_orphan`]. `last` is what the PID file says.
    fn claim(&self, last: Last, port: Option<u16>) -> Option<Orphan> {
        let all = self.orphans(last);
        let was_started_for = |pid, port| match last {
            Last::Running { port: told, .. } => told == port,
            _ => was_started_for(pid, port),
        };
        let listens = || {
            all.iter()
                .find_map(|pid| listeners::ports(*pid).first().copied())
        };
        if let Some(port) = port.or_else(listens)
            && let Some(left) = choose(port, &all, &self.owner, was_started_for)
        {
            if !matches!(last, Last::Running { .. }) {
                self.pid_file.write(left.pid, port);
            }
            return Some(left);
        }
        self.kill(
            &all,
            "it does not listen at the port of this session's last master",
        );
        None
    }

    /// The rosmasters that an earlier rosrescue with this checkpoint left running. `last` is what the PID file says.
    fn orphans(&self, last: Last) -> Vec<u32> {
        match last {
            Last::Running { pid, .. } if is_in_our_network(pid) => vec![pid],
            Last::Running { .. } | Last::Ended => Vec::new(),
            Last::Unknown => {
                let mut all = find(&self.owner);
                all.retain(|pid| !runs(*pid, "rosout"));
                all
            }
        }
    }

    fn kill(&self, orphans: &[u32], why: &str) {
        let name = self.program.file_name().unwrap_or_default();
        let name = name.to_string_lossy();
        for &pid in orphans.iter().filter(|pid| runs(**pid, &name)) {
            tracing::info!(
                pid,
                why,
                "killing a rosmaster that an earlier rosrescue left running"
            );
            unsent::kill(pid);
        }
    }
}

/// Chooses from `all` the process that listens at `port` or will listen there. `was_started_for` says whether a process
/// was started with that port. If none of `all` listens, the listener may be another process of `owner`, because a
/// program given by `--rosmaster` may have started the real rosmaster.
fn choose(
    port: u16,
    all: &[u32],
    owner: &OsStr,
    was_started_for: impl Fn(u32, u16) -> bool,
) -> Option<Orphan> {
    let sockets = listeners::sockets(port);
    let serves = !sockets.is_empty();
    let mut known = all.iter().copied();
    let pid = match serves {
        false => known.find(|pid| was_started_for(*pid, port)),
        true => known
            .find(|pid| listeners::holds_one(*pid, &sockets))
            .or_else(|| {
                let mut others = listeners::listeners_at(port).into_iter();
                others.find(|pid| is_orphan(*pid, owner))
            }),
    };
    pid.map(|pid| Orphan { pid, port, serves })
}

/// Whether the process `pid` was started with `port` as its port.
fn was_started_for(pid: u32, port: u16) -> bool {
    let command_line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    let words: Vec<_> = command_line.split(|byte| *byte == 0).collect();
    let port = port.to_string();
    words
        .windows(2)
        .any(|pair| pair == [b"-p", port.as_bytes()])
}

/// Living processes with this `owner` whose rosrescue is gone. Only this network namespace is searched: processes of
/// other containers may be visible, and their checkpoint may have the same path.
pub(super) fn find(owner: &OsStr) -> Vec<u32> {
    super::all_pids()
        .filter(|pid| is_orphan(*pid, owner))
        .collect()
}

fn is_orphan(pid: u32, owner: &OsStr) -> bool {
    bears(pid, owner) && is_in_our_network(pid) && !has_rosrescue(pid)
}

/// Whether the environment of the process `pid` has this `owner`.
pub(super) fn bears(pid: u32, owner: &OsStr) -> bool {
    owner_of(pid).is_some_and(|of| of == owner.as_bytes())
}

/// Whether the process `pid` was started by a rosrescue.
pub(super) fn has_owner(pid: u32) -> bool {
    owner_of(pid).is_some()
}

fn owner_of(pid: u32) -> Option<Vec<u8>> {
    let environment = fs::read(format!("/proc/{pid}/environ")).ok()?;
    let start = format!("{OWNER}=").into_bytes();
    let mut pairs = environment.split(|byte| *byte == 0);
    pairs.find_map(|pair| pair.strip_prefix(&*start).map(<[u8]>::to_vec))
}

/// Whether the process `pid` is in this process's network namespace.
pub(crate) fn is_in_our_network(pid: u32) -> bool {
    network(&pid) == network(&"self")
}

/// The network namespace of a process.
fn network(process: &dyn std::fmt::Display) -> Option<PathBuf> {
    fs::read_link(format!("/proc/{process}/ns/net")).ok()
}

/// Whether the parent of `pid` is a rosrescue, so that `pid` is not an orphan. The parent of this process does not
/// count: a guardian starts no masters, but as the first process of a container it inherits those of dead workers.
fn has_rosrescue(pid: u32) -> bool {
    let parent = super::parent_of(pid);
    parent.is_some_and(|parent| parent != parent_id() && super::is_rosrescue(parent))
}

/// Waits until the process `pid` has ended. It need not be a child of this process.
///
/// # Errors
///
/// If the process is gone, or if the kernel is older than 5.3 and cannot watch it.
pub(super) async fn wait_until_ended(pid: u32) -> io::Result<()> {
    let pid = i32::try_from(pid).map_err(io::Error::other)?;
    let process = pidfd::open(pid, PidfdFlags::empty())?;
    process.readable().await
}

#[cfg(test)]
mod tests {
    use std::{
        process::{Command, Stdio},
        time::Duration,
    };

    use super::*;
    use crate::{config::SupervisedConfig, process::Stat};

    /// Runs `program` and returns the process id that it prints.
    fn pid_of(program: &str, owner: &OsStr) -> u32 {
        let output = Command::new("sh")
            .args(["-c", program])
            .env(OWNER, owner)
            .stderr(Stdio::null())
            .output()
            .unwrap();
        String::from_utf8(output.stdout)
            .unwrap()
            .trim()
            .parse()
            .unwrap()
    }

    #[tokio::test]
    async fn only_an_orphan_with_the_owner_variable_counts_as_left_behind() {
        let folder = tempfile::tempdir().unwrap();
        let owner = owner(&folder.path().join("checkpoint"));
        let mut kept = Command::new("sleep")
            .arg("60")
            .env(OWNER, &owner)
            .spawn()
            .unwrap();
        // This test's program also has a name that begins with rosrescue.
        assert_eq!(find(&owner), Vec::<u32>::new(), "its rosrescue lives");
        let orphan = pid_of("sleep 60 >/dev/null & echo $!", &owner);
        assert_eq!(find(&owner), [orphan]);
        assert_eq!(find(OsStr::new("another")), Vec::<u32>::new());
        let end = crate::task::spawn(wait_until_ended(orphan));
        unsent::kill(orphan);
        let end = tokio::time::timeout(Duration::from_secs(60), end).await;
        end.expect("the end is reported").unwrap().unwrap();
        assert_eq!(find(&owner), Vec::<u32>::new());
        kept.kill().unwrap();
        kept.wait().unwrap();
    }

    /// A rosmaster that is the program `sleep`, with a checkpoint in `folder`, and an orphan of it.
    fn sleeping(folder: &Path) -> (Rosmaster, u32) {
        let checkpoint = folder.join("checkpoint");
        let orphan = pid_of("sleep 60 >/dev/null & echo $!", &owner(&checkpoint));
        let config = SupervisedConfig {
            port: None,
            rosmaster: Some("/bin/sleep".into()),
            numworkers: 1,
            timeout: 0.0,
            rosout: false,
        };
        while !runs(orphan, "sleep") {
            std::thread::sleep(Duration::from_millis(1));
        }
        (Rosmaster::find(&config, &checkpoint).unwrap(), orphan)
    }

    fn wait_killed(orphan: u32) {
        while Stat::read(orphan).is_some_and(Stat::is_alive) {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn processes_are_searched_only_without_a_pid_file() {
        let folder = tempfile::tempdir().unwrap();
        let (rosmaster, orphan) = sleeping(folder.path());
        assert_eq!(rosmaster.claim(Last::Ended, Some(1)), None);
        assert!(Stat::read(orphan).is_some_and(Stat::is_alive), "not found");

        let last = Last::Running {
            pid: orphan,
            port: 1,
        };
        let starting = Orphan {
            pid: orphan,
            port: 1,
            serves: false,
        };
        assert_eq!(rosmaster.claim(last, Some(1)), Some(starting));
        assert_eq!(rosmaster.claim(Last::Unknown, Some(1)), None);
        wait_killed(orphan);
    }

    #[test]
    fn a_pid_file_that_cannot_be_written_hides_no_orphan() {
        let folder = tempfile::tempdir().unwrap();
        let (rosmaster, orphan) = sleeping(folder.path());
        let mut earlier = Command::new("true").spawn().unwrap();
        rosmaster.pid_file.record(earlier.id(), 1);
        earlier.wait().unwrap();
        rosmaster.kill_orphans(true);
        assert!(Stat::read(orphan).is_some_and(Stat::is_alive), "not found");
        rosmaster.kill_orphans(false);
        wait_killed(orphan);
    }

    #[test]
    fn a_master_is_starting_if_no_process_listens_at_its_port() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let mut starting = Command::new("sh")
            .args(["-c", "read line", "rosmaster", "--core", "-p"])
            .arg(port.to_string())
            .stdin(Stdio::piped())
            .spawn()
            .unwrap();
        let own = std::process::id();
        let pid = starting.id();
        // The kernel shows the command line a moment after the program has begun.
        while !was_started_for(pid, port) {
            std::thread::sleep(Duration::from_millis(1));
        }
        let choose = |port, all: &[u32]| choose(port, all, OsStr::new("nothing"), was_started_for);
        let orphan = |pid, serves| Some(Orphan { pid, port, serves });
        assert_eq!(choose(port, &[pid, own]), orphan(own, true));
        assert_eq!(choose(port, &[pid]), None, "its port is taken");
        drop(listener);
        listeners::wait_closed(port);
        assert_eq!(choose(port, &[own, pid]), orphan(pid, false));
        assert_eq!(choose(1, &[own, pid]), None, "it is for another port");
        starting.kill().unwrap();
        starting.wait().unwrap();
    }

    #[test]
    fn a_checkpoint_has_one_name() {
        let folder = tempfile::tempdir().unwrap();
        let (real, link) = (folder.path().join("real"), folder.path().join("link"));
        fs::create_dir(&real).unwrap();
        std::os::unix::fs::symlink(&real, &link).unwrap();
        assert_eq!(owner(&real.join("c")), owner(&link.join("c")));
        assert_ne!(owner(&real.join("c")), owner(&real.join("d")));
    }
}
