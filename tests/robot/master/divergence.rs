//! What the mirror learns when it is not what the master is: from answers that differ, from replies that
//! were lost, from calls that it cannot read, and from looks at the master.

use crate::support::{
    FakeNode, Mode, Relay, Robot, Rosmaster, Scratch, State, eventually, eventually_some, params,
    status,
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
    eventually("the mirror is rebuilt", || mirrored(&client) == 0);
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
    // The master may be looked at in between because of the one before: then it is tried again.
    for topic in ["/t1", "/t2"] {
        let before = divergences(&client);
        eventually("an unregistration diverges", || {
            client.ok("registerPublisher", params!["/p", topic, "a/B", api]);
            let own = params!["/p", topic, api];
            robot.bare().ok("unregisterPublisher", own.clone());
            client.ok("unregisterPublisher", own);
            divergences(&client) > before
        });
        let before = divergences(&client);
        eventually("a subscription diverges", || {
            client.set_param("/key", "hush");
            robot.bare().set_param("/key", "psst");
            let value = client.ok("subscribeParam", params!["/p", api, "/key"]);
            assert_eq!(value, "psst".into());
            divergences(&client) > before
        });
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
fn a_node_past_the_proxy_is_in_the_mirror_once_a_client_has_listed_it() {
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    let client = robot.client();
    let [known, past] = ["/known", "/past"].map(FakeNode::start);
    known.publish(&client, "/topic", "std_msgs/String");
    past.publish(&robot.bare(), "/topic", "std_msgs/String");
    let wanted = robot.settled_state();
    eventually("the mirror has the node that was listed", || {
        client.ok("getSystemState", params!["/rosnode"]);
        status(&client)["state"]["nodes"] == 2
    });
    assert_eq!(divergences(&client), 0);
    robot.take_master_away();
    wanted.assert_same(&State::read(&client), "without a master");
}

/// What the master did is answered as done, although the connection ended before it said so.
#[test]
fn a_call_whose_reply_was_lost_is_answered_as_done() {
    let scratch = Scratch::new();
    let (master, relay, rescue) = Relay::between(&scratch);
    let client = rescue.client();
    let node = FakeNode::start("/node");
    let (name, api, service_api) = ("/node", node.api.as_str(), node.service_api());
    node.publish(&client, "/topic", "std_msgs/String");
    node.subscribe(&client, "/topic", "std_msgs/String");
    node.offer(&client, "/service");
    for (method, params) in [
        ("setParam", params![name, "/key", 5]),
        ("deleteParam", params![name, "/key"]),
        ("unregisterPublisher", params![name, "/topic", api]),
        ("unregisterSubscriber", params![name, "/topic", api]),
        ("unregisterService", params![name, "/service", service_api]),
    ] {
        eventually("calls pass", || status(&client)["open"] == true);
        // What a living node says of itself counts.
        match method {
            "unregisterPublisher" => node.claim_publication("/topic", None),
            "unregisterSubscriber" => node.claim_subscription("/topic", None),
            _ => {}
        }
        relay.swallow(method, 1);
        let answer = client.status(method, params).unwrap();
        assert_eq!((relay.hunger(), answer.0), (0, 1), "{method}: {answer:?}");
    }
    eventually("calls pass", || status(&client)["open"] == true);
    let state = State::read(&master.client());
    assert!(
        !state.knows("/node") && state.param_names.is_empty(),
        "{state}"
    );
    state.assert_same(&State::read(&client), "through rosrescue");
}

/// It is what was recovered all the same, and nodes that died in the outage are taken out.
#[test]
fn an_injection_whose_reply_was_lost_is_a_recovery() {
    let scratch = Scratch::new();
    let (mut master, relay, rescue) = Relay::between(&scratch);
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
