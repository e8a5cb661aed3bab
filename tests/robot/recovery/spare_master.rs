//! With `--spare-master`, the next rosmaster has already been started when the first one dies.

use std::{fs, time::Duration};

use rustix::process::Signal;

use crate::support::{
    FakeNode, Mode, Robot, Scratch, Setup, alive, eventually, eventually_some, free_port, holds,
    signal, stop,
};

/// Processes started by rosrescue that could be a spare master: all possible ones except `master`.
fn spares(rescue: u32, master: u32) -> Vec<u32> {
    let children = fs::read_dir(format!("/proc/{rescue}/task"))
        .unwrap()
        .flatten();
    let children =
        children.filter_map(|task| fs::read_to_string(task.path().join("children")).ok());
    let children: Vec<u32> = children
        .flat_map(|text| {
            text.split_whitespace()
                .map(|pid| pid.parse().unwrap())
                .collect::<Vec<_>>()
        })
        .collect();
    let is_one = |pid: &u32| {
        let command = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        *pid != master && String::from_utf8_lossy(&command).contains("readline")
    };
    children.into_iter().filter(is_one).collect()
}

#[track_caller]
fn spare(robot: &Robot) -> u32 {
    let (rescue, master) = (robot.rescue.pid(), robot.master_pid());
    eventually_some("a spare master is there", || spares(rescue, master).pop())
}

fn robot() -> Robot {
    Robot::start_with(Mode::Core, &["--spare-master"])
}

/// Kills the master. Returns the next one, after checking that it has the same state.
#[track_caller]
fn kill_master(robot: &Robot) -> u32 {
    let (dead, before) = (robot.master_pid(), robot.settled_state());
    signal(dead, Signal::KILL);
    robot.await_recovery(dead);
    assert_eq!(robot.settled_state(), before);
    robot.master_pid()
}

#[test]
fn after_each_death_the_spare_takes_over_and_another_spare_is_started() {
    let robot = robot();
    let node = FakeNode::start("/known");
    node.publish(&robot.client(), "/chatter", "std_msgs/String");
    for _ in 0..3 {
        let spare = spare(&robot);
        assert_eq!(kill_master(&robot), spare);
    }
}

/// If the spare was killed or hangs, a new master is started.
#[test]
fn a_dead_or_hung_spare_is_replaced() {
    let robot = robot();
    let killed = spare(&robot);
    signal(killed, Signal::KILL);
    eventually("the spare master is dead", || !alive(killed));
    assert_ne!(kill_master(&robot), killed);
    let hung = spare(&robot);
    stop(hung);
    assert_ne!(kill_master(&robot), hung);
    eventually("the hung spare master is dead", || !alive(hung));
    assert_ne!(spare(&robot), hung);
}

#[test]
fn a_spare_ends_with_rosrescue_and_is_never_adopted() {
    let mut robot = robot();
    let (master, first) = (robot.master_pid(), spare(&robot));
    robot.rescue.kill();
    eventually("the spare master has ended", || !alive(first));
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    assert_eq!(robot.master_pid(), master);
    let second = spare(&robot);
    // A clean stop, while the spare hangs.
    stop(second);
    signal(robot.rescue.pid(), Signal::TERM);
    eventually("the spare master and the master have ended", || {
        !alive(second) && !alive(master)
    });
}

#[test]
fn a_program_other_than_rosmaster_has_no_spare() {
    let scratch = Scratch::new();
    let program = scratch.path("rosmaster.sh");
    fs::write(&program, "#!/bin/sh\nexec rosmaster \"$@\"\n").unwrap();
    fs::set_permissions(
        &program,
        std::os::unix::fs::PermissionsExt::from_mode(0o755),
    )
    .unwrap();
    let setup =
        Setup::core(&scratch, free_port()).args(["--no-rosout", "--spare-master", "--rosmaster"]);
    let mut rescue = setup.arg(&program).start();
    rescue.wait_line("the log says that there is no spare master", |line| {
        line.contains("no spare rosmaster")
    });
    let (rescue, master) = (rescue.pid(), rescue.client().master_pid().unwrap());
    assert!(holds(Duration::from_secs(1), || spares(rescue, master).is_empty()));
}
