//! The real parts of ROS: rosmaster, the command line tools, and where the test nodes are.

use std::ffi::{OsStr, OsString};
use std::fs::{self, File, Permissions};
use std::iter;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};
use std::sync::OnceLock;

use ros1_master::xmlrpc::Value;

use super::node::Library;
use super::patience::eventually;
use super::process::Process;
use super::rpc::Client;
use super::scratch::{Scratch, free_port};

/// The folder with the rospy nodes and the sources of the roscpp nodes.
pub(crate) const NODES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/nodes");

/// The log configuration of a rosmaster that a test starts: that of a supervised one, which starts in half the time.
const LOGGING: &str = include_str!("../../src/process/rosmaster_logging.conf");

const MISSING: &str = "this test needs ROS 1: `tests/run.sh` installs what is missing";

/// Finds a program of ROS in the PATH or where ROS installs it.
pub(crate) fn find_program(name: &str) -> PathBuf {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let on_path = std::env::split_paths(&path).map(|folder| folder.join(name));
    let installed = fs::read_dir("/opt/ros")
        .into_iter()
        .flatten()
        .flatten()
        .map(|distro| distro.path().join("bin").join(name));
    on_path
        .chain(installed)
        .find(|program| program.is_file())
        .unwrap_or_else(|| panic!("`{name}` is not installed; {MISSING}"))
}

/// A PATH whose first folder has a `rosversion` that prints at once what the real one prints. Each `core` runs it twice, and
/// two more Python programs for each test take a tenth of the time of all tests.
pub(crate) fn path_with_quick_rosversion() -> &'static OsStr {
    static PATH: OnceLock<OsString> = OnceLock::new();
    PATH.get_or_init(|| {
        let rosversion = find_program("rosversion");
        let printed = ["-d", "roslaunch"].map(|argument| {
            let output = Command::new(&rosversion).arg(argument).output().unwrap();
            assert!(output.status.success(), "rosversion {argument}: {output:?}");
            String::from_utf8(output.stdout).unwrap()
        });
        let [distro, version] = printed.each_ref().map(|text| text.trim());
        let script = format!(
            "#!/bin/sh\ncase $1 in -d) echo '{distro}' ;; roslaunch) echo '{version}' ;; *) exit 2 ;; esac\n"
        );
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).with_file_name("quick-rosversion");
        fs::create_dir_all(&folder).unwrap();
        // Another test program may run the script meanwhile.
        let new = folder.join(format!("new-{}", std::process::id()));
        fs::write(&new, script).unwrap();
        fs::set_permissions(&new, Permissions::from_mode(0o755)).unwrap();
        fs::rename(&new, folder.join("rosversion")).unwrap();
        let path = std::env::var_os("PATH").unwrap_or_default();
        std::env::join_paths(iter::once(folder).chain(std::env::split_paths(&path))).unwrap()
    })
}

/// A command with the environment of a node that uses the master at `port`.
pub(crate) fn ros_command(scratch: &Scratch, program: impl AsRef<OsStr>, port: u16) -> Command {
    let mut command = Command::new(program);
    scratch.prepare(&mut command);
    let packages = [NODES, cpp_nodes().to_str().unwrap()].join(":");
    let packages = match std::env::var("ROS_PACKAGE_PATH") {
        Ok(others) => format!("{packages}:{others}"),
        Err(_) => packages,
    };
    command
        .env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"))
        .env("ROS_PACKAGE_PATH", packages)
        .current_dir(scratch.path(""));
    command
}

/// A real rosmaster and nothing else.
#[derive(Debug)]
pub(crate) struct Rosmaster {
    process: Process,
    pub(crate) port: u16,
}

impl Rosmaster {
    /// Starts a rosmaster on a free port and waits until it answers.
    #[track_caller]
    pub(crate) fn start(scratch: &Scratch) -> Self {
        Self::start_at(scratch, free_port())
    }

