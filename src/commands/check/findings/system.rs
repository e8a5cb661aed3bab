//! Judges this computer and its ROS.

use super::{
    super::{
        facts::{CheckpointDisk, Clock, Port, SetupFacts},
        launch::Launches,
        ros::Responder,
        units::UnitKind,
    },
    Findings, named,
    todo::delete_logs,
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
                match holder.pid {
                    Some(pid) => format!("stop it: `kill {pid}`, or use another --checkpoint here"),
                    None => format!("`fuser {path}` names the process"),
                },
            );
        }
        if disk.is_folder {
            let todo = format!("`rosrescue core --checkpoint {path}/latest-chkpt.yaml`");
            return self.bad(SUBJECT, format!("{path} is a folder"), todo);
        }
        let (free, is_read_only) = match &disk.space {
            Ok(space) => *space,
            Err(why) => {
                let todo = "`sudo dmesg | tail` shows what is wrong with the disk";
                return self.bad(SUBJECT, format!("{folder}: {why}"), todo);
            }
        };
        if is_read_only {
            let todo =
                format!("`sudo mount -o remount,rw $(df --output=target {folder} | tail -n 1)`");
            return self.bad(SUBJECT, format!("{folder} is mounted read-only"), todo);
        }
        if let Some(why) = &disk.refused {
            let todo = format!(
                "`sudo chown $(id -un) {folder}` as the user of rosrescue, or choose another --checkpoint than {path}"
            );
            return self.bad(SUBJECT, format!("{folder} cannot be written: {why}"), todo);
        }
        if let Some(files) = disk.inodes.filter(|files| *files < FEW_INODES) {
            let what = format!("{folder}: {files} more files can be created (inodes, `df -i`)");
            let todo = delete_logs();
            return match files {
                ..NO_INODES => self.bad(SUBJECT, what, todo),
                _ => self.warn(SUBJECT, what, todo),
            };
        }
        let mib = free >> 20;
        let (of, source) = disk.mount.clone().unwrap_or_default();
        let what = format!("{path}: {mib} MiB free on {source} ({of})");
        let todo = format!(
            "{}; `du -xh {folder} | sort -h | tail` shows what is large",
            delete_logs()
        );
        match free {
            ..NO_SPACE => self.bad(SUBJECT, what, todo),
            NO_SPACE..LITTLE_SPACE => self.warn(SUBJECT, what, todo),
            _ => self.ok(SUBJECT, what),
        }
        if of == "tmpfs" || of == "ramfs" {
            let todo = "a power cut loses it: choose a place on a disk with --checkpoint, as `df -h` shows";
            self.note(SUBJECT, format!("{folder} is in memory"), todo);
        } else if of.starts_with("nfs") || of == "cifs" || of.starts_with("fuse.sshfs") {
            let todo = "writes wait for the network: choose a disk of this computer with --checkpoint, as `df -h -l` \
                        shows";
            self.warn(
                SUBJECT,
                format!("{folder} is on another computer ({of})"),
                todo,
            );
        } else if source.starts_with("/dev/mmcblk") {
            let todo = "cards wear out and can stall for seconds. `rosrescue core --sync never` writes less, but a \
                        power cut loses more";
            self.note(
                SUBJECT,
                format!("{folder} is on an SD card or eMMC ({source})"),
                todo,
            );
        }
    }

    pub(super) fn files(&mut self, files: u64) {
        let what = format!("{files} open files at most");
        let todo = "`sudo prlimit --pid $$ --nofile=65536` raises it for this shell; `sudo systemctl edit rosrescue` \
                    for a service (LimitNOFILE=65536)";
        match files {
            ..TOO_FEW_FILES => self.bad("descriptors", what, todo),
            TOO_FEW_FILES..FEW_FILES => self.warn("descriptors", what, todo),
            _ => self.ok("descriptors", what),
        }
    }

    pub(super) fn clock(&mut self, clock: &Clock) {
        let now = clock::wall_text(clock.now);
        if clock.now < EARLIEST {
            let todo = "tf drops all data when the clock jumps: `sudo timedatectl set-ntp true`, or without a network \
                        `sudo date -s '2026-01-31 12:00'` with the right time";
            self.bad("clock", format!("says {now}"), todo);
        } else if clock.now + BEHIND_FILES < clock.newest {
            let newest = clock::wall_text(clock.newest);
            let todo = "logs and tf are wrong: `sudo timedatectl set-ntp true`, or without a network `sudo date -s \
                        '2026-01-31 12:00'` with the right time";
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
                "fine for one computer. With several, tf needs the same time: `sudo apt-get install chrony`",
            );
        }
    }

    pub(super) fn ros(&mut self, facts: &SetupFacts) {
        match &facts.rosmaster {
            None => {}
            Some(Err(why)) => self.bad(
                "rosmaster",
                why.clone(),
                "`sudo apt-get install python3-rosmaster` on Debian, `sudo apt-get install ros-noetic-rosmaster` with \
                 the packages of ros.org",
            ),
            Some(Ok(program)) => {
                let path = program.path.display();
                let version = program.version.as_deref().unwrap_or("of unknown version");
                match &program.broken {
                    Some(why) => self.bad(
                        "rosmaster",
                        format!("{path} fails with {}: {why}", program.interpreter),
                        "`conda deactivate` (or `deactivate` in a venv), then `source /opt/ros/*/setup.bash`",
                    ),
                    None => {
                        let http = software::keeps_alive(version, &facts.kernel);
                        let http = http.map(|keeps| software::speaks(keeps, None));
                        let speaks = http.map(|http| format!(", {http}")).unwrap_or_default();
                        self.ok("rosmaster", format!("{path}, {version}{speaks}"));
                    }
                }
                if !facts.has_rosout {
                    let todo = "`sudo apt-get install rosout` on Debian, `sudo apt-get install ros-noetic-rosout` with \
                                the packages of ros.org, or --no-rosout";
                    self.warn("rosout", "is not installed: nothing collects /rosout", todo);
                }
            }
        }
        if let Some(python) = &facts.strange_python {
            self.warn(
                "python",
                format!("{} comes first on the PATH and has no ROS", python.display()),
                "nodes that begin with #!/usr/bin/env python3 fail: `conda deactivate`, or `export PATH=/usr/bin:$PATH`",
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
            Responder::Rosrescue { proxied, .. } => {
                let todo = match proxied {
                    Some(real) => format!("`rosrescue check --master {real}`"),
                    None => "it has a master of its own: `rosrescue check` without --master".to_owned(),
                };
                self.bad("master", format!("--master {uri} is a rosrescue"), todo);
            }
            Responder::Other => {
                let todo = "give the address of the real rosmaster: `ss -ltnp | grep rosmaster` shows its port";
                self.bad(
                    "master",
                    format!("what answers at {uri} is not a ROS master"),
                    todo,
                );
            }
            Responder::Nobody | Responder::Silent => self.warn(
                "master",
                format!("no answer from {uri}"),
                format!(
                    "at its first start, proxy lets calls wait for a master: `rosmaster --core -p {}`",
                    uri.port
                ),
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
        let others: Vec<_> = others.collect();
        let pids: Vec<_> = others
            .iter()
            .map(|process| process.pid.to_string())
            .collect();
        let others: Vec<_> = others.into_iter().map(named).collect();
        if !others.is_empty() {
            self.warn(
                "masters",
                format!("other masters run on this computer: {}", others.join(", ")),
                format!(
                    "their nodes do not see the nodes of rosrescue. Stop those you do not need: `kill {}`",
                    pids.join(" ")
                ),
            );
        }
    }

    pub(super) fn systemd(&mut self, facts: &SetupFacts) {
        let mut own = 0;
        for unit in &facts.units {
            let name = &unit.name;
            let systemctl = match unit.is_users {
                true => "systemctl --user",
                false => "sudo systemctl",
            };
            match (unit.kind, unit.is_enabled) {
                (UnitKind::Rosrescue, true) => {
                    own += 1;
                    self.ok("systemd", format!("{name} starts at boot"));
                }
                (UnitKind::Rosrescue, false) => {
                    let todo = format!("`{systemctl} enable {name}`");
                    self.note("systemd", format!("{name} does not start at boot"), todo);
                }
                (UnitKind::Roscore, true) if facts.proxied.is_none() => {
                    let todo = format!("`{systemctl} disable --now {name}`");
                    let what = format!("{name} starts another master at boot");
                    self.bad("systemd", what, todo);
                }
                (UnitKind::Roslaunch, true) => self.warn(
                    "systemd",
                    format!("{name} runs roslaunch, which starts a master if it finds none"),
                    format!("add --wait to its roslaunch, and After=rosrescue.service: `{systemctl} edit --full {name}`"),
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
            let todo = "`sudo rosrescue install` adds one that starts at boot";
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
                format!(
                    "its nodes use that master, not rosrescue. If they belong to this robot, remove the <env>: `nano \
                     +{} {}`",
                    one.line,
                    one.file.display()
                ),
            );
        }
        if count > SETTINGS_MOST {
            let what = format!("{} more set ROS_MASTER_URI", count - SETTINGS_MOST);
            self.warn(
                SUBJECT,
                what,
                "fix the first ones, then run `rosrescue check` again",
            );
        }
        let files = launches.files;
        if launches.is_cut {
            let todo = "`ROS_PACKAGE_PATH=$HOME/catkin_ws/src rosrescue check` reads only the robot's own packages";
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
                "the kernel kills a program when memory runs out: `ps -eo rss,pid,comm --sort=-rss | head` shows what uses it",
            ),
            false => self.ok("memory", what),
        }
    }
}
