//! Child processes: finds, starts and stops rosmaster and rosout. It reports what happens and decides nothing.

use std::{
    ffi::{OsStr, OsString},
    io,
    net::{Ipv4Addr, SocketAddrV4},
    panic::resume_unwind,
    path::{Path, PathBuf},
    process::{ExitStatus, Stdio},
    thread,
    time::Duration,
};

use rustix::process::{
    Pid, Signal, getpriority_process, kill_process, setpriority_process, test_kill_process,
};
use socket2::{Domain, Socket, Type};
use thiserror::Error;
use tokio::{
    process::{Child, Command},
    runtime::Handle,
    task::block_in_place,
};

use crate::{
    config::SupervisedConfig,
    guardian::{self, handover},
};

pub(crate) mod bypass;
pub(crate) mod effort;
pub(crate) mod listeners;
mod log_config;
mod orphan;
mod output;
mod pid_file;
pub(crate) mod pidfd;
mod rosout;
mod stat;
pub(crate) mod unsent;
mod usage;

use log_config::LogConfig;
pub(crate) use orphan::{Orphan, is_in_our_network};
use output::Output;
use pid_file::PidFile;
pub(crate) use rosout::Rosout;
pub(crate) use stat::Stat;
pub(crate) use usage::usage;

/// How long a process may take to end after SIGINT, and then again after SIGTERM.
const STOP_TIME: Duration = Duration::from_secs(2);
/// The PATH that systemd gives to services.
pub(crate) const SERVICE_PATH: &str =
    "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin";
/// Where ROS installs programs that are not on the PATH.
const ROS_PREFIXES: &str = "/opt/ros";
/// Why a child process cannot be started.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ProcessError {
    /// No rosmaster was found.
    #[error(
        "there is no rosmaster on the PATH or in /opt/ros/*/bin: install it (apt-get install \
         python3-rosmaster, or ros-noetic-rosmaster), source ROS's setup.bash, or name it with \
         --rosmaster"
    )]
    NoRosmaster,
    /// `--rosmaster` does not name a program.
    #[error("--rosmaster: `{}` is not an executable program", path.display())]
    NotAProgram { path: PathBuf },
    /// The master's port is taken.
    #[error("--master-port: port {port} on loopback is in use by {by}; choose another one")]
    PortInUse { port: u16, by: String },
    /// The system refused to start the program.
    #[error("cannot start `{}`: {source}", program.display())]
    Spawn { program: PathBuf, source: io::Error },
}

#[derive(Clone, Debug)]
pub(crate) struct Rosmaster {
    program: PathBuf,
    config: SupervisedConfig,
    /// Stdout and stderr of the last rosmaster.
    output: Output,
    /// The logging configuration for rosmaster. `None` if the user has one, or if the kernel does not support sealed
    /// files in memory.
    log_config: Option<LogConfig>,
    /// PID file of the last rosmaster.
    pid_file: PidFile,
    /// The checkpoint's path, which marks the rosmasters of this rosrescue in their environment.
    owner: OsString,
}

impl Rosmaster {
    /// Finds the rosmaster program. Its output and PID files are created next to `checkpoint`.
    pub(crate) fn find(config: &SupervisedConfig, checkpoint: &Path) -> Result<Self, ProcessError> {
        Ok(Self {
            program: find_rosmaster(config.rosmaster.as_deref())?,
            config: config.clone(),
            output: Output::beside(checkpoint, ".rosmaster-output.log"),
            log_config: LogConfig::unless_given(),
            pid_file: PidFile::beside(checkpoint, "rosmaster"),
            owner: orphan::owner(checkpoint),
        })
    }

    /// Whether this is ROS's own rosmaster, and not a program that the user chose.
    pub(crate) fn is_ros_rosmaster(&self) -> bool {
        self.config.rosmaster.is_none()
    }

    /// Chooses the port for a master: the configured one, else `remembered` if it is free, else any
    /// free one.
    pub(crate) fn choose_port(&self, remembered: Option<u16>) -> Result<u16, ProcessError> {
        if let Some(port) = self.config.port {
            return if is_free(port) {
                Ok(port)
            } else {
                let by = listeners::named(port);
                Err(ProcessError::PortInUse { port, by })
            };
        }
        if let Some(port) = remembered.filter(|port| is_free(*port)) {
            return Ok(port);
        }
        let spawn_error = |source| ProcessError::Spawn {
            program: self.program.clone(),
            source,
        };
        free_port().map_err(spawn_error)
    }

    /// Starts a master on `port` of loopback. It outlives rosrescue: dropping the child does not end it.
    pub(crate) async fn start(&self, port: u16) -> Result<Child, ProcessError> {
        self.pid_file.clear().await;
        let child = self.spawn(port).await?;
        if let Some(pid) = child.id() {
            self.pid_file.write(pid, port);
        }
        Ok(child)
    }

