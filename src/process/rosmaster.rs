//! The rosmaster program: finds it, chooses its port, and starts it.

use std::{
    ffi::{OsStr, OsString},
    io,
    net::{Ipv4Addr, SocketAddrV4},
    path::{Path, PathBuf},
    process::Stdio,
    time::Duration,
};

use socket2::{Domain, Socket, Type};
use thiserror::Error;
use tokio::{process::Child, task::block_in_place};

use super::{
    Output, PidFile, command, is_program, listeners,
    log_config::{self, LogConfig},
    orphan,
    ros_programs::{find_program, find_program_on, ros_paths},
    start,
};
use crate::config::SupervisedConfig;

/// Why a child process cannot be started.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ProcessError {
    /// No rosmaster was found.
    #[error(
        "there is no rosmaster on the PATH or in /opt/ros/*/bin: install it (apt-get install \
         python3-rosmaster, or ros-DISTRO-rosmaster as in ros-noetic-rosmaster), source ROS's setup.bash, or name it with \
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
    pub(super) program: PathBuf,
    /// Variables with the paths of its ROS, read once: a disk that is silent later must not delay the next master.
    paths: Vec<(&'static str, OsString)>,
    config: SupervisedConfig,
    /// Stdout and stderr of the last rosmaster.
    output: Output,
    /// The logging configuration for rosmaster. `None` if the user has one, or if the kernel does not support sealed
    /// files in memory.
    log_config: Option<LogConfig>,
    /// PID file of the last rosmaster.
    pub(super) pid_file: PidFile,
    /// The checkpoint's path, which marks the rosmasters of this rosrescue in their environment.
    pub(super) owner: OsString,
}

impl Rosmaster {
    /// After which time the program gives up a node that does not answer. `None` for never.
    pub(crate) fn socket_timeout(&self) -> Option<Duration> {
        self.config.socket_timeout()
    }

    /// Finds the rosmaster program. Its output and PID files are created next to `checkpoint`.
    pub(crate) fn find(config: &SupervisedConfig, checkpoint: &Path) -> Result<Self, ProcessError> {
        let program = find_rosmaster(config.rosmaster.as_deref())?;
        Ok(Self {
            paths: ros_paths(&program, 2),
            program,
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
                let by = block_in_place(|| listeners::named(port));
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
        command.envs(self.paths.iter().cloned());
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

/// The nice value of the rosmaster, if rosrescue has [`guardian::NICE`]: it runs before the nodes, which wait for it, and
/// after rosrescue, so that its start does not delay calls.
const ROSMASTER_NICE: i32 = -10;

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

/// The rosmaster that a process with this PATH would find.
pub(crate) fn find_rosmaster_on(path: &OsStr) -> Option<PathBuf> {
    find_program_on(path, "rosmaster", &["bin"])
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
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
