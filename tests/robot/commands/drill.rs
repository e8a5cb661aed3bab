//! `rosrescue drill` on real robots.

use std::fs;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use rustix::process::Signal;
use serde_json::Value;

use crate::support::{
    FakeNode, LIBRARIES, Library, Mode, Netns, Node, Process, Robot, Scratch, Setup, alive,
    eventually, eventually_some, find_program, free_port, params, ros_command,
};

/// A drill at `port`.
fn drill(scratch: &Scratch, port: u16, options: &[&str]) -> Process {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rosrescue"));
    scratch.prepare(&mut command);
    command
        .args([
            "drill",
            "--json",
            "--uri",
            &format!("http://127.0.0.1:{port}"),
        ])
        .args(options);
    Process::start(format!("a drill {options:?}"), &mut command)
}

/// The verdict of a drill, with its exit status checked.
#[track_caller]
fn verdict(mut drill: Process) -> Value {
    let status = drill.wait_output().code();
    let verdict: Value = serde_json::from_str(&drill.stdout().join("\n")).expect("a verdict");
    let expected = if verdict["passed"] == true { 0 } else { 1 };
    assert_eq!(status, Some(expected), "{verdict:#}");
    verdict
}

#[track_caller]
fn assert_passed(verdict: &Value) {
    // A pause in the messages is no damage: a talker or the drill may have got no processor for a second.
    let is_pause = |failure: &Value| failure.as_str().unwrap().contains(" came for ");
    let failures = verdict["failures"].as_array().unwrap();
    assert!(failures.iter().all(is_pause), "{verdict:#}");
    assert_eq!(verdict["passed"], failures.is_empty(), "{verdict:#}");
    for calls in ["reads", "writes", "notifications"] {
        let calls = &verdict["calls"][calls];
        assert!(calls["longest_ms"].as_f64().unwrap() > 0.0, "{verdict:#}");
    }
}

/// Asserts that the drill failed and that a failure contains `words`.
#[track_caller]
fn assert_failed(verdict: &Value, words: &str) {
    assert_eq!(verdict["passed"], false, "{verdict:#}");
    let failures = verdict["failures"].to_string();
    assert!(failures.contains(words), "{verdict:#}");
}

/// A program that publishes empty messages, once it is registered.
fn published(robot: &Robot, topic: &str, kind: &str, rate: &str) -> Process {
    let mut publish = ros_command(&robot.scratch, find_program("rostopic"), robot.port());
    publish.args(["pub", "-r", rate, topic, kind, "{}"]);
    let process = Process::start(format!("a publisher of {topic}"), &mut publish);
    eventually("the topic is published", || {
        !robot.state().publishers_of(topic).is_empty()
    });
    process
}

#[test]
fn a_master_is_killed_and_nobody_notices() {
    let robot = Robot::start(Mode::Core);
    let nodes = LIBRARIES.map(|(library, suffix)| {
        let name = format!("__name:=talker_{suffix}");
        robot.node(library, "talker", &["50", "quiet", &name])
    });
    // Messages with sequence numbers.
    let odometry = published(&robot, "/odom", "nav_msgs/Odometry", "20");
    robot.client().set_param("/robot/wheels", 4);
    let before = robot.settled_state();
    let first = robot.master_pid();
    let found = verdict(drill(
        &robot.scratch,
        robot.port(),
        &["--yes", "--times", "2"],
    ));
    assert_passed(&found);
    assert_eq!(found["kills"].as_array().unwrap().len(), 2);
    assert_eq!(
        found["kills"][0]["killed"][0],
        serde_json::json!(["master", first])
    );
    assert!(found["kills"][1]["recovered_ms"].as_f64().unwrap() > 0.0);
    assert!(!alive(first));
    // The topic that a robot drives by comes first, although others have more messages.
    let (odometry_topic, chatter) = (&found["topics"][0], &found["topics"][1]);
    assert_eq!(
        (&odometry_topic["topic"], &odometry_topic["lost"]),
        (&"/odom".into(), &0.into())
    );
    assert_eq!(
        (&chatter["topic"], &chatter["lost"]),
        (&"/chatter".into(), &Value::Null)
    );
    assert_eq!(chatter["publishers"], 2);
    for topic in [odometry_topic, chatter] {
        assert!(topic["messages"].as_u64().unwrap() > 40, "{found:#}");
    }
    assert_eq!(found["nodes"], 4, "talkers, odometry and rosout");
    // The drill has left nothing behind, not even in the state that the rescue keeps for `restore`.
    robot.await_state(&before, "after the drill");
    let mut kept = robot.rescue.checkpoint().to_owned().into_os_string();
    kept.push(".rescue-1");
    let kept = eventually_some("the rescue is kept", || fs::read_to_string(&kept).ok());
    assert!(
        kept.contains("wheels") && !kept.contains("rosrescue_drill_"),
        "{kept}"
    );
    drop((nodes, odometry));
}