    async fn spawn(&self, port: u16) -> Result<Child, ProcessError> {
        let mut command = command(&self.program);
        command.arg("--core").arg("-p").arg(port.to_string());
        command.stdin(Stdio::null());
        self.output.renew().await;
        command.arg("-w").arg(self.config.numworkers.to_string());
        if self.config.timeout > 0.0 {
            command.arg("-t").arg(self.config.timeout.to_string());
        }
        add_ros_paths(&mut command, &self.program, 2);
        command.env(orphan::OWNER, &self.owner);
        // The master listens on loopback only, because nodes connect to rosrescue.
        command.env("ROS_IP", Ipv4Addr::LOCALHOST.to_string());
        command.env_remove("ROS_HOSTNAME").env_remove("ROS_IPV6");
        if let Some(config) = &self.log_config {
            command.env(log_config::VARIABLE, config.path());
        }
        let (stdout, stderr) = match self.output.file() {
            Some(file) => (
                file.try_clone().map_or_else(|_| Stdio::null(), Stdio::from),
                file.into(),
            ),
            None => (Stdio::null(), Stdio::null()),
        };
        // The master gets its own process group, because rosrescue handles Ctrl-C in the terminal.
        command.stdout(stdout).stderr(stderr).process_group(0);
        start(command, ROSMASTER_NICE).map_err(|source| ProcessError::Spawn {
            program: self.program.clone(),
            source,
        })
    }

    /// The last output of the last rosmaster, for the message that rosmaster died early.
    pub(crate) async fn last_words(&self) -> String {
        self.output.tail().await
    }
}

/// The `given` rosmaster, or the installed one.
pub(crate) fn find_rosmaster(given: Option<&Path>) -> Result<PathBuf, ProcessError> {
    match given {
        Some(path) if is_program(path) => Ok(path.to_owned()),
        Some(path) => Err(ProcessError::NotAProgram {
            path: path.to_owned(),
        }),
        None => find_program("rosmaster", &["bin"]).ok_or(ProcessError::NoRosmaster),
    }
}

/// The interpreter and its arguments in the first line of `program`, if it is a Python script.
pub(crate) fn interpreter(program: &Path) -> Option<Vec<String>> {
    let text = std::fs::read(program).ok()?;
    let line = text.split(|byte| *byte == b'\n').next()?;
    let words = std::str::from_utf8(line).ok()?.strip_prefix("#!")?;
    let words: Vec<_> = words.split_whitespace().map(str::to_owned).collect();
    let is_python = |word: &String| word.rsplit('/').next()?.strip_prefix("python").map(drop);
    words.last().and_then(is_python).map(|()| words)
}

/// A command that runs `python` without output, with the paths of the ROS installation that
/// contains `program`.
pub(crate) fn python(python: &Path, program: &Path) -> Command {
    let mut command = command(python);
    add_ros_paths(&mut command, program, 2);
    command.stdin(Stdio::null()).kill_on_drop(true);
    command
}

/// A command that runs `program` without the variables that are meant for rosrescue alone.
fn command(program: &Path) -> Command {
    let mut command = Command::new(program);
    handover::keep_from(command.as_std_mut());
    command
}

/// Path of a file that belongs to `checkpoint`.
pub(crate) fn beside(checkpoint: &Path, suffix: &str) -> PathBuf {
    let mut name = checkpoint.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}

/// The nice value of the rosmaster, if rosrescue has [`guardian::NICE`]: it runs before the nodes, which wait for it, and
/// after rosrescue, so that its start does not delay calls.
const ROSMASTER_NICE: i32 = -10;

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

