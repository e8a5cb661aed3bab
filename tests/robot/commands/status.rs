//! `rosrescue status`: shows the status, for people and for scripts.

use std::io::{Read, Write};
use std::net::TcpListener;
use std::process::Command;
use std::thread;

use crate::support::{
    FakeNode, Library, Mode, Robot, Rosmaster, Scratch, Setup, State, Tool, command, eventually,
    free_port, page, params, port_of,
};

/// rosrescue shows pages only under the names of its own computer, because of pages in browsers. A command is none.
#[test]
fn a_robot_is_found_under_a_name_that_only_the_reader_of_the_status_knows() {
    let robot = Robot::start(Mode::Core);
    let hosts = robot.scratch.path("hosts");
    std::fs::write(&hosts, "127.0.0.1 other-name\n").unwrap();
    let status = Command::new("unshare")
        .args(["--mount", "sh", "-ec"])
        .arg("mount --bind \"$0\" /etc/hosts; exec \"$@\"")
        .arg(hosts)
        .args([env!("CARGO_BIN_EXE_rosrescue"), "status"])
        .env(
            "ROS_MASTER_URI",
            format!("http://other-name:{}", robot.port()),
        )
        .output()
        .unwrap();
    let printed = String::from_utf8_lossy(&status.stdout);
    assert!(printed.starts_with("protected, since "), "{status:?}");
}

/// A robot whose nodes are dead is not well because its master is. A node that stops cleanly is no trouble.
#[test]
fn nodes_that_died_come_before_everything_else() {
    let robot = Robot::start(Mode::Core);
    let [mut orderly, mut dead] = ["/orderly", "/dead"].map(|name| {
        let name = format!("__name:={}", &name[1..]);
        robot.node(Library::Rospy, "talker", &[&name])
    });
    let port = robot.port();
    let status = || Tool::rosrescue(&robot.scratch, port, &["status"]);
    assert!(status().stdout.starts_with("protected, since "));
    // rospy does this at each log line and never ends it.
    let api = format!("http://127.0.0.1:{}/", port_of(&robot.client(), "/orderly"));
    let log = params!["/orderly", api, "/rosout_disable_topics_generation"];
    robot.client().ok("subscribeParam", log);
    orderly.terminate();
    eventually("the node has unregistered", || {
        State::try_read(&robot.client()).is_ok_and(|state| !state.knows("/orderly"))
    });
    let good = status();
    assert_eq!(good.exit(), 0, "{good:?}");
    dead.kill();
    // The tool says more. It is a program of its own, so the test waits without it.
    let condition = || robot.status().unwrap()["condition"]["name"].clone();
    eventually("the dead node is noticed", || condition() == "nodes_dead");
    let bad = status();
    assert!(bad.stdout.starts_with("NODES DIED, since "), "{bad:?}");
    assert_eq!(bad.exit(), 1, "{bad:?}");
    let said = "1 node died without unregistering: /dead since 2";
    assert!(bad.stdout.contains(said), "{bad:?}");
    assert!(bad.stdout.contains("Other nodes work as usual"), "{bad:?}");
    let live = Tool::rosrescue(&robot.scratch, port, &["check", "--live"]);
    assert_eq!(live.exit(), 1, "{live:?}");
    assert!(live.stdout.starts_with("PROBLEM  robot"), "{live:?}");
    assert!(live.stdout.contains(said), "{live:?}");
    let metrics = page(&robot.client(), "/metrics");
    for line in [
        "rosrescue_condition{name=\"nodes_dead\"} 1",
        "rosrescue_dead_nodes 1",
        "rosrescue_action_needed 1",
        "rosrescue_protected 1",
    ] {
        assert!(metrics.contains(line), "{line}: {metrics}");
    }
    let wait = Tool::rosrescue(&robot.scratch, port, &["wait", "--for", "protected"]);
    assert_eq!(wait.exit(), 0, "the state is recorded: {wait:?}");
    // A rescue unregisters the dead node, which is dead nevertheless.
    let master = robot.master_pid();
    crate::support::signal(master, rustix::process::Signal::KILL);
    robot.await_recovery(master);
    eventually("the dead node is unregistered", || {
        State::try_read(&robot.client()).is_ok_and(|state| !state.knows("/dead"))
    });
    let after = status();
    let said = "1 node died, now unregistered: /dead since 2";
    assert!(after.stdout.starts_with("NODES DIED, since "), "{after:?}");
    assert!(after.stdout.contains(said), "{after:?}");
    let _again = robot.node(Library::Rospy, "talker", &["__name:=dead"]);
    eventually("all is well when the node is back", || {
        condition() == "protected"
    });
    assert_eq!(status().exit(), 0);
}