#[test]
fn a_drill_kills_the_worker_or_both_at_once() {
    let scratch = Scratch::new();
    let rescue = Setup::core(&scratch, free_port()).guarded().start();
    let mut talker = Node::start(
        &scratch,
        Library::Roscpp,
        rescue.port(),
        "talker",
        &["50", "quiet"],
    );
    for kill in ["worker", "both"] {
        let options = [
            "--yes", "--times", "1", "--kill", kill, "--topic", "chatter",
        ];
        let found = verdict(drill(&scratch, rescue.port(), &options));
        assert_passed(&found);
        let killed = found["kills"][0]["killed"].as_array().unwrap();
        assert_eq!(killed.len(), if kill == "both" { 2 } else { 1 });
        for victim in killed {
            assert!(!alive(u32::try_from(victim[1].as_u64().unwrap()).unwrap()));
        }
    }
    assert!(talker.exited().is_none());
}

#[test]
fn a_master_that_hangs_is_left_alive_by_a_proxy() {
    // It counts as hung before it continues.
    let robot = Robot::start_with(Mode::Proxy, &["--probe-timeout", "500"]);
    let found = verdict(drill(
        &robot.scratch,
        robot.port(),
        &["--yes", "--times", "1", "--hang"],
    ));
    assert_passed(&found);
    assert_eq!(found["kills"][0]["signal"], "SIGSTOP");
    assert!(
        found["notes"]
            .to_string()
            .contains("no topic carried messages")
    );
    assert!(
        robot.bare().master_pid().is_some(),
        "the same master continues"
    );
}

/// The drill asks who is registered, and then each node's address, which a node that unregisters meanwhile has no more.
#[test]
fn nodes_that_come_and_go_while_the_state_is_read_are_no_damage() {
    let robot = Robot::start(Mode::Core);
    let master = robot.master_pid();
    let drill = drill(
        &robot.scratch,
        robot.port(),
        &["--no-kill", "--seconds", "1"],
    );
    let is_over = AtomicBool::new(false);
    let found = std::thread::scope(|scope| {
        scope.spawn(|| {
            let client = robot.client();
            // Bounded, so that a failed test ends.
            for number in 0..1_500 {
                if is_over.load(Relaxed) {
                    break;
                }
                let (node, api) = (format!("/brief_{number}"), "http://127.0.0.1:9/");
                client.ok("registerPublisher", params![&*node, "/brief", "x/Y", api]);
                std::thread::sleep(Duration::from_millis(4));
                client.ok("unregisterPublisher", params![&*node, "/brief", api]);
                std::thread::sleep(Duration::from_millis(4));
            }
        });
        let found = verdict(drill);
        is_over.store(true, Relaxed);
        found
    });
    assert_passed(&found);
    // A drill without kills only watches.
    assert_eq!(found["kills"], Value::Array(Vec::new()));
    assert_eq!(robot.master_pid(), master);
}

