//! Files that other users have planted next to the checkpoint, and a disk that hangs: no call is delayed, and no file
//! elsewhere is changed.

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};

use crate::support::{
    FailingDisk, Rescue, Scratch, Setup, Trouble, eventually, free_port, signal, status,
};
use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::process::Signal;

/// The files that rosrescue opens next to a checkpoint.
const FILES: [&str; 4] = [
    ".rosmaster-output.log",
    ".rosmaster-logging.conf",
    ".rosout-output.log",
    ".lock",
];

/// Makes a folder that every user may write to. Returns the path of a checkpoint in it.
fn open_folder(scratch: &Scratch) -> PathBuf {
    let folder = scratch.path("open");
    fs::create_dir(&folder).unwrap();
    fs::set_permissions(&folder, fs::Permissions::from_mode(0o777)).unwrap();
    folder.join("latest-chkpt.yaml")
}

fn beside(checkpoint: &Path, suffix: &str) -> PathBuf {
    format!("{}{suffix}", checkpoint.display()).into()
}

/// Kills the master, and checks that calls are answered and another master comes.
#[track_caller]
fn assert_rescued(rescue: &mut Rescue) {
    let client = rescue.client();
    client.set_param("/kept", 1);
    let dead = client.master_pid().unwrap();
    signal(dead, Signal::KILL);
    eventually("another master", || {
        assert_eq!(client.param("/kept"), Some(1.into()));
        client.master_pid().is_some_and(|pid| pid != dead) && status(&client)["open"] == true
    });
    rescue.assert_no_panic();
}

#[test]
fn planted_symbolic_links_are_not_followed() {
    let scratch = Scratch::new();
    let checkpoint = open_folder(&scratch);
    let victim = scratch.path("victim");
    fs::write(&victim, "kept").unwrap();
    for suffix in FILES {
        symlink(&victim, beside(&checkpoint, suffix)).unwrap();
    }
    let mut rescue = Setup::core(&scratch, free_port())
        .at_checkpoint(checkpoint)
        .start();
    rescue.wait_line(
        "the log says that other users may write to the folder",
        |line| line.contains("WARN") && line.contains("every user may write to it"),
    );
    assert_rescued(&mut rescue);
    assert_eq!(fs::read_to_string(&victim).unwrap(), "kept");
}

#[test]
fn planted_pipes_delay_no_call() {
    let scratch = Scratch::new();
    let checkpoint = open_folder(&scratch);
    for suffix in FILES {
        let pipe = beside(&checkpoint, suffix);
        mknodat(CWD, &pipe, FileType::Fifo, Mode::from_raw_mode(0o600), 0).unwrap();
    }
    let mut rescue = Setup::core(&scratch, free_port())
        .at_checkpoint(checkpoint)
        .start();
    assert_rescued(&mut rescue);
}

/// Python would execute parts of a planted log configuration.
#[test]
fn rosmasters_log_configuration_is_not_a_file_that_others_could_plant() {
    let scratch = Scratch::new();
    let checkpoint = open_folder(&scratch);
    let rescue = Setup::core(&scratch, free_port())
        .at_checkpoint(checkpoint.clone())
        .start();
    let master = rescue.client().master_pid().unwrap();
    let environment = fs::read(format!("/proc/{master}/environ")).unwrap();
    let mut variables = environment.split(|byte| *byte == 0);
    let prefix = b"ROS_PYTHON_LOG_CONFIG_FILE=";
    let given = variables
        .find_map(|variable| variable.strip_prefix(prefix))
        .unwrap();
    assert!(given.starts_with(b"/proc/self/fd/"));
    assert!(!beside(&checkpoint, ".rosmaster-logging.conf").exists());
    let log = || fs::read_to_string(scratch.log_dir().join("master.log")).unwrap_or_default();
    eventually("rosmaster writes its log", || {
        log().contains("initialization complete")
    });
}

/// While the disk hangs, files in the checkpoint's folder cannot be opened.
#[test]
fn a_hung_disk_delays_neither_calls_nor_the_next_master() {
    let scratch = Scratch::new();
    let disk = FailingDisk::new(&scratch);
    let setup = Setup::core(&scratch, free_port()).at_checkpoint(open_folder(&scratch));
    let mut rescue = disk.under(setup).start();
    disk.begin(Trouble::HangsOnOpen);
    assert_rescued(&mut rescue);
    rescue.wait_line("the log says which file is missing", |line| {
        line.contains("cannot create the output file of a child process")
    });
    disk.heal();
    assert_rescued(&mut rescue);
    eventually("rosrescue is protected", || {
        status(&rescue.client())["unprotected"].is_null()
    });
}
