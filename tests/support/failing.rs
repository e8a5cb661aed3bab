//! A real rosmaster that can be made to die (`tests/failing/rosmaster`), and what rosrescue reports about it.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use rustix::process::Signal;

use super::process::signal;
use super::rescue::{Rescue, Setup};
use super::rpc::Client;
use super::scratch::{Scratch, free_port};
use super::state::State;

/// The program that runs such a rosmaster.
pub(crate) const FAILING_ROSMASTER: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/tests/failing/rosmaster");

/// The reasons why masters die, in a file that they read when they start.
#[derive(Debug)]
pub(crate) struct Failures {
    pub(crate) file: PathBuf,
}

impl Failures {
    /// Starts without any reason to die.
    pub(crate) fn new(scratch: &Scratch) -> Self {
        Self {
            file: scratch.path("failures"),
        }
    }

    /// `rosrescue core` whose rosmasters fail for these reasons.
    pub(crate) fn core(&self, scratch: &Scratch, master_port: u16) -> Setup {
        Setup::core(scratch, master_port)
            .args(["--no-rosout", "--rosmaster", FAILING_ROSMASTER])
            .env("FAILURES", &self.file)
    }

    /// Makes masters die for these reasons, from the next start on.
    pub(crate) fn set(&self, lines: &str) {
        let half = self.file.with_extension("half");
        fs::write(&half, lines).unwrap();
        fs::rename(half, &self.file).unwrap();
    }

    /// Lets masters live, from the next start on.
    pub(crate) fn clear(&self) {
        fs::remove_file(&self.file).unwrap();
    }

    fn lines(&self, kind: &str) -> Vec<String> {
        let text = fs::read_to_string(self.file.with_extension(kind)).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }

    /// The process ids of the masters that have died so far for these reasons.
    pub(crate) fn deaths(&self) -> Vec<u32> {
        let deaths = self.lines("deaths");
        let pids = deaths.iter().map(|line| line.split(' ').next().unwrap());
        pids.map(|pid| pid.parse().unwrap()).collect()
    }

    /// The times at which masters were started, in seconds.
    pub(crate) fn starts(&self) -> Vec<f64> {
        let starts = self.lines("starts");
        starts.iter().map(|line| line.parse().unwrap()).collect()
    }
}

/// rosrescue with a rosmaster that can be made to fail.
#[derive(Debug)]
pub(crate) struct Failing {
    pub(crate) rescue: Rescue,
    pub(crate) master_port: u16,
    pub(crate) failures: Failures,
    pub(crate) scratch: Scratch,
}

impl Failing {
    /// `rosrescue core`, without rosout.
    #[track_caller]
    pub(crate) fn core(options: &[&str]) -> Self {
        Self::start(|scratch, port, failures| failures.core(scratch, port).args(options))
    }

    /// Starts the rosrescue that `setup` describes for the given port of the master.
    #[track_caller]
    pub(crate) fn start(setup: impl FnOnce(&Scratch, u16, &Failures) -> Setup) -> Self {
        let scratch = Scratch::new();
        let failures = Failures::new(&scratch);
        let master_port = free_port();
        Self {
            rescue: setup(&scratch, master_port, &failures).start(),
            master_port,
            failures,
            scratch,
        }
    }

    pub(crate) fn client(&self) -> Client {
        self.rescue.client()
    }

    /// A client that talks directly to the real master.
    pub(crate) fn bare(&self) -> Client {
        Client::new(self.master_port)
    }

    /// The state of the real master, once the parameters of roscore are set.
    #[track_caller]
    pub(crate) fn state(&self) -> State {
        self.client().await_roscore_params();
        State::read(&self.bare())
    }

    /// Kills the real master with SIGKILL. Returns its process id.
    #[track_caller]
    pub(crate) fn kill_master(&self) -> u32 {
        let pid = self.bare().master_pid().expect("a master");
        signal(pid, Signal::KILL);
        pid
    }
}

/// A process that starts masters much faster than usual, by forking.
#[derive(Debug)]
pub(crate) struct Forkserver {
    child: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Forkserver {
    pub(crate) fn new(scratch: &Scratch) -> Self {
        Self::of(scratch, FAILING_ROSMASTER.as_ref())
    }

    /// Starts masters that seem to be those of a roscore.
    pub(crate) fn roscore(scratch: &Scratch) -> Self {
        let roscore = scratch.path("roscore");
        std::os::unix::fs::symlink(FAILING_ROSMASTER, &roscore).unwrap();
        Self::of(scratch, &roscore)
    }

    fn of(scratch: &Scratch, program: &Path) -> Self {
        let mut command = Command::new(program);
        scratch.prepare(&mut command);
        let mut child = command
            .arg("--forkserver")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        Self {
            orders: child.stdin.take().unwrap(),
            answers: BufReader::new(child.stdout.take().unwrap()),
            child,
        }
    }

    fn order(&mut self, order: &str) -> String {
        writeln!(self.orders, "{order}").unwrap();
        let mut answer = String::new();
        self.answers.read_line(&mut answer).unwrap();
        answer.trim_end().to_owned()
    }

    /// Starts a master on `port` and returns its process id. It does what `failures` says (`tests/failing/rosmaster`),
    /// unless that is empty.
    pub(crate) fn start(&mut self, port: u16, failures: &str) -> u32 {
        let order = format!("start {port} {failures}");
        self.order(order.trim_end()).parse().unwrap()
    }

    /// Waits until that master has died.
    pub(crate) fn wait(&mut self, pid: u32) {
        assert_eq!(self.order(&format!("wait {pid}")), format!("ended {pid}"));
    }

    /// Kills that master with SIGKILL and waits for its end.
    pub(crate) fn kill(&mut self, pid: u32) {
        assert_eq!(self.order(&format!("kill {pid}")), format!("ended {pid}"));
    }
}

impl Drop for Forkserver {
    fn drop(&mut self) {
        // The masters are killed together with the scratch folder.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Fetches a page of rosrescue.
pub(crate) fn page(client: &Client, path: &str) -> String {
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
    client.exchange(request.as_bytes()).unwrap().text()
}
