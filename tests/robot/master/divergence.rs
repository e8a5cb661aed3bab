//! How the mirror notices that it differs from the master: by answers that differ, lost replies, calls that
//! it cannot read, and by reading the master's state.

use ros1_master::xmlrpc::{Reply, Value};

use crate::support::{
    FakeNode, Mode, Relay, Robot, Rosmaster, Scratch, State, eventually, eventually_some, params,
    status,
};

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

/// The status code of an answer.
fn code(reply: &Reply) -> Option<i32> {
    match reply {
        Reply::Value(Value::Array(answer)) => answer.first()?.as_int(),
        _ => None,
    }
}

/// The log has one line per method, with both replies but no parameter values.
#[test]
fn a_divergence_corrects_the_mirror_and_is_logged_once_per_method_with_both_replies() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    client.set_param("/a", 1);
    client.set_param("/b", 2);
    // Two parameters are deleted directly at the master: one that the client then deletes too, and another one.
    for key in ["/a", "/b"] {
        robot.bare().ok("deleteParam", params!["/x", key]);
    }
    let reply = client.call("deleteParam", params!["/n", "/a"]).unwrap();
    assert_eq!(code(&reply), Some(-1));
    assert_eq!(divergences(&client), 1);
    eventually("the mirror is rebuilt", || mirrored(&client) == 0);
    let api = "http://127.0.0.1:1/";
    // Because of an earlier divergence the master's state may be read in between. Then it is retried.
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
        let line = robot.rescue.wait_line("the log says what differs", wanted);
        // Both rounds are over, so a repeated line would be there by now.
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
    robot.crash_master();
    assert_eq!(client.param("/a"), None);
    assert_eq!(client.param("/b"), None);
}

#[test]
fn writes_that_bypass_the_proxy_are_found_at_the_resync_interval() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--resync-interval", "0.2"]);
    let client = robot.client();
    robot.bare().set_param("/a", 1);
    eventually("the mirror has it", || mirrored(&client) == 1);
    assert_eq!(divergences(&client), 0);
    robot.crash_master();
    assert_eq!(client.param("/a"), Some(1.into()));
}

#[test]
fn a_node_that_bypassed_the_proxy_is_known_once_a_client_lists_the_nodes() {
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    let client = robot.client();
    let [known, past] = ["/known", "/past"].map(FakeNode::start);
    known.publish(&client, "/topic", "std_msgs/String");
    past.publish(&robot.bare(), "/topic", "std_msgs/String");
    let wanted = robot.settled_state();
    eventually("the mirror has the node", || {
        client.ok("getSystemState", params!["/rosnode"]);
        status(&client)["state"]["nodes"] == 2
    });
    assert_eq!(divergences(&client), 0);
    robot.take_master_away();
    wanted.assert_same(&State::read(&client), "without a master");
}

/// A write is answered as done if the master ran it, even if the connection ended before the reply. A recovery counts as
/// successful although a reply was lost, and nodes that died during the outage are unregistered.
#[test]
fn a_write_and_an_injection_whose_replies_were_lost_count_as_done() {
    let scratch = Scratch::new();
    let (mut master, relay, rescue) = Relay::between(&scratch);
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
        // rosrescue believes what a living node reports about itself.
        match method {
            "unregisterPublisher" => node.claim_publication("/topic", None),
            "unregisterSubscriber" => node.claim_subscription("/topic", None),
            _ => {}
        }
        relay.swallow(method, 1);
        let answer = client.status(method, params).unwrap();
        assert_eq!(
            (relay.to_swallow(), answer.0),
            (0, 1),
            "{method}: {answer:?}"
        );
    }
    eventually("calls pass", || status(&client)["open"] == true);
    let state = State::read(&master.client());
    assert!(
        !state.knows("/node") && state.param_names.is_empty(),
        "{state}"
    );
    state.assert_same(&State::read(&client), "through rosrescue");

    client.set_param("/swallowed", 1);
    FakeNode::start("/dead").publish(&client, "/topic", "std_msgs/String");
    let port = master.client().port();
    master.kill();
    eventually("the gate is shut", || status(&client)["open"] == false);
    relay.swallow("swallowed", 1);
    let master = Rosmaster::start_at(&scratch, port);
    let report = eventually_some("a report of the rescue", || {
        let report = status(&client)["last_recovery"].clone();
        (report["number"] == 1 && !report["health_check_ms"].is_null()).then_some(report)
    });
    assert_eq!(report["outcome"], "injected", "{report}");
    assert_eq!(relay.to_swallow(), 0);
    assert_eq!(client.param("/swallowed"), Some(1.into()));
    eventually("the dead node is unregistered", || {
        let known = master.client().ok("getSystemState", params!["/x"]);
        !format!("{known:?}").contains("/dead")
    });
}
