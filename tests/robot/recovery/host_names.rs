//! Nodes that are registered under host names. Names that resolve slowly or not at all delay no other node,
//! and a node is found at the address that its name has now.

use std::net::Ipv4Addr;
use std::time::Duration;

use crate::support::{
    Client, FakeNode, NameServer, Rescue, Scratch, Setup, State, eventually, free_port, holds,
    names, params, status, within,
};

/// Maximum time until a living subscriber knows a new publisher. Waiting for one lookup would take 5 s.
const SOON: Duration = Duration::from_millis(4_500);

/// A `rosrescue core` that uses only the name server `server`, also for its master.
fn core(server: &NameServer, scratch: &Scratch, master_port: u16) -> Rescue {
    let setup = Setup::core(scratch, master_port);
    setup.wrapped(|own| server.serving(own)).start()
}

fn kill_master(client: &Client) -> u32 {
    let dead = client.master_pid().expect("a master");
    crate::support::signal(dead, rustix::process::Signal::KILL);
    dead
}

/// Waits for the report of the recovery from the death of `dead`, including its health check.
fn report(client: &Client, dead: u32) -> serde_json::Value {
    let mut last = serde_json::Value::Null;
    eventually("the recovery is complete", || {
        last = status(client)["last_recovery"].clone();
        last["master_pid"] != dead && last["health_check_ms"].is_number()
    });
    last
}

#[test]
fn host_names_that_resolve_slowly_delay_no_other_node() {
    let scratch = Scratch::new();
    let server = NameServer::silent(&scratch);
    let rescue = core(&server, &scratch, free_port());
    let client = rescue.client();
    for i in 0..40 {
        let (name, api) = (format!("/slow{i}"), format!("http://slow{i}.test:4711/"));
        client.ok(
            "registerSubscriber",
            params![name.as_str(), "/chatter", "std_msgs/String", api],
        );
    }
    let living = FakeNode::start("/living");
    // This node is registered under a name that the computer knows without a name server.
    let api = format!("http://localhost:{}/", living.port());
    living.claim_subscription("/chatter", Some("std_msgs/String"));
    client.ok(
        "registerSubscriber",
        params!["/living", "/chatter", "std_msgs/String", api],
    );
    let dead = client.master_pid().expect("a master");
    crate::support::signal(dead, rustix::process::Signal::KILL);
    let publisher = FakeNode::start("/publisher");
    within(SOON, "a registration", || {
        publisher.publish(&client, "/chatter", "std_msgs/String");
    });
    within(SOON, "a notification", || {
        eventually("the living subscriber is notified", || {
            living.updates("/chatter").last() == Some(&vec![publisher.api.clone()])
        });
    });
    // While the lookups are under way, calls pass, and new publishers register.
    for i in 0..50 {
        within(SOON, "a write", || client.set_param("/n", i));
    }
    eventually("exactly the nodes with slow names are unreachable", || {
        names(&status(&client)["unreachable"]).len() == 40
    });
    let second = FakeNode::start("/second");
    within(SOON, "a registration and a notification", || {
        second.publish(&client, "/chatter", "std_msgs/String");
        eventually("the living subscriber knows the second publisher", || {
            living
                .updates("/chatter")
                .last()
                .is_some_and(|list| list.len() == 2)
        });
    });
    assert_eq!(living.received("shutdown").len(), 0);
    // Stopping does not wait for a name server either.
    let mut rescue = rescue;
    within(Duration::from_secs(5), "a stop", || rescue.terminate());
}