/// One node is stopped and started again, as `respawn` does, one is killed and started again, one is stopped, and one is
/// killed for good. Other programs change a parameter and end a subscription.
#[test]
fn a_drill_fails_for_what_is_lost_and_notes_what_others_did() {
    let robot = Robot::start(Mode::Core);
    let client = robot.client();
    client.set_param("/robot/wheels", 4);
    let node = FakeNode::start("/node");
    node.subscribe(&client, "/commands", "std_msgs/String");
    let talker = |name: &str, library| {
        let name = format!("__name:={name}");
        robot.spawn_node(library, "talker", &["50", "quiet", &name])
    };
    let [mut respawned, mut killed, mut dead, mut ended] = Node::all_ready([
        talker("respawned", Library::Roscpp),
        talker("killed", Library::Roscpp),
        talker("dead", Library::Roscpp),
        talker("ended", Library::Rospy),
    ]);
    eventually("all publish", || {
        robot.state().publishers_of("/chatter").len() == 4
    });
    let nodes = robot.state().nodes;
    let (_, dead_at) = nodes.into_iter().find(|(name, _)| name == "/dead").unwrap();
    let options = ["--yes", "--times", "1", "--topic", "chatter"];
    let mut drill = drill(&robot.scratch, robot.port(), &options);
    drill.wait_line("that it kills", |line| line.starts_with("1 of 1"));
    // The drill watches for some seconds, so what takes longest comes first, and both talkers start at once.
    // roscpp unregisters at SIGINT.
    respawned.signal(Signal::INT);
    ended.signal(Signal::TERM);
    killed.kill();
    dead.kill();
    client.set_param("/robot/wheels", 5);
    node.unsubscribe(&client, "/commands");
    respawned.wait();
    let again = ["respawned", "killed"].map(|name| talker(name, Library::Roscpp));
    let again = Node::all_ready(again);
    ended.wait();
    let found = verdict(drill);
    assert_eq!(found["passed"], false, "{found:#}");
    let link = format!("/chatter: the link to {dead_at} was lost");
    let failures = found["failures"].as_array().unwrap();
    let failures: Vec<_> = failures.iter().filter_map(Value::as_str).collect();
    for lost in [
        "the node /dead, process ",
        &*link,
        "/node as subscriber of /commands is gone",
    ] {
        let is_said = failures.iter().any(|said| said.starts_with(lost));
        assert!(is_said, "{lost}: {failures:#?}");
    }
    // The others did no damage.
    let mut others = failures.iter();
    let about = [&*dead_at, "/dead", "/node"];
    let all = others.all(|said| about.iter().any(|who| said.contains(who)));
    assert!(all, "{failures:#?}");
    let notes = found["notes"].to_string();
    for node in ["respawned", "killed"] {
        let before = format!("the node /{node}, process ");
        assert!(notes.contains(&before), "{notes}");
    }
    assert!(notes.matches("was started again").count() == 2, "{notes}");
    assert!(notes.contains("has unregistered and ended"), "{notes}");
    assert!(
        notes.contains("the parameter /robot/wheels has changed: another program did that"),
        "{notes}"
    );
    assert_eq!(found["nodes"], 1, "rosout");
    drop(again);
}

#[test]
fn it_fails_when_the_master_is_not_restarted() {
    let robot = Robot::start(Mode::Proxy);
    let before = robot.client().ok("getSystemState", vec!["/test".into()]);
    let options = ["--yes", "--times", "1", "--limit", "2"];
    let found = verdict(drill(&robot.scratch, robot.port(), &options));
    assert_failed(&found, "2 s after the SIGKILL of the master");
    assert_eq!(found["kills"][0]["recovered_ms"], Value::Null);
    // The mirror answered all the time and has nothing left of the drill.
    assert_eq!(found["calls"]["reads"]["failed"], 0);
    assert_eq!(
        robot.client().ok("getSystemState", vec!["/test".into()]),
        before
    );
}

