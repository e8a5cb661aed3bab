//! The default checkpoint. There is one per port.

use crate::support::{Scratch, Setup, Tool, eventually, free_port, status};

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
