//! Processes: starts, stops and describes them, also rosmaster and rosout. It reports what happens and decides nothing.

use std::{io, panic::resume_unwind, path::Path, process::ExitStatus, thread, time::Duration};

use rustix::{
    io::Errno,
    process::{
        Pid, Signal, getpriority_process, kill_process, setpriority_process, test_kill_process,
    },
};
use tokio::{
    process::{Child, Command},
    runtime::Handle,
    task::block_in_place,
};

use crate::guardian;

pub(crate) mod bypass;
pub(crate) mod effort;
pub(crate) mod listeners;
mod log_config;
mod orphan;
mod output;
mod pid_file;
pub(crate) mod pidfd;
mod ros_programs;
mod rosmaster;
mod rosout;
mod stat;
pub(crate) mod unsent;
mod usage;

pub(crate) use orphan::{Orphan, is_in_our_network};
use output::Output;
use pid_file::PidFile;
pub(crate) use ros_programs::{SERVICE_PATH, find_program, interpreter, output_of, python};
use ros_programs::{command, is_program, ros_paths};
pub(crate) use rosmaster::{ProcessError, Rosmaster, find_rosmaster, find_rosmaster_on};
pub(crate) use rosout::Rosout;
pub(crate) use stat::Stat;
pub(crate) use usage::usage;

/// How long a process may take to end after SIGINT, and then again after SIGTERM.
const STOP_TIME: Duration = Duration::from_secs(2);

/// Starts `command`, with this nice value if rosrescue runs with [`guardian::NICE`]. The program may be on a slow disk,
/// so other tasks continue meanwhile. A stop of rosrescue does not interrupt the start, because the process id of the
/// new process would be lost.
///
/// The new process inherits the nice value of the thread that starts it. If rosrescue set it afterwards, a worker that
/// dies in between would leave a process with its own.
fn start(mut command: Command, nice: i32) -> io::Result<Child> {
    let runtime = Handle::current();
    let start = || {
        if getpriority_process(None).is_ok_and(|own| own == guardian::NICE) {
            // On Linux this concerns this thread alone.
            let _ = setpriority_process(None, nice);
        }
        let _runtime = runtime.enter();
        command.spawn()
    };
    block_in_place(|| {
        thread::scope(|scope| {
            let starter = thread::Builder::new().name("start".to_owned());
            let child = starter.spawn_scoped(scope, start)?.join();
            child.unwrap_or_else(|panic| resume_unwind(panic))
        })
    })
}

fn raw_pid(pid: u32) -> Option<Pid> {
    i32::try_from(pid).ok().and_then(Pid::from_raw)
}

/// Stops a process: sends SIGINT, SIGTERM, SIGKILL, with a pause after each. `ended` completes when the process has
/// ended.
pub(crate) async fn stop(pid: u32, ended: impl Future) {
    let mut ended = std::pin::pin!(ended);
    for signal in [Signal::INT, Signal::TERM, Signal::KILL] {
        signal_process(pid, signal);
        if tokio::time::timeout(STOP_TIME, &mut ended).await.is_ok() {
            return;
        }
        tracing::warn!(
            pid,
            ?signal,
            "a process did not end in time after this signal; sending the next one"
        );
    }
}

/// Sends a signal. Does nothing if the process is gone.
pub(crate) fn signal_process(pid: u32, signal: Signal) {
    if let Some(pid) = raw_pid(pid) {
        let _ = kill_process(pid, signal);
    }
}

/// Whether the process `pid` exists and has not ended. A zombie has: its parent may never wait for it, as the first
/// process of some containers.
pub(crate) fn is_alive(pid: u32) -> bool {
    // EPERM: the process is another user's. A `stat` that cannot be read says nothing.
    let exists = raw_pid(pid).is_some_and(|pid| test_kill_process(pid) != Err(Errno::SRCH));
    exists && !Stat::read(pid).is_some_and(Stat::is_zombie)
}

/// Whether the process `pid` runs a program with this name, according to its command line. A process id that was
/// remembered may belong to another process by now.
pub(crate) fn runs(pid: u32, name: &str) -> bool {
    let command_line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    command_line.split(|byte| *byte == 0).any(|argument| {
        let argument = String::from_utf8_lossy(argument);
        Path::new(&*argument)
            .file_name()
            .is_some_and(|file| file == name)
    })
}

/// Whether the process `pid` was started by a rosrescue with this checkpoint.
pub(crate) fn belongs_to(pid: u32, checkpoint: &Path) -> bool {
    orphan::bears(pid, &orphan::owner(checkpoint))
}

/// Whether the process `pid` was started by any rosrescue.
pub(crate) fn belongs_to_any_rosrescue(pid: u32) -> bool {
    orphan::has_owner(pid) || parent_of(pid).is_some_and(is_rosrescue)
}

/// The id of this boot of the computer.
pub(crate) fn boot_id() -> String {
    kernel_id("/proc/sys/kernel/random/boot_id")
}

/// A new random id.
pub(crate) fn new_id() -> String {
    kernel_id("/proc/sys/kernel/random/uuid")
}

/// Reads an id from the kernel, or returns a constant if there is none. Ids are only compared.
fn kernel_id(path: &str) -> String {
    std::fs::read_to_string(path).map_or_else(|_| "unknown".to_owned(), |id| id.trim().to_owned())
}

/// All processes that this one can see.
pub(crate) fn all_pids() -> impl Iterator<Item = u32> {
    let processes = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    processes.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
}

/// The parent of the process `pid`.
pub(crate) fn parent_of(pid: u32) -> Option<u32> {
    Stat::read(pid).map(|stat| stat.parent)
}

/// The name of the process `pid`, at most 15 bytes; empty if there is no such process.
pub(crate) fn name_of(pid: u32) -> String {
    let name = std::fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
    name.trim_end().to_owned()
}

/// Whether the process `pid` runs rosrescue, even if its file was replaced.
pub(crate) fn is_rosrescue(pid: u32) -> bool {
    let program = std::fs::read_link(format!("/proc/{pid}/exe")).unwrap_or_default();
    let name = program.file_name().unwrap_or_default();
    name.as_encoded_bytes().starts_with(b"rosrescue")
}

/// Waits until the process `pid` has ended. It need not be a child of this process.
pub(crate) async fn wait_until_ended(pid: u32) {
    if orphan::wait_until_ended(pid).await.is_err() {
        while is_alive(pid) {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }
}

/// Describes how a process ended.
pub(crate) fn describe(status: ExitStatus) -> String {
    use std::os::unix::process::ExitStatusExt;
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("exit status {code}"),
        (None, Some(signal)) => format!("signal {signal}"),
        (None, None) => "in an unknown way".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[test]
    fn a_process_is_known_by_its_program() {
        let own = std::env::current_exe().unwrap();
        let name = own.file_name().unwrap().to_str().unwrap();
        assert!(runs(std::process::id(), name));
        assert!(!runs(std::process::id(), "rosmaster"));
        assert!(is_alive(std::process::id()));
    }

    #[test]
    fn a_process_that_has_ended_is_not_alive_although_its_parent_does_not_wait() {
        let mut child = std::process::Command::new("sleep")
            .arg("60")
            .spawn()
            .unwrap();
        assert!(is_alive(child.id()));
        child.kill().unwrap();
        let deadline = Instant::now() + Duration::from_secs(60);
        while is_alive(child.id()) {
            assert!(Instant::now() < deadline, "it counts as alive");
            thread::sleep(Duration::from_millis(1));
        }
        child.wait().unwrap();
    }
}
