//! A real rosmaster that is made to die (`tests/sick/rosmaster`), and what rosrescue says of it.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use super::rpc::Client;
use super::scratch::Scratch;

/// The program.
pub(crate) const SICK_ROSMASTER: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/tests/sick/rosmaster");

/// What masters die of: a file that they read at their start.
#[derive(Debug)]
pub(crate) struct Sickness {
    pub(crate) file: PathBuf,
}

impl Sickness {
    /// None yet.
    pub(crate) fn new(scratch: &Scratch) -> Self {
        Self {
            file: scratch.path("sickness"),
        }
    }

    /// From the next start on, masters die of this.
    pub(crate) fn set(&self, lines: &str) {
        let half = self.file.with_extension("half");
        fs::write(&half, lines).unwrap();
        fs::rename(half, &self.file).unwrap();
    }

    /// From the next start on, masters live.
    pub(crate) fn cure(&self) {
        fs::remove_file(&self.file).unwrap();
    }

    fn lines(&self, kind: &str) -> Vec<String> {
        let text = fs::read_to_string(self.file.with_extension(kind)).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }

    /// What masters have died of.
    pub(crate) fn deaths(&self) -> Vec<String> {
        self.lines("deaths")
    }

    /// When masters were started, in seconds.
    pub(crate) fn starts(&self) -> Vec<f64> {
        let starts = self.lines("starts");
        starts.iter().map(|line| line.parse().unwrap()).collect()
    }
}

/// A process that starts masters in a fraction of the time.
#[derive(Debug)]
pub(crate) struct Zygote {
    child: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Zygote {
    pub(crate) fn new(scratch: &Scratch) -> Self {
        let mut command = Command::new(SICK_ROSMASTER);
        scratch.prepare(&mut command);
        let mut child = command
            .arg("--zygote")
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

    /// Starts a master on `port` that dies of this, if it is not empty; gives its process id.
    pub(crate) fn start(&mut self, port: u16, sickness: &str) -> u32 {
        let order = format!("start {port} {sickness}");
        self.order(order.trim_end()).parse().unwrap()
    }

    /// Returns when that master has died.
    pub(crate) fn wait(&mut self, pid: u32) {
        assert_eq!(self.order(&format!("wait {pid}")), format!("ended {pid}"));
    }

    /// SIGKILL to that master, and its end.
    pub(crate) fn kill(&mut self, pid: u32) {
        assert_eq!(self.order(&format!("kill {pid}")), format!("ended {pid}"));
    }
}

impl Drop for Zygote {
    fn drop(&mut self) {
        // Its masters end with the scratch folder.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A page of rosrescue.
pub(crate) fn page(client: &Client, path: &str) -> String {
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
    client.exchange(request.as_bytes()).unwrap().text()
}
