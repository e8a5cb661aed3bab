//! This computer and the ROS on it.

use std::path::PathBuf;

use checkpoint_store::LockHolder;

use super::{
    super::super::{
        Severity::{Note, Problem, Warning},
        facts::SetupFacts,
        launch::Setting,
        ros::Responder,
        units::UnitKind,
    },
    one, process, rosrescue, said, unit,
};
use crate::ros_env::MasterUri;

#[test]
fn where_the_checkpoint_goes() {
    let mount = |facts: &mut SetupFacts, of: &str, source: &str| {
        facts.disk.mount = Some((of.to_owned(), source.to_owned()));
    };
    one(
        Problem,
        "checkpoint",
        "in use by another rosrescue, process 9",
        |facts| {
            facts.disk.holder = Some(LockHolder { pid: Some(9) });
        },
    );
    one(Problem, "checkpoint", "is a folder", |facts| {
        facts.disk.is_folder = true
    });
    one(Problem, "checkpoint", "5 MiB free", |facts| {
        facts.disk.space = Ok((5 << 20, false))
    });
    one(Warning, "checkpoint", "50 MiB free", |facts| {
        facts.disk.space = Ok((50 << 20, false))
    });
    one(Problem, "checkpoint", "read-only", |facts| {
        facts.disk.space = Ok((1 << 40, true))
    });
    one(Problem, "checkpoint", "I/O error", |facts| {
        facts.disk.space = Err("I/O error".to_owned());
    });
    one(
        Problem,
        "checkpoint",
        "cannot be written: Permission denied",
        |facts| {
            facts.disk.refused = Some("Permission denied".to_owned());
        },
    );
    one(Note, "checkpoint", "is in memory", |facts| {
        mount(facts, "tmpfs", "tmpfs")
    });
    one(
        Warning,
        "checkpoint",
        "is on another computer (nfs4)",
        |facts| {
            mount(facts, "nfs4", "nas:/home");
        },
    );
    one(
        Note,
        "checkpoint",
        "is on an SD card or eMMC (/dev/mmcblk0p2)",
        |facts| {
            mount(facts, "ext4", "/dev/mmcblk0p2");
        },
    );
}

#[test]
fn what_the_computer_lacks() {
    one(Problem, "descriptors", "64 open files", |facts| {
        facts.files = 64
    });
    one(Warning, "descriptors", "1024 open files", |facts| {
        facts.files = 1024
    });
    one(Problem, "clock", "says 1970-01-01T00:01:00Z", |facts| {
        facts.clock.now = 60.0
    });
    one(Warning, "clock", "before files of", |facts| {
        facts.clock.newest = 1.9e9
    });
    one(Note, "clock", "no time service runs", |facts| {
        facts.clock.service = None
    });
    one(Warning, "memory", "100 MiB are free", |facts| {
        facts.memory = Some(100 << 20)
    });
    assert_eq!(said(|facts| facts.memory = None), []);
}

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
            .push(unit("roscore.service", UnitKind::Roscore, true));
    };
    assert_eq!(said(|facts| proxy(facts, Responder::Master(Some(9)))), []);
    one(Warning, "master", "no answer from", |facts| {
        proxy(facts, Responder::Nobody)
    });
    one(Problem, "master", "is not a ROS master", |facts| {
        proxy(facts, Responder::Other)
    });
    one(Problem, "master", "is a rosrescue", |facts| {
        proxy(facts, rosrescue(None))
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
        with(UnitKind::Roscore, true),
    );
    one(
        Warning,
        "systemd",
        "robot.service runs roslaunch",
        with(UnitKind::Roslaunch, true),
    );
    assert_eq!(said(with(UnitKind::Roscore, false)), []);
    one(Note, "systemd", "no rosrescue service", |facts| {
        facts.units.clear()
    });
    one(Note, "systemd", "does not start at boot", |facts| {
        facts.units[0].is_enabled = false;
    });
}

#[test]
fn a_file_system_without_inodes_takes_no_checkpoint() {
    one(
        Problem,
        "checkpoint",
        "0 more files can be created",
        |facts| {
            facts.disk.inodes = Some(0);
        },
    );
    one(
        Warning,
        "checkpoint",
        "500 more files can be created",
        |facts| {
            facts.disk.inodes = Some(500);
        },
    );
    assert_eq!(said(|facts| facts.disk.inodes = None), []);
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
    let found = said(|facts| facts.launches.settings = vec![setting.clone(); 30]);
    assert_eq!(found.len(), 11);
}
