//! A disk that cannot be written (FAULTS.md F10, F11): calls go on being forwarded, it says that it
//! is unprotected, and it re-arms by itself.

use std::fs;

use crate::support::{Rescue, Scratch, SmallDisk, eventually, signal, status};
use rustix::process::Signal;

fn unprotected(rescue: &Rescue) -> bool {
    !status(&rescue.client())["unprotected"].is_null()
}

/// Both die, and the state is that of `/last`.
fn assert_survives(rescue: &mut Rescue, last: i32) {
    let master = rescue.client().master_pid().unwrap();
    rescue.kill();
    signal(master, Signal::KILL);
    rescue.start_again();
    rescue.wait_serving();
    assert_eq!(rescue.client().param("/last"), Some(last.into()));
}

/// Each set is answered while the disk is unusable; the state of memory is what a dead master is
/// restored from.
fn goes_on_without(rescue: &mut Rescue) {
    let client = rescue.client();
    let mut count = 0;
    eventually("it is said to be unprotected", || {
        count += 1;
        client.set_param("/last", count);
        unprotected(rescue)
    });
    rescue.wait_line("why", |line| line.contains("unprotected"));
    client.set_param("/last", -1);
    let dead = client.master_pid().unwrap();
    signal(dead, Signal::KILL);
    eventually("another master is there", || {
        client.master_pid().is_some_and(|pid| pid != dead)
    });
    assert_eq!(client.param("/last"), Some((-1).into()));
}

fn is_protected_again(rescue: &mut Rescue) {
    eventually("it is protected again", || !unprotected(rescue));
    rescue.wait_line("that", |line| line.contains("protected again"));
    rescue.client().set_param("/last", 1000);
    assert_survives(rescue, 1000);
}

#[test]
fn a_disk_that_somebody_fills() {
    let scratch = Scratch::new();
    let disk = SmallDisk::new(&scratch, "1m");
    let mut rescue = disk.rescue(&scratch);
    let filler = disk.fill();
    goes_on_without(&mut rescue);
    fs::remove_file(filler).unwrap();
    is_protected_again(&mut rescue);
    assert_eq!(rescue.terminate().code(), Some(0));
}

/// While files are open for writing, a disk does not become read-only.
#[test]
fn a_disk_that_is_read_only_at_the_start() {
    let scratch = Scratch::new();
    let disk = SmallDisk::new(&scratch, "1m");
    disk.remount("remount,ro");
    let mut rescue = disk.rescue(&scratch);
    goes_on_without(&mut rescue);
    disk.remount("remount,rw");
    is_protected_again(&mut rescue);
    assert_eq!(rescue.terminate().code(), Some(0));
}
