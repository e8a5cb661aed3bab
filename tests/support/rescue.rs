//! rosrescue itself, as a person starts it.

use std::ffi::OsStr;
use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use rosrescue::guardian::handover::TUNABLES;

use super::patience::eventually;
use super::process::{Process, behind};
use super::rpc::Client;
use super::scratch::{Scratch, free_port};

/// Set, rosrescue is a single process.
const NO_GUARDIAN: &str = "ROSRESCUE_NO_GUARDIAN";

/// The rosrescue that is started: this build's, unless another one is set before.
pub(crate) static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// How to start rosrescue; the same again after a crash.
#[derive(Debug)]
pub(crate) struct Setup {
    command: Command,
    pub(crate) port: u16,
    pub(crate) checkpoint: PathBuf,
}

impl Setup {
    /// `rosrescue` with `arguments` and nothing else but the environment of the scratch folder.
    pub(crate) fn bare<I: AsRef<OsStr>>(
        scratch: &Scratch,
        arguments: impl IntoIterator<Item = I>,
    ) -> Self {
        let own = || PathBuf::from(env!("CARGO_BIN_EXE_rosrescue"));
        let mut command = Command::new(PROGRAM.get_or_init(own));
        scratch.prepare(&mut command);
        command.args(arguments).current_dir(scratch.path(""));
        // Most tests are about the worker: it is the process that they signal and measure. Its memory is
        // managed as under a guardian.
        let (name, value) = TUNABLES;
        command.env(NO_GUARDIAN, "1").env(name, value);
        // On a busy computer any master is late at times. Tests of that give the time themselves.
        command.env("ROSRESCUE_STAND_IN_AFTER", "5000");
        Self {
            command,
            port: 0,
            checkpoint: scratch.log_dir().join("unknown"),
        }
    }

    /// `rosrescue core` on a free port, its rosmaster on `master_port`.
    pub(crate) fn core(scratch: &Scratch, master_port: u16) -> Self {
        let port = free_port();
        let setup = Self::bare(scratch, ["core", "-p", &port.to_string()]);
        let setup = setup.at_port(port);
        setup.arg("--master-port").arg(master_port.to_string())
    }

    /// `rosrescue proxy` on a free port before the master at `master_port`.
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

    /// Runs it by another command, which `wrap` makes of its own.
    pub(crate) fn wrapped(mut self, wrap: impl FnOnce(&Command) -> Command) -> Self {
        self.command = wrap(&self.command);
        self
    }

    /// With its guardian, as a person runs it: the process that is started is the guardian then.
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

    /// As if the computer had been booted with `boot_id`: a private mount shows it in place of the
    /// kernel's own.
    fn in_boot(&mut self, boot_id: &Path) {
        const SHOW: &str = r#"mount --bind "$0" /proc/sys/kernel/random/boot_id && exec "$@""#;
        let mut command = Command::new("unshare");
        if !rustix::process::geteuid().is_root() {
            command.arg("--map-root-user");
        }
        command.args(["--mount", "sh", "-c", SHOW]).arg(boot_id);
        self.command = behind(command, &self.command);
    }

    /// Starts it and waits until it serves a living master.
    #[track_caller]
    pub(crate) fn start(self) -> Rescue {
        let mut rescue = self.spawn();
        rescue.wait_serving();
        rescue
    }

    /// Starts it and waits for nothing.
    #[track_caller]
    pub(crate) fn spawn(mut self) -> Rescue {
        let process = Process::start("rosrescue", &mut self.command);
        Rescue {
            process,
            setup: self,
        }
    }
}

/// A running rosrescue. On drop it is killed; what it started ends with the scratch folder.
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

    /// Waits until it has said its address and that it protects a living master.
    #[track_caller]
    pub(crate) fn wait_serving(&mut self) {
        self.wait_line("its address", |line| {
            line.contains("ROS_MASTER_URI=http://")
        });
        self.wait_line("the paper's words", |line| {
            line.contains("ROS Rescue enabled. Master is now fault tolerant!!")
        });
    }

    /// Starts it again, with the same arguments, after it has ended; waits for nothing.
    #[track_caller]
    pub(crate) fn start_again(&mut self) {
        assert!(self.process.exited().is_some(), "rosrescue still runs");
        self.assert_no_panic();
        self.process = Process::start("rosrescue, again", &mut self.setup.command);
    }

    /// Starts it again as after a reboot of its computer, `boot_id` being a file that holds the new
    /// boot's id; waits for nothing.
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
