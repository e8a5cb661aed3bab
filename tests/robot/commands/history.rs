//! The kept checkpoints, and `history`.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use ros1_master::xmlrpc::Value;

use crate::support::{FakeNode, Mode, Robot, Scratch, Tool, eventually};

fn history(robot: &Robot) -> Vec<serde_json::Value> {
    let json = Tool::rosrescue(&robot.scratch, robot.port(), &["history", "--json"]).json(0);
    json["kept"].as_array().unwrap().clone()
}

fn names(robot: &Robot) -> Vec<String> {
    let rows = history(robot);
    let names = rows
        .iter()
        .map(|row| row["name"].as_str().unwrap().to_owned());
    let mut names: Vec<_> = names.collect();
    names.sort();
    names
}

/// Waits until the state of a rescue is kept.
#[track_caller]
fn await_rescue(robot: &Robot, number: u32) {
    let mut file = robot.rescue.checkpoint().into_os_string();
    file.push(format!(".rescue-{number}"));
    eventually("the rescue is kept", || Path::new(&file).is_file());
    assert!(names(robot).contains(&format!("rescue-{number}")));
}

/// Stops rosrescue cleanly and starts it again. With `--restore never` that begins another session.
fn start_again(robot: &mut Robot) {
    assert!(robot.rescue.terminate().success());
    robot.rescue.start_again();
    robot.rescue.wait_serving();
}

#[test]
fn the_last_five_sessions_and_each_rescue_are_kept() {
    let mut robot = Robot::start_with(Mode::Core, &["--no-rosout", "--restore", "never"]);
    for session in 1..=6 {
        robot.client().set_param("/session", session);
        start_again(&mut robot);
    }
    let kept = [2, 3, 4, 5, 6].map(|number| format!("session-{number}"));
    assert_eq!(names(&robot), [&["present".to_owned()][..], &kept].concat());
    // A user with another home folder, as a service has, gets the same answer.
    let elsewhere = Tool::rosrescue(&Scratch::new(), robot.port(), &["history", "--json"]);
    assert_eq!(elsewhere.json(0)["kept"].as_array().unwrap().len(), 6);
    // Checkpoints can be given by name and by number.
    let run = |robot: &Robot, arguments: &[&str]| {
        Tool::rosrescue(&robot.scratch, robot.port(), arguments).ended(0)
    };
    let params = run(&robot, &["params", "session-3"]);
    assert!(params.contains("\"session\": 3"), "{params}");
    let second = history(&robot)[1]["name"].as_str().unwrap().to_owned();
    assert_eq!(
        run(&robot, &["inspect", "2"]),
        run(&robot, &["inspect", &second])
    );

    robot.client().set_param("/before", 1);
    let dead = FakeNode::start("/dead");
    dead.publish(&robot.client(), "/scan", "x/Y");
    drop(dead);
    robot.crash_master();
    await_rescue(&robot, 1);
    // The state at the master's death, before the dead node was unregistered.
    let rescue = run(&robot, &["inspect", "rescue-1"]);
    assert!(rescue.contains("  /dead at http"), "{rescue}");
    eventually("the dead node is unregistered", || {
        !robot.settled_state().knows("/dead")
    });
    robot.client().set_param("/before", 2);
    let text = Tool::rosrescue(
        &robot.scratch,
        robot.port(),
        &["diff", "rescue-1", "--live"],
    );
    let text = text.ended(1);
    assert!(
        text.contains("node /dead at ") && text.ends_with("parameter /before: 1 -> 2"),
        "{text}"
    );
    robot.crash_master();
    await_rescue(&robot, 2);
    assert!(run(&robot, &["params", "rescue-2"]).contains("\"before\": 2"));
    let text = run(&robot, &["history"]);
    assert!(text.contains("restored in a rescue"), "{text}");
    assert_eq!(text.lines().count(), 2 * history(&robot).len());
    // Only the owner may read them.
    for row in history(&robot) {
        let mode = fs::metadata(row["path"].as_str().unwrap())
            .unwrap()
            .permissions()
            .mode();
        assert_eq!(mode & 0o777, 0o600, "{row}");
    }
}

/// A service may run as another user. Needs root.
#[test]
fn a_user_without_permission_is_not_told_that_there_is_nothing() {
    let shared = tempfile::tempdir_in("/tmp").unwrap();
    let (program, closed) = (
        shared.path().join("rosrescue"),
        shared.path().join("closed"),
    );
    fs::copy(env!("CARGO_BIN_EXE_rosrescue"), &program).unwrap();
    fs::create_dir(&closed).unwrap();
    for (folder, mode) in [(shared.path(), 0o755), (closed.as_path(), 0o700)] {
        fs::set_permissions(folder, fs::Permissions::from_mode(mode)).unwrap();
    }
    for words in [&["history"][..], &["report"], &["inspect", "rescue-1"]] {
        let mut other = Command::new("setpriv");
        other.args(["--reuid=65534", "--regid=65534", "--clear-groups"]);
        other.arg(&program).args(words).arg("--checkpoint");
        other.arg(closed.join("latest-chkpt.yaml")).current_dir("/");
        let output = other.output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(said.contains("Permission denied"), "{said}");
    }
}

#[test]
fn a_history_without_space_keeps_only_the_last_session() {
    let options = ["--no-rosout", "--restore", "never", "--history", "0"];
    let mut robot = Robot::start_with(Mode::Core, &options);
    for session in 1..=2 {
        robot.client().set_param("/session", session);
        if session == 2 {
            robot.crash_master();
        }
        start_again(&mut robot);
    }
    // A kept checkpoint would exist before the stop has ended.
    assert_eq!(names(&robot), ["present", "session-2"]);
}

/// A large state must not fill the disk with copies.
#[test]
fn a_rescue_that_would_not_fit_is_not_kept() {
    let mut robot = Robot::start_with(Mode::Core, &["--no-rosout", "--history", "1"]);
    robot.client().set_param("/large", "x".repeat(2 << 20));
    // The next generation has the large parameter in its snapshot.
    assert!(robot.rescue.terminate().success());
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    let large = Value::from("x".repeat(2 << 20));
    robot.client().set_param("/large", large);
    robot.client().set_param("/small", 1);
    robot.crash_master();
    assert!(robot.rescue.terminate().success());
    let rescues: Vec<_> = names(&robot)
        .into_iter()
        .filter(|name| name.starts_with("rescue"))
        .collect();
    assert_eq!(rescues, [""; 0]);
}
