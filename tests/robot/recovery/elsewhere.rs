//! Nodes of another computer that have registered under an address that means this computer here, such as `localhost`. With
//! a bare master they reach each other and receive what the robot publishes. Nothing at that address here proves
//! anything about them.

use std::net::ToSocketAddrs;
use std::process::Command;

use rustix::process::Signal;
use serde_json::Value as Json;

use crate::support::{
    Client, FakeNode, Library, Netns, Node, Scratch, Setup, State, eventually, free_port, names,
    params, signal, status,
};

/// Registers publishers from the other computer. Its arguments are the master's address, the node and the node's
/// address of each.
const REGISTER: &str = "
import sys, xmlrpc.client
for uri, node, api in zip(sys.argv[1::3], sys.argv[2::3], sys.argv[3::3]):
    assert xmlrpc.client.ServerProxy(uri).registerPublisher(node, node + '/t', 'std_msgs/String', api)[0] == 1
";

fn register(scratch: &Scratch, net: &Netns, publishers: &[[String; 3]]) {
    let mut command = Command::new("/usr/bin/python3");
    scratch.prepare(&mut command);
    command
        .args(["-c", REGISTER])
        .args(publishers.as_flattened());
    let output = net.inside(&command).output().unwrap();
    assert!(output.status.success(), "{output:?}");
}

/// Kills the master, and waits for the health check after the rescue.
fn rescue(client: &Client) {
    let dead = client.master_pid().expect("a master");
    signal(dead, Signal::KILL);
    eventually("the rescue and its health check are complete", || {
        let last = status(client)["last_recovery"].clone();
        last["master_pid"] != dead && last["health_check_ms"].is_number()
    });
}

/// The nodes that the status reports as misaddressed, each with the computer from which it has registered.
fn misaddressed(status: &Json) -> Vec<(String, String)> {
    let text = |of: &Json, key: &str| of[key].as_str().unwrap().to_owned();
    let nodes = status["misaddressed_nodes"].as_array().unwrap().iter();
    nodes
        .map(|of| (text(of, "node"), text(of, "from")))
        .collect()
}

#[test]
fn nodes_of_another_computer_that_are_registered_as_localhost_survive_rescues() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).env("ROS_IP", net.near());
    // After an orderly stop, only nodes that can be checked continue the session by themselves.
    let options = ["--no-rosout", "--reap", "all", "--restore", "always"];
    let mut robot = setup.args(options).start();
    let (client, port) = (robot.client(), robot.port());
    let nodes = [("talker", Library::Rospy), ("listener", Library::Roscpp)];
    let nodes = nodes.map(|(node, library)| {
        let mut command = library.command(&scratch, port, node);
        command
            .env_remove("ROS_IP")
            .env("ROS_HOSTNAME", "localhost")
            .env("ROS_MASTER_URI", format!("http://{}:{port}", net.near()));
        Node::run(&mut net.inside(&command))
    });
    nodes[1].wait_messages("/talker", 3);
    let from = net.far(2);
    let both = [("/listener", from.as_str()), ("/talker", &from)];
    let both = both.map(|(node, from)| (node.to_owned(), from.to_owned()));
    eventually("both nodes are named as misaddressed", || {
        misaddressed(&status(&client)) == both
    });
    let now = status(&client);
    assert_eq!(names(&now["unchecked_nodes"]), ["/listener", "/talker"]);
    let action = now["condition"]["action"].as_str().unwrap_or_default();
    assert!(
        action.contains(&format!("export ROS_IP={from}")),
        "{action}"
    );
    // A program of this computer has the port of the listener. It is another program.
    let state = State::read(&client);
    let listener = client.ok("lookupNode", params!["/test", "/listener"]);
    let listener_port = listener.as_str().unwrap().trim_end_matches('/');
    let listener_port: u16 = listener_port.rsplit(':').next().unwrap().parse().unwrap();
    let stranger = FakeNode::start_at("/stranger", listener_port).at_host("localhost");
    // The place of the origin is also known after a restart, from the journal and from a snapshot.
    for restart in ["none", "kill", "stop"] {
        match restart {
            "kill" => robot.kill(),
            "stop" => drop(robot.terminate()),
            _ => {}
        }
        if restart != "none" {
            robot.start_again();
            robot.wait_serving();
            eventually("both nodes are named again", || {
                misaddressed(&status(&client)) == both
            });
        }
        rescue(&client);
        state.assert_same(&State::read(&client), restart);
        let now = status(&client);
        for list in ["dead_nodes", "unreachable"] {
            assert_eq!(names(&now[list]), Vec::<String>::new(), "{list}, {restart}");
        }
    }
    // While the mirror stands in, rosrescue notifies nodes.
    let dead = client.master_pid().expect("a master");
    signal(dead, Signal::KILL);
    let publisher = FakeNode::start("/publisher");
    publisher.publish(&client, "/chatter", "std_msgs/String");
    eventually("there is another master", || {
        client.master_pid().is_some_and(|pid| pid != dead)
    });
    publisher.unpublish(&client, "/chatter");
    let told = stranger.calls().into_iter();
    let told: Vec<_> = told.filter(|call| call.from_rosrescue).collect();
    let update = told.iter().find(|call| call.method == "publisherUpdate");
    assert!(update.is_none(), "a stranger was notified: {update:?}");
    // The stranger registers at what looks like the same port. Neither of the two is gone.
    stranger.publish(&client, "/stranger", "std_msgs/String");
    rescue(&client);
    let now = State::read(&client);
    for node in ["/talker", "/listener", "/stranger"] {
        assert!(now.knows(node), "{node}");
    }
    assert_eq!(misaddressed(&status(&client)), both);
    nodes[1].wait_messages("/talker", 3);
}

