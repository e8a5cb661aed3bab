//! This computer.

use checkpoint_store::LockHolder;

use super::{
    super::super::{
        Severity::{Note, Problem, Warning},
        facts::SetupFacts,
    },
    findings_of, one, todo,
};

#[test]
fn where_the_checkpoint_goes() {
    let mount = |facts: &mut SetupFacts, of: &str, source: &str| {
        facts.disk.mount = Some((of.to_owned(), source.to_owned()));
    };
    one(
        Problem,
        "checkpoint",
        "in use by another rosrescue, process 9",
        |facts| {
            facts.disk.holder = Some(LockHolder { pid: Some(9) });
        },
    );
    one(Problem, "checkpoint", "is a folder", |facts| {
        facts.disk.is_folder = true
    });
    one(Problem, "checkpoint", "5 MiB free", |facts| {
        facts.disk.space = Ok((5 << 20, false))
    });
    one(Warning, "checkpoint", "50 MiB free", |facts| {
        facts.disk.space = Ok((50 << 20, false))
    });
    one(Problem, "checkpoint", "read-only", |facts| {
        facts.disk.space = Ok((1 << 40, true))
    });
    one(Problem, "checkpoint", "I/O error", |facts| {
        facts.disk.space = Err("I/O error".to_owned());
    });
    one(Note, "checkpoint", "is in memory", |facts| {
        mount(facts, "tmpfs", "tmpfs")
    });
    one(
        Warning,
        "checkpoint",
        "is on another computer (nfs4)",
        |facts| {
            mount(facts, "nfs4", "nas:/home");
        },
    );
    one(
        Note,
        "checkpoint",
        "is on an SD card or eMMC (/dev/mmcblk0p2)",
        |facts| {
            mount(facts, "ext4", "/dev/mmcblk0p2");
        },
    );
}

#[test]
fn the_advice_for_a_path_without_permission_changes_no_folder_of_the_system() {
    let checkpoint = "/home/r/.ros/log/latest-chkpt.yaml";
    for (refused, is_folder_there, command) in [
        ("/home/r/.ros/log", true, "chown $(id -un) /home/r/.ros/log"),
        (
            checkpoint,
            true,
            "chown $(id -un) /home/r/.ros/log/latest-chkpt.yaml*",
        ),
        ("/", false, "install -d -o $(id -un) /home/r/.ros/log"),
    ] {
        let refuse = |facts: &mut SetupFacts| {
            facts.disk.refused = Some((refused.into(), "Permission denied".to_owned()));
            facts.disk.is_folder_there = is_folder_there;
        };
        let words = format!("{refused} cannot be written: Permission denied");
        one(Problem, "checkpoint", &words, refuse);
        let todo = todo(refuse);
        assert!(todo.starts_with(&format!("`sudo {command}` as")), "{todo}");
    }
}

#[test]
fn what_the_computer_lacks() {
    one(Problem, "descriptors", "64 open files", |facts| {
        facts.files = 64
    });
    one(Warning, "descriptors", "1024 open files", |facts| {
        facts.files = 1024
    });
    one(Problem, "clock", "says 1970-01-01T00:01:00Z", |facts| {
        facts.clock.now = 60.0
    });
    one(Warning, "clock", "before files of", |facts| {
        facts.clock.newest = 1.9e9
    });
    one(Note, "clock", "no time service runs", |facts| {
        facts.clock.service = None
    });
    one(Warning, "memory", "100 MiB are free", |facts| {
        facts.memory = Some(100 << 20)
    });
    assert_eq!(findings_of(|facts| facts.memory = None), []);
}

#[test]
fn a_file_system_without_inodes_takes_no_checkpoint() {
    one(
        Problem,
        "checkpoint",
        "0 more files can be created",
        |facts| {
            facts.disk.inodes = Some(0);
        },
    );
    one(
        Warning,
        "checkpoint",
        "500 more files can be created",
        |facts| {
            facts.disk.inodes = Some(500);
        },
    );
    assert_eq!(findings_of(|facts| facts.disk.inodes = None), []);
}
