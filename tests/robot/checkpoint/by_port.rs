//! The default checkpoint. There is one per port.

use std::fs;
use std::path::Path;

use rosrescue::checkpoint::{
    format::{self, Checkpoint},
    session, store,
};

use crate::support::{Rescue, Scratch, Setup, Tool, eventually, free_port, status};

#[test]
fn two_cores_in_one_home_have_separate_checkpoints() {
    let scratch = Scratch::new();
    let start = || {
        let setup = Setup::core(&scratch, free_port()).guarded();
        setup.arg("--no-rosout").start()
    };
    let mut cores = [start(), start()];
    for core in &cores {
        core.client().set_param("/port", i32::from(core.port()));
        let client = core.client();
        eventually("rosrescue is protected", || {
            status(&client)["unprotected"].is_null()
        });
        assert_eq!(
            status(&client)["checkpoint"],
            core.checkpoint().to_str().unwrap()
        );
    }
    for core in &mut cores {
        let worker = u32::try_from(status(&core.client())["pid"].as_u64().unwrap()).unwrap();
        core.kill();
        crate::support::signal(worker, rustix::process::Signal::KILL);
    }
    for core in &mut cores {
        // Commands find the same file when no rosrescue runs.
        let port = core.port();
        let tool = |words: &[&str]| Tool::rosrescue(&scratch, port, words).ended(0);
        assert!(tool(&["params", "present"]).contains(&format!("\"port\": {port}")));
        let found = tool(&["inspect"]);
        assert!(
            found.contains(core.checkpoint().to_str().unwrap()),
            "{found}"
        );
        core.start_again();
        core.wait_serving();
        assert_eq!(core.client().param("/port"), Some(i32::from(port).into()));
    }
}

/// Rewrites the checkpoint at `path` as an earlier version would write it, without the port.
fn forget_port(path: &Path) {
    let loaded = store::read(path).unwrap().unwrap();
    let first = loaded.checkpoint.as_ref().unwrap().seq;
    let seq = loaded.records.last().map_or(first, |record| record.seq);
    let rebuilt = session::rebuild(loaded.checkpoint, loaded.records);
    let session = rebuilt.session.unwrap();
    assert_ne!(session.port, 0);
    let checkpoint = Checkpoint {
        seq,
        session: format::Session { port: 0, ..session },
        snapshot: rebuilt.mirror.snapshot(),
        pending: Vec::new(),
        displaced: Vec::new(),
        follows: false,
    };
    fs::write(
        path,
        format::encode_checkpoint(&checkpoint, 9).unwrap().bytes,
    )
    .unwrap();
}

#[test]
fn the_default_checkpoint_of_an_earlier_version_is_used_only_for_its_own_port() {
    let scratch = Scratch::new();
    let old = scratch.log_dir().join("latest-chkpt.yaml");
    let setup = Setup::core(&scratch, free_port()).arg("--no-rosout");
    let mut rescue = setup.at_checkpoint(old.clone()).start();
    rescue.client().set_param("/old", 1);
    let master = rescue.client().master_pid();
    let other = |port: u16| -> Rescue {
        let setup = Setup::bare(&scratch, ["core", "--no-rosout", "-p", &port.to_string()]);
        setup.at_port(port).start()
    };
    let value = |rescue: &Rescue| rescue.client().param("/old");
    assert_eq!(value(&other(free_port())), None, "the checkpoint is in use");
    rescue.kill();
    assert_eq!(
        value(&other(free_port())),
        None,
        "the checkpoint belongs to another port"
    );
    forget_port(&old);
    let rescue = other(rescue.port());
    assert_eq!(value(&rescue), Some(1.into()));
    assert_eq!(
        rescue.client().master_pid(),
        master,
        "the same master stays in use"
    );
    assert!(
        rescue
            .log()
            .contains("copied the checkpoint of an earlier version")
    );
    assert!(old.exists());
}
