//! `restore`: gives a running robot the parameters of a checkpoint.

use std::io::Write;
use std::process::{Command, Stdio};

use ros1_master::xmlrpc::Value;

use crate::support::{
    FakeNode, Mode, Robot, Tool, eventually, in_both_modes, params, ros_command, tree,
};

fn run(robot: &Robot, arguments: &[&str]) -> Tool {
    Tool::rosrescue(&robot.scratch, robot.port(), arguments)
}

in_both_modes!(parameters_are_put_back_and_only_on_request_deleted);

fn parameters_are_put_back_and_only_on_request_deleted(mode: Mode) {
    let mut robot = Robot::start_with(mode, &["--restore", "never"]);
    let client = robot.client();
    client.set_param("/gains", tree! { "p" => 1.0, "i" => 2 });
    client.set_param("/wifi", tree! { "password" => "geheim" });
    assert!(robot.rescue.terminate().success());
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    if mode == Mode::Core {
        client.await_roscore_params();
    }
    let watcher = FakeNode::start("/watcher");
    watcher.watch_param(&client, "/gains");
    client.set_param("/gains", tree! { "p" => 3.0, "d" => 1 });
    client.ok("setParam", params!["/test", "/extra", true]);
    client.ask("deleteParam", params!["/test", "/wifi"]);
    let run_id = client.param("/run_id");

    let text = run(&robot, &["restore", "session-1", "--plan"]).ended(0);
    for line in [
        "set /gains/p: 3.0 -> 1.0",
        "set /gains/i: 2",
        "set /wifi/password: \"(hidden)\"",
        "3 parameters to set, 0 to delete",
    ] {
        assert!(text.lines().any(|found| found == line), "{line}\n{text}");
    }
    assert_eq!(client.param("/gains/p"), Some(3.0.into()));
    // `restore` asks before it changes anything. Without a terminal it cannot.
    let refused = run(&robot, &["restore", "session-1"]);
    assert!(refused.stderr.contains("--yes"), "{refused:?}");
    refused.ended(2);
    run(&robot, &["restore", "session-1", "--json"]).json(2);
    assert_eq!(client.param("/gains/i"), None);

    let text = run(&robot, &["restore", "session-1", "--yes"]).ended(0);
    assert!(text.ends_with("done and read back"), "{text}");
    let gains = tree! { "p" => 1.0, "d" => 1, "i" => 2 };
    assert_eq!(client.param("/gains"), Some(gains));
    assert_eq!(client.param("/wifi/password"), Some("geheim".into()));
    assert_eq!(client.param("/extra"), Some(true.into()));
    assert_eq!(client.param("/run_id"), run_id);
    eventually("the watcher is notified", || {
        let heard = watcher.received("paramUpdate");
        heard
            .iter()
            .any(|update| update[1..] == params!["/gains/i/", 2])
    });
    // The real master also has the value.
    assert_eq!(robot.bare().param("/gains/i"), Some(Value::from(2)));

    let json = run(
        &robot,
        &["restore", "session-1", "--yes", "--exact", "--json"],
    )
    .json(0);
    assert_eq!(
        json["plan"]["delete"],
        serde_json::json!(["/gains/d", "/extra"])
    );
    assert_eq!(json["done"], true);
    assert_eq!(client.param("/extra"), None);
    assert_eq!(client.param("/run_id"), run_id);
    let text = run(&robot, &["restore", "session-1", "--yes", "--exact"]).ended(0);
    assert!(text.ends_with("nothing to do"), "{text}");
}

/// The mirror answers the writes as usual, and the next master gets them.
#[test]
fn a_checkpoint_is_put_back_while_there_is_no_master() {
    let mut robot = Robot::start_for_outages(Mode::Core);
    robot.client().set_param("/x", 1);
    let file = robot.scratch.path("file.yaml");
    std::fs::copy(robot.rescue.checkpoint(), &file).unwrap();
    robot.client().set_param("/x", 2);
    robot.take_master_away();
    let file = file.to_str().unwrap();
    let text = run(&robot, &["restore", file, "--yes"]).ended(0);
    assert!(
        text.contains("set /x: 2 -> 1") && text.ends_with("read back"),
        "{text}"
    );
    robot.revive_master();
    robot.await_gate();
    assert_eq!(robot.bare().param("/x"), Some(1.into()));
}

#[test]
fn at_a_terminal_it_asks() {
    let mut robot = Robot::start_with(Mode::Core, &["--no-rosout", "--restore", "never"]);
    robot.client().set_param("/x", 1);
    assert!(robot.rescue.terminate().success());
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    let answer = |answer: &str| {
        let program = env!("CARGO_BIN_EXE_rosrescue");
        let mut command: Command = ros_command(&robot.scratch, "script", robot.port());
        let asked = format!("'{program}' restore session-1");
        command.args(["--quiet", "--return", "--command", &asked, "/dev/null"]);
        let child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        writeln!(child.stdin.as_ref().unwrap(), "{answer}").unwrap();
        let output = child.wait_with_output().unwrap();
        (
            output.status.code(),
            String::from_utf8_lossy(&output.stdout).into_owned(),
        )
    };
    let (status, text) = answer("n");
    assert!(
        status == Some(1) && text.contains("Set these parameters? [y/N]"),
        "{status:?} {text}"
    );
    assert_eq!(robot.client().param("/x"), None);
    let (status, text) = answer("y");
    assert!(
        status == Some(0) && text.contains("done and read back"),
        "{status:?} {text}"
    );
    assert_eq!(robot.client().param("/x"), Some(1.into()));
}
