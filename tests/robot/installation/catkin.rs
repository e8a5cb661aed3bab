//! The catkin package: built by catkin, and used by rosrun and roslaunch.

use std::fs::{self, File};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use crate::support::{
    Client, Process, Scratch, eventually, eventually_some, free_port, open_to, ros_command, signal,
    status,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// A workspace in which catkin has built and installed the package, with the program under test. It is made once. Another
/// test process that also needs it waits until this one has ended.
#[track_caller]
fn workspace() -> &'static Path {
    static WORKSPACE: OnceLock<(PathBuf, File)> = OnceLock::new();
    let (folder, _) = WORKSPACE.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("catkin-workspace");
        let lock = File::create(folder.with_extension("lock")).unwrap();
        lock.lock().unwrap();
        if folder.exists() {
            fs::remove_dir_all(&folder).unwrap();
        }
        build(&folder, &lock);
        (folder, lock)
    });
    folder
}

/// `lock` stays locked until the processes of the build have ended, even if this one is killed.
#[track_caller]
fn build(folder: &Path, lock: &File) {
    let source = folder.join("src");
    fs::create_dir_all(&source).unwrap();
    symlink(ROOT, source.join("rosrescue")).unwrap();
    let program = format!("-DROSRESCUE_PROGRAM={}", env!("CARGO_BIN_EXE_rosrescue"));
    let output = Command::new("catkin_make")
        .args(["--directory", folder.to_str().unwrap(), &program, "install"])
        // catkin works only with the system's Python.
        .env("PATH", "/usr/sbin:/usr/bin:/sbin:/bin")
        .stdin(lock.try_clone().unwrap())
        .output();
    let output =
        output.expect("catkin_make is not installed: tests/run.sh installs catkin and cmake");
    assert!(output.status.success(), "{output:?}");
}

/// `program` in the installed workspace.
fn ros(scratch: &Scratch, program: &str, port: u16) -> Command {
    let mut command = ros_command(scratch, "sh", port);
    let setup = workspace().join("install/setup.sh");
    let setup = setup.to_str().unwrap();
    command.args(["-c", &format!(". {setup} && exec \"$0\" \"$@\""), program]);
    command.env("PATH", "/usr/sbin:/usr/bin:/sbin:/bin");
    command
}

/// The contents of roslaunch's log files.
fn roslaunch_logs(scratch: &Scratch) -> String {
    let folders = fs::read_dir(scratch.log_dir()).into_iter().flatten();
    let files = folders
        .flatten()
        .flat_map(|folder| fs::read_dir(folder.path()).into_iter().flatten());
    let is_roslaunch = |name: &str| name.starts_with("roslaunch-") && name.ends_with(".log");
    let logs = files
        .flatten()
        .filter(|file| file.file_name().to_str().is_some_and(is_roslaunch));
    logs.flat_map(|file| fs::read_to_string(file.path()))
        .collect()
}

#[test]
fn catkin_builds_a_package_that_rosrun_and_roslaunch_can_use() {
    let scratch = Scratch::new();
    let port = free_port();
    let output = ros(&scratch, "rosrun", port)
        .args(["rosrescue", "rosrescue", "--version"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        said.starts_with(concat!("rosrescue ", env!("CARGO_PKG_VERSION"))),
        "{output:?}"
    );

    let mut roslaunch = ros(&scratch, "roslaunch", port);
    roslaunch.args(["rosrescue", "core.launch", "args:=--no-rosout -t 4"]);
    let mut roslaunch = Process::start("roslaunch", &mut roslaunch);
    let master = Client::new(port);
    let is_launched =
        || master.param("/roslaunch/uris").is_some() && master.param("/rosrescue/pid").is_some();
    eventually("roslaunch has found a master", || {
        assert!(roslaunch.exited().is_none(), "{}", roslaunch.log());
        master.connect().is_ok() && is_launched()
    });
    // Not `getPid`: while there is no master, rosrescue answers that with its own process id.
    let pid_of_master = || open_to(&status(&master));
    let first = eventually_some("the master runs", pid_of_master);
    signal(first, Signal::KILL);
    let second = eventually_some("another master runs", || {
        pid_of_master().filter(|pid| *pid != first)
    });
    assert!(is_launched());

    // Until roslaunch waits for its nodes, it treats Ctrl-C as an error.
    eventually("roslaunch waits for its nodes", || {
        let logs = roslaunch_logs(&scratch);
        logs.lines().any(|line| line.ends_with(": spin"))
    });

    roslaunch.signal(Signal::INT);
    assert_eq!(roslaunch.wait().code(), Some(0), "{}", roslaunch.log());
    assert!(
        !roslaunch.log().contains("Exception"),
        "{}",
        roslaunch.log()
    );
    eventually("rosrescue and its rosmaster have ended", || {
        master.connect().is_err() && !Path::new(&format!("/proc/{second}")).exists()
    });
}

#[test]
fn rosrescue_ends_with_roslaunch_unless_roslaunch_was_killed() {
    let scratch = Scratch::new();
    let start = |port| {
        let mut roslaunch = ros(&scratch, "roslaunch", port);
        roslaunch.args(["rosrescue", "core.launch", "args:=--no-rosout"]);
        Process::start("roslaunch", &mut roslaunch)
    };
    // Ctrl-C while roslaunch still reads the launch file.
    let port = free_port();
    let master = Client::new(port);
    let mut roslaunch = start(port);
    eventually("rosrescue listens", || master.connect().is_ok());
    // roslaunch sometimes misses a Ctrl-C while it starts, also without rosrescue, so it is pressed again.
    let mut pressed: Option<Instant> = None;
    eventually("roslaunch ends", || {
        if pressed.is_none_or(|at| at.elapsed() > Duration::from_secs(5)) {
            pressed = Some(Instant::now());
            roslaunch.signal(Signal::INT);
        }
        roslaunch.exited().is_some()
    });
    eventually("rosrescue has ended", || master.connect().is_err());

    let port = free_port();
    let master = Client::new(port);
    let mut roslaunch = start(port);
    let started = "process[rosrescue_of_roslaunch-1]: started with pid";
    roslaunch.wait_line("that its node runs", |line| line.contains(started));
    let file = scratch.path(format!("rosrescue-of-roslaunch-{}.pid", roslaunch.pid()));
    let node = file.with_extension("pid.node");
    eventually("the node waits", || node.exists());
    roslaunch.signal(Signal::KILL);
    roslaunch.wait();
    eventually("the end of roslaunch was noticed", || !file.exists());
    assert!(master.param("/rosrescue/pid").is_some());
}

#[test]
fn the_launch_file_uses_a_master_that_is_already_there() {
    let scratch = Scratch::new();
    let master = crate::support::Rosmaster::start(&scratch);
    let run_id = master.client().ok(
        "setParam",
        vec!["/test".into(), "/run_id".into(), "1-2".into()],
    );
    assert_eq!(run_id, Value::Int(0));
    let output = ros(&scratch, "roslaunch", master.port)
        .args(["rosrescue", "core.launch"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(said.contains("/rosrescue/pid: none"), "{output:?}");
    assert!(output.status.success(), "{output:?}");
}
