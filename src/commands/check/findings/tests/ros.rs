//! The installed ROS, units and launch files.

use std::path::PathBuf;

use super::{
    super::super::{
        Severity::{Note, Problem, Warning},
        facts::SetupFacts,
        launch::Setting,
        ros::Responder,
        units::UnitKind,
    },
    findings_of, one, process, rosrescue, unit,
};
use crate::ros_env::MasterUri;

#[test]
fn the_ros_that_is_installed() {
    one(
        Problem,
        "rosmaster",
        "there is no rosmaster on the PATH",
        |facts| {
            facts.rosmaster = Some(Err("there is no rosmaster on the PATH".to_owned()));
        },
    );
    one(
        Problem,
        "rosmaster",
        "fails with /usr/bin/python3: No module",
        |facts| {
            if let Some(Ok(program)) = &mut facts.rosmaster {
                program.broken = Some("No module".to_owned());
            }
        },
    );
    one(Warning, "rosout", "is not installed", |facts| {
        facts.has_rosout = false
    });
    one(
        Warning,
        "python",
        "/opt/conda/bin/python3 comes first",
        |facts| {
            facts.strange_python = Some(PathBuf::from("/opt/conda/bin/python3"));
        },
    );
}

#[test]
fn the_master_of_a_proxy() {
    let proxy = |facts: &mut SetupFacts, server| {
        facts.rosmaster = None;
        facts.proxied = Some((MasterUri::parse("http://robot:11411").unwrap(), server));
        facts.masters = vec![process(9, "rosmaster", 11411)];
        // A master at that address is intended.
        facts
            .units
            .push(unit("roscore.service", UnitKind::Roscore(11311), true));
    };
    assert_eq!(
        findings_of(|facts| proxy(facts, Responder::Master(Some(9)))),
        []
    );
    one(Warning, "master", "no answer from", |facts| {
        proxy(facts, Responder::Nobody)
    });
    one(Problem, "master", "is not a ROS master", |facts| {
        proxy(facts, Responder::Other)
    });
    one(Problem, "master", "is a rosrescue", |facts| {
        proxy(facts, rosrescue())
    });
}

#[test]
fn units_of_systemd() {
    let with = |kind, is_enabled| {
        move |facts: &mut SetupFacts| facts.units.push(unit("robot.service", kind, is_enabled))
    };
    one(
        Problem,
        "systemd",
        "robot.service starts another master",
        with(UnitKind::Roscore(11311), true),
    );
    one(
        Problem,
        "systemd",
        "robot.service starts another master at boot, and nodes",
        with(UnitKind::RoscoreAndNodes(11311), true),
    );
    one(
        Warning,
        "systemd",
        "robot.service runs roslaunch",
        with(UnitKind::Roslaunch, true),
    );
    for (kind, is_enabled) in [
        (UnitKind::Roscore(11311), false),
        (UnitKind::Roscore(11411), true),
        (UnitKind::RoscoreAndNodes(11411), true),
    ] {
        assert_eq!(findings_of(with(kind, is_enabled)), []);
    }
    one(Note, "systemd", "no rosrescue service", |facts| {
        facts.units.clear()
    });
    one(Note, "systemd", "does not start at boot", |facts| {
        facts.units[0].is_enabled = false;
    });
}

#[test]
fn a_launch_file_with_a_master_of_its_own_is_said_with_its_line() {
    let setting = Setting {
        file: PathBuf::from("/ws/src/arm/arm.launch"),
        line: 7,
        uri: "http://arm:11311".to_owned(),
    };
    let words = "/ws/src/arm/arm.launch:7 sets ROS_MASTER_URI to http://arm:11311";
    one(Warning, "launch files", words, |facts| {
        facts.launches.settings = vec![setting.clone()];
    });
    one(Note, "launch files", "there are more", |facts| {
        facts.launches.is_cut = true;
    });
    let found = findings_of(|facts| facts.launches.settings = vec![setting.clone(); 30]);
    assert_eq!(found.len(), 11);
}
