//! How rosrescue stops, and what it keeps running until then. Signals stop it cleanly even if another process hangs.
//! Nothing is left behind, and no call gets a false answer.

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::process::Command;
use std::thread;
use std::time::Duration;

use crate::support::{
    FakeNode, Mode, Robot, Scratch, Setup, alive, eventually, find_program, free_port, holds,
    params, unreadable, within,
};
use rustix::process::Signal;

#[test]
fn an_orderly_stop_leaves_nothing_behind() {
    // `restart::guardian` plays SIGINT and SIGHUP.
    let mut robot = Robot::start(Mode::Core);
    robot.client().set_param("/x", 1);
    let master = robot.master_pid();
    assert!(
        robot.processes().len() >= 3,
        "rosrescue, rosmaster and rosout: {:?}",
        robot.processes()
    );
    robot.rescue.signal(Signal::TERM);
    assert_eq!(robot.rescue.wait().code(), Some(0));
    assert!(!alive(master), "rosmaster is left behind");
    assert_eq!(robot.scratch.survivors(), vec![]);
    assert!(robot.rescue.checkpoint().exists());
    let mut robot = Robot::start(Mode::Proxy);
    let master = robot.master_pid();
    robot.rescue.signal(Signal::TERM);
    assert_eq!(robot.rescue.wait().code(), Some(0));
    assert!(alive(master), "the master of others is ended");
}

#[test]
fn a_clean_stop_in_an_outage_keeps_answered_writes_and_gives_no_false_answer() {
    let mut robot = Robot::start(Mode::Proxy);
    robot.kill_master();
    let client = robot.client();
    for number in 0..5 {
        client.ok("setParam", params!["/c", "/answered", number]);
    }
    // Calls that only a master understands.
    let waiting: Vec<_> = (0..5)
        .map(|number| {
            let client = client.clone();
            thread::spawn(move || client.exchange(&unreadable("/waiting", number)))
        })
        .collect();
    assert!(holds(Duration::from_millis(500), || waiting
        .iter()
        .all(|call| !call.is_finished())));
    let status = within(Duration::from_secs(15), "a stop", || {
        robot.rescue.terminate()
    });
    assert_eq!(status.code(), Some(0));
    for call in waiting {
        // No master ran the calls, so they must not succeed.
        assert!(call.join().unwrap().is_err());
    }
    let checkpoint = fs::read_to_string(robot.rescue.checkpoint()).unwrap();
    assert!(checkpoint.contains("\"answered\": 4"), "{checkpoint}");
    assert!(!checkpoint.contains("waiting"), "{checkpoint}");
}

#[test]
fn a_core_stops_even_if_its_master_hangs() {
    let mut robot = Robot::start(Mode::Core);
    let master = robot.master_pid();
    crate::support::stop(master);
    assert_eq!(robot.rescue.terminate().code(), Some(0));
    eventually("the master that hangs is ended", || !alive(master));
    assert_eq!(robot.scratch.survivors(), vec![]);
}

#[test]
fn a_second_signal_ends_at_once() {
    for (second, code) in [(Signal::INT, 130), (Signal::TERM, 143)] {
        // A rosout that stops slowly must not give rosrescue time to replace the hung master.
        let mut robot = Robot::start_with(Mode::Core, &["--probe-count", "1000"]);
        let master = robot.master_pid();
        // A clean stop must wait for the hung master.
        crate::support::stop(master);
        robot.rescue.signal(Signal::TERM);
        // The first signal has been handled. Two pending signals may be merged into one.
        eventually("the stop has begun", || rosout(&robot).is_none());
        robot.rescue.signal(second);
        let status = within(Duration::from_secs(3), "the end", || robot.rescue.wait());
        assert_eq!(status.code(), Some(code));
    }
}

/// Runs its arguments in a new terminal, closes the terminal once calls pass, and exits with their status.
const IN_A_TERMINAL: &str = r#"
import os, pty, sys
pid, terminal = pty.fork()
if pid == 0:
    os.execv(sys.argv[1], sys.argv[1:])
said = b""
while b"fault tolerant" not in said:
    said += os.read(terminal, 4096)
os.close(terminal)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) % 256)
"#;

#[test]
fn closing_the_terminal_stops_rosrescue_cleanly() {
    let scratch = Scratch::new();
    let port = free_port().to_string();
    let setup = Setup::bare(&scratch, ["core", "-v", "-p", &port]).wrapped(|command| {
        let mut python = Command::new("/usr/bin/python3");
        scratch.prepare(&mut python);
        python.args(["-c", IN_A_TERMINAL]);
        python.arg(command.get_program()).args(command.get_args());
        python
    });
    let mut rescue = setup.spawn();
    assert_eq!(rescue.wait().code(), Some(0), "{:?}", rescue.output());
    assert_eq!(scratch.survivors(), vec![]);
}

