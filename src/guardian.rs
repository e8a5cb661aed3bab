//! The guardian: the parent process that keeps the listening sockets and restarts the worker.
//!
//! An interactive `rosrescue` is two processes. The guardian has the sockets, starts the worker, which is
//! the same program with the sockets passed on ([`handover`]), and restarts it when it dies ([`restart`]).
//! Connections that arrive meanwhile wait in the kernel's queue and are not refused. The guardian does nothing
//! else, so that little can kill it: it has no runtime and reads nothing from the network.
//!
//! Under systemd a socket unit replaces it.

use std::{
    ffi::OsString,
    io::{self, Read},
    net::TcpListener,
    os::{
        fd::OwnedFd,
        unix::{net::UnixStream, process::CommandExt},
    },
    process::Command,
    sync::mpsc::{Receiver, RecvTimeoutError, sync_channel},
    thread,
    time::{Duration, Instant},
};

use command_fds::{CommandFdExt, FdMapping, FdMappingCollision};
use rustix::process::{
    Pid, Signal, WaitOptions, getpriority_process, kill_process, setpriority_process,
};
use signal_hook::{
    consts::{SIGCHLD, SIGHUP, SIGINT, SIGQUIT, SIGTERM},
    iterator::Signals,
};
use thiserror::Error;

pub mod handover;
pub mod restart;

use crate::limit::rarely;
use restart::{End, NextStart, Restarts};

/// The running program, even after its file has been replaced by another version.
const PROGRAM: &str = "/proc/self/exe";

/// Equals `OOMScoreAdjust=` in the systemd unit.
const OOM_SCORE_ADJUST: &str = "-500";

/// Equals `Nice=` in the systemd unit.
pub(crate) const NICE: i32 = -20;

/// Longest wait until a worker handles signals. After that, a signal is passed on even if it kills the worker.
const START_TIME: Duration = Duration::from_secs(1);

