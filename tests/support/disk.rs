//! Disks that belong to one test.

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use super::process::{Process, behind};
use super::rescue::{Rescue, Setup};
use super::scratch::{Scratch, free_port};

/// A small disk that is visible only to commands that are run [on](Self::on) it.
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
        holder.wait_line("the disk is mounted", |line| line == "ready");
        Self { holder, folder }
    }

    /// Wraps `command` so that it sees the disk.
    pub(crate) fn on(&self, command: &Command) -> Command {
        let mut nsenter = Command::new("nsenter");
        nsenter.args(["--mount", "--target", &self.holder.pid().to_string()]);
        behind(nsenter, command)
    }

    /// The folder through which the test itself sees the disk.
    pub(crate) fn seen(&self) -> PathBuf {
        let root = PathBuf::from(format!("/proc/{}/root", self.holder.pid()));
        root.join(self.folder.strip_prefix("/").unwrap())
    }

    /// Fills the disk. Returns the file that takes the space.
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

    /// A core whose checkpoint and whose master's log are on this disk, as they are by default.
    pub(crate) fn rescue(&self, scratch: &Scratch) -> Rescue {
        Setup::core(scratch, free_port())
            .at_checkpoint(self.folder.join("latest-chkpt.yaml"))
            .env("ROS_LOG_DIR", &self.folder)
            .wrapped(|command| self.on(command))
            .start()
    }
}

/// A disk that misbehaves on request (`tests/failing/disk.c`), for the checkpoint of a rosrescue that runs
/// [on](Self::under) it.
pub(crate) struct FailingDisk {
    folder: PathBuf,
    state: PathBuf,
}

/// What goes wrong on a [`FailingDisk`].
#[derive(Clone, Copy, Debug)]
pub(crate) enum Trouble {
    /// No operation is answered until the trouble is over.
    Hangs,
    /// No file can be opened until the trouble is over.
    HangsOnOpen,
    /// No sync finishes until the trouble is over.
    HangsOnSync,
    /// No sync of a new checkpoint, which does not have its name yet, finishes until the trouble is over.
    HangsOnNewFile,
    /// Each operation takes 0.2 s.
    Slow,
    Full,
    ReadOnly,
}

/// The compiled `tests/failing/disk.c`. Another test program may use it already.
fn failing_disk() -> &'static Path {
    static LIBRARY: OnceLock<PathBuf> = OnceLock::new();
    LIBRARY.get_or_init(|| {
        let library = Path::new(env!("CARGO_TARGET_TMPDIR")).with_file_name("failing-disk.so");
        let half = library.with_extension(format!("half-{}", std::process::id()));
        let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/failing/disk.c");
        let mut compiler = Command::new("gcc");
        compiler.args(["-shared", "-fPIC", "-o"]);
        let compiled = compiler.arg(&half).arg(source).status();
        assert!(compiled.expect("gcc runs").success());
        fs::rename(half, &library).unwrap();
        library
    })
}

impl FailingDisk {
    pub(crate) fn new(scratch: &Scratch) -> Self {
        let state = scratch.path("disk.state");
        let folder = scratch.path("");
        Self { folder, state }
    }

    /// Runs `setup` with all files of its robot on this disk.
    pub(crate) fn under(&self, setup: Setup) -> Setup {
        setup
            .env("LD_PRELOAD", failing_disk())
            .env("DISK_PATH", &self.folder)
            .env("DISK_STATE", &self.state)
    }

    pub(crate) fn begin(&self, trouble: Trouble) {
        let letter = match trouble {
            Trouble::Hangs => "h",
            Trouble::HangsOnOpen => "o",
            Trouble::HangsOnSync => "y",
            Trouble::HangsOnNewFile => "n",
            Trouble::Slow => "s",
            Trouble::Full => "f",
            Trouble::ReadOnly => "r",
        };
        let half = self.state.with_extension("half");
        fs::write(&half, letter).unwrap();
        fs::rename(half, &self.state).unwrap();
    }

    /// Ends the trouble.
    pub(crate) fn heal(&self) {
        let _ = fs::remove_file(&self.state);
    }
}