#[test]
fn an_address_proves_something_only_if_it_leads_to_where_the_node_has_registered_from() {
    let net = Netns::new();
    net.add_ipv6();
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).env("ROS_IP", net.near());
    let robot = setup.arg("--no-rosout").start();
    let (client, port) = (robot.client(), robot.port());
    let system = rustix::system::uname();
    // Not every computer has its own name in /etc/hosts.
    let own = system.nodename().to_str().unwrap();
    let hostname = (own, 0).to_socket_addrs().map_or("localhost", |_| own);
    let uri = format!("http://{}:{port}", net.near());
    let uri6 = format!("http://[{}]:{port}", net.near6());
    // Nobody listens at any of these addresses.
    let kept = [
        ("/localhost", &uri, "localhost".to_owned()),
        ("/loopback", &uri, "127.0.0.1".to_owned()),
        ("/loopback6", &uri6, "[::1]".to_owned()),
        ("/localhost6", &uri6, "localhost".to_owned()),
        ("/same_host_name", &uri, hostname.to_owned()),
        ("/our_address", &uri, net.near()),
        ("/our_address6", &uri6, format!("[{}]", net.near6())),
        // Another computer may have this address here and there.
        ("/never_seen", &uri, net.far(9)),
    ];
    let dead_far = ("/dead_far", &uri, net.far(2));
    let publishers = kept.iter().chain([&dead_far]).map(|(node, uri, host)| {
        let api = format!("http://{host}:9/");
        [uri.to_string(), node.to_string(), api]
    });
    register(&scratch, &net, &publishers.collect::<Vec<_>>());
    // Registrations from this computer, under each of its addresses.
    for (node, host, at) in [
        ("/dead_here", net.near(), "localhost"),
        ("/dead_here6", format!("[{}]", net.near6()), hostname),
    ] {
        let api = format!("http://{at}:19/");
        let publisher = params![node, "/here", "std_msgs/String", api];
        Client::at(&host, port).ok("registerPublisher", publisher);
    }
    rescue(&client);
    let state = State::read(&client);
    for (node, ..) in &kept {
        assert!(state.knows(node), "{node}");
    }
    for node in ["/dead_far", "/dead_here", "/dead_here6"] {
        assert!(!state.knows(node), "{node}");
    }
    let mut expected: Vec<_> = kept.iter().map(|(node, ..)| *node).collect();
    expected.retain(|node| *node != "/never_seen");
    expected.sort_unstable();
    eventually("each node that nobody can reach is named", || {
        let now = status(&client);
        let found = misaddressed(&now);
        let found: Vec<_> = found.iter().map(|(node, _)| node.as_str()).collect();
        found == expected && names(&now["dead_nodes"]).is_empty()
    });
    assert_eq!(names(&status(&client)["unreachable"]), ["/never_seen"]);
}
