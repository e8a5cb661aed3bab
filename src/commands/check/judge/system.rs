//! Judges this computer and its ROS.

use super::{
    super::{
        facts::{CheckpointDisk, Clock, Port, SetupFacts},
        launch::Launches,
        ros::Responder,
        units::UnitKind,
    },
    Findings, named,
};
use crate::{clock, status::software};

/// Minimum free space, in bytes. A checkpoint and ROS's logs could soon use up less space than this.
const LITTLE_SPACE: u64 = 500 << 20;
const NO_SPACE: u64 = 20 << 20;
/// Minimum number of files that can still be created. Each start and each rescue creates some ten files: checkpoint,
/// reports and logs.
const FEW_INODES: u64 = 1000;
const NO_INODES: u64 = 10;
/// Minimum limit of open files. With a lower limit, client connections may be refused for lack of files.
const FEW_FILES: u64 = 4096;
const TOO_FEW_FILES: u64 = 256;
/// Minimum free memory, in bytes. rosmaster and rosrescue need some 40 MB.
const LITTLE_MEMORY: u64 = 200 << 20;
/// Maximum number of settings in launch files that are listed. More would hide the other findings.
const SETTINGS_MOST: usize = 10;
/// 2024-01-01, in seconds since 1970. A clock that shows an earlier time is wrong, because this program is younger.
const EARLIEST: f64 = 1_704_067_200.0;
/// A clock that is this many seconds behind existing files was set back.
const BEHIND_FILES: f64 = 120.0;
impl Findings {
    pub(super) fn disk(&mut self, disk: &CheckpointDisk, port: Option<&Port>) {
        const SUBJECT: &str = "checkpoint";
        let (path, folder) = (disk.checkpoint.display(), disk.folder.display());
        let runs = port.and_then(|port| port.taken.as_ref());
        let runs = runs.is_some_and(|taken| matches!(taken.server, Responder::Rosrescue { .. }));
        if let (Some(holder), false) = (disk.holder, runs) {
            let who = holder
                .pid
                .map_or_else(String::new, |pid| format!(", process {pid}"));
            return self.bad(
                SUBJECT,
                format!("{path} is in use by another rosrescue{who}"),
                "stop it, or use another --checkpoint here",
            );
        }
        if disk.is_folder {
            return self.bad(SUBJECT, format!("{path} is a folder"), "give a file in it");
        }
        let (free, is_read_only) = match &disk.space {
            Ok(space) => *space,
            Err(why) => return self.bad(SUBJECT, format!("{folder}: {why}"), "repair the disk"),
        };
        if is_read_only {
            let todo = "mount it writable, or choose another place with --checkpoint";
            return self.bad(SUBJECT, format!("{folder} is mounted read-only"), todo);
        }
        if let Some(why) = &disk.refused {
            let todo = format!(
                "chown it to the user of rosrescue, or choose another --checkpoint than {path}"
            );
            return self.bad(SUBJECT, format!("{folder} cannot be written: {why}"), todo);
        }
        if let Some(files) = disk.inodes.filter(|files| *files < FEW_INODES) {
            let what = format!("{folder}: {files} more files can be created (inodes, `df -i`)");
            let todo = "delete small files, such as old logs (rosclean purge)";
            return match files {
                ..NO_INODES => self.bad(SUBJECT, what, todo),
                _ => self.warn(SUBJECT, what, todo),
            };
        }
        let mib = free >> 20;
        let (of, source) = disk.mount.clone().unwrap_or_default();
        let what = format!("{path}: {mib} MiB free on {source} ({of})");
        let todo = "delete old logs (rosclean purge)";
        match free {
            ..NO_SPACE => self.bad(SUBJECT, what, todo),
            NO_SPACE..LITTLE_SPACE => self.warn(SUBJECT, what, todo),
            _ => self.ok(SUBJECT, what),
        }
        if of == "tmpfs" || of == "ramfs" {
            let todo = "a power cut loses it: choose a place on a disk";
            self.note(SUBJECT, format!("{folder} is in memory"), todo);
        } else if of.starts_with("nfs") || of == "cifs" || of.starts_with("fuse.sshfs") {
            let todo = "choose a disk of this computer: otherwise writes wait for the network";
            self.warn(
                SUBJECT,
                format!("{folder} is on another computer ({of})"),
                todo,
            );
        } else if source.starts_with("/dev/mmcblk") {
            let todo = "cards wear out and can stall for seconds. --sync never writes less, but a power cut loses more";
            self.note(
                SUBJECT,
                format!("{folder} is on an SD card or eMMC ({source})"),
                todo,
            );
        }
    }

