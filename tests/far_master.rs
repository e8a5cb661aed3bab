//! A name server that does not answer holds up nobody for long.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod support;

use std::time::{Duration, Instant};

use support::{NameServer, Rosmaster, Scratch, Setup, free_port, params};

/// Options with which a master is missed after two seconds.
const PROBES: [&str; 6] = [
    "--probe-interval",
    "100",
    "--probe-timeout",
    "1000",
    "--probe-count",
    "2",
];
const SOON: Duration = Duration::from_secs(2);

/// A rosrescue before the master at `host`.
fn proxy(scratch: &Scratch, host: &str, master_port: u16) -> Setup {
    let port = free_port();
    let master = format!("http://{host}:{master_port}");
    let listen = format!("127.0.0.1:{port}");
    let arguments = ["proxy", "--master", &master, "--listen", &listen];
    let setup = Setup::bare(scratch, arguments).at_port(port);
    setup.args(["--hold", "60", "--verbose"]).args(PROBES)
}

#[test]
fn a_stop_does_not_wait_for_the_name_of_the_master() {
    let scratch = Scratch::new();
    let names = NameServer::silent(&scratch);
    let setup = proxy(&scratch, "master.test", free_port());
    let mut rescue = setup.wrapped(|own| names.serving(own)).spawn();
    rescue.wait_line("that it waits", |line| line.contains("cannot reach"));
    let start = Instant::now();
    assert_eq!(rescue.terminate().code(), Some(0));
    let took = start.elapsed();
    assert!(took < SOON, "{took:?}");
}

/// After a boot it is asked whether the nodes of the session are on other computers.
#[test]
fn a_stop_does_not_wait_for_the_names_of_nodes() {
    let scratch = Scratch::new();
    let names = NameServer::silent(&scratch);
    let port = free_port();
    let _master = Rosmaster::start_at(&scratch, port);
    let setup = Setup::proxy(&scratch, port);
    let mut rescue = setup.wrapped(|own| names.serving(own)).start();
    let api = "http://node.test:4711/";
    let params = params!["/node", "/topic", "std_msgs/String", api];
    rescue.client().ok("registerPublisher", params);
    rescue.kill();
    let boot_id = scratch.path("boot_id");
    std::fs::write(&boot_id, "another boot").unwrap();
    rescue.start_after_reboot(&boot_id);
    rescue.wait_serving();
    let start = Instant::now();
    assert_eq!(rescue.terminate().code(), Some(0));
    let took = start.elapsed();
    assert!(took < SOON, "{took:?}");
}