/// Why there is no worker. The exit status is 1.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum GuardianError {
    /// The system refused to start the worker.
    #[error("cannot start the worker process: {0}; --no-guardian runs rosrescue without one")]
    Spawn(#[from] io::Error),
    /// This cannot happen, because every descriptor gets its own number.
    #[error("cannot pass the sockets to the worker: {0}")]
    Handover(#[from] FdMappingCollision),
}

/// Runs workers with the command line `words` that serve `listeners`, until one stops cleanly. Returns the exit status.
///
/// # Errors
///
/// If the first worker cannot be started, or signals cannot be received. Later failures are retried forever.
pub fn run(listeners: &[TcpListener], words: &[OsString]) -> Result<i32, GuardianError> {
    evade_oom_killer();
    take_priority();
    let signals = receive_signals()?;
    let mut restarts = Restarts::default();
    let mut worker = Worker::start(listeners, words, 0, false)?;
    let mut count = 0;
    loop {
        let end = worker.run_until_end(&signals, |signal| restarts.stop(signal));
        let (pause, again_and_again) = match restarts.worker_ended(
            end,
            worker.wait_for_word(handover::SERVES),
            Instant::now(),
        ) {
            NextStart::Exit(status) => return Ok(status),
            NextStart::Restart {
                pause,
                again_and_again,
            } => (pause, again_and_again),
        };
        let pid = worker.pid;
        if again_and_again || !pause.is_zero() {
            rarely!(
                error, pid, how = %end, ?pause,
                "the worker keeps dying; restarting it after the pause; the port stays open. The lines above say why; please report them"
            );
        } else {
            rarely!(warn, pid, how = %end, "the worker has ended; restarting it at once; the port stays open");
        }
        let stop;
        count += 1;
        (worker, stop) = start_again(
            listeners,
            words,
            &signals,
            pause,
            (count, restarts.has_served()),
        )?;
        if let Some(signal) = stop.or_else(|| restarts.stopped_by()) {
            restarts.stop(signal);
            worker.pass_on(signal);
        }
    }
}

/// Starts a worker after `pause`, retrying until it succeeds. A stop signal ends the pause and is returned with the
/// worker. After a signal the new worker only ends the processes that the dead worker left running.
fn start_again(
    listeners: &[TcpListener],
    words: &[OsString],
    signals: &Receiver<i32>,
    mut pause: Duration,
    (restarts, continues): (u64, bool),
) -> Result<(Worker, Option<i32>), GuardianError> {
    loop {
        let stop = wait(signals, pause)?;
        match Worker::start(listeners, words, restarts, continues) {
            Ok(worker) => return Ok((worker, stop)),
            Err(error) if stop.is_some() => return Err(error),
            Err(error) => {
                rarely!(error, %error, "cannot start a worker; calls wait; retrying")
            }
        }
        pause = restart::PAUSE_MOST;
    }
}

/// Waits for `pause`, or until a stop signal arrives.
fn wait(signals: &Receiver<i32>, pause: Duration) -> io::Result<Option<i32>> {
    let until = Instant::now() + pause;
    loop {
        match signals.recv_timeout(until.saturating_duration_since(Instant::now())) {
            // An orphan that this process inherited has ended.
            Ok(SIGCHLD) => drop(reap(None)),
            Ok(signal) => return Ok(Some(signal)),
            Err(RecvTimeoutError::Timeout) => return Ok(None),
            Err(RecvTimeoutError::Disconnected) => {
                return Err(io::Error::other(
                    "this process can no longer receive signals",
                ));
            }
        }
    }
}

struct Worker {
    pid: u32,
    /// Through this link the worker reports that it handles signals, and later that it answers calls. Through it the
    /// worker also notices the guardian's end.
    link: UnixStream,
    handles_signals: bool,
}

impl Worker {
    /// Starts a worker after `restarts` others. `continues` says whether one of these has answered calls.
    fn start(
        listeners: &[TcpListener],
        words: &[OsString],
        restarts: u64,
        continues: bool,
    ) -> Result<Self, GuardianError> {
        let (link, of_worker) = UnixStream::pair()?;
        link.set_read_timeout(Some(START_TIME))?;
        let mut passed = Vec::new();
        for listener in listeners {
            passed.push(OwnedFd::from(listener.try_clone()?));
        }
        passed.push(of_worker.into());
        let count = passed.len().to_string();
        let mappings = (handover::FIRST..).zip(passed);
        let mappings = mappings.map(|(child_fd, parent_fd)| FdMapping {
            parent_fd,
            child_fd,
        });
        let mut command = Command::new(PROGRAM);
        if let Some((name, arguments)) = words.split_first() {
            command.arg0(name).args(arguments);
        }
        command
            .env(handover::LISTEN_FDS, count)
            .env(handover::GUARDIAN, std::process::id().to_string())
            .env(handover::RESTARTS, restarts.to_string())
            .env_remove(handover::CONTINUES)
            .env_remove(handover::LISTEN_PID)
            .env_remove(handover::LISTEN_FDNAMES)
            // The worker gets its own process group, so that terminal signals reach only the
            // guardian, which passes them on once.
            .process_group(0);
        if continues {
            command.env(handover::CONTINUES, "1");
        }
        if sd_notify::watchdog_enabled().is_none() {
            // The variable is meant for another process.
            command.env_remove("WATCHDOG_USEC");
        }
        let (name, value) = handover::TUNABLES;
        if std::env::var_os(name).is_none() {
            command.env(name, value);
        }
        // The worker feeds systemd's watchdog in place of the guardian.
        command.env_remove("WATCHDOG_PID");
        command.fd_mappings(mappings.collect())?;
        let pid = command.spawn()?.id();
        Ok(Self {
            pid,
            link,
            handles_signals: false,
        })
    }

    /// Waits for the worker's end, and passes signals on. Calls `stopping` for each signal.
    fn run_until_end(&mut self, signals: &Receiver<i32>, mut stopping: impl FnMut(i32)) -> End {
        loop {
            match signals.recv() {
                Ok(SIGCHLD) => {
                    if let Some(end) = reap(Some(self.pid)) {
                        return end;
                    }
                }
                Ok(signal) => {
                    stopping(signal);
                    self.pass_on(signal);
                }
                // The signal thread has panicked.
                Err(_) => return End::Code(1),
            }
        }
    }

    /// Passes on `signal` once the worker handles signals. Before that, a signal would kill it.
    fn pass_on(&mut self, signal: i32) {
        if !std::mem::replace(&mut self.handles_signals, true) {
            self.wait_for_word(handover::HANDLES_SIGNALS);
        }
        let signal = match signal {
            SIGINT => Signal::INT,
            SIGHUP => Signal::HUP,
            SIGQUIT => Signal::QUIT,
            _ => Signal::TERM,
        };
        // The child has not been waited for, so its process id cannot have been reused.
        if let Some(pid) = i32::try_from(self.pid).ok().and_then(Pid::from_raw) {
            let _ = kill_process(pid, signal);
        }
    }

    /// Waits until the worker has written `word` to the link. Returns false if the worker ends
    /// first, or is silent for [`START_TIME`]. Skips other words.
    fn wait_for_word(&self, word: u8) -> bool {
        let mut said = [0];
        while (&self.link).read(&mut said).is_ok_and(|length| length > 0) {
            if said == [word] {
                return true;
            }
        }
        false
    }
}

/// Reaps all children that have ended, because the first process of a container also inherits other
/// processes. Returns the end of `worker` if it is among them.
fn reap(worker: Option<u32>) -> Option<End> {
    let mut end = None;
    while let Ok(Some((pid, status))) = rustix::process::wait(WaitOptions::NOHANG) {
        if u32::try_from(pid.as_raw_nonzero().get()).ok() == worker {
            end = match (status.exit_status(), status.terminating_signal()) {
                (Some(code), _) => Some(End::Code(code)),
                (None, Some(signal)) => Some(End::Signal(signal)),
                (None, None) => None,
            };
        }
    }
    end
}

/// Makes the kernel kill nodes first when memory runs out, as the systemd unit does. Children inherit this. It needs
/// CAP_SYS_RESOURCE, and is skipped if the user has chosen a value.
fn evade_oom_killer() {
    const SCORE: &str = "/proc/self/oom_score_adj";
    if std::fs::read_to_string(SCORE).is_ok_and(|score| score.trim() == "0") {
        // If this fails, the guardian is still the smallest process.
        let _ = std::fs::write(SCORE, OOM_SCORE_ADJUST);
    }
}

/// Makes the kernel run rosrescue first on a busy computer, as the systemd unit does. All nodes wait for it, and it needs
/// little processor time: 5 to 8 ms until a new worker answers. With 32 busy processes per core, that takes a second or
/// more at the default nice value. It needs `CAP_SYS_NICE`, and is skipped if the user has chosen a value.
fn take_priority() {
    if getpriority_process(None).is_ok_and(|nice| nice == 0) {
        let _ = setpriority_process(None, NICE);
    }
}

fn receive_signals() -> io::Result<Receiver<i32>> {
    let mut wanted = vec![SIGCHLD, SIGINT, SIGQUIT, SIGTERM];
    if !is_hangup_ignored() {
        wanted.push(SIGHUP);
    }
    let mut signals = Signals::new(wanted)?;
    let (sender, receiver) = sync_channel(8);
    thread::Builder::new()
        .name("signals".to_owned())
        .spawn(move || {
            for signal in signals.forever() {
                if sender.send(signal).is_err() {
                    return;
                }
            }
        })?;
    Ok(receiver)
}

/// Whether this process was started with SIGHUP ignored, as by nohup. It must then outlive the
/// terminal.
pub fn is_hangup_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    // The lowest bit is signal 1.
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .is_some_and(|mask| mask & 1 == 1)
}
