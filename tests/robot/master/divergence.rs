//! What the mirror learns when it is not what the master is: from answers that differ, from replies that
//! were lost, from calls that it cannot read, and from looks at the master.

use crate::support::{
    FakeNode, Mode, Relay, Robot, Rosmaster, Scratch, Setup, encode_call, eventually,
    eventually_some, http_request, params, request, signal, status, stop,
};
use rosrescue::xmlrpc::{Reply, Value};

/// How many parameters the mirror holds.
fn mirrored(client: &crate::support::Client) -> u64 {
    status(client)["state"]["params"]
        .as_u64()
        .expect("a number")
}

fn divergences(client: &crate::support::Client) -> u64 {
    let divergences = &status(client)["counters"]["divergences"];
    divergences.as_u64().expect("a number")
}

/// The code of an answer.
fn code(reply: &Reply) -> Option<i32> {
    match reply {
        Reply::Value(Value::Array(answer)) => answer.first()?.as_int(),
        _ => None,
    }
}

#[test]
fn a_refusal_that_the_mirror_did_not_expect_is_believed() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    client.set_param("/a", 1);
    client.set_param("/b", 2);
    // Past the proxy: one that it is going to ask for, and one that it is not.
    for key in ["/a", "/b"] {
        robot.bare().ok("deleteParam", params!["/x", key]);
    }
    let reply = client.call("deleteParam", params!["/n", "/a"]).unwrap();
    assert_eq!(code(&reply), Some(-1));
    assert_eq!(divergences(&client), 1);
    eventually("the mirror is made anew", || mirrored(&client) == 0);
    robot.crash_master();
    assert_eq!(client.param("/a"), None);
    assert_eq!(client.param("/b"), None);
}

/// Once for each method, with what both said, but no parameter's value.
#[test]
fn a_divergence_is_logged_once_for_each_method_with_both_replies() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let api = "http://127.0.0.1:1/";
    for (round, topic) in (0..).zip(["/t1", "/t2"]) {
        client.ok("registerPublisher", params!["/p", topic, "a/B", api]);
        let own = params!["/p", topic, api];
        robot.bare().ok("unregisterPublisher", own.clone());
        client.ok("unregisterPublisher", own);
        client.set_param("/key", "hush");
        robot.bare().set_param("/key", "psst");
        let value = client.ok("subscribeParam", params!["/p", api, "/key"]);
        assert_eq!(value, "psst".into());
        assert_eq!(divergences(&client), 2 * (round + 1));
    }
    let mut said = |method: &str| {
        let wanted = |line: &str| line.contains(&format!("method=\"{method}\""));
        let line = robot.rescue.wait_line("what differs", wanted);
        // Both rounds are over: what had been said twice would be there.
        let lines = robot.rescue.output();
        assert_eq!(lines.iter().filter(|line| wanted(line)).count(), 1);
        line
    };
    let line = said("unregisterPublisher");
    let (mirror, master) = line.split_once(" master=").unwrap();
    assert!(
        mirror.contains("Unregistered [/p] as provider of [/t1]"),
        "{line}"
    );
    assert!(master.contains("[/p] is not a registered node"), "{line}");
    let line = said("subscribeParam");
    let (mirror, master) = line.split_once(" master=").unwrap();
    for reply in [mirror, master] {
        assert!(reply.contains("Subscribed to parameter [/key]"), "{line}");
    }
    let lines = robot.rescue.output().join("\n");
    assert!(
        !lines.contains("hush") && !lines.contains("psst"),
        "{lines}"
    );
}

#[test]
fn what_was_written_past_the_proxy_is_found_at_the_interval() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--resync-interval", "0.2"]);
    let client = robot.client();
    robot.bare().set_param("/a", 1);
    eventually("the mirror has it", || mirrored(&client) == 1);
    assert_eq!(divergences(&client), 0);
    robot.crash_master();
    assert_eq!(client.param("/a"), Some(1.into()));
}

