//! Whether a start goes on with the session before: after an orderly stop, a crash, a reboot.
//!
//! A reboot is a private mount that shows another boot id; everything else is the real thing. What a
//! crash and an orderly stop come to is in `own_restart.rs` too.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod support;

use std::fs;
use std::path::{Path, PathBuf};

use rustix::process::Signal;
use support::{Library, Mode, Robot, alive, eventually, signal};

/// The id of another boot, as the kernel shows it.
fn another_boot(robot: &Robot) -> PathBuf {
    let file = robot.scratch.path("boot_id");
    fs::write(&file, "01234567-89ab-4cde-8f01-23456789abcd\n").unwrap();
    file
}

/// SIGKILL to rosrescue and to its master, as a power cut does it.
fn cut_power(robot: &mut Robot) {
    let master = robot.master_pid();
    robot.rescue.kill();
    robot.kill_master_at_once(master);
    eventually("the master is dead", || !alive(master));
}

/// Files beside the checkpoint that hold `text`.
fn kept(robot: &Robot, text: &str) -> Vec<String> {
    let checkpoint = robot.rescue.checkpoint();
    let is_old = |path: &Path| path != checkpoint && path.to_string_lossy().contains("chkpt");
    let folder = fs::read_dir(checkpoint.parent().unwrap()).unwrap();
    let others = folder.flatten().filter(|entry| is_old(&entry.path()));
    let holding = others.filter(|entry| {
        fs::read_to_string(entry.path()).is_ok_and(|content| content.contains(text))
    });
    let names = holding.map(|entry| entry.file_name().to_string_lossy().into_owned());
    names.collect()
}

#[test]
fn after_a_reboot_without_nodes_the_robot_starts_afresh() {
    for mode in [Mode::Core, Mode::Proxy] {
        let mut robot = Robot::start(mode);
        robot.client().set_param("/use_sim_time", true);
        let _talker = robot.node(Library::Rospy, "talker", &[]);
        robot.settled_state();
        cut_power(&mut robot);
        // The nodes too, rosout among them.
        for pid in robot.processes() {
            signal(pid, Signal::KILL);
        }
        eventually("every process has ended", || {
            !robot.processes().into_iter().any(alive)
        });
        let boot = another_boot(&robot);
        robot.revive_master();
        robot.rescue.start_after_reboot(&boot);
        robot.rescue.wait_serving();
        robot.await_gate();
        let client = robot.client();
        assert_eq!(client.param("/use_sim_time"), None, "{mode:?}");
        assert!(!robot.settled_state().knows("/talker"), "{mode:?}");
        let names = kept(&robot, "use_sim_time");
        assert_eq!(names.len(), 1, "the old file is kept: {names:?}");
        // The new session is one: a crash now restores it.
        client.set_param("/today", 1);
        robot.crash_master();
        assert_eq!(robot.client().param("/today"), Some(1.into()));
        assert_eq!(robot.client().param("/use_sim_time"), None);
    }
}

#[test]
fn after_a_reboot_with_nodes_alive_elsewhere_the_session_goes_on() {
    for mode in [Mode::Core, Mode::Proxy] {
        let mut robot = Robot::start(mode);
        robot.client().set_param("/gain", 3);
        let talker = robot.node(Library::Roscpp, "talker", &[]);
        let listener = robot.node(Library::Rospy, "listener", &[]);
        listener.wait_messages("/talker", 5);
        let before = robot.settled_state();
        cut_power(&mut robot);
        let boot = another_boot(&robot);
        robot.revive_master();
        robot.rescue.start_after_reboot(&boot);
        robot.rescue.wait_serving();
        robot.await_gate();
        // rosout may have been started anew; its address is its own affair.
        let (before, now) = (before.without_node("/rosout"), robot.settled_state());
        before.assert_same(&now.without_node("/rosout"), "after the reboot");
        let late = robot.node(Library::Roscpp, "listener", &["__name:=late"]);
        late.wait_messages("/talker", 5);
        listener.assert_no_message_lost("/talker");
        talker.assert_no_link_lost();
    }
}

#[test]
fn after_a_crash_without_nodes_the_session_goes_on() {
    for mode in [Mode::Core, Mode::Proxy] {
        let mut robot = Robot::start(mode);
        robot.client().set_param("/gain", 3);
        robot.settled_state();
        cut_power(&mut robot);
        robot.revive_master();
        robot.rescue.start_again();
        robot.rescue.wait_serving();
        robot.await_gate();
        assert_eq!(robot.client().param("/gain"), Some(3.into()), "{mode:?}");
    }
}

#[test]
fn after_an_orderly_stop_living_nodes_keep_their_session() {
    let mut robot = Robot::start(Mode::Core);
    robot.client().set_param("/gain", 3);
    let talker = robot.node(Library::Rospy, "talker", &[]);
    let listener = robot.node(Library::Roscpp, "listener", &[]);
    listener.wait_messages("/talker", 5);
    let before = robot.settled_state().without_node("/rosout");
    assert_eq!(robot.rescue.terminate().code(), Some(0));
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    let now = robot.settled_state().without_node("/rosout");
    before.assert_same(&now, "after an orderly stop and start with nodes alive");
    listener.assert_no_message_lost("/talker");
    talker.assert_no_link_lost();
}
