//! Other computers, and robots as a whole.

use checkpoint_store::LockHolder;

use super::{
    super::super::{
        Severity::{Note, Problem, Warning},
        facts::SetupFacts,
        reach::{Outcome, Reached},
        ros::Responder,
    },
    findings_of, from_facts, host, nowhere, one, port, robot, rosrescue, taken, todo,
};
use crate::ros_env::MasterUri;

#[test]
fn a_robot_without_problems_has_no_findings() {
    assert_eq!(findings_of(|_| {}), []);
    assert!(from_facts(&robot()).len() >= 8);
    // There is no finding either while rosrescue runs, with its own master and its checkpoint in use.
    let found = findings_of(|facts| {
        port(facts).taken = taken(rosrescue());
        facts.disk.holder = Some(LockHolder { pid: Some(7) });
        facts.node_hosts = vec![(host("robot", "10.0.0.7", true), vec!["/a".to_owned()])];
    });
    assert_eq!(found, []);
}

#[test]
fn a_firewall_between_the_computers_is_found() {
    let base = |port, of: &str, outcome| Reached {
        address: MasterUri::parse(&format!("http://base:{port}")).unwrap(),
        of: of.to_owned(),
        from: Some("10.0.0.7".parse().unwrap()),
        outcome,
    };
    let blocked = |is_on| Outcome::Blocked { is_on };
    let far = |facts: &mut SetupFacts| {
        facts.node_hosts = vec![(host("base", "10.0.0.9", false), vec!["/a".to_owned()])];
    };
    let words = "base is on, but does not answer at 1 of 2 ports tried: 40001 (/a). A firewall";
    one(Problem, "network", words, |facts| {
        far(facts);
        facts.reached = vec![
            base(22, "/b", Outcome::Answered),
            base(40_001, "/a", blocked(false)),
        ];
    });
    let found = todo(|facts| {
        far(facts);
        facts.reached = vec![base(40_001, "/a", blocked(true))];
    });
    for words in [
        "TCP 32768-60999",
        "`sudo ufw allow from 10.0.0.7`",
        "iptables",
    ] {
        assert!(found.contains(words), "{found}");
    }
    let words = "base does not answer at 40001 (/a): it is off, out of reach, or behind a firewall";
    one(Warning, "network", words, |facts| {
        far(facts);
        facts.reached = vec![base(40_001, "/a", blocked(false))];
    });
    let answered = findings_of(|facts| {
        far(facts);
        facts.reached = vec![base(40_001, "/a", Outcome::Answered)];
    });
    assert_eq!(answered, []);
    one(
        Note,
        "network",
        "firewall (ufw) has to let in TCP 32768-60999",
        |facts| {
            far(facts);
            facts.firewall = Some("ufw");
        },
    );
    assert_eq!(findings_of(|facts| facts.firewall = Some("ufw")), []);
}

/// On a computer that only runs nodes, the check does not ask for what a master needs.
#[test]
fn another_computer_of_the_robot() {
    let elsewhere = |facts: &mut SetupFacts| {
        facts.env.master_uri = Some("http://base:11311/".to_owned());
        facts.master_host = Some(host("base", "10.0.0.9", false));
        facts.elsewhere = Some(rosrescue());
        facts.elsewhere_host = Some(host("base", "10.0.0.9", false));
        facts.rosmaster = Some(Err("there is no rosmaster on the PATH".to_owned()));
        facts.disk.refused = Some(("/data".into(), "denied".to_owned()));
        facts.units.clear();
    };
    assert_eq!(findings_of(elsewhere), []);
    one(
        Warning,
        "ROS_MASTER_URI",
        "calls itself robot, which has no address here",
        |facts| {
            elsewhere(facts);
            facts.elsewhere_host = Some(nowhere("robot"));
        },
    );
    one(
        Problem,
        "nodes",
        "/a registered at arm, which has no address here",
        |facts| {
            elsewhere(facts);
            facts.node_hosts = vec![(nowhere("arm"), vec!["/a".to_owned()])];
        },
    );
    one(
        Problem,
        "host name",
        "other computers cannot reach, but base is part of the robot",
        |facts| {
            elsewhere(facts);
            facts.own = host("arm", "127.0.1.1", true);
        },
    );
    one(
        Warning,
        "ROS_MASTER_URI",
        "a master without rosrescue",
        |facts| {
            elsewhere(facts);
            facts.elsewhere = Some(Responder::Master(None));
            facts.elsewhere_host = None;
        },
    );
    one(
        Problem,
        "ROS_MASTER_URI",
        "is another computer (10.0.0.9)",
        |facts| {
            elsewhere(facts);
            facts.elsewhere = Some(Responder::Nobody);
            facts.rosmaster = robot().rosmaster;
            facts.disk.refused = None;
            facts.units = robot().units;
        },
    );
}
