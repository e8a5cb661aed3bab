//! `rosrescue wait`: start scripts continue once its condition holds.

use std::net::TcpListener;
use std::time::{Duration, Instant};

use crate::support::{
    FakeNode, Mode, Process, Robot, Rosmaster, Scratch, Setup, Tool, command, eventually,
    free_port, within,
};

#[test]
fn it_waits_until_its_conditions_hold() {
    let scratch = Scratch::new();
    let (master_port, rescue) = {
        let port = free_port();
        (port, Setup::proxy(&scratch, port))
    };
    let port = rescue.port;
    let wait = |name: &str, wanted: &[&str]| {
        let mut arguments = vec!["wait", "--timeout", "0"];
        arguments.extend(wanted.iter().flat_map(|what| ["--for", what]));
        let mut process = Process::start(name, &mut command(&scratch, port, &arguments));
        process.wait_line("what it waits for", |line| line.contains("waiting for "));
        process
    };
    // Nothing listens yet.
    let mut answered = wait("answered", &[]);
    let mut all = wait("all", &["master", "protected", "/talker"]);
    let rescue = rescue.spawn();
    let _master = Rosmaster::start_at(&scratch, master_port);
    assert_eq!(answered.wait().code(), Some(0));
    let protected = Tool::rosrescue(&scratch, port, &["wait", "--for", "protected", "--json"]);
    assert_eq!(protected.exit(), 0, "{protected:?}");
    assert_eq!(protected.json(0)["met"], true);
    assert!(all.exited().is_none(), "there is no talker");
    let talker = FakeNode::start("/talker");
    talker.publish(&rescue.client(), "/topic", "std_msgs/String");
    assert_eq!(all.wait_output().code(), Some(0));
    let said = all.stderr();
    assert_eq!(said.len(), 1, "once: {said:?}");
    assert!(said[0].contains("the node /talker"), "{said:?}");
}

#[test]
fn it_ends_in_time_and_says_what_is_missing() {
    let robot = Robot::start(Mode::Core);
    let start = Instant::now();
    // Long enough for an answer on a busy computer.
    let arguments = ["wait", "--for", "master", "/nobody", "--timeout", "5"];
    let ran = Tool::rosrescue(&robot.scratch, robot.port(), &arguments);
    assert!(start.elapsed() >= Duration::from_secs(5));
    assert_eq!(ran.exit(), 1, "{ran:?}");
    assert!(ran.stdout.contains("the node /nobody"), "{ran:?}");
    assert!(!ran.stdout.contains("a master"), "{ran:?}");
    let nobody = Tool::rosrescue(&robot.scratch, free_port(), &["wait", "--timeout", "0.1"]);
    assert_eq!(nobody.exit(), 1, "{nobody:?}");
    for wrong in [["--for", "everything"], ["--timeout", "-1"]] {
        let ran = Tool::rosrescue(
            &robot.scratch,
            robot.port(),
            &[&["wait"], &wrong[..]].concat(),
        );
        assert_eq!(ran.exit(), 2, "{ran:?}");
    }
}

/// A program that accepts connections and never answers, as a stopped rosrescue does.
#[test]
fn it_ends_in_time_if_rosrescue_does_not_answer() {
    let (scratch, listener) = (Scratch::new(), TcpListener::bind("127.0.0.1:0").unwrap());
    let port = listener.local_addr().unwrap().port();
    let arguments = ["wait", "--for", "master", "/talker", "--timeout", "0.5"];
    let ran = within(Duration::from_secs(3), "the wait", || {
        Tool::rosrescue(&scratch, port, &arguments)
    });
    assert_eq!(ran.exit(), 1, "{ran:?}");
    assert!(ran.stdout.contains("no answer from"), "{ran:?}");
}

/// A lookup would be held until there is a master.
#[test]
fn it_says_that_there_has_never_been_a_master_instead_of_waiting_for_a_lookup() {
    let scratch = Scratch::new();
    let rescue = Setup::proxy(&scratch, free_port()).spawn();
    eventually("the reason is that of the status", || {
        let arguments = ["wait", "--for", "/talker", "--timeout", "1"];
        let ran = Tool::rosrescue(&scratch, rescue.port(), &arguments);
        ran.exit() == 1 && ran.stdout.contains("waiting for the first master")
    });
}

/// While the mirror stands in, calls are answered although there is no master.
#[test]
fn an_answer_of_the_mirror_does_not_count_as_a_master() {
    let mut robot = Robot::start(Mode::Proxy);
    robot.take_master_away();
    let exit = |what: &str, timeout: &str| {
        let arguments = ["wait", "--for", what, "--timeout", timeout];
        Tool::rosrescue(&robot.scratch, robot.port(), &arguments).exit()
    };
    assert_eq!(exit("answered", "60"), 0);
    assert_eq!(exit("master", "0.1"), 1);
    assert_eq!(exit("protected", "0.1"), 1);
}