    pub(super) fn files(&mut self, files: u64) {
        let what = format!("{files} open files at most");
        let todo = "raise it: `ulimit -Hn`, or LimitNOFILE= in the unit";
        match files {
            ..TOO_FEW_FILES => self.bad("descriptors", what, todo),
            TOO_FEW_FILES..FEW_FILES => self.warn("descriptors", what, todo),
            _ => self.ok("descriptors", what),
        }
    }

    pub(super) fn clock(&mut self, clock: &Clock) {
        let now = clock::wall_text(clock.now);
        if clock.now < EARLIEST {
            let todo =
                "set the clock, or wait for the network: tf drops all data when the clock jumps";
            self.bad("clock", format!("says {now}"), todo);
        } else if clock.now + BEHIND_FILES < clock.newest {
            let newest = clock::wall_text(clock.newest);
            let todo = "set the clock: otherwise logs and tf are wrong";
            self.warn(
                "clock",
                format!("says {now}, before files of {newest}"),
                todo,
            );
        } else if let Some(service) = &clock.service {
            self.ok("clock", format!("says {now}, set by {service}"));
        } else {
            self.note(
                "clock",
                format!("says {now}; no time service runs"),
                "fine for one computer. With several, tf needs chrony or systemd-timesyncd",
            );
        }
    }

    pub(super) fn ros(&mut self, facts: &SetupFacts) {
        match &facts.rosmaster {
            None => {}
            Some(Err(why)) => self.bad("rosmaster", why.clone(), "core needs it"),
            Some(Ok(program)) => {
                let path = program.path.display();
                let version = program.version.as_deref().unwrap_or("of unknown version");
                match &program.broken {
                    Some(why) => self.bad(
                        "rosmaster",
                        format!("{path} fails with {}: {why}", program.interpreter),
                        "remove conda, pyenv or the venv from the PATH (conda deactivate), and source \
                         ROS's setup.bash",
                    ),
                    None => {
                        let http = software::keeps_alive(version, &facts.kernel);
                        let http = http.map(|keeps| software::speaks(keeps, None));
                        let speaks = http.map(|http| format!(", {http}")).unwrap_or_default();
                        self.ok("rosmaster", format!("{path}, {version}{speaks}"));
                    }
                }
                if !facts.has_rosout {
                    let todo = "apt-get install rosout (ros-noetic-rosout), or --no-rosout";
                    self.warn("rosout", "is not installed: nothing collects /rosout", todo);
                }
            }
        }
        if let Some(python) = &facts.strange_python {
            self.warn(
                "python",
                format!("{} comes first on the PATH and has no ROS", python.display()),
                "nodes that begin with `#!/usr/bin/env python3` fail: conda deactivate, or put /usr/bin first",
            );
        }
        let Some((uri, server)) = &facts.proxied else {
            return;
        };
        match server {
            Responder::Master(_) => {
                let speaks = facts.proxied_speaks.as_deref();
                let speaks = speaks
                    .map(|speaks| format!(": {speaks}"))
                    .unwrap_or_default();
                self.ok("master", format!("{uri} answers{speaks}"));
            }
            Responder::Rosrescue { .. } => self.bad(
                "master",
                format!("--master {uri} is a rosrescue"),
                "give the address of the real rosmaster",
            ),
            Responder::Other => {
                let todo = "give the address of the real rosmaster";
                self.bad(
                    "master",
                    format!("what answers at {uri} is not a ROS master"),
                    todo,
                );
            }
            Responder::Nobody | Responder::Silent => self.warn(
                "master",
                format!("no answer from {uri}"),
                "start it: at its first start, proxy lets calls wait for a master",
            ),
        }
    }