/// Adds the paths of the ROS installation in `/opt/ros` that contains `program`. ROS's programs need these paths to
/// find modules and libraries. A shell has them from `setup.bash`, a service does not. `depth` is the number of folders
/// between the installation and the program.
fn add_ros_paths(command: &mut Command, program: &Path, depth: usize) {
    let Some(prefix) = program
        .ancestors()
        .nth(depth)
        .filter(|p| p.starts_with(ROS_PREFIXES))
    else {
        return;
    };
    for (variable, folder) in [
        ("PYTHONPATH", "lib/python3/dist-packages"),
        ("LD_LIBRARY_PATH", "lib"),
    ] {
        let own = std::env::var_os(variable).unwrap_or_default();
        let paths = [prefix.join(folder)]
            .into_iter()
            .chain(std::env::split_paths(&own));
        let paths = paths.filter(|path| !path.as_os_str().is_empty());
        if let Ok(joined) = std::env::join_paths(paths) {
            command.env(variable, joined);
        }
    }
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

/// Whether a process with this process id exists.
pub(crate) fn is_alive(pid: u32) -> bool {
    raw_pid(pid).is_some_and(|pid| test_kill_process(pid).is_ok())
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
pub(crate) fn is_of(pid: u32, checkpoint: &Path) -> bool {
    orphan::bears(pid, &orphan::owner(checkpoint))
}

/// Whether the process `pid` was started by any rosrescue.
pub(crate) fn is_of_any(pid: u32) -> bool {
    orphan::has_owner(pid) || parent_of(pid).is_some_and(is_rosrescue)
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

/// The output of `program`, if it ends within `limit`, in the form that roslaunch's `command=` would use.
pub(crate) async fn output_of(
    program: &str,
    arguments: &[&str],
    limit: Duration,
) -> Option<String> {
    let mut command = command(&find_program(program, &["bin"])?);
    command
        .args(arguments)
        .stdin(Stdio::null())
        .stderr(Stdio::null())
        .kill_on_drop(true);
    let output = tokio::time::timeout(limit, command.output())
        .await
        .ok()?
        .ok()?;
    output
        .status
        .success()
        .then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

/// The rosmaster that a process with this PATH would find.
pub(crate) fn find_rosmaster_on(path: &OsStr) -> Option<PathBuf> {
    find_program_on(path, "rosmaster", &["bin"])
}

/// Finds a program on the PATH, or else in one of `folders` of a ROS installation.
pub(crate) fn find_program(name: &str, folders: &[&str]) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    find_program_on(&path, name, folders)
}

fn find_program_on(path: &OsStr, name: &str, folders: &[&str]) -> Option<PathBuf> {
    let on_path = std::env::split_paths(path)
        .map(|folder| folder.join(name))
        .find(|p| is_program(p));
    on_path.or_else(|| {
        let mut distributions: Vec<_> = std::fs::read_dir(ROS_PREFIXES)
            .ok()?
            .flatten()
            .map(|entry| entry.path())
            .collect();
        // Newer distributions have later names (kinetic, melodic, noetic), so the last name is tried first.
        distributions.sort();
        let candidates = distributions.iter().rev();
        let mut programs =
            candidates.flat_map(|prefix| folders.iter().map(|f| prefix.join(f).join(name)));
        programs.find(|path| is_program(path))
    })
}

fn is_program(path: &Path) -> bool {
    use std::os::unix::fs::PermissionsExt;
    path.metadata()
        .is_ok_and(|meta| meta.is_file() && meta.permissions().mode() & 0o111 != 0)
}

/// Whether rosmaster could listen on this port. rosmaster sets SO_REUSEADDR, and so does this check.
fn is_free(port: u16) -> bool {
    bind_loopback(port).is_ok()
}

fn free_port() -> io::Result<u16> {
    let address = bind_loopback(0)?.local_addr()?;
    address
        .as_socket()
        .map(|address| address.port())
        .ok_or_else(|| io::ErrorKind::AddrNotAvailable.into())
}

fn bind_loopback(port: u16) -> io::Result<Socket> {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, None)?;
    socket.set_reuse_address(true)?;
    socket.bind(&SocketAddrV4::new(Ipv4Addr::LOCALHOST, port).into())?;
    socket.listen(1)?;
    Ok(socket)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_in_use_is_not_free() {
        let socket = bind_loopback(0).unwrap();
        let port = socket.local_addr().unwrap().as_socket().unwrap().port();
        assert!(!is_free(port));
        drop(socket);
        // A process that another test is starting holds the socket until it runs its program.
        while !is_free(port) {
            thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn a_ros_in_opt_gets_its_own_paths() {
        let paths = |program: &str, depth| {
            let mut command = Command::new(program);
            add_ros_paths(&mut command, Path::new(program), depth);
            let set = command.as_std().get_envs();
            let set = set.filter_map(|(name, value)| Some((name.to_owned(), value?.to_owned())));
            set.collect::<std::collections::HashMap<_, _>>()
        };
        let set = paths("/opt/ros/noetic/bin/rosmaster", 2);
        let python = std::env::split_paths(&set[OsStr::new("PYTHONPATH")]).next();
        assert_eq!(
            python.unwrap(),
            Path::new("/opt/ros/noetic/lib/python3/dist-packages")
        );
        assert!(paths("/usr/bin/rosmaster", 2).is_empty());
    }

    #[test]
    fn a_process_is_known_by_its_program() {
        let own = std::env::current_exe().unwrap();
        let name = own.file_name().unwrap().to_str().unwrap();
        assert!(runs(std::process::id(), name));
        assert!(!runs(std::process::id(), "rosmaster"));
        assert!(is_alive(std::process::id()));
    }
}
