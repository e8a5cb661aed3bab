//! `core` does everything that roscore does, as far as the master shows it.

use std::process::Command;

use ros1_master::xmlrpc::Value;

use crate::support::{
    Client, Process, Scratch, Setup, State, eventually_some, find_program, free_port,
};

/// The state of a complete core, with rosout and all parameters.
fn complete(client: &Client) -> State {
    eventually_some("the core is complete", || {
        let state = State::try_read(client).ok()?;
        let keys = ["run_id", "rosversion", "rosdistro"];
        let params = state.params.as_struct()?;
        let whole = state.knows("/rosout")
            && state.services.len() == 2
            && !state.subscribers_of("/rosout").is_empty()
            && !state.publishers_of("/rosout_agg").is_empty()
            && keys.iter().all(|key| params.contains_key(*key));
        whole.then_some(state)
    })
}

/// The bare `rosrescue` is `rosrescue core`, at the port of `ROS_MASTER_URI`.
#[test]
fn a_bare_rosrescue_is_a_core_and_prints_what_roscore_prints() {
    let scratch = Scratch::new();
    let [theirs, ours] = [false, true].map(|is_ours| {
        let port = free_port();
        let uri = Client::at("localhost", port).uri();
        if is_ours {
            let path = std::env::var_os("PATH").unwrap();
            let setup = Setup::bare(&scratch, [""; 0]).env("ROS_MASTER_URI", uri);
            // With the real `rosversion`.
            let setup = setup.env("PATH", path);
            let _rescue = setup.at_port(port).start();
            return complete(&Client::new(port));
        }
        let mut command = Command::new(find_program("roscore"));
        scratch.prepare(&mut command);
        command
            .args(["-p", &port.to_string()])
            .env("ROS_MASTER_URI", uri);
        let _roscore = Process::start("roscore", &mut command);
        complete(&Client::new(port))
    });
    for key in ["rosversion", "rosdistro"] {
        assert_eq!(
            ours.params.as_struct().unwrap()[key],
            theirs.params.as_struct().unwrap()[key]
        );
    }
    let is_uuid = |state: &State| match &state.params.as_struct().unwrap()["run_id"] {
        Value::String(id) => {
            let parts: Vec<_> = id.split('-').map(str::len).collect();
            parts == [8, 4, 4, 4, 12]
        }
        _ => false,
    };
    assert!(is_uuid(&theirs) && is_uuid(&ours), "{ours}");
    assert_eq!(ours.publishers, theirs.publishers);
    assert_eq!(ours.subscribers, theirs.subscribers);
    assert_eq!(ours.services, theirs.services);
    assert_eq!(ours.topic_types, theirs.topic_types);
}
