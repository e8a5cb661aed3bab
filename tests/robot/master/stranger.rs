//! Another program takes the port of rosrescue's rosmaster before that can listen. The program receives no call, and
//! rosmaster is started at another port at once.

use std::fs;
use std::io::Read;
use std::net::TcpListener;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

use crate::support::{
    Client, NODES, Scratch, Setup, eventually, eventually_some, free_port, signal, within,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

/// Takes the port of the next rosmaster. Returns the port, and the number of bytes that it has received.
fn rob(scratch: &Scratch) -> impl FnOnce() -> (u16, Arc<AtomicUsize>) + use<> {
    let (rob, port) = (scratch.path("rob"), scratch.path("port"));
    fs::write(&rob, "").unwrap();
    move || {
        let taken = eventually_some("rosmaster reports its port", || {
            fs::read_to_string(&port).ok()?.parse().ok()
        });
        fs::remove_file(&rob).unwrap();
        fs::remove_file(&port).unwrap();
        let listener = TcpListener::bind(("127.0.0.1", taken)).unwrap();
        let told = Arc::new(AtomicUsize::new(0));
        thread::spawn({
            let told = told.clone();
            move || {
                for stream in listener.incoming() {
                    let (told, mut stream) = (told.clone(), stream.unwrap());
                    thread::spawn(move || {
                        while let Ok(count @ 1..) = stream.read(&mut [0; 4096]) {
                            told.fetch_add(count, Ordering::Relaxed);
                        }
                    });
                }
            }
        });
        (taken, told)
    }
}

#[test]
fn another_program_at_the_port_of_our_master_receives_no_call() {
    let scratch = Scratch::new();
    let port = free_port();
    let robbed = Path::new(NODES).join("robbed_rosmaster.py");
    let arguments = [
        "core",
        "--no-rosout",
        "-p",
        &port.to_string(),
        "--rosmaster",
    ];
    let setup = Setup::bare(&scratch, arguments).arg(robbed).at_port(port);
    let setup = setup.args(["--start-limit", "300"]);
    let take = rob(&scratch);
    // rosrescue must not wait for the 300 s that a rosmaster has for its start. Two starts may take long.
    let soon = Duration::from_secs(120);
    let (rescue, first, bytes) = within(soon, "the start", || {
        let mut rescue = setup.spawn();
        let (first, bytes) = take();
        rescue.wait_serving();
        (rescue, first, bytes)
    });
    let client: Client = rescue.client();
    client.set_param("/kept", 7);
    assert_eq!(
        bytes.load(Ordering::Relaxed),
        0,
        "the other program was called"
    );

    let dead = client.master_pid().unwrap();
    let take = rob(&scratch);
    signal(dead, Signal::KILL);
    let (second, bytes) = within(soon, "the replacement", || {
        let taken = take();
        eventually("another master serves", || {
            client.master_pid().is_some_and(|pid| pid != dead)
                && crate::support::status(&client)["open"] == true
        });
        taken
    });
    assert_ne!(first, second);
    assert_eq!(client.param("/kept"), Some(Value::Int(7)));
    assert_eq!(
        bytes.load(Ordering::Relaxed),
        0,
        "the other program was called"
    );
}