    /// Starts a rosmaster on `port` and waits until it answers.
    #[track_caller]
    pub(crate) fn start_at(scratch: &Scratch, port: u16) -> Self {
        Self::start_with(scratch, port, |_| {})
    }

    /// Like [`Self::start_at`], with further arguments or environment variables.
    #[track_caller]
    pub(crate) fn start_with(
        scratch: &Scratch,
        port: u16,
        change: impl FnOnce(&mut Command),
    ) -> Self {
        let mut command = Command::new(find_program("rosmaster"));
        scratch.prepare(&mut command);
        command.args(["--core", "-p"]).arg(port.to_string());
        change(&mut command);
        // Benchmarks measure what users have.
        if cfg!(test) {
            let logging = scratch.path("rosmaster-logging.conf");
            fs::write(&logging, LOGGING).unwrap();
            command.env("ROS_PYTHON_LOG_CONFIG_FILE", logging);
        }
        let ipv6 = command
            .get_envs()
            .any(|(key, value)| key == "ROS_IPV6" && value.is_some());
        let host = if ipv6 { "[::1]" } else { "127.0.0.1" };
        let client = Client::at(host, port);
        let mut process = Process::start(format!("rosmaster at {port}"), &mut command);
        let pid = i32::try_from(process.pid()).unwrap();
        eventually(&format!("rosmaster answers at {port}"), || {
            let ended = process.exited();
            assert!(
                ended.is_none(),
                "rosmaster ended ({ended:?}):\n{}",
                process.log()
            );
            client
                .ask("getPid", vec!["/test".into()])
                .is_some_and(|value| value == Value::Int(pid))
        });
        Self { process, port }
    }

    pub(crate) fn client(&self) -> Client {
        Client::new(self.port)
    }

    pub(crate) fn pid(&self) -> u32 {
        self.process.pid()
    }

    /// Sends SIGKILL and waits for the end of the process.
    pub(crate) fn kill(&mut self) {
        self.process.kill();
    }
}

/// One run of a command line tool of ROS or of rosrescue.
#[derive(Debug)]
pub(crate) struct Tool {
    pub(crate) status: ExitStatus,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Tool {
    /// Runs `name` with the master at `port` until it ends by itself.
    #[track_caller]
    pub(crate) fn run(scratch: &Scratch, port: u16, name: &str, arguments: &[&str]) -> Self {
        Self::wait(
            &mut ros_command(scratch, find_program(name), port),
            arguments,
        )
    }

    /// Makes each of `runs`, a tool's name and its arguments, one after another. The tools are imported only once
    /// (`tests/nodes/tools.py`), which is most of what a run costs.
    #[track_caller]
    pub(crate) fn run_all(scratch: &Scratch, port: u16, runs: &[&[&str]]) -> Vec<Self> {
        let mut command = Library::Rospy.command(scratch, port, "tools");
        let runs = serde_json::to_string(runs).unwrap();
        let printed = Self::wait(&mut command, &[&runs]).ended(0);
        let results: Vec<(i32, String, String)> = serde_json::from_str(&printed).unwrap();
        let tool = |(status, stdout, stderr): (i32, String, String)| Self {
            status: ExitStatus::from_raw(status),
            stdout: stdout.lines().collect::<Vec<_>>().join("\n"),
            stderr: stderr.lines().collect::<Vec<_>>().join("\n"),
        };
        results.into_iter().map(tool).collect()
    }

    /// Runs a command of rosrescue with the master at `port` until it ends by itself.
    #[track_caller]
    pub(crate) fn rosrescue(scratch: &Scratch, port: u16, arguments: &[&str]) -> Self {
        Self::wait(&mut command(scratch, port, &[]), arguments)
    }

    pub(crate) fn exit(&self) -> i32 {
        self.status.code().expect("an exit status")
    }

    #[track_caller]
    fn wait(command: &mut Command, arguments: &[&str]) -> Self {
        let mut process = Process::start(format!("{command:?}"), command.args(arguments));
        let status = process.wait_output();
        Self {
            status,
            stdout: process.stdout().join("\n"),
            stderr: process.stderr().join("\n"),
        }
    }

    /// The tool's standard output. Panics unless the tool has ended with `status`.
    #[track_caller]
    pub(crate) fn ended(self, status: i32) -> String {
        assert_eq!(self.status.code(), Some(status), "{self:?}");
        self.stdout
    }

    /// The tool's standard output as JSON. Panics unless the tool has ended with `status`.
    #[track_caller]
    pub(crate) fn json(self, status: i32) -> serde_json::Value {
        serde_json::from_str(&self.ended(status)).expect("JSON")
    }
}

/// `rosrescue ARGUMENTS`, with a `ROS_MASTER_URI` for this port.
pub(crate) fn command(scratch: &Scratch, port: u16, arguments: &[&str]) -> Command {
    let mut command = ros_command(scratch, env!("CARGO_BIN_EXE_rosrescue"), port);
    command.args(arguments).current_dir(scratch.path(""));
    command
}

/// The folder with the compiled roscpp nodes. Compiles those whose source has changed; a lock keeps test
/// processes that run at the same time from doing so twice.
pub(crate) fn cpp_nodes() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).with_file_name("ros-nodes");
        fs::create_dir_all(&folder).unwrap();
        let lock = File::create(folder.join("lock")).unwrap();
        lock.lock()
            .expect("cannot lock the folder of the roscpp nodes");
        compile(&folder);
        folder
    })
}

