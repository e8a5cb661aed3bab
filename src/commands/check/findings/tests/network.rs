//! Port, addresses and names.

use std::time::Duration;

use checkpoint_store::LockHolder;

use super::{
    super::super::{
        Severity::{Note, Problem, Warning},
        facts::{Lease, PortInUse, SetupFacts, UpstreamMaster},
        reach::{Outcome, Reached},
        ros::Responder,
        shell::ShellSetting,
    },
    from_facts, host, nowhere, one, port, process, robot, rosrescue, said, taken,
};
use crate::ros_env::MasterUri;

#[test]
fn a_robot_without_problems_has_no_findings() {
    assert_eq!(said(|_| {}), []);
    assert!(from_facts(&robot()).len() >= 8);
    // There is no finding either while rosrescue runs, with its own master and its checkpoint in use.
    let found = said(|facts| {
        port(facts).taken = taken(rosrescue(None));
        facts.disk.holder = Some(LockHolder { pid: Some(7) });
        facts.node_hosts = vec![(host("robot", "10.0.0.7", true), vec!["/a".to_owned()])];
    });
    assert_eq!(found, []);
}

#[test]
fn who_has_the_port() {
    one(
        Problem,
        "port",
        "a master without rosrescue: who (process 7, port 11311)",
        |facts| {
            port(facts).taken = taken(Responder::Master(Some(7)));
            facts.masters = vec![process(7, "rosmaster", 11311)];
        },
    );
    one(Problem, "port", "a program that is not a master", |facts| {
        port(facts).taken = taken(Responder::Other);
    });
    one(
        Problem,
        "port",
        "a process that only root can see",
        |facts| {
            port(facts).taken = Some(PortInUse {
                by: Vec::new(),
                server: Responder::Silent,
            });
        },
    );
    one(Problem, "port", "cannot listen at 11311: denied", |facts| {
        port(facts).error = Some("denied".to_owned());
    });
    one(
        Note,
        "port",
        "the running rosrescue is 1.0.0, this program is 2.0.0",
        |facts| {
            port(facts).taken = taken(rosrescue(None));
            facts.version = "2.0.0";
        },
    );
    one(
        Problem,
        "checkpoint",
        "unprotected: the disk is full",
        |facts| {
            port(facts).taken = taken(rosrescue(Some("the disk is full")));
        },
    );
    one(
        Warning,
        "masters",
        "rosmaster (process 9, port 12000)",
        |facts| {
            facts.masters = vec![process(9, "rosmaster", 12000)];
        },
    );
}

#[test]
fn traps_of_ros_master_uri() {
    let uri = |facts: &mut SetupFacts, uri: &str| facts.env.master_uri = Some(uri.to_owned());
    one(Warning, "ROS_MASTER_URI", "is not set", |facts| {
        facts.env.master_uri = None;
        facts.master_host = None;
    });
    one(
        Problem,
        "ROS_MASTER_URI",
        "is not the URI of a master",
        |facts| {
            uri(facts, "robot:11311");
            facts.port = Err(MasterUri::parse("robot:11311").unwrap_err());
            facts.master_host = None;
        },
    );
    one(Problem, "ROS_MASTER_URI", "ends with a space", |facts| {
        uri(facts, "http://robot:11311/ ")
    });
    one(Problem, "ROS_MASTER_URI", "base has no address", |facts| {
        uri(facts, "http://base:11311/");
        facts.master_host = Some(nowhere("base"));
    });
    one(
        Problem,
        "ROS_MASTER_URI",
        "is another computer (10.0.0.9)",
        |facts| {
            uri(facts, "http://base:11311/");
            facts.master_host = Some(host("base", "10.0.0.9", false));
        },
    );
    one(
        Problem,
        "ROS_MASTER_URI",
        "has port 11312, but rosrescue would use 11311",
        |facts| {
            uri(facts, "http://robot:11312/");
        },
    );
}

#[test]
fn traps_of_ros_ip_and_ros_hostname() {
    let ip = |facts: &mut SetupFacts, ip: &str| facts.env.ip = Some(ip.to_owned());
    one(Problem, "ROS_IP", "`10.0.0.7 ` begins or ends", |facts| {
        ip(facts, "10.0.0.7 ");
        facts.own = nowhere("10.0.0.7 ");
    });
    one(
        Problem,
        "ROS_HOSTNAME",
        "`http://robot` is not a host name",
        |facts| {
            facts.env.hostname = Some("http://robot".to_owned());
        },
    );
    one(Warning, "ROS_IP", "`robot` is not an address", |facts| {
        ip(facts, "robot")
    });
    one(
        Warning,
        "ROS_IP",
        "10.0.0.8 is ignored: ROS_HOSTNAME=robot",
        |facts| {
            ip(facts, "10.0.0.8");
            facts.env.hostname = Some("robot".to_owned());
        },
    );
    one(
        Problem,
        "ROS_IP",
        "10.0.0.8, which is not this computer",
        |facts| {
            ip(facts, "10.0.0.8");
            facts.own = host("10.0.0.8", "10.0.0.8", false);
        },
    );
    one(
        Problem,
        "ROS_IP",
        "127.0.0.1, which other computers cannot reach, but base is part of the robot",
        |facts| {
            ip(facts, "127.0.0.1");
            facts.own = host("127.0.0.1", "127.0.0.1", true);
            facts.node_hosts = vec![(host("base", "10.0.0.9", false), vec!["/a".to_owned()])];
        },
    );
    let alone = said(|facts| {
        ip(facts, "127.0.0.1");
        facts.own = host("127.0.0.1", "127.0.0.1", true);
    });
    assert_eq!(alone.len(), 1, "{alone:?}");
    assert_eq!((alone[0].severity, alone[0].subject), (Note, "ROS_IP"));
}

