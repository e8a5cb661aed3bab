//! `--allow` and `--allow-write` decide which hosts may make calls and which may change anything, over IPv4 and IPv6.

use std::process::Command;

use crate::support::{
    Client, Library, Netns, Process, Scratch, Setup, eventually, free_port, status,
};

/// Prints the HTTP status of the answer to each of these requests.
const ASK: &str = r#"
import http.client, sys
from xmlrpc.client import dumps

def ask(method, body=None):
    master = http.client.HTTPConnection(sys.argv[1], int(sys.argv[2]), 60, (sys.argv[3], 0))
    master.request(method, "/", body, {"Content-Type": "text/xml"} if body else {})
    return master.getresponse().status

read = {"methodName": "getParam", "params": ["/far", "/here"]}
write = {"methodName": "setParam", "params": ["/far", "/there", 1]}
print(
    ask("GET"),
    *(ask("POST", dumps(tuple(call["params"]), call["methodName"])) for call in (read, write)),
    *(ask("POST", dumps((calls,), "system.multicall")) for calls in ([read], [read, write])),
    ask("POST", dumps(("/far",), "nonsense")),
    ask("POST", "<?xml version='1.0' encoding='cp1252'?><nonsense/>"),
)
"#;

const NOTHING: &str = "403 403 403 403 403 403 403";
const READS: &str = "200 200 403 200 403 403 403";
const ALL: &str = "200 200 200 200 200 200 200";

/// The statuses of the answers to the requests from `far`, an address of the other computer.
#[track_caller]
fn asked(scratch: &Scratch, net: &Netns, near: &str, port: u16, far: &str) -> String {
    let mut ask = Command::new("/usr/bin/python3");
    scratch.prepare(&mut ask);
    ask.args(["-c", ASK, near, &port.to_string(), far]);
    let output = net.inside(&ask).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

#[test]
fn allow_and_allow_write_decide_who_may_call_and_who_may_change() {
    let net = Netns::new();
    net.add_ipv6();
    let scratch = Scratch::new();
    // An IPv4 network may be written as IPv6, and a bare address counts as a network.
    let mut rescue = Setup::core(&scratch, free_port())
        .env("ROS_IP", net.near())
        .env(
            "ROSRESCUE_ALLOW_WRITE",
            format!("{},{}", net.far(3), net.far6(3)),
        )
        .args(["--allow", &format!("{}/32", net.far(2))])
        .args([
            "--allow",
            &format!("::ffff:{}/128,{}/128", net.far(4), net.far6(2)),
        ])
        .start();
    let port = rescue.port();
    // All requests from this computer are allowed, under each of its addresses.
    for host in [
        "127.0.0.1",
        "[::1]",
        &net.near(),
        &format!("[{}]", net.near6()),
    ] {
        Client::at(host, port).set_param("/here", host);
    }
    for (host, expected) in [(2, READS), (3, ALL), (4, READS), (5, NOTHING)] {
        let found = asked(&scratch, &net, &net.near(), port, &net.far(host));
        assert_eq!(found, expected, "{}", net.far(host));
    }
    for (host, expected) in [(2, READS), (3, ALL), (5, NOTHING)] {
        let found = asked(&scratch, &net, &net.near6(), port, &net.far6(host));
        assert_eq!(found, expected, "{}", net.far6(host));
    }
    assert_eq!(rescue.client().param("/there"), Some(1.into()));
    // One of the requests from hosts that may change anything is refused by another rule.
    let refused = 2 * 7 + 3 * 4 + 2;
    assert_eq!(
        status(&rescue.client())["counters"]["requests_refused"],
        refused
    );
    // There is one log line per address, however often it asks.
    rescue.wait_line("the log says who may change anything", |line| {
        line.contains("only these may change: this computer")
    });
    for host in [net.far(2), net.far(5), net.far6(2), net.far6(5)] {
        let refused = format!("refused: {host} may");
        rescue.wait_line("who is refused", |line| line.contains(&refused));
        let log = rescue.output();
        let lines = log.iter().filter(|line| line.contains(&refused));
        assert_eq!(lines.count(), 1, "{host}");
    }
}

/// A refusal delays a node but does no other harm.
#[test]
fn refused_nodes_continue_as_soon_as_they_are_allowed() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let port = free_port();
    let core = |allow: &str| {
        let arguments = [
            "core",
            "--no-rosout",
            "-p",
            &port.to_string(),
            "--allow",
            allow,
        ];
        let setup = Setup::bare(&scratch, arguments).at_port(port);
        setup.env("ROS_IP", net.near()).start()
    };
    let mut rescue = core("192.0.2.0/24");
    let nodes = [Library::Rospy, Library::Roscpp].map(|library| {
        let mut command = library.command(&scratch, port, "talker");
        // A second node of the same name would shut the first one down.
        command.arg(format!("__name:={library:?}"));
        command.env("ROS_MASTER_URI", Client::at(&net.near(), port).uri());
        command.env("ROS_IP", net.far(2));
        Process::start(format!("{library:?}"), &mut net.inside(&command))
    });
    let refused = |count: u64| {
        eventually("the nodes call again", || {
            let refused = status(&Client::new(port))["counters"]["requests_refused"].as_u64();
            refused.is_some_and(|refused| refused >= count)
        });
    };
    refused(50);
    rescue.kill();
    drop(rescue);
    let _rescue = core(&net.far(2));
    for mut node in nodes {
        node.wait_line("`sent`", |line| line.starts_with("sent "));
        assert_eq!(node.exited(), None);
    }
}

#[test]
fn a_malformed_network_is_a_usage_error() {
    let scratch = Scratch::new();
    for given in ["robot", "10.0.0.0/33", ""] {
        let setup = Setup::bare(&scratch, ["core", "--allow-write", given]);
        let mut rescue = setup.spawn();
        assert_eq!(rescue.wait_output().code(), Some(2), "{given}");
        let said = rescue.stderr().join("\n");
        assert!(said.contains("--allow-write"), "{said}");
        assert!(said.contains("as in 10.0.0.0/24"), "{said}");
    }
}
