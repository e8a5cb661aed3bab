//! Names and addresses of computers.

use std::time::Duration;

use super::{
    super::super::{
        Severity::{Problem, Warning},
        facts::{Lease, SetupFacts},
    },
    host, nowhere, one, todo,
};

#[test]
fn names_that_lead_nowhere_or_elsewhere() {
    one(Problem, "host name", "robot has no address", |facts| {
        facts.own = nowhere("robot")
    });
    one(
        Problem,
        "host name",
        "robot is 10.0.0.9, which is not this computer",
        |facts| {
            facts.own = host("robot", "10.0.0.9", false);
        },
    );
    one(
        Warning,
        "host name",
        "robot is 127.0.1.1, which other computers cannot reach",
        |facts| {
            facts.own = host("robot", "127.0.1.1", true);
        },
    );
    one(Warning, "host name", "takes 4000 ms", |facts| {
        facts.own.took = Duration::from_secs(4);
    });
    one(
        Problem,
        "nodes",
        "/a, /b registered at arm, which has no address here",
        |facts| {
            let nodes = ["/a", "/b"].map(str::to_owned).to_vec();
            facts.node_hosts = vec![(nowhere("arm"), nodes)];
        },
    );
}

#[test]
fn each_advice_about_addresses_is_one_command() {
    let two = |facts: &mut SetupFacts| {
        facts.env.ip = Some("172.17.0.1 10.0.0.7 ".to_owned());
        facts.own = nowhere("172.17.0.1 10.0.0.7 ");
    };
    one(Problem, "ROS_IP", "is more than one address", two);
    assert_eq!(todo(two), "`export ROS_IP=10.0.0.7`");
    // A variable that comes first has to go.
    let wrong = |facts: &mut SetupFacts| {
        facts.env.hostname = Some("old".to_owned());
        facts.own = host("old", "10.0.0.9", false);
    };
    let findings_of = todo(wrong);
    assert!(
        findings_of
            .starts_with("`unset ROS_HOSTNAME; export ROS_IP=10.0.0.7` before anything starts"),
        "{findings_of}"
    );
    let unknown = |facts: &mut SetupFacts| {
        wrong(facts);
        facts.local = None;
    };
    assert!(todo(unknown).contains("ROS_IP=$(hostname -I | cut -d' ' -f1)`"));
    // An address is not looked for in /etc/hosts.
    let findings_of = todo(|facts| {
        facts.env.ip = Some("10.99.99.99".to_owned());
        facts.own = host("10.99.99.99", "10.99.99.99", false);
    });
    assert!(!findings_of.contains("/etc/hosts"), "{findings_of}");
    let findings_of = todo(|facts| facts.own.took = Duration::from_secs(4));
    assert!(
        findings_of.contains("`echo 10.0.0.7 robot | sudo tee -a /etc/hosts`"),
        "{findings_of}"
    );
}

#[test]
fn addresses_that_may_change_are_found() {
    one(
        Warning,
        "ROS_IP",
        "10.0.0.7 is a leased (DHCP) address (eth0)",
        |facts| {
            facts.env.ip = Some("10.0.0.7".to_owned());
            facts.own = host("10.0.0.7", "10.0.0.7", true);
            facts.lease = Some(Lease {
                address: "10.0.0.7".to_owned(),
                interface: "eth0".to_owned(),
                is_leased: true,
                is_wireless: false,
            });
        },
    );
    one(
        Warning,
        "host name",
        "robot is 10.0.0.7, an address of Wi-Fi (wlan0)",
        |facts| {
            facts.lease = Some(Lease {
                address: "10.0.0.7".to_owned(),
                interface: "wlan0".to_owned(),
                is_leased: false,
                is_wireless: true,
            });
        },
    );
}
