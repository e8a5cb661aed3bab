//! `log`: what changed, when and by whom, and the state at an earlier time.

use ros1_master::xmlrpc::Value;
use serde_json::Value as Json;

use crate::support::{FakeNode, Mode, Robot, Tool, eventually, page, params};

fn run(robot: &Robot, arguments: &[&str]) -> Tool {
    Tool::rosrescue(&robot.scratch, robot.port(), arguments)
}

/// The entries of the log, one JSON object each.
fn entries(robot: &Robot, arguments: &[&str]) -> Vec<Json> {
    let text = run(robot, &[&["log", "--json"], arguments].concat()).ended(0);
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect()
}

/// A caller's name looks like a line of the log about the operator.
#[test]
fn a_line_break_in_a_name_forges_no_line() {
    const FORGED: &str =
        "2026-11-27T19:00:00.000Z  /operator (10.0.0.5)  set /estop: true -> false";
    let robot = Robot::start(Mode::Core);
    let client = robot.client();
    let breaks = [
        "\n", "\u{85}", "\u{2028}", "\u{2029}", "\u{202e}", "\u{200b}",
    ];
    for end in breaks {
        let name = format!("/cam{end}{FORGED}");
        client.ok(
            "setParam",
            params![name.as_str(), "/speed", end.len() as i32],
        );
        client.ok("setParam", params!["/n", name.as_str(), 1]);
        let nobody = "http://127.0.0.1:1/";
        client.ok(
            "registerSubscriber",
            params![name.as_str(), "/t", "x/Y", nobody],
        );
    }
    let mut texts = vec![page(&client, "/"), page(&client, "/status.json")];
    for arguments in [
        &["log"][..],
        &["log", "--json"],
        &["status"],
        &["status", "--json"],
        &["top", "--count", "1"],
        &["top", "--count", "1", "--json"],
        &["inspect"],
        &["inspect", "--json"],
        &["history"],
        &["verify"],
    ] {
        texts.push(run(&robot, arguments).stdout);
    }
    for text in texts {
        let forged = text.lines().any(|line| line.starts_with("2026-11-27T19"));
        assert!(!forged, "{text}");
        for end in &breaks[1..] {
            assert!(!text.contains(end), "{end:?} in {text}");
        }
    }
}

/// Sets a parameter so often that several generations of the checkpoint are replaced.
fn fill_generations(robot: &Robot) {
    let client = robot.client();
    let text = "x".repeat(2_000);
    let closed = |robot: &Robot| {
        let folder = std::fs::read_dir(robot.scratch.log_dir()).unwrap();
        let mut names = folder.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        names.any(|name| name.contains(".log-"))
    };
    for value in 0.. {
        assert!(value < 10_000, "no generation was replaced");
        client.set_param("/filler", format!("{value} {text}"));
        if value > 300 && closed(robot) {
            return;
        }
    }
}