#[test]
fn what_was_written_past_the_proxy_is_found_when_the_same_master_goes_on() {
    let probes = [
        "--probe-interval",
        "100",
        "--probe-timeout",
        "300",
        "--probe-count",
        "2",
    ];
    let mut robot = Robot::start_with(Mode::Proxy, &probes);
    let client = robot.client();
    let pid = robot.master_pid();
    stop(pid);
    eventually("the gate is shut", || !robot.is_open());
    let mut past = robot.bare().connect().unwrap();
    let set = encode_call("setParam", params!["/x", "/a", 1]);
    past.send(&http_request(&set)).unwrap();
    signal(pid, rustix::process::Signal::CONT);
    assert_eq!(code(&past.response().unwrap().reply()), Some(1));
    robot.await_gate();
    eventually("the mirror has it", || mirrored(&client) == 1);
    robot.crash_master();
    assert_eq!(client.param("/a"), Some(1.into()));
}

/// A rosmaster behind a relay, and rosrescue before it.
fn relayed(scratch: &Scratch) -> (Rosmaster, Relay, crate::support::Rescue) {
    let master = Rosmaster::start(scratch);
    let relay = Relay::to(master.client().port());
    let rescue = Setup::proxy(scratch, relay.port()).start();
    (master, relay, rescue)
}

#[test]
fn a_deletion_whose_reply_was_lost_is_answered_as_done() {
    let scratch = Scratch::new();
    let (master, relay, rescue) = relayed(&scratch);
    let client = rescue.client();
    client.set_param("/swallowed", 1);
    relay.swallow("deleteParam", 1);
    let reply = client.call("deleteParam", params!["/n", "/swallowed"]);
    assert_eq!(code(&reply.unwrap()), Some(1));
    assert_eq!(relay.hunger(), 0);
    assert_eq!(master.client().param("/swallowed"), None);
    eventually("the mirror knows", || mirrored(&client) == 0);
}

#[test]
fn a_write_whose_reply_was_lost_is_answered_as_done() {
    let scratch = Scratch::new();
    let (master, relay, rescue) = relayed(&scratch);
    let client = rescue.client();
    relay.swallow("/swallowed", 1);
    let reply = client.call("setParam", params!["/n", "/swallowed", 5]);
    assert_eq!(code(&reply.unwrap()), Some(1));
    assert_eq!(client.param("/swallowed"), Some(5.into()));
    eventually("calls pass", || {
        relay.hunger() == 0 && status(&client)["open"] == true
    });
    assert_eq!(master.client().param("/swallowed"), Some(5.into()));
    eventually("the mirror knows", || mirrored(&client) == 1);
}

/// It is what was recovered all the same, and nodes that died in the outage are taken out.
#[test]
fn an_injection_whose_reply_was_lost_is_a_recovery() {
    let scratch = Scratch::new();
    let (mut master, relay, rescue) = relayed(&scratch);
    let client = rescue.client();
    client.set_param("/swallowed", 1);
    FakeNode::start("/dead").publish(&client, "/topic", "std_msgs/String");
    let port = master.client().port();
    master.kill();
    eventually("the gate is shut", || status(&client)["open"] == false);
    relay.swallow("swallowed", 1);
    let master = Rosmaster::start_at(&scratch, port);
    eventually("the dead node is taken out", || {
        let known = master.client().ok("getSystemState", params!["/x"]);
        relay.hunger() == 0 && !format!("{known:?}").contains("/dead")
    });
    assert_eq!(client.param("/swallowed"), Some(1.into()));
    let report = eventually_some("a report", || {
        let report = status(&client)["last_recovery"].clone();
        (!report["health_check_ms"].is_null()).then_some(report)
    });
    assert_eq!(report["outcome"], "injected", "{report}");
}

/// rosmaster understands more than we do: what such a call did is recorded before it is answered.
#[test]
fn a_call_that_cannot_be_read_is_answered_when_the_mirror_knows_what_it_did() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let call = String::from_utf8(encode_call("setParam", params!["/n", "/a", 1])).unwrap();
    let call = call.replacen("?>", "?><!DOCTYPE methodCall>", 1);
    let post = request(
        "POST / HTTP/1.1",
        &["Content-Type: text/xml"],
        call.as_bytes(),
    );
    let reply = client.exchange(&post).unwrap().reply();
    assert_eq!(code(&reply), Some(1), "{reply:?}");
    assert_eq!(mirrored(&client), 1);
    robot.crash_master();
    assert_eq!(client.param("/a"), Some(1.into()));
}