fn compile(folder: &Path) {
    let sources: Vec<_> = fs::read_dir(NODES)
        .unwrap()
        .flatten()
        .map(|entry| entry.path())
        .collect();
    let is =
        |path: &Path, extension: &str| path.extension().is_some_and(|found| found == extension);
    let changed = |path: &Path| {
        fs::metadata(path)
            .and_then(|metadata| metadata.modified())
            .ok()
    };
    let headers = sources
        .iter()
        .filter(|path| is(path, "h"))
        .filter_map(|path| changed(path))
        .max();
    let mut flags = None;
    for source in sources.iter().filter(|path| is(path, "cpp")) {
        let node = folder.join(source.file_stem().unwrap());
        if changed(&node) > changed(source).max(headers) {
            continue;
        }
        // Debian has no catkin, but a plain node needs no more than this. `listener.cpp` explains why access
        // is not checked. An unfinished node has another name.
        let half = node.with_extension("half");
        let output = Command::new("g++")
            .args(["-O1", "-Wall", "-fno-access-control", "-o"])
            .args([&half, source])
            .args(flags.get_or_insert_with(roscpp_flags))
            .output()
            .unwrap_or_else(|error| panic!("cannot run g++: {error}; {MISSING}"));
        assert!(
            output.status.success(),
            "cannot compile {}; {MISSING}\n{}",
            source.display(),
            String::from_utf8_lossy(&output.stderr)
        );
        fs::rename(half, node).unwrap();
    }
    // roslaunch finds a node by its package, which is this folder. Nodes of another test process may read this file now.
    let package = fs::read_to_string(Path::new(NODES).join("package.xml")).unwrap();
    let package = package.replace("rosrescue_nodes", "rosrescue_cpp_nodes");
    let half = folder.join("package.xml.half");
    fs::write(&half, package).unwrap();
    fs::rename(half, folder.join("package.xml")).unwrap();
}

fn roscpp_flags() -> Vec<String> {
    let output = Command::new("pkg-config")
        .args(["--cflags", "--libs", "roscpp", "std_msgs"])
        .output()
        .unwrap_or_else(|error| panic!("cannot run pkg-config: {error}; {MISSING}"));
    assert!(
        output.status.success(),
        "{}\n{MISSING}",
        String::from_utf8_lossy(&output.stderr)
    );
    let flags = String::from_utf8(output.stdout).unwrap();
    flags.split_whitespace().map(str::to_owned).collect()
}