#[test]
fn the_log_shows_who_changed_what_and_the_state_at_any_time() {
    let robot = Robot::start(Mode::Core);
    let client = robot.client();
    client.ok("setParam", params!["/tuner", "/arm/gain", 1]);
    client.ok("setParam", params!["/tuner", "/wifi/password", "geheim"]);
    let old = FakeNode::start("/driver");
    old.publish(&client, "/scan", "x/Y");
    let gain = |arguments: &[&str]| {
        let param = ["--param", "/arm/gain"];
        entries(&robot, &[&param, arguments].concat())
    };
    let before = gain(&[])[0]["time"].as_str().unwrap().to_owned();
    fill_generations(&robot);
    client.ok("setParam", params!["/other", "/arm/gain", 2]);
    let new = FakeNode::start("/driver");
    new.publish(&client, "/scan", "x/Y");

    let nothing = run(&robot, &["log", "--param", "/arm/gian"]);
    assert_eq!(nothing.exit(), 1, "{nothing:?}");
    assert!(
        nothing.stderr.contains("no change in the log beside "),
        "{nothing:?}"
    );
    let found = gain(&[]);
    let of = |entry: &Json, key: &str| entry[key].as_str().unwrap_or_default().to_owned();
    assert_eq!(found.len(), 2, "{found:?}");
    assert_eq!(of(&found[1], "text"), "set /arm/gain: 1 -> 2");
    assert_eq!(of(&found[1], "caller"), "/other");
    assert_eq!(of(&found[1], "from"), "127.0.0.1");
    assert_eq!(gain(&["--until", &before]).len(), 1);
    let text = run(&robot, &["log", "--node", "/driver"]).ended(0);
    let displaced = format!(
        "node /driver at {} displaced the one at {}",
        new.api, old.api
    );
    assert!(text.contains(&displaced), "{text}");
    assert!(text.contains("publishes /scan (x/Y)"), "{text}");
    let all = run(&robot, &["log", "-n", "0"]).ended(0);
    assert!(!all.contains("geheim") && all.contains("set /wifi/password: \"(hidden)\""));
    assert_eq!(
        run(&robot, &["log"]).ended(0).lines().count(),
        all.lines().count().min(1000)
    );
    assert_eq!(run(&robot, &["log", "-n", "7"]).ended(0).lines().count(), 7);
    run(&robot, &["log", "--param", "/no/such"]).ended(1);
    run(&robot, &["log", "--since", "soon"]).ended(2);

    // The state at an earlier time.
    let text = run(&robot, &["inspect", "--at", &before]).ended(0);
    assert!(text.contains("  /arm/gain: 1"), "{text}");
    let text = run(&robot, &["params", "--at", &before]).ended(0);
    assert!(text.contains("\"gain\": 1"), "{text}");
    let text = run(&robot, &["diff", "--from", &before]).ended(1);
    assert!(text.contains("parameter /arm/gain: 1 -> 2"), "{text}");
    run(&robot, &["diff", "--from", "now", "--to", "now"]).ended(0);
    run(&robot, &["inspect", "--at", "1999-01-01"]).ended(2);
    let restore = ["restore", "--param", "/arm/gain", "--at", &before];
    let plan = run(&robot, &[&restore[..], &["--plan"]].concat()).ended(0);
    assert!(plan.contains("set /arm/gain: 2 -> 1"), "{plan}");
    assert!(plan.contains("1 parameters to set, 0 to delete"), "{plan}");
    run(&robot, &[&restore[..], &["--yes"]].concat()).ended(0);
    assert_eq!(client.param("/arm/gain"), Some(Value::from(1)));
    assert!(client.param("/filler").is_some());
    assert_eq!(gain(&[]).len(), 3);
}

#[test]
fn rescues_and_restarts_are_in_the_log() {
    let mut robot = Robot::start_with(Mode::Core, &["--no-rosout", "--restore", "always"]);
    robot.client().set_param("/before", 1);
    robot.crash_master();
    robot.client().set_param("/after", 1);
    eventually("the rescue is in the log", || {
        let text = run(&robot, &["log"]).ended(0);
        text.contains("rescue 1 after") && text.contains("another master was brought to the state")
    });
    assert!(robot.rescue.terminate().success());
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.client().set_param("/again", 1);
    let text = run(&robot, &["log"]).ended(0);
    for part in ["set /before: 1", "rosrescue was stopped", "set /again: 1"] {
        assert!(text.contains(part), "{part}\n{text}");
    }
}

#[test]
fn follow_shows_new_changes() {
    let robot = Robot::start(Mode::Core);
    let folder = robot.scratch.log_dir();
    let output = folder.join("followed");
    let mut command = run_in_background(&robot, &output);
    robot.client().set_param("/watched", 7);
    eventually("the change is shown", || {
        let text = std::fs::read_to_string(&output).unwrap();
        text.contains("set /watched: 7")
    });
    command.kill().unwrap();
    command.wait().unwrap();
}

fn run_in_background(robot: &Robot, output: &std::path::Path) -> std::process::Child {
    std::process::Command::new(env!("CARGO_BIN_EXE_rosrescue"))
        .args(["log", "--follow", "--param", "/watched", "--checkpoint"])
        .arg(robot.scratch.log_dir().join(checkpoint_name(robot)))
        .stdout(std::fs::File::create(output).unwrap())
        .spawn()
        .unwrap()
}

fn checkpoint_name(robot: &Robot) -> String {
    let folder = std::fs::read_dir(robot.scratch.log_dir()).unwrap();
    let mut names = folder.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names
        .find(|name| name.starts_with("latest-chkpt") && name.ends_with(".yaml"))
        .unwrap()
}
