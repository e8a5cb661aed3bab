//! Values that a master takes and that spoil its answers, or that XML changes on their way: rosrescue
//! serves such a master, and knows what else it holds.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod support;

use support::{Rosmaster, Scratch, Setup, eventually, params};

/// CPython writes a carriage return as it is, and whoever reads that as XML gets a line feed.
#[test]
fn carriage_returns_outlive_master_and_rosrescue() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    master.client().set_param("/before", "a\r\nb\rc");
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    client.set_param("/through", "d\r\ne\rf");
    let api = "http://127.0.0.1:1/";
    client.ok("subscribeParam", params!["/n", api, "/through"]);
    let metrics = client.exchange(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n");
    let metrics = metrics.unwrap().text();
    assert!(
        metrics.contains("\nrosrescue_divergences_total 0\n"),
        "{metrics}"
    );
    rescue.kill();
    rescue.start_again();
    rescue.wait_serving();
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    eventually("the parameters are back", || {
        master.client().param("/before") == Some("a\r\nb\rc".into())
            && master.client().param("/through") == Some("d\r\ne\rf".into())
    });
}