    /// Reports masters beside rosrescue.
    pub(super) fn masters(&mut self, facts: &SetupFacts) {
        let port = facts.port.as_ref().ok().map(|port| port.number);
        let proxied = facts.proxied.as_ref().map(|(uri, _)| uri.port);
        let others = facts.masters.iter().filter(|process| {
            let at = |port: Option<u16>| port.is_some_and(|port| process.ports.contains(&port));
            // The finding about the port reports a master at `port`. A master at `proxied` is intended.
            !at(port) && !at(proxied)
        });
        let others: Vec<_> = others.map(named).collect();
        if !others.is_empty() {
            self.warn(
                "masters",
                format!("other masters run on this computer: {}", others.join(", ")),
                "stop those you do not need: their nodes do not see the nodes of rosrescue",
            );
        }
    }

    pub(super) fn systemd(&mut self, facts: &SetupFacts) {
        let mut own = 0;
        for unit in &facts.units {
            let name = &unit.name;
            match (unit.kind, unit.is_enabled) {
                (UnitKind::Rosrescue, true) => {
                    own += 1;
                    self.ok("systemd", format!("{name} starts at boot"));
                }
                (UnitKind::Rosrescue, false) => {
                    let todo = format!("systemctl enable {name}");
                    self.note("systemd", format!("{name} does not start at boot"), todo);
                }
                (UnitKind::Roscore, true) if facts.proxied.is_none() => {
                    let todo = format!("systemctl disable --now {name}");
                    let what = format!("{name} starts another master at boot");
                    self.bad("systemd", what, todo);
                }
                (UnitKind::Roslaunch, true) => self.warn(
                    "systemd",
                    format!("{name} runs roslaunch, which starts a master if it finds none"),
                    "add --wait to its roslaunch, and After=rosrescue.service to the unit",
                ),
                _ => {}
            }
        }
        if own == 0
            && facts
                .units
                .iter()
                .all(|unit| unit.kind != UnitKind::Rosrescue)
        {
            let todo = "`rosrescue install` adds one that starts at boot";
            self.note("systemd", "there is no rosrescue service", todo);
        }
    }

    /// Reports launch files that send nodes to another master.
    pub(super) fn launches(&mut self, launches: &Launches) {
        const SUBJECT: &str = "launch files";
        let count = launches.settings.len();
        for one in launches.settings.iter().take(SETTINGS_MOST) {
            self.warn(
                SUBJECT,
                format!("{}:{} sets ROS_MASTER_URI to {}", one.file.display(), one.line, one.uri),
                "remove this <env> if its nodes belong to this robot: they use that master, not rosrescue",
            );
        }
        if count > SETTINGS_MOST {
            let what = format!("{} more set ROS_MASTER_URI", count - SETTINGS_MOST);
            self.warn(SUBJECT, what, "fix the first ones, then check again");
        }
        let files = launches.files;
        if launches.is_cut {
            let todo = "check again with only the robot's own packages in ROS_PACKAGE_PATH";
            self.note(SUBJECT, format!("read {files}, and there are more"), todo);
        } else if count == 0 && files > 0 {
            self.ok(
                SUBJECT,
                format!("read {files}; none sets another ROS_MASTER_URI"),
            );
        }
    }

    pub(super) fn memory(&mut self, memory: Option<u64>) {
        let Some(free) = memory else { return };
        let what = format!("{} MiB are free", free >> 20);
        match free < LITTLE_MEMORY {
            true => self.warn(
                "memory",
                what,
                "stop something: the kernel kills a program when memory runs out",
            ),
            false => self.ok("memory", what),
        }
    }
}
