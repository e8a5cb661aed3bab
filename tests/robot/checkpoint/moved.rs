//! The checkpoint is moved or changed by another program while rosrescue runs. rosrescue reports it within
//! about a second, writes the state to the path again, and lets no second rosrescue use it in the meantime.
//! When rosrescue and the master die then, nothing is lost.

use std::fs::{self, File};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use crate::support::{
    Rescue, Scratch, Setup, SmallDisk, eventually, free_port, signal, status, within,
};
use rustix::process::Signal;

/// Time in which the change must be reported: about a second, or longer on a busy computer, but long before the next
/// sync.
const SAID: Duration = Duration::from_secs(10);

fn robot(scratch: &Scratch) -> Rescue {
    let folder = scratch.path("robot");
    fs::create_dir(&folder).unwrap();
    // rosrescue checks the file often, even if it syncs rarely.
    Setup::core(scratch, free_port())
        .args(["--sync-interval", "30000"])
        .at_checkpoint(folder.join("chkpt.yaml"))
        .start()
}

fn said(rescue: &Rescue, words: &str) -> usize {
    let output = rescue.output();
    output.iter().filter(|line| line.contains(words)).count()
}

/// Checks that another rosrescue with the same checkpoint ends at once and says why.
fn assert_refused(second: Setup) {
    let mut second = second.spawn();
    eventually("the second rosrescue ends", || second.exited().is_some());
    assert_eq!(second.exited().unwrap().code(), Some(1));
    second.wait_line("the second rosrescue says why", |line| {
        line.contains("in use by another rosrescue")
    });
}

fn second(scratch: &Scratch, checkpoint: PathBuf) -> Setup {
    Setup::core(scratch, free_port()).at_checkpoint(checkpoint)
}

/// Runs `deed` while no calls come, and waits until rosrescue is protected again. Checks that a second rosrescue is
/// refused then, and that nothing is lost when rosrescue and the master are killed.
fn assert_survives(rescue: &mut Rescue, deed: impl FnOnce(&Path), second: impl Fn() -> Setup) {
    rescue.client().set_param("/before", 1);
    deed(&rescue.checkpoint());
    within(SAID, "the report", || {
        eventually("rosrescue reports that it is unprotected", || {
            said(rescue, "unprotected: ") > 0
        });
    });
    rescue.client().set_param("/between", 2);
    eventually("rosrescue is protected again", || {
        said(rescue, "protected again") > 0 && status(&rescue.client())["unprotected"].is_null()
    });
    assert_refused(second());
    rescue.client().set_param("/after", 3);
    let master = rescue.client().master_pid().unwrap();
    rescue.kill();
    signal(master, Signal::KILL);
    rescue.start_again();
    rescue.wait_serving();
    for (name, value) in [("/before", 1), ("/between", 2), ("/after", 3)] {
        assert_eq!(rescue.client().param(name), Some(value.into()), "{name}");
    }
    assert_eq!(rescue.terminate().code(), Some(0));
}

fn assert_deed_survived(deed: impl FnOnce(&Path)) {
    let scratch = Scratch::new();
    let mut rescue = robot(&scratch);
    let checkpoint = rescue.checkpoint();
    let second = || second(&scratch, checkpoint.clone());
    let deed = |path: &Path| {
        deed(path);
        assert_refused(second());
    };
    assert_survives(&mut rescue, deed, second);
}

fn kept(checkpoint: &Path, content: &[u8]) -> bool {
    let aside = checkpoint.with_extension("yaml.broken-1");
    fs::read(aside).is_ok_and(|kept| kept == content)
}

#[test]
fn a_renamed_checkpoint_folder_is_noticed_and_nothing_is_lost() {
    assert_deed_survived(|checkpoint| {
        let folder = checkpoint.parent().unwrap();
        fs::rename(folder, folder.with_extension("old")).unwrap();
    });
}

#[test]
fn a_deleted_lock_file_is_replaced_and_still_keeps_others_out() {
    assert_deed_survived(|checkpoint| {
        fs::remove_file(checkpoint.with_extension("yaml.lock")).unwrap();
    });
}

/// A process that shares only the folder, as in another container, is refused too.
#[test]
fn a_deleted_lock_file_still_keeps_another_container_out() {
    let scratch = Scratch::new();
    let mut rescue = robot(&scratch);
    let checkpoint = rescue.checkpoint();
    let elsewhere = || {
        second(&scratch, checkpoint.clone()).wrapped(|command| {
            let mut unshare = Command::new("unshare");
            unshare.args(["--mount", "--"]);
            crate::support::behind(unshare, command)
        })
    };
    let deed = |path: &Path| {
        fs::remove_file(path.with_extension("yaml.lock")).unwrap();
        assert_refused(elsewhere());
    };
    assert_survives(&mut rescue, deed, elsewhere);
}

#[test]
fn a_truncated_checkpoint_is_noticed_and_nothing_is_lost() {
    for length in [0, 200] {
        assert_deed_survived(|checkpoint| {
            let file = File::options().write(true).open(checkpoint).unwrap();
            file.set_len(length).unwrap();
        });
    }
}

#[test]
fn an_overwritten_checkpoint_is_noticed_and_nothing_is_lost() {
    assert_deed_survived(|checkpoint| {
        let file = File::options().write(true).open(checkpoint).unwrap();
        file.write_all_at(b"something else", 300).unwrap();
    });
}

#[test]
fn a_file_that_replaces_the_checkpoint_is_kept() {
    const FOREIGN: &[u8] = b"use_sim_time: true\n";
    let scratch = Scratch::new();
    let mut rescue = robot(&scratch);
    let checkpoint = rescue.checkpoint();
    let deed = |path: &Path| {
        let other = scratch.path("other.yaml");
        fs::write(&other, FOREIGN).unwrap();
        fs::rename(other, path).unwrap();
    };
    let second = || second(&scratch, checkpoint.clone());
    assert_survives(&mut rescue, deed, second);
    assert!(kept(&checkpoint, FOREIGN));
}

#[test]
fn an_unmounted_checkpoint_folder_is_noticed_and_nothing_is_lost() {
    let scratch = Scratch::new();
    let disk = SmallDisk::new(&scratch, "1m");
    let mut rescue = disk.rescue(&scratch);
    let checkpoint = rescue.checkpoint();
    let second = || second(&scratch, checkpoint.clone()).wrapped(|command| disk.on(command));
    let deed = |_: &Path| {
        let mut umount = Command::new("umount");
        umount.arg("--lazy").arg(&disk.folder);
        assert!(disk.on(&umount).status().unwrap().success());
        assert_refused(second());
    };
    assert_survives(&mut rescue, deed, second);
    // The file is in the folder below the mount, where every process sees it.
    assert!(checkpoint.is_file());
}
