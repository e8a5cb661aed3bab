//! Tests of the tests: each one has a network of its own, leaves nothing behind, and explains its failure.

use std::net::TcpListener;
use std::process::Command;
use std::sync::mpsc;
use std::thread;

use crate::support::{
    FakeNode, Scratch, alive, eventually, free_port, is_isolated, isolate, report,
};

/// Runs `test` like a test named `name`. Returns `None` if it panics.
fn run<T: Send + 'static>(name: &str, test: impl FnOnce() -> T + Send + 'static) -> Option<T> {
    let thread = thread::Builder::new().name(name.to_owned()).spawn(test);
    thread.unwrap().join().ok()
}

/// Whether the system lets a test have a network namespace.
fn is_possible() -> bool {
    let isolated = run("any", || {
        isolate();
        is_isolated()
    });
    isolated.unwrap()
}

#[test]
fn two_tests_can_listen_at_the_same_port() {
    if !is_possible() {
        return;
    }
    let port = 40_000;
    let listen = move || {
        isolate();
        TcpListener::bind(("0.0.0.0", port)).unwrap()
    };
    let one = run("one", listen);
    let other = run("other", listen);
    assert!(one.is_some() && other.is_some());
}

/// The process is not marked as one of the test's, and ignores a request to stop.
#[test]
fn a_process_that_a_test_leaves_behind_ends_with_it() {
    if !is_possible() {
        return;
    }
    for fails in [false, true] {
        let (send, receive) = mpsc::sync_channel(1);
        let ended = run("careless", move || {
            isolate();
            let mut sleep = Command::new("setsid");
            sleep.args(["sh", "-c", "trap '' HUP INT TERM; sleep 1000 & wait"]);
            send.send(sleep.spawn().unwrap().id()).unwrap();
            assert!(!fails, "this test fails on purpose");
        });
        assert_eq!(ended.is_none(), fails);
        let left = receive.recv().unwrap();
        // It has been killed, and a busy computer takes a moment to end it.
        eventually(&format!("process {left} ends"), || !alive(left));
    }
}

#[test]
fn the_report_about_a_failure_says_who_listens_and_how_to_repeat_it() {
    let said = run("some::test", || {
        let _scratch = Scratch::new();
        let port = free_port();
        let _node = FakeNode::start_at("/node", port);
        (port, report().unwrap())
    });
    let (port, said) = said.unwrap();
    let repeat = "cargo test --locked --test robot some::test -- --exact --nocapture";
    assert!(said.contains(repeat), "{said}");
    let listening = format!(
        "listening at 127.0.0.1:{port}: process {}",
        std::process::id()
    );
    assert!(said.contains(&listening), "{said}");
}
