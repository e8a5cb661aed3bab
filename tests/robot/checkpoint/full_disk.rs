//! A disk that cannot be written (FAULTS.md F10, F11): calls are still forwarded, rosrescue reports that it
//! is unprotected, and it recovers by itself.

use std::fs;

use crate::support::{Rescue, Scratch, SmallDisk, eventually, signal, status};
use rustix::process::Signal;

fn unprotected(rescue: &Rescue) -> bool {
    !status(&rescue.client())["unprotected"].is_null()
}

/// Kills rosrescue and the master, and checks that `/last` is restored.
fn assert_survives(rescue: &mut Rescue, last: i32) {
    let master = rescue.client().master_pid().unwrap();
    rescue.kill();
    signal(master, Signal::KILL);
    rescue.start_again();
    rescue.wait_serving();
    assert_eq!(rescue.client().param("/last"), Some(last.into()));
}

/// Checks that calls are answered while the disk is unusable, and that a dead master is restored from memory.
fn goes_on_without(rescue: &mut Rescue) {
    let client = rescue.client();
    let mut count = 0;
    eventually("rosrescue reports that it is unprotected", || {
        count += 1;
        client.set_param("/last", count);
        unprotected(rescue)
    });
    rescue.wait_line("why", |line| line.contains("unprotected"));
    client.set_param("/last", -1);
    let dead = client.master_pid().unwrap();
    signal(dead, Signal::KILL);
    eventually("another master answers", || {
        client.master_pid().is_some_and(|pid| pid != dead)
    });
    assert_eq!(client.param("/last"), Some((-1).into()));
}

fn is_protected_again(rescue: &mut Rescue) {
    eventually("rosrescue is protected again", || !unprotected(rescue));
    rescue.wait_line("that", |line| line.contains("protected again"));
    rescue.client().set_param("/last", 1000);
    assert_survives(rescue, 1000);
}

#[test]
fn calls_are_answered_on_a_full_disk_and_recorded_when_it_has_room_again() {
    let scratch = Scratch::new();
    let disk = SmallDisk::new(&scratch, "1m");
    let mut rescue = disk.rescue(&scratch);
    let filler = disk.fill();
    goes_on_without(&mut rescue);
    fs::remove_file(filler).unwrap();
    is_protected_again(&mut rescue);
    assert_eq!(rescue.terminate().code(), Some(0));
}

/// A disk does not become read-only while files are open for writing.
#[test]
fn calls_are_answered_on_a_read_only_disk_and_recorded_when_it_is_writable_again() {
    let scratch = Scratch::new();
    let disk = SmallDisk::new(&scratch, "1m");
    disk.remount("remount,ro");
    let mut rescue = disk.rescue(&scratch);
    goes_on_without(&mut rescue);
    disk.remount("remount,rw");
    is_protected_again(&mut rescue);
    assert_eq!(rescue.terminate().code(), Some(0));
}

/// Kills rosrescue twice, and checks that the next one uses the living master and its state, although the disk has
/// neither.
fn keeps_its_master(mut rescue: Rescue) {
    let client = rescue.client();
    let master = client.master_pid();
    for value in 1..3 {
        assert!(unprotected(&rescue));
        client.set_param("/last", value);
        rescue.kill();
        rescue.start_again();
        rescue.wait_serving();
        assert_eq!(
            client.param("/last"),
            Some(value.into()),
            "{}",
            rescue.log()
        );
        assert_eq!(client.master_pid(), master, "{}", rescue.log());
    }
}

#[test]
fn a_living_master_is_used_again_although_nothing_was_ever_recorded() {
    let scratch = Scratch::new();
    let disk = SmallDisk::new(&scratch, "1m");
    disk.fill();
    keeps_its_master(disk.rescue(&scratch));
}

/// The disk says that the last master has ended, and where it listened.
#[test]
fn a_living_master_is_used_again_although_the_disk_names_the_one_before() {
    let scratch = Scratch::new();
    let disk = SmallDisk::new(&scratch, "1m");
    let mut rescue = disk.rescue(&scratch);
    assert_eq!(rescue.terminate().code(), Some(0));
    disk.remount("remount,ro");
    rescue.start_again();
    rescue.wait_serving();
    keeps_its_master(rescue);
}
