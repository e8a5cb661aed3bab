//! A checkpoint that cannot be read at the start. Its previous generation is restored, and what is at the path is
//! kept.

use std::fs;
use std::os::unix::fs::FileTypeExt;
use std::path::PathBuf;
use std::process::Command;

use crate::support::{Rescue, Scratch, Setup, eventually, free_port, signal, status};
use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::process::Signal;

/// A rosrescue that has died with its master. Both generations of its checkpoint contain the parameter `/kept`. Also
/// returns the checkpoint's folder.
fn dead(scratch: &Scratch) -> (Rescue, PathBuf) {
    let folder = scratch.path("robot");
    fs::create_dir(&folder).unwrap();
    let mut rescue = Setup::core(scratch, free_port())
        .at_checkpoint(folder.join("chkpt.yaml"))
        .start();
    rescue.client().set_param("/kept", 1);
    kill(&mut rescue);
    // The first generation of the second start makes the old one the previous generation.
    rescue.start_again();
    rescue.wait_serving();
    kill(&mut rescue);
    assert!(folder.join("chkpt.yaml.previous").is_file());
    (rescue, folder)
}

fn kill(rescue: &mut Rescue) {
    let master = rescue.client().master_pid().unwrap();
    rescue.kill();
    signal(master, Signal::KILL);
}

fn unprotected(rescue: &Rescue) -> bool {
    !status(&rescue.client())["unprotected"].is_null()
}

fn assert_restored(rescue: &mut Rescue) {
    rescue.wait_line("the log says which file cannot be read", |line| {
        line.contains("cannot read") && line.contains("chkpt.yaml")
    });
    rescue.wait_line("the log says which file is used instead", |line| {
        line.contains("chkpt.yaml.previous` is used")
    });
    rescue.wait_serving();
    assert_eq!(rescue.client().param("/kept"), Some(1.into()));
    eventually("rosrescue is protected", || !unprotected(rescue));
}

/// `tests/checkpoint/store/damage.rs` has other things that cannot be read.
#[test]
fn a_pipe_at_the_path_is_kept_and_the_previous_generation_restored() {
    let scratch = Scratch::new();
    let (mut rescue, folder) = dead(&scratch);
    let path = folder.join("chkpt.yaml");
    fs::remove_file(&path).unwrap();
    let mut mkfifo = Command::new("mkfifo");
    assert!(mkfifo.arg(&path).status().unwrap().success());
    rescue.start_again();
    assert_restored(&mut rescue);
    rescue.client().set_param("/more", 2);
    kill(&mut rescue);
    rescue.start_again();
    rescue.wait_serving();
    assert_eq!(rescue.client().param("/kept"), Some(1.into()));
    assert_eq!(rescue.client().param("/more"), Some(2.into()));
    let aside = fs::metadata(folder.join("chkpt.yaml.unreadable-1")).unwrap();
    assert!(aside.file_type().is_fifo());
    assert_eq!(rescue.terminate().code(), Some(0));
}

/// The disk gives an error first, and later the file.
#[test]
fn a_good_file_that_was_unreadable_at_the_start_is_kept() {
    let scratch = Scratch::new();
    let (rescue, folder) = dead(&scratch);
    let path = folder.join("chkpt.yaml");
    let good = fs::read(&path).unwrap();
    drop(rescue);
    let mut rescue = Setup::core(&scratch, free_port())
        .at_checkpoint(path.clone())
        .wrapped(|command| {
            let mut strace = Command::new("strace");
            strace
                .args(["-f", "--seccomp-bpf", "-qq", "-o", "/dev/null"])
                .args(["-e", "trace=read", "-e", "inject=read:error=EIO", "-P"])
                .arg(&path);
            crate::support::behind(strace, command)
        })
        .spawn();
    assert_restored(&mut rescue);
    let aside = folder.join("chkpt.yaml.unreadable-1");
    assert_eq!(fs::read(aside).unwrap(), good);
}

/// Nothing can be read at the start, so a new session begins. It must not destroy a file that appears later.
#[test]
fn a_good_file_that_appears_later_is_kept() {
    let scratch = Scratch::new();
    let (mut rescue, folder) = dead(&scratch);
    let path = folder.join("chkpt.yaml");
    let elsewhere = scratch.path("good.yaml");
    let good = fs::read(&path).unwrap();
    fs::rename(&path, &elsewhere).unwrap();
    fs::remove_file(folder.join("chkpt.yaml.previous")).unwrap();
    fs::create_dir(&path).unwrap();
    rescue.start_again();
    rescue.wait_serving();
    assert!(unprotected(&rescue));
    assert_eq!(rescue.client().param("/kept"), None);
    renameat_with(CWD, &elsewhere, CWD, &path, RenameFlags::EXCHANGE).unwrap();
    eventually("rosrescue is protected", || !unprotected(&rescue));
    rescue.client().set_param("/new", 1);
    kill(&mut rescue);
    rescue.start_again();
    rescue.wait_serving();
    assert_eq!(rescue.client().param("/new"), Some(1.into()));
    let kept = fs::read_dir(&folder).unwrap().flatten();
    let mut kept = kept.filter(|entry| fs::read(entry.path()).is_ok_and(|bytes| bytes == good));
    assert!(kept.next().is_some(), "the good file is gone");
}
