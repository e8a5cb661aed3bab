//! A disk of a test's own.

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::PathBuf;
use std::process::Command;

use super::process::{Process, behind};
use super::rescue::{Rescue, Setup};
use super::scratch::{Scratch, free_port};

/// A small disk that only those see who are run [on](Self::on) it.
pub(crate) struct SmallDisk {
    holder: Process,
    pub(crate) folder: PathBuf,
}

impl SmallDisk {
    pub(crate) fn new(scratch: &Scratch, size: &str) -> Self {
        const MOUNT: &str =
            r#"mount -t tmpfs -o size="$1" none "$0" && echo ready && exec tail -f /dev/null"#;
        let folder = scratch.path("disk");
        fs::create_dir(&folder).unwrap();
        let mut command = Command::new("unshare");
        command
            .args(["--mount", "sh", "-c", MOUNT])
            .arg(&folder)
            .arg(size);
        let mut holder = Process::start("a disk (mounts need root)", &mut command);
        holder.wait_line("that it is there", |line| line == "ready");
        Self { holder, folder }
    }

    /// `command`, run by somebody who sees the disk.
    pub(crate) fn on(&self, command: &Command) -> Command {
        let mut nsenter = Command::new("nsenter");
        nsenter.args(["--mount", "--target", &self.holder.pid().to_string()]);
        behind(nsenter, command)
    }

    /// The disk's folder, for us.
    pub(crate) fn seen(&self) -> PathBuf {
        let root = PathBuf::from(format!("/proc/{}/root", self.holder.pid()));
        root.join(self.folder.strip_prefix("/").unwrap())
    }

    /// Takes what is left of the disk.
    pub(crate) fn fill(&self) -> PathBuf {
        let path = self.seen().join("somebody-elses.log");
        let mut file = fs::File::create(&path).unwrap();
        let error = loop {
            if let Err(error) = file.write_all(&[b'x'; 4096]) {
                break error;
            }
        };
        assert_eq!(error.kind(), ErrorKind::StorageFull);
        path
    }

    pub(crate) fn remount(&self, how: &str) {
        let mut mount = Command::new("mount");
        mount.args(["-o", how]).arg(&self.folder);
        assert!(
            self.on(&mount).status().unwrap().success(),
            "mount -o {how}"
        );
    }

    pub(crate) fn rescue(&self, scratch: &Scratch) -> Rescue {
        Setup::core(scratch, free_port())
            .at_checkpoint(self.folder.join("latest-chkpt.yaml"))
            .wrapped(|command| self.on(command))
            .start()
    }
}
