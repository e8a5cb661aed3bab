//! This computer loses an address and gets it back, as DHCP and Wi-Fi do.

use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

use crate::support::{FakeNode, Mode, Netns, Robot, eventually, names, page};

fn status(robot: &Robot) -> serde_json::Value {
    robot.status().unwrap_or_default()
}

/// DHCP has given the address to another computer, which refuses connections to the node's port.
#[test]
fn a_node_whose_lost_address_a_stranger_has_stays_registered() {
    let net = Netns::new();
    let mut robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let client = robot.client();
    let node = FakeNode::start_on("/here", net.near().parse().unwrap(), 0);
    node.subscribe(&client, "/topic", "std_msgs/String");
    let other = FakeNode::start("/other");
    other.publish(&client, "/topic", "std_msgs/String");
    eventually("both nodes are alive", || {
        status(&robot)["alive_nodes"] == 2
    });
    let before = robot.settled_state();
    let told = node.updates("/topic").len();
    net.give_near_away();
    eventually("the lost address is reported", || {
        names(&status(&robot)["lost_addresses"][0]["nodes"]) == ["/here"]
    });
    robot.crash_master();
    eventually("the health check has ended", || {
        status(&robot)["last_recovery"]["health_check_ms"].is_number()
    });
    before.assert_same(&robot.state(), "after the health check");
    net.take_near_back();
    eventually("the node is notified again", || {
        node.updates("/topic").len() > told
    });
}

#[test]
fn nodes_at_a_lost_address_are_reported_and_told_again_when_it_is_back() {
    let rounds = std::env::var("ROSRESCUE_ROUNDS").map_or(5, |rounds| rounds.parse().unwrap());
    let net = Netns::new();
    let robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let client = robot.client();
    let near: Ipv4Addr = net.near().parse().unwrap();
    let node = FakeNode::start_on("/here", near, 0);
    node.subscribe(&client, "/topic", "std_msgs/String");
    let other = FakeNode::start("/other");
    other.publish(&client, "/topic", "std_msgs/String");
    eventually("both nodes are alive", || {
        status(&robot)["alive_nodes"] == 2
    });
    assert_eq!(status(&robot)["lost_addresses"], serde_json::json!([]));

    let mut slowest = [Duration::ZERO; 2];
    for _ in 0..rounds {
        let before = node.updates("/topic").len();
        net.lose_near();
        let at = Instant::now();
        eventually("the lost address is reported", || {
            names(&status(&robot)["lost_addresses"][0]["nodes"]) == ["/here"]
        });
        slowest[0] = slowest[0].max(at.elapsed());
        let lost = status(&robot);
        assert_eq!(lost["lost_addresses"][0]["address"], near.to_string());
        let action = lost["condition"]["action"].as_str().unwrap();
        assert!(action.contains(&near.to_string()), "{action}");
        net.return_near();
        let at = Instant::now();
        eventually("the node is notified again", || {
            node.updates("/topic").len() > before
        });
        slowest[1] = slowest[1].max(at.elapsed());
        eventually("no address is lost", || {
            status(&robot)["lost_addresses"] == serde_json::json!([])
        });
    }
    println!(
        "{rounds} rounds: reported after {:?}, notified again after {:?} at most",
        slowest[0], slowest[1]
    );
    assert!(page(&client, "/metrics").contains("\nrosrescue_lost_addresses 0\n"));
    let output = robot.rescue.output().join("\n");
    for line in [
        "this computer has lost",
        "the address of these nodes is back",
    ] {
        assert!(output.contains(line), "{line}");
    }
}