#[test]
fn an_interrupted_drill_leaves_nothing_behind() {
    let robot = Robot::start(Mode::Core);
    let _talker = robot.node(Library::Roscpp, "talker", &["50", "quiet"]);
    let before = robot.settled_state();
    for which in [Signal::INT, Signal::TERM, Signal::HUP] {
        let options = ["--no-kill", "--seconds", "600", "--topic", "chatter"];
        let mut drill = drill(&robot.scratch, robot.port(), &options);
        drill.wait_line("that it watches", |line| line.starts_with("watching for"));
        eventually("the drill's parameter is set", || {
            let names = robot.client().ok("getParamNames", vec!["/test".into()]);
            format!("{names:?}").contains("/rosrescue_drill_")
        });
        drill.signal(which);
        assert_eq!(drill.wait_output().code(), Some(1));
        assert!(drill.stderr().join(" ").contains("cleaned up"));
        robot.await_state(&before, "after an interrupted drill");
    }
    // After a drill that was killed itself, the next drill removes its parameter, and a health check its registrations.
    let mut killed = drill(
        &robot.scratch,
        robot.port(),
        &["--no-kill", "--seconds", "600", "--topic", "chatter"],
    );
    killed.wait_line("that it watches", |line| line.starts_with("watching for"));
    killed.kill();
    let options = ["--yes", "--times", "1", "--topic", "chatter"];
    assert_passed(&verdict(drill(&robot.scratch, robot.port(), &options)));
    robot.await_state(&before, "after the drill that follows");
}

#[test]
fn nothing_is_killed_without_consent_or_with_wrong_options() {
    let robot = Robot::start(Mode::Core);
    let refused = |options: &[&str], status, words: &str| {
        let mut drill = drill(&robot.scratch, robot.port(), options);
        assert_eq!(drill.wait_output().code(), Some(status), "{options:?}");
        let said = drill.stderr().join("\n");
        assert!(said.contains(words), "{said}");
    };
    let master = robot.master_pid();
    refused(&[], 2, "with --yes");
    refused(&["--yes", "--kill", "worker"], 2, "without a guardian");
    refused(
        &["--no-kill", "--topic", "/nothere"],
        2,
        "no node publishes /nothere",
    );
    refused(&["--yes", "--times", "0"], 2, "--times");
    assert_eq!(robot.master_pid(), master);
    let mut nobody = drill(&robot.scratch, free_port(), &["--yes"]);
    assert_eq!(nobody.wait_output().code(), Some(3));
    assert!(nobody.stderr()[0].contains("no rosrescue at"));
}

/// At a terminal the drill asks first.
#[test]
fn a_user_at_a_terminal_is_asked_first() {
    let robot = Robot::start(Mode::Core);
    let master = robot.master_pid();
    let ask = |answer: &str| {
        let own = env!("CARGO_BIN_EXE_rosrescue");
        let uri = robot.client().uri();
        let line = format!("{own} drill --times 1 --uri {uri}");
        let mut command = Command::new("sh");
        robot.scratch.prepare(&mut command);
        command.args([
            "-c",
            r#"tail -n +1 -f "$1" | script --quiet --return --command "$0" /dev/null"#,
        ]);
        let typed = robot.scratch.path(format!("typed-{answer}"));
        fs::write(&typed, format!("{answer}\n")).unwrap();
        Process::start("a drill on a terminal", command.arg(line).arg(typed))
    };
    let mut no = ask("n");
    no.wait_line("the question", |line| {
        line.contains("Is the robot safe on the bench")
    });
    no.wait_line("that nothing happened", |line| {
        line.contains("killed nothing")
    });
    assert_eq!(robot.master_pid(), master);
    let mut yes = ask("y");
    yes.wait_line("the verdict", |line| {
        line.contains("PASSED: master killed 1 time")
    });
    assert_ne!(robot.master_pid(), master);
}

/// Needs root.
#[test]
fn on_another_computer_it_only_watches() {
    let (scratch, computer) = (Scratch::new(), Netns::new());
    let (near, far) = (computer.near(), computer.far(2));
    let rescue = Setup::core(&scratch, free_port())
        .env("ROS_IP", &far)
        .wrapped(|command| computer.inside(command))
        .start();
    let drill = |options: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_rosrescue"));
        scratch.prepare(&mut command);
        let uri = format!("http://{far}:{}", rescue.port());
        command
            .args(["drill", "--json", "--uri", &uri])
            .args(options)
            .env("ROS_IP", &near);
        Process::start(format!("a drill {options:?}"), &mut command)
    };
    let mut refused = drill(&["--yes"]);
    assert_eq!(refused.wait_output().code(), Some(2));
    let said = refused.stderr().join(" ");
    assert!(said.contains("is on another computer"), "{said}");
    assert_passed(&verdict(drill(&["--no-kill", "--seconds", "1"])));
}