#[test]
fn a_core_under_nohup_outlives_its_terminal() {
    let scratch = Scratch::new();
    let port = free_port();
    let setup = Setup::bare(&scratch, ["core", "-p", &port.to_string()]);
    let setup = setup.wrapped(|command| {
        let mut nohup = Command::new("nohup");
        scratch.prepare(&mut nohup);
        nohup.arg(command.get_program()).args(command.get_args());
        nohup
    });
    let mut rescue = setup.at_port(port).start();
    rescue.signal(Signal::HUP);
    assert!(holds(Duration::from_millis(500), || rescue
        .exited()
        .is_none()));
    rescue.client().set_param("/alive", true);
    assert_eq!(rescue.terminate().code(), Some(0));
}

/// The process of rosout, if it runs.
fn rosout(robot: &Robot) -> Option<u32> {
    let mut processes = robot.scratch.survivors().into_iter();
    let rosout = processes.find(|(_, command)| command.contains("rosout/rosout"));
    rosout.map(|(pid, _)| pid)
}

/// rosout is restarted when it ends, and its registrations are restored.
#[test]
fn a_core_keeps_rosout_alive() {
    let robot = Robot::start(Mode::Core);
    let before = robot.settled_state();
    let old = rosout(&robot).expect("rosout runs");
    crate::support::signal(old, Signal::KILL);
    eventually("another rosout runs", || {
        rosout(&robot).is_some_and(|pid| pid != old)
    });
    eventually("the new rosout is registered", || {
        let now = robot.settled_state();
        now.publishers == before.publishers
            && now.subscribers == before.subscribers
            && now.nodes != before.nodes
    });
}

/// The process id that a rosout in a container or of another computer reports means another process here.
#[test]
fn a_rosout_that_ran_elsewhere_is_replaced_when_it_has_ended() {
    let robot = Robot::start(Mode::Core);
    robot.settled_state();
    assert!(rosout(&robot).is_some());
    let elsewhere = FakeNode::start("/rosout");
    elsewhere.claim_pid(1);
    elsewhere.subscribe(&robot.client(), "/rosout", "rosgraph_msgs/Log");
    eventually("rosrescue's rosout has ended", || {
        rosout(&robot).is_none() && elsewhere.received("getPid").len() > 1
    });
    drop(elsewhere);
    eventually("rosrescue's rosout runs again", || rosout(&robot).is_some());
}

/// A rosout that ends at once, for example because its libraries are missing, is started again after growing pauses.
/// The log has its last output. It is the one of the ROS that contains rosmaster, as one built from source.
#[test]
fn a_rosout_that_cannot_run_is_logged_with_its_last_output() {
    let scratch = Scratch::new();
    let [folder, libraries] = ["ros/bin", "ros/lib/rosout"].map(|folder| scratch.path(folder));
    fs::create_dir_all(&folder).unwrap();
    fs::create_dir_all(&libraries).unwrap();
    symlink(find_program("rosmaster"), folder.join("rosmaster")).unwrap();
    let program = libraries.join("rosout");
    let starts = scratch.path("starts");
    let script = format!(
        "#!/bin/sh\ndate +%s.%N >>'{}'\necho no library here >&2\nexit 127\n",
        starts.display()
    );
    fs::write(&program, script).unwrap();
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", folder.display(), std::env::var("PATH").unwrap());
    let port = free_port();
    let setup = Setup::bare(&scratch, ["core", "-p", &port.to_string()]);
    let mut rescue = setup.env("PATH", path).at_port(port).start();
    let line = rescue.wait_line("that it has ended", |line| {
        line.contains("rosout has ended")
    });
    assert!(line.contains("no library here"), "{line}");
    assert!(line.contains("127"), "{line}");
    let starts = || -> Vec<f64> {
        let text = fs::read_to_string(&starts).unwrap();
        text.lines().map(|line| line.parse().unwrap()).collect()
    };
    eventually("rosout is started three more times", || starts().len() > 3);
    let starts = starts();
    // The pauses are 1, 2 and 4 seconds.
    assert!(starts[3] - starts[0] > 6.5, "{starts:?}");
    assert_eq!(rescue.terminate().code(), Some(0));
}
