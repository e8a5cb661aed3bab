//! Judges this computer: the disk of the checkpoint, files, memory, clock.

use super::{
    super::{
        facts::{CheckpointDisk, Clock, Port},
        ros::Responder,
    },
    Findings,
    todo::delete_logs,
};
use crate::clock;

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
/// 2024-01-01, in seconds since 1970. A clock that shows an earlier time is wrong, because this program is younger.
const EARLIEST: f64 = 1_704_067_200.0;
/// A clock that is this many seconds behind existing files was set back.
const BEHIND_FILES: f64 = 120.0;

impl Findings {
    pub(super) fn disk(&mut self, disk: &CheckpointDisk, port: Option<&Port>) {
        const SUBJECT: &str = "checkpoint";
        let (path, folder) = (disk.checkpoint.display(), disk.folder.display());
        let runs = port.and_then(|port| port.taken.as_ref());
        // One that does not answer is a finding about the port.
        let runs = runs.is_some_and(|taken| {
            matches!(
                taken.server,
                Responder::Rosrescue { .. } | Responder::Silent
            )
        });
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
            let todo = format!(
                "`sudo mount -o remount,rw $(df --output=target {folder} | tail -n 1)`. If it is intended, choose a \
                 --checkpoint, and a ROS_LOG_DIR for the nodes, on another disk"
            );
            return self.bad(SUBJECT, format!("{folder} is mounted read-only"), todo);
        }
        if let Some((refused, why)) = &disk.refused {
            let own = disk.checkpoint.parent().unwrap_or(&disk.folder).display();
            let command = match disk.is_folder_there {
                // The folder that refuses may belong to the system.
                false => format!("sudo install -d -o $(id -un) {own}"),
                // The files beside the checkpoint begin with its name.
                true if *refused == disk.checkpoint => format!("sudo chown $(id -un) {path}*"),
                true => format!("sudo chown $(id -un) {own}"),
            };
            let todo = format!(
                "`{command}` as the user of rosrescue, or choose another --checkpoint than {path}"
            );
            let what = format!("{} cannot be written: {why}", refused.display());
            return self.bad(SUBJECT, what, todo);
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