#[test]
fn it_says_what_nodes_notice_and_what_to_do() {
    let mut robot = Robot::start(Mode::Proxy);
    let (scratch, port) = (&robot.scratch, robot.port());
    let talker = FakeNode::start("/talker");
    talker.publish(&robot.client(), "/topic", "std_msgs/String");
    let good = Tool::rosrescue(scratch, port, &["status"]);
    assert_eq!(good.exit(), 0, "{good:?}");
    assert!(good.stdout.starts_with("protected, since "), "{good:?}");
    assert!(good.stdout.contains("Nodes work as usual"), "{good:?}");
    assert!(good.stdout.lines().count() <= 10, "{good:?}");
    // The page has the same text.
    let first = |text: &str| text.lines().nth(1).map(str::to_owned);
    assert_eq!(first(&page(&robot.client(), "/")), first(&good.stdout));

    let dead = robot.master_pid();
    robot.kill_master_at_once(dead);
    eventually("the mirror stands in", || !robot.is_open());
    robot.client().set_param("/meanwhile", 1);
    let away = Tool::rosrescue(&robot.scratch, port, &["status"]);
    assert_eq!(away.exit(), 1, "{away:?}");
    assert!(
        away.stdout
            .starts_with("standing in for the master, since "),
        "{away:?}"
    );
    assert!(away.stdout.contains("Nodes keep working"), "{away:?}");
    let last = format!(", not serving; the last one was process {dead}");
    assert!(away.stdout.contains(&last), "{away:?}");
    assert!(
        away.stdout
            .contains("pending     1 change for the next master"),
        "{away:?}"
    );
    assert!(
        away.stdout
            .contains("\nto do       start the master at http://"),
        "{away:?}"
    );
    let json = Tool::rosrescue(&robot.scratch, port, &["status", "--json"]);
    let json = json.json(1);
    assert_eq!(json["schema"], 1);
    assert_eq!(json["condition"]["name"], "standing_in");
    assert_eq!(json["pending_writes"], 1);

    robot.revive_master();
    robot.await_recovery(dead);
    let after = Tool::rosrescue(&robot.scratch, port, &["status"]);
    assert_eq!(after.exit(), 0, "{after:?}");
    assert!(
        after.stdout.contains("rescues     1, the last:\n"),
        "{after:?}"
    );
    assert!(
        after.stdout.contains("a new master got the whole state"),
        "{after:?}"
    );
    // A report from another computer, without its files.
    let empty = Scratch::new();
    let uri = robot.client().uri();
    let report = Tool::rosrescue(&empty, port, &["report", "--uri", &uri]).ended(0);
    assert!(
        report.contains("a new master got the whole state"),
        "{report}"
    );
    let json = Tool::rosrescue(&robot.scratch, port, &["status", "--json"]).json(0);
    let rescue = &json["last_rescues"][0];
    assert_eq!(rescue["outcome"], "injected", "{rescue}");
    assert_eq!(json["last_rescues"].as_array().unwrap().len(), 1);
    let slowest = json["slowest_callers"].as_array().unwrap();
    let longest = |row: &serde_json::Value| row["longest_ms"].as_f64().unwrap();
    assert!(!slowest.is_empty(), "{json}");
    assert!(
        slowest.is_sorted_by(|a, b| longest(a) >= longest(b)),
        "{slowest:?}"
    );
    assert!(
        json["journal"]["disk_free_bytes"].as_u64() > Some(0),
        "{json}"
    );
}

/// Callers choose their names, which must not write control characters to a terminal.
#[test]
fn it_prints_no_commands_for_a_terminal() {
    let robot = Robot::start(Mode::Core);
    let evil = "/evil\u{1b}[2J";
    robot.client().call("getPid", params![evil]).unwrap();
    for command in [&["status"][..], &["top", "--count", "1"]] {
        let ran = Tool::rosrescue(&robot.scratch, robot.port(), command);
        assert!(!ran.stdout.contains('\u{1b}'), "{ran:?}");
    }
}

#[test]
fn no_rosrescue_or_another_program_at_the_port_is_exit_status_3() {
    let scratch = Scratch::new();
    let nobody = Tool::rosrescue(&scratch, free_port(), &["status"]);
    assert_eq!(nobody.exit(), 3, "{nobody:?}");
    assert!(
        nobody.stderr.contains("no rosrescue at http://127.0.0.1:"),
        "{nobody:?}"
    );
    let master = Rosmaster::start(&scratch);
    let bare = Tool::rosrescue(&scratch, master.client().port(), &["status"]);
    assert_eq!(bare.exit(), 3, "{bare:?}");
    assert!(bare.stderr.contains("perhaps a bare rosmaster"), "{bare:?}");
    let nonsense = Tool::rosrescue(&scratch, 1, &["status", "--uri", "nonsense"]);
    assert_eq!(nonsense.exit(), 2, "{nonsense:?}");
    assert_eq!(nonsense.stderr.lines().count(), 1, "{nonsense:?}");
}

#[test]
fn a_newer_rosrescue_is_reported_as_newer() {
    let scratch = Scratch::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let _ = stream.read(&mut [0; 1024]);
            let body = r#"{"schema": 2, "version": "9.9.9"}"#;
            let length = body.len();
            let _ = write!(
                stream,
                "HTTP/1.1 200 OK\r\nContent-Length: {length}\r\n\r\n{body}"
            );
        }
    });
    let ran = Tool::rosrescue(&scratch, port, &["status"]);
    assert_eq!(ran.exit(), 1, "{ran:?}");
    assert!(
        ran.stderr.contains("version 9.9.9, newer than this one"),
        "{ran:?}"
    );
}

/// There has never been a master, so nodes wait. The status says so.
#[test]
fn it_says_that_nodes_wait_for_a_first_master() {
    let scratch = Scratch::new();
    let rescue = Setup::proxy(&scratch, free_port()).spawn();
    eventually("the status says so", || {
        let ran = Tool::rosrescue(&scratch, rescue.port(), &["status"]);
        ran.exit() == 1 && ran.stdout.contains("Calls wait") && ran.stdout.contains("\nto do ")
    });
}

/// As with `rosrescue … 2>&1 | head -n 1`, or when the terminal was closed.
#[test]
fn a_command_whose_stderr_is_closed_keeps_its_exit_status() {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let scratch = Scratch::new();
    let mut status = command(&scratch, free_port(), &["status"]);
    assert_eq!(status.stderr(writer).status().unwrap().code(), Some(3));
}
