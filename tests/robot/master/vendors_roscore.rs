//! `proxy` in front of a real roscore, which sets its own run id. roscore ends if it finds another one.

use std::process::Command;

use crate::support::{
    Process, Scratch, Setup, eventually, find_program, free_port, signal, status,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

/// Starts a roscore and waits until it has started rosout or found one, or has ended. A roscore whose master dies while
/// it starts may leave its rosout behind, which registers with the next master.
fn start(scratch: &Scratch, port: u16) -> Process {
    let mut command = Command::new(find_program("roscore"));
    scratch.prepare(&mut command);
    command
        .args(["-p", &port.to_string()])
        .env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}/"));
    let mut roscore = Process::start("roscore", &mut command);
    eventually("roscore is ready", || {
        roscore.log().contains("core service [/rosout]") || roscore.exited().is_some()
    });
    assert_eq!(roscore.exited(), None, "{}", roscore.log());
    roscore
}

#[test]
fn a_roscore_that_starts_again_keeps_running_and_gets_the_old_run_id() {
    let scratch = Scratch::new();
    let port = free_port();
    let mut roscore = start(&scratch, port);
    let rescue = Setup::proxy(&scratch, port).start();
    let client = rescue.client();
    let run_id = client.param("/run_id").expect("a run id");
    client.set_param("/robot", 7);
    for _ in 0..2 {
        signal(client.master_pid().unwrap(), Signal::KILL);
        // Without its master a roscore ends by itself.
        roscore.wait();
        roscore = start(&scratch, port);
        eventually("calls pass to the new master", || {
            status(&client)["open"] == true
        });
        assert_eq!(client.param("/robot"), Some(Value::Int(7)));
        eventually("the run id is the old one", || {
            client.param("/run_id").as_ref() == Some(&run_id)
        });
    }
}
