//! rosrescue itself, started like a user would.

use std::ffi::OsStr;
use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use rosrescue::guardian::handover::TUNABLES;

use super::patience::eventually;
use super::process::{Process, behind};
use super::ros::path_with_quick_rosversion;
use super::rpc::Client;
use super::scratch::{Scratch, free_port};

/// If this variable is set, rosrescue runs as a single process.
const NO_GUARDIAN: &str = "ROSRESCUE_NO_GUARDIAN";

/// The program to start: the one that was just built, unless another one has been set.
pub(crate) static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// How to start rosrescue. After a crash it can be started again in the same way.
#[derive(Debug)]
pub(crate) struct Setup {
    command: Command,
    pub(crate) port: u16,
    pub(crate) checkpoint: PathBuf,
}

impl Setup {
    /// `rosrescue` with `arguments` and only the environment of the scratch folder.
    pub(crate) fn bare<I: AsRef<OsStr>>(
        scratch: &Scratch,
        arguments: impl IntoIterator<Item = I>,
    ) -> Self {
        let own = || PathBuf::from(env!("CARGO_BIN_EXE_rosrescue"));
        let mut command = Command::new(PROGRAM.get_or_init(own));
        scratch.prepare(&mut command);
        command.args(arguments).current_dir(scratch.path(""));
        // Most tests signal and measure the worker, so it runs without a guardian. Its memory is managed as
        // under a guardian.
        let (name, value) = TUNABLES;
        command.env(NO_GUARDIAN, "1").env(name, value);
        // Benchmarks measure what users have.
        if cfg!(test) {
            command.env("PATH", path_with_quick_rosversion());
            // A master that was silent for a while is examined again, and the report of that takes the place of the
            // rescue's. Tests of masters that hang set a time themselves.
            command.env("ROSRESCUE_PROBE_TIMEOUT", "5000");
        }
        // On a busy computer any master is late from time to time. Tests about that set a time themselves.
        command.env("ROSRESCUE_STAND_IN_AFTER", "5000");
        Self {
            command,
            port: 0,
            checkpoint: scratch.log_dir().join("unknown"),
        }
    }

    /// `rosrescue core` on a free port, with its rosmaster on `master_port`.
    pub(crate) fn core(scratch: &Scratch, master_port: u16) -> Self {
        let port = free_port();
        let setup = Self::bare(scratch, ["core", "-p", &port.to_string()]);
        let setup = setup.at_port(port);
        setup.arg("--master-port").arg(master_port.to_string())
    }

    /// `rosrescue proxy` on a free port, in front of the master at `master_port`.
    pub(crate) fn proxy(scratch: &Scratch, master_port: u16) -> Self {
        let port = free_port();
        let master = format!("http://127.0.0.1:{master_port}");
        let listen = format!("127.0.0.1:{port}");
        Self::bare(scratch, ["proxy", "--master", &master, "--listen", &listen]).at_port(port)
    }

    pub(crate) fn arg(mut self, argument: impl AsRef<OsStr>) -> Self {
        self.command.arg(argument);
        self
    }

    pub(crate) fn args<I: AsRef<OsStr>>(mut self, arguments: impl IntoIterator<Item = I>) -> Self {
        self.command.args(arguments);
        self
    }

    pub(crate) fn env(mut self, key: &str, value: impl AsRef<OsStr>) -> Self {
        self.command.env(key, value);
        self
    }

    /// Replaces the command by the one that `wrap` makes from it.
    pub(crate) fn wrapped(mut self, wrap: impl FnOnce(&Command) -> Command) -> Self {
        self.command = wrap(&self.command);
        self
    }

    /// Runs rosrescue with its guardian, as users do. The started process is then the guardian.
    pub(crate) fn guarded(mut self) -> Self {
        self.command.env_remove(NO_GUARDIAN).env_remove(TUNABLES.0);
        self
    }

    pub(crate) fn at_port(mut self, port: u16) -> Self {
        self.port = port;
        self.checkpoint
            .set_file_name(format!("latest-chkpt-{port}.yaml"));
        self
    }

    pub(crate) fn at_checkpoint(mut self, checkpoint: PathBuf) -> Self {
        self.command.arg("--checkpoint").arg(&checkpoint);
        self.checkpoint = checkpoint;
        self
    }

    /// Makes the computer look as if it had booted with `boot_id`: a private mount shows it in place of the
    /// kernel's file.
    fn in_boot(&mut self, boot_id: &Path) {
        const SHOW: &str = r#"mount --bind "$0" /proc/sys/kernel/random/boot_id && exec "$@""#;
        let mut command = Command::new("unshare");
        if !rustix::process::geteuid().is_root() {
            command.arg("--map-root-user");
        }
        command.args(["--mount", "sh", "-c", SHOW]).arg(boot_id);
        self.command = behind(command, &self.command);
    }

    /// Starts rosrescue and waits until it serves calls with a living master.
    #[track_caller]
    pub(crate) fn start(self) -> Rescue {
        let mut rescue = self.spawn();
        rescue.wait_serving();
        rescue
    }

    /// Starts rosrescue without waiting.
    #[track_caller]
    pub(crate) fn spawn(mut self) -> Rescue {
        let process = Process::start("rosrescue", &mut self.command);
        Rescue {
            process,
            setup: self,
        }
    }
}

/// A running rosrescue. It is killed on drop; the processes that it has started end with the scratch folder.
#[derive(Debug)]
pub(crate) struct Rescue {
    process: Process,
    setup: Setup,
}

impl Rescue {
    pub(crate) fn port(&self) -> u16 {
        self.setup.port
    }

    pub(crate) fn checkpoint(&self) -> PathBuf {
        self.setup.checkpoint.clone()
    }

    pub(crate) fn client(&self) -> Client {
        Client::new(self.setup.port)
    }

    /// Waits until rosrescue has printed its address and reports that it protects a living master.
    #[track_caller]
    pub(crate) fn wait_serving(&mut self) {
        self.wait_line("its address", |line| {
            line.contains("ROS_MASTER_URI=http://")
        });
        self.wait_line("rosrescue prints the paper's message", |line| {
            line.contains("ROS Rescue enabled")
        });
    }

    /// Starts rosrescue again after it has ended, with the same arguments and without waiting.
    #[track_caller]
    pub(crate) fn start_again(&mut self) {
        let ended = self.process.exited();
        assert!(ended.is_some(), "rosrescue is still running");
        self.assert_no_panic();
        // A test that fails later shows what each process has said.
        self.process.show_end(ended);
        self.process = Process::start("rosrescue, again", &mut self.setup.command);
    }

    /// Starts rosrescue again without waiting, as after a reboot of its computer. `boot_id` is a file with the id of
    /// the new boot.
    #[track_caller]
    pub(crate) fn start_after_reboot(&mut self, boot_id: &Path) {
        self.setup.in_boot(boot_id);
        self.start_again();
    }

    #[track_caller]
    pub(crate) fn assert_no_panic(&self) {
        let panic = self
            .process
            .output()
            .into_iter()
            .find(|line| line.contains("panicked at"));
        assert!(panic.is_none(), "rosrescue panicked: {panic:?}");
    }
}

impl Drop for Rescue {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.assert_no_panic();
        }
    }
}

impl Deref for Rescue {
    type Target = Process;

    fn deref(&self) -> &Process {
        &self.process
    }
}

impl DerefMut for Rescue {
    fn deref_mut(&mut self) -> &mut Process {
        &mut self.process
    }
}
