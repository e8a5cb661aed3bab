mod bypass;
mod computers;
mod names;
mod network;
mod port;
mod ros;
mod system;
mod variables;

use std::{path::PathBuf, time::Duration};

use super::{
    super::{
        Finding, Severity,
        facts::{CheckpointDisk, Clock, Environment, Host, Port, PortInUse, Process, SetupFacts},
        launch::Launches,
        ros::{Program, Responder},
        units::{Unit, UnitKind},
    },
    from_facts,
};

fn host(name: &str, address: &str, is_here: bool) -> Host {
    Host {
        name: name.to_owned(),
        addresses: Ok(vec![address.parse().unwrap()]),
        is_here,
        took: Duration::from_millis(1),
    }
}

fn nowhere(name: &str) -> Host {
    Host {
        addresses: Err("Name or service not known".to_owned()),
        ..host(name, "127.0.0.1", false)
    }
}

/// A robot without problems.
fn robot() -> SetupFacts {
    SetupFacts {
        version: "1.0.0",
        proxied: None,
        proxied_speaks: None,
        kernel: "6.1.0".to_owned(),
        env: Environment {
            master_uri: Some("http://robot:11311/".to_owned()),
            ..Environment::default()
        },
        port: Ok(Port {
            number: 11311,
            error: None,
            taken: None,
        }),
        own: host("robot", "10.0.0.7", true),
        master_host: Some(host("robot", "10.0.0.7", true)),
        elsewhere: None,
        elsewhere_host: None,
        node_hosts: Vec::new(),
        disk: CheckpointDisk {
            checkpoint: PathBuf::from("/home/r/.ros/log/latest-chkpt.yaml"),
            folder: PathBuf::from("/home/r/.ros/log"),
            is_folder_there: true,
            space: Ok((10 << 30, false)),
            inodes: Some(1 << 20),
            refused: None,
            mount: Some(("ext4".to_owned(), "/dev/sda1".to_owned())),
            holder: None,
            is_folder: false,
        },
        files: 1 << 20,
        clock: Clock {
            now: 1.8e9,
            newest: 1.7e9,
            service: Some("chronyd".to_owned()),
        },
        rosmaster: Some(Ok(Program {
            path: PathBuf::from("/usr/bin/rosmaster"),
            version: Some("1.15.15".to_owned()),
            interpreter: "/usr/bin/python3".to_owned(),
            broken: None,
        })),
        has_rosout: true,
        strange_python: None,
        units: vec![unit("rosrescue.service", UnitKind::Rosrescue, true)],
        launches: Launches::default(),
        memory: Some(4 << 30),
        strays: Vec::new(),
        lease: None,
        local: Some("10.0.0.7".parse().unwrap()),
        shell: Vec::new(),
        reached: Vec::new(),
        ports_of_nodes: "32768-60999".to_owned(),
        firewall: None,
        behind: None,
        masters: Vec::new(),
        cluster: None,
    }
}

fn unit(name: &str, kind: UnitKind, is_enabled: bool) -> Unit {
    Unit {
        name: name.to_owned(),
        kind,
        is_enabled,
        is_users: false,
    }
}

fn process(pid: u32, name: &str, port: u16) -> Process {
    Process {
        pid,
        name: name.to_owned(),
        ports: vec![port],
    }
}

fn taken(server: Responder) -> Option<PortInUse> {
    Some(PortInUse {
        by: vec![process(7, "who", 11311)],
        server,
    })
}

fn rosrescue() -> Responder {
    Responder::Rosrescue {
        version: "1.0.0".to_owned(),
        uri: "http://robot:11311/".to_owned(),
        proxied: None,
        bypassing: Vec::new(),
    }
}

fn port(facts: &mut SetupFacts) -> &mut Port {
    facts.port.as_mut().unwrap()
}

/// The warnings and problems that remain after `spoil` has broken one thing.
fn findings_of(spoil: impl FnOnce(&mut SetupFacts)) -> Vec<Finding> {
    let mut facts = robot();
    spoil(&mut facts);
    let mut found = from_facts(&facts);
    found.retain(|finding| finding.severity != Severity::Ok);
    found
}

/// Asserts that `spoil` causes exactly one finding, with these words and something to do.
#[track_caller]
fn one(severity: Severity, subject: &str, words: &str, spoil: impl FnOnce(&mut SetupFacts)) {
    let found = findings_of(spoil);
    let [finding] = found.as_slice() else {
        panic!("{found:?}");
    };
    assert_eq!(
        (finding.severity, finding.subject),
        (severity, subject),
        "{found:?}"
    );
    assert!(finding.what.contains(words), "{finding:?} lacks {words}");
    // The options of --cluster are explained elsewhere.
    if subject != "--cluster" {
        assert_has_a_command(finding);
    }
}

/// Asserts that the advice contains a command, and that a shell can read each of its commands.
#[track_caller]
fn assert_has_a_command(finding: &Finding) {
    const PROGRAMS: [&str; 30] = [
        "cat",
        "conda",
        "deactivate",
        "df",
        "du",
        "echo",
        "env",
        "export",
        "find",
        "fuser",
        "grep",
        "kill",
        "nano",
        "ping",
        "ps",
        "rosmaster",
        "rosnode",
        "rosrescue",
        "rosrun",
        "sed",
        "source",
        "ss",
        "sudo",
        "systemctl",
        "unset",
        "ROS_PACKAGE_PATH=$HOME/catkin_ws/src",
        "apt-get",
        "iptables",
        "ufw",
        "date",
    ];
    let commands: Vec<_> = finding.todo.split('`').skip(1).step_by(2).collect();
    assert!(!commands.is_empty(), "{finding:?}");
    for command in commands {
        let program = command.split_whitespace().next().unwrap_or_default();
        assert!(PROGRAMS.contains(&program), "{command}: {finding:?}");
        let shell = std::process::Command::new("bash")
            .args(["-n", "-c", command])
            .output();
        let shell = shell.unwrap();
        assert!(
            shell.status.success() && shell.stderr.is_empty(),
            "{command}: {shell:?}"
        );
    }
}

/// The todo of the only finding that `spoil` causes.
#[track_caller]
fn todo(spoil: impl FnOnce(&mut SetupFacts)) -> String {
    let found = findings_of(spoil);
    assert_eq!(found.len(), 1, "{found:?}");
    found[0].todo.clone()
}
