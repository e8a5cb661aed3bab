//! How rosrescue starts with the checkpoint that it finds: unwritable, not a checkpoint, empty, or damaged.
//! It serves calls in any case, reports the problem, and never destroys a user's file.

use std::fs;

use crate::support::{Rosmaster, Scratch, Setup, eventually, free_port, params};
use rustix::process::Signal;

/// The robot keeps running: rosrescue reports that it is unprotected and why, and restores a dead master from
/// memory. Tests may run as root, who may write to any file, so the unwritable places are a file where a
/// folder should be, and a folder where the file should be.
#[test]
fn rosrescue_serves_calls_without_a_writable_checkpoint() {
    let scratch = Scratch::new();
    let file = scratch.path("file");
    fs::write(&file, "a file").unwrap();
    let folder = scratch.path("folder");
    fs::create_dir(&folder).unwrap();
    for checkpoint in [
        file.join("chkpt.yaml"),
        folder.clone(),
        "/proc/chkpt.yaml".into(),
    ] {
        let mut rescue = Setup::core(&scratch, free_port())
            .at_checkpoint(checkpoint.clone())
            .start();
        rescue.wait_line("the log names the file that cannot be written", |line| {
            line.contains("unprotected") && line.contains(checkpoint.to_str().unwrap())
        });
        let client = rescue.client();
        client.set_param("/kept", 1);
        let dead = client.master_pid().expect("the master's process id");
        crate::support::signal(dead, Signal::KILL);
        eventually("another master answers", || {
            client.master_pid().is_some_and(|pid| pid != dead)
        });
        assert_eq!(client.param("/kept"), Some(1.into()));
        client.set_param("/kept", 2);
        assert_eq!(rescue.terminate().code(), Some(0));
        assert_eq!(scratch.survivors(), vec![]);
    }
    assert_eq!(fs::read_to_string(&file).unwrap(), "a file");
    // The user's folder is not renamed either.
    assert!(folder.is_dir() && !scratch.path("folder.unreadable-1").exists());
}

/// A file of another program is never lost: it stays in its place or is kept under another name.
#[test]
fn a_file_of_another_program_at_the_checkpoints_path_is_never_lost() {
    let scratch = Scratch::new();
    let contents: &[&[u8]] = &[
        b"my: precious\nnotes: [1, 2]\n",
        b"\x7fELF\x00\x01\xff\xfe garbage",
        b"# rosrescue checkpoint v999 generation=1\n",
        b"{{{{",
        "- registerPublisher\n"
            .repeat(10_000)
            .as_bytes()
            .to_owned()
            .leak(),
    ];
    for (number, content) in contents.iter().enumerate() {
        let folder = scratch.path(format!("case{number}"));
        fs::create_dir(&folder).unwrap();
        let checkpoint = folder.join("chkpt.yaml");
        fs::write(&checkpoint, content).unwrap();
        let mut rescue = Setup::core(&scratch, free_port())
            .at_checkpoint(checkpoint.clone())
            .spawn();
        let client = rescue.client();
        eventually("rosrescue serves calls or refuses to start", || {
            rescue.exited().is_some() || client.ask("setParam", params!["/c", "/x", 1]).is_some()
        });
        eventually("the log names the file", || {
            rescue
                .output()
                .iter()
                .any(|line| line.contains("chkpt.yaml"))
        });
        match rescue.exited() {
            Some(status) => assert_eq!(status.code(), Some(1)),
            None => assert_eq!(rescue.terminate().code(), Some(0)),
        }
        rescue.assert_no_panic();
        let kept = fs::read_dir(&folder)
            .unwrap()
            .flatten()
            .any(|entry| fs::read(entry.path()).is_ok_and(|kept| kept == *content));
        assert!(kept, "case {number}: the content is lost");
    }
}

#[test]
fn an_empty_checkpoint_starts_a_new_session() {
    let scratch = Scratch::new();
    let checkpoint = scratch.path("empty.yaml");
    fs::write(&checkpoint, "").unwrap();
    let rescue = Setup::core(&scratch, free_port())
        .at_checkpoint(checkpoint)
        .start();
    rescue.client().set_param("/x", 1);
}

#[test]
fn the_whole_records_of_a_damaged_checkpoint_are_restored_and_the_damage_is_reported() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    for i in 0..20 {
        rescue.client().set_param(&format!("/p{i}"), i);
    }
    rescue.kill();
    let checkpoint = rescue.checkpoint();
    let mut bytes = fs::read(&checkpoint).unwrap();
    // The last record is incomplete. According to the file it was never acknowledged.
    let end = bytes
        .iter()
        .rposition(|&byte| byte == b'{')
        .expect("a record");
    bytes.truncate(end + 5);
    fs::write(&checkpoint, &bytes).unwrap();
    master.kill();
    let _master = Rosmaster::start_at(&scratch, master.port);
    rescue.start_again();
    rescue.wait_serving();
    for i in 0..19 {
        assert_eq!(
            rescue.client().param(&format!("/p{i}")),
            Some(i.into()),
            "/p{i}"
        );
    }
}
