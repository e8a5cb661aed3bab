//! The addresses of `core`: every address of its computer, over IPv4 and IPv6, also from other computers. Its rosmaster
//! is only at loopback.

use std::io::ErrorKind;
use std::net::TcpStream;
use std::process::Command;

use crate::support::{Client, Netns, Scratch, Setup, free_port};

/// A program that sets a parameter from another computer.
const FROM_AFAR: &str = "
import sys, xmlrpc.client
master = xmlrpc.client.ServerProxy(sys.argv[1])
assert master.setParam('/far', '/from', 'afar')[0] == 1
";

#[test]
fn core_is_reached_at_every_address_and_its_master_at_loopback_only() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let master_port = free_port();
    // No variable limits `core` to loopback. (rosout would look up this computer's name.)
    let rescue = Setup::core(&scratch, master_port)
        .arg("--no-rosout")
        .env("ROS_IP", "")
        .start();
    let behind = Client::new(master_port);
    let near = net.near();
    for host in ["127.0.0.1", "[::1]", &near] {
        Client::at(host, rescue.port()).set_param("/from", host);
        assert_eq!(behind.param("/from"), Some(host.into()));
    }
    let mut far = Command::new("/usr/bin/python3");
    scratch.prepare(&mut far);
    far.args(["-c", FROM_AFAR]);
    far.arg(Client::at(&near, rescue.port()).uri());
    let output = net.inside(&far).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    assert_eq!(behind.param("/from"), Some("afar".into()));

    for address in [near.as_str(), "::1"] {
        let refused = TcpStream::connect((address, master_port)).map_err(|error| error.kind());
        assert_eq!(
            refused.unwrap_err(),
            ErrorKind::ConnectionRefused,
            "{address}"
        );
    }
}

/// `core` reads the variables for the computer's own address in the same way as ROS.
#[test]
fn core_listens_at_loopback_only_if_ros_variables_say_so() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let said = [("ROS_IP", "127.0.0.1"), ("ROS_HOSTNAME", "localhost")];
    for (variable, address) in said {
        let rescue = Setup::core(&scratch, free_port())
            .args(["--no-rosout", "--restore", "never"])
            .env(variable, address)
            .start();
        for host in ["127.0.0.1", "[::1]"] {
            Client::at(host, rescue.port()).set_param("/from", host);
        }
        let refused = TcpStream::connect((net.near(), rescue.port()));
        assert_eq!(
            refused.map_err(|error| error.kind()).unwrap_err(),
            ErrorKind::ConnectionRefused
        );
        let uri = rescue.client().ok("getUri", vec!["/c".into()]);
        assert_eq!(uri, Client::at(address, rescue.port()).uri().into());
    }
}
