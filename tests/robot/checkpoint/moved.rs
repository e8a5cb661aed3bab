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
/// refused then, and that nothing is lost when rosrescue and the master are killed. `round` makes values differ from those
/// of other rounds.
fn assert_survives(
    rescue: &mut Rescue,
    round: i32,
    deed: impl FnOnce(&Path),
    second: impl Fn() -> Setup,
) {
    let values = [("/before", round), ("/between", -round), ("/after", round)];
    let set = |rescue: &Rescue, (name, value)| rescue.client().set_param(name, value);
    set(rescue, values[0]);
    deed(&rescue.checkpoint());
    within(SAID, "the report", || {
        eventually("rosrescue reports that it is unprotected", || {
            said(rescue, "unprotected: ") > 0
        });
    });
    set(rescue, values[1]);
    eventually("rosrescue is protected again", || {
        said(rescue, "protected again") > 0 && status(&rescue.client())["unprotected"].is_null()
    });
    assert_refused(second());
    set(rescue, values[2]);
    let master = rescue.client().master_pid().unwrap();
    rescue.kill();
    signal(master, Signal::KILL);
    rescue.start_again();
    rescue.wait_serving();
    for (name, value) in values {
        assert_eq!(rescue.client().param(name), Some(value.into()), "{name}");
    }
}

/// Whether a file beside the checkpoint has this content.
fn kept(checkpoint: &Path, content: &[u8]) -> bool {
    let files = fs::read_dir(checkpoint.parent().unwrap()).unwrap();
    let mut files = files.map(|file| file.unwrap().path());
    files.any(|file| fs::read(file).is_ok_and(|kept| kept == content))
}

fn rename_folder(checkpoint: &Path) {
    let folder = checkpoint.parent().unwrap();
    fs::rename(folder, folder.with_extension("old")).unwrap();
}

fn delete_lock_file(checkpoint: &Path) {
    fs::remove_file(checkpoint.with_extension("yaml.lock")).unwrap();
}

fn truncate(checkpoint: &Path, length: u64) {
    let file = File::options().write(true).open(checkpoint).unwrap();
    file.set_len(length).unwrap();
}

fn overwrite(checkpoint: &Path) {
    let file = File::options().write(true).open(checkpoint).unwrap();
    file.write_all_at(b"something else", 300).unwrap();
}

const FOREIGN: &[u8] = b"use_sim_time: true\n";

fn replace(checkpoint: &Path) {
    let other = checkpoint.with_file_name("other.yaml");
    fs::write(&other, FOREIGN).unwrap();
    fs::rename(other, checkpoint).unwrap();
}

/// rosrescue is killed after each change and starts again, so the next change meets a process that has continued from the
/// checkpoint.
#[test]
fn a_changed_checkpoint_is_noticed_and_nothing_is_lost() {
    let deeds = [
        ("renamed", &rename_folder as &dyn Fn(&Path)),
        ("without a lock file", &delete_lock_file),
        ("empty", &|checkpoint| truncate(checkpoint, 0)),
        ("truncated", &|checkpoint| truncate(checkpoint, 200)),
        ("overwritten", &overwrite),
        ("replaced", &replace),
    ];
    let scratch = Scratch::new();
    let mut rescue = robot(&scratch);
    let checkpoint = rescue.checkpoint();
    let here = || second(&scratch, checkpoint.clone());
    // A process that shares only the folder, as in another container, is refused too.
    let elsewhere = || {
        here().wrapped(|command| {
            let mut unshare = Command::new("unshare");
            unshare.args(["--mount", "--"]);
            crate::support::behind(unshare, command)
        })
    };
    for (round, (what, deed)) in (1..).zip(deeds) {
        println!("{what}");
        let deed = |path: &Path| {
            deed(path);
            assert_refused(here());
            if what == "without a lock file" {
                assert_refused(elsewhere());
            }
        };
        assert_survives(&mut rescue, round, deed, elsewhere);
    }
    assert_eq!(rescue.terminate().code(), Some(0));
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
    assert_survives(&mut rescue, 1, deed, second);
    assert_eq!(rescue.terminate().code(), Some(0));
    // The file is in the folder below the mount, where every process sees it.
    assert!(checkpoint.is_file());
}
