//! Tests of the question which nodes are at a port.

use super::*;
use ros1_master::master::port_of;

const FIRST: &str = "http://n:1";

fn names<'a>(master: &'a Master, port: &str) -> Vec<&'a str> {
    master.nodes_at(port).map(|(name, _)| name).collect()
}

#[test]
fn addresses_that_differ_only_after_the_port_share_it() {
    for (api, port) in [
        ("http://n:1/", "http://n:1"),
        ("http://n:1", "http://n:1"),
        (" http://n:1/a/b", "http://n:1"),
        ("http://[::1]:1/", "http://[::1]:1"),
        ("n", "n"),
        ("", ""),
    ] {
        assert_eq!(port_of(api), port);
    }
}

#[test]
fn the_nodes_at_a_port_are_those_that_are_registered_there_now() {
    let register = |node: &str, at: &str| call("registerPublisher", &[node, "/t", "a/B", at]);
    let mut master = after([register("/a", "http://n:1/"), register("/b", "http://n:1")]);
    let all: Vec<_> = master.nodes_at(FIRST).collect();
    assert_eq!(all, [("/a", "http://n:1/"), ("/b", "http://n:1")]);
    let restored = Master::from_snapshot(master.snapshot()).unwrap();
    assert_eq!(names(&restored, FIRST), ["/a", "/b"]);

    master.apply(&register("/a", "http://n:2/"));
    assert_eq!(names(&master, FIRST), ["/b"]);
    assert_eq!(names(&master, "http://n:2"), ["/a"]);
    master.apply(&register("/a", "http://n:2"));
    assert_eq!(names(&master, "http://n:2"), ["/a"]);
    master.apply(&call("unregisterPublisher", &["/b", "/t", FIRST]));
    assert_eq!(names(&master, FIRST), [""; 0]);
    assert_eq!(names(&restored, FIRST), ["/a", "/b"], "a clone has its own");
}
