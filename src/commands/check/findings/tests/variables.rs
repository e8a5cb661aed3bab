//! ROS's environment variables and the files of the shell.

use std::{fs, process::Command};

use super::{
    super::super::{
        Severity::{Note, Problem, Warning},
        facts::SetupFacts,
        shell::{ShellSetting, settings},
    },
    findings_of, host, nowhere, one, todo,
};
use crate::ros_env::MasterUri;

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
    let alone = findings_of(|facts| {
        ip(facts, "127.0.0.1");
        facts.own = host("127.0.0.1", "127.0.0.1", true);
    });
    assert_eq!(alone.len(), 1, "{alone:?}");
    assert_eq!((alone[0].severity, alone[0].subject), (Note, "ROS_IP"));
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
    assert_eq!(findings_of(|facts| facts.shell = vec![same]), []);
    // This shell has the wrong address from that file.
    let findings_of = todo(|facts| {
        facts.env.ip = Some("10.0.0.9".to_owned());
        facts.own = host("10.0.0.9", "10.0.0.9", false);
        facts.shell = vec![setting("ROS_IP", "10.0.0.9")];
    });
    assert!(
        findings_of.ends_with("`sed -i '120s/^/#/' /home/r/.bashrc`"),
        "{findings_of}"
    );
}

#[test]
fn all_advice_for_one_file_can_be_followed() {
    let home = tempfile::tempdir().unwrap();
    let file = home.path().join(".bashrc");
    let lines = "export ROS_MASTER_URI=http://10.0.0.9:11311\nexport ROS_IP=10.0.0.9\n";
    fs::write(&file, format!("{lines}source devel/setup.bash\n")).unwrap();
    let found = findings_of(|facts| {
        facts.env.master_uri = Some("http://10.0.0.9:11311".to_owned());
        facts.master_host = Some(host("10.0.0.9", "10.0.0.9", false));
        facts.env.ip = Some("10.0.0.9".to_owned());
        facts.own = host("10.0.0.9", "10.0.0.9", false);
        facts.shell = settings(home.path(), "/bin/bash");
    });
    let commands = found.iter().flat_map(|finding| finding.todo.split('`'));
    let commands: Vec<_> = commands.filter(|it| it.starts_with("sed ")).collect();
    assert_eq!(commands.len(), 2, "{found:?}");
    for command in commands {
        let status = Command::new("bash").args(["-c", command]).status();
        assert!(status.unwrap().success(), "{command}");
    }
    let lines = lines.replace("export", "#export");
    assert_eq!(
        fs::read_to_string(&file).unwrap(),
        format!("{lines}source devel/setup.bash\n")
    );
    assert_eq!(settings(home.path(), "/bin/bash"), []);
}

#[test]
fn a_uri_without_a_port_is_found() {
    let port = "has no port: roscpp nodes do not start";
    one(Problem, "ROS_MASTER_URI", port, |facts| {
        facts.env.master_uri = Some("http://robot".to_owned());
    });
}