/// The todo of the only finding that `spoil` causes.
#[track_caller]
fn todo(spoil: impl FnOnce(&mut SetupFacts)) -> String {
    let found = said(spoil);
    assert_eq!(found.len(), 1, "{found:?}");
    found[0].todo.clone()
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
    let said = todo(wrong);
    assert!(
        said.starts_with("`unset ROS_HOSTNAME; export ROS_IP=10.0.0.7` before anything starts"),
        "{said}"
    );
    let unknown = |facts: &mut SetupFacts| {
        wrong(facts);
        facts.local = None;
    };
    assert!(todo(unknown).contains("ROS_IP=$(hostname -I | cut -d' ' -f1)`"));
    // An address is not looked for in /etc/hosts.
    let said = todo(|facts| {
        facts.env.ip = Some("10.99.99.99".to_owned());
        facts.own = host("10.99.99.99", "10.99.99.99", false);
    });
    assert!(!said.contains("/etc/hosts"), "{said}");
    let said = todo(|facts| facts.own.took = Duration::from_secs(4));
    assert!(
        said.contains("`echo 10.0.0.7 robot | sudo tee -a /etc/hosts`"),
        "{said}"
    );
}

#[test]
fn a_stale_file_of_the_shell_is_found() {
    let setting = |variable, value: &str| ShellSetting {
        file: "/home/r/.bashrc".into(),
        line: 120,
        variable,
        value: value.to_owned(),
    };
    one(
        Warning,
        "ROS_MASTER_URI",
        "is http://robot:11311/ here, but /home/r/.bashrc:120 sets http://old:11311 in every new shell",
        |facts| facts.shell = vec![setting("ROS_MASTER_URI", "http://old:11311")],
    );
    one(
        Warning,
        "ROS_IP",
        "is not set here, but /home/r/.bashrc:120 sets 10.0.0.9",
        |facts| facts.shell = vec![setting("ROS_IP", "10.0.0.9")],
    );
    let same = setting("ROS_MASTER_URI", "http://robot:11311/");
    assert_eq!(said(|facts| facts.shell = vec![same]), []);
    // This shell has the wrong address from that file.
    let said = todo(|facts| {
        facts.env.ip = Some("10.0.0.9".to_owned());
        facts.own = host("10.0.0.9", "10.0.0.9", false);
        facts.shell = vec![setting("ROS_IP", "10.0.0.9")];
    });
    assert!(said.ends_with("`sed -i 120d /home/r/.bashrc`"), "{said}");
}

#[test]
fn a_uri_without_a_port_is_found() {
    let port = "has no port: roscpp nodes do not start";
    one(Problem, "ROS_MASTER_URI", port, |facts| {
        facts.env.master_uri = Some("http://robot".to_owned());
    });
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
    let answered = said(|facts| {
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
    assert_eq!(said(|facts| facts.firewall = Some("ufw")), []);
}

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

/// On a computer that only runs nodes, the check does not ask for what a master needs.
#[test]
fn another_computer_of_the_robot() {
    let elsewhere = |facts: &mut SetupFacts| {
        facts.env.master_uri = Some("http://base:11311/".to_owned());
        facts.master_host = Some(host("base", "10.0.0.9", false));
        facts.elsewhere = Some(rosrescue(None));
        facts.elsewhere_host = Some(host("base", "10.0.0.9", false));
        facts.rosmaster = Some(Err("there is no rosmaster on the PATH".to_owned()));
        facts.disk.refused = Some("denied".to_owned());
        facts.units.clear();
    };
    assert_eq!(said(elsewhere), []);
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

#[test]
fn addresses_that_may_change_and_nodes_of_another_master() {
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
    one(
        Warning,
        "ROS_MASTER_URI",
        "48 processes were started with ROS_MASTER_URI=http://other:11311: node (process 1, port 40001), ",
        |facts| {
            facts.strays = (1..49)
                .map(|number| {
                    let process = process(number, "node", 40_000 + u16::try_from(number).unwrap());
                    (process, "http://other:11311".to_owned())
                })
                .collect();
        },
    );
    one(
        Warning,
        "ROS_MASTER_URI",
        "camera (process 9, port 40000) was started with ROS_MASTER_URI=http://other:11311",
        |facts| {
            facts.strays = vec![(
                process(9, "camera", 40_000),
                "http://other:11311".to_owned(),
            )];
        },
    );
}

#[test]
fn clients_that_bypass_rosrescue_are_reported() {
    let behind = |bypassing: &[&str], is_open| {
        Some(UpstreamMaster {
            uri: MasterUri::parse("http://robot:11312").unwrap(),
            bypassing: bypassing.iter().map(|&who| who.to_owned()).collect(),
            is_open,
        })
    };
    one(
        Warning,
        "unprotected",
        "rosout (process 9) talks directly to the master at http://robot:11312/",
        |facts| facts.behind = behind(&["rosout (process 9)"], false),
    );
    one(
        Warning,
        "unprotected",
        "accepts connections from other computers",
        |facts| facts.behind = behind(&[], true),
    );
    one(
        Warning,
        "unprotected",
        "camera (process 9, port 40000) was started with ROS_MASTER_URI=http://localhost:11312, the master behind",
        |facts| {
            facts.behind = behind(&[], false);
            facts.strays = vec![(
                process(9, "camera", 40_000),
                "http://localhost:11312".to_owned(),
            )];
        },
    );
}