/// A name that does not exist now may exist later, so its node counts as unreachable and is kept.
#[test]
fn nodes_whose_host_names_do_not_exist_are_unreachable_and_delay_no_other_node() {
    const COUNT: usize = 20;
    let scratch = Scratch::new();
    let server = NameServer::of_hosts(&scratch);
    let port = free_port();
    let rescue = core(&server, &scratch, port);
    let client = rescue.client();
    let unresolvable: Vec<_> = (0..COUNT)
        .map(|i| FakeNode::start(&format!("/unresolvable{i}")).at_host(&format!("nobody{i}.test")))
        .collect();
    let living = FakeNode::start("/living");
    for node in unresolvable.iter().chain([&living]) {
        node.subscribe(&client, "/chatter", "std_msgs/String");
    }
    let dead = kill_master(&client);
    let publisher = FakeNode::start("/publisher");
    within(Duration::from_secs(4), "a registration", || {
        publisher.publish(&client, "/chatter", "std_msgs/String");
    });
    let all = vec![publisher.api.clone()];
    within(SOON, "a notification", || {
        eventually("the living subscriber is notified", || {
            living.updates("/chatter").last() == Some(&all)
        });
    });
    let report = report(&client, dead);
    assert_eq!(names(&report["removed"]), Vec::<String>::new());
    let mut unreachable: Vec<_> = unresolvable.iter().map(|node| node.name.clone()).collect();
    unreachable.sort();
    assert_eq!(names(&report["unreachable"]), unreachable);
    assert_eq!(names(&status(&client)["unreachable"]), unreachable);
    let state = State::read(&Client::new(port));
    assert_eq!(state.subscribers_of("/chatter").len(), COUNT + 1);

    // When a name begins to exist, its node gets all pending notifications.
    let found = &unresolvable[0];
    assert!(found.calls().is_empty(), "{:?}", found.calls());
    server.set("nobody0.test", Ipv4Addr::LOCALHOST);
    eventually("the node is found", || {
        found.updates("/chatter").last() == Some(&all)
    });
    eventually("only this node is reachable again", || {
        let unreachable = names(&status(&client)["unreachable"]);
        unreachable.len() == COUNT - 1 && !unreachable.contains(&found.name)
    });
    for node in unresolvable.iter().chain([&living]) {
        assert_eq!(node.received("shutdown").len(), 0);
    }
}

/// The host of a node gets another address, while the node's registered address stays the same text.
#[test]
fn a_node_is_found_again_when_its_host_name_gets_another_address() {
    let scratch = Scratch::new();
    let server = NameServer::of_hosts(&scratch);
    let master_port = free_port();
    let rescue = core(&server, &scratch, master_port);
    let client = rescue.client();
    let port = free_port();
    let host = |number: u8| Ipv4Addr::new(127, 0, 0, number);
    let start = |number| FakeNode::start_on("/mover", host(number), port).at_host("mover.test");
    let first = start(1);
    server.set("mover.test", host(1));
    first.subscribe(&client, "/chatter", "std_msgs/String");
    let kept = || {
        let state = State::read(&Client::new(master_port));
        state.subscribers_of("/chatter") == ["/mover"]
    };

    // The host moves during an outage. At the old address the port refuses, which would mean that the node is
    // dead.
    let second = start(2);
    second.claim_subscription("/chatter", Some("std_msgs/String"));
    server.set("mover.test", host(2));
    drop(first);
    let dead = kill_master(&client);
    let publisher = FakeNode::start("/publisher");
    publisher.publish(&client, "/chatter", "std_msgs/String");
    let recovered = report(&client, dead);
    assert_eq!(names(&recovered["removed"]), Vec::<String>::new());
    assert_eq!(names(&recovered["unreachable"]), Vec::<String>::new());
    let all = vec![publisher.api.clone()];
    eventually("the node is notified at the new address", || {
        second.updates("/chatter").last() == Some(&all)
    });
    let asked = second.calls().into_iter().any(|call| call.from_rosrescue);
    assert!(asked && kept());

    // The host moves while the node is unreachable.
    second.hold();
    let dead = kill_master(&client);
    assert_eq!(names(&report(&client, dead)["unreachable"]), ["/mover"]);
    let third = start(3);
    third.claim_subscription("/chatter", Some("std_msgs/String"));
    server.set("mover.test", host(3));
    eventually("the node is reachable again", || {
        names(&status(&client)["unreachable"]).is_empty()
    });
    eventually("the node gets all notifications at the new address", || {
        third.updates("/chatter").last() == Some(&all)
    });
    assert!(kept());
    assert!(holds(SOON, || third.received("shutdown").is_empty()));
}
