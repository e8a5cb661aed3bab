//! A network namespace for each test: loopback and nothing else. No test sees another test's ports, nodes or multicast.
//!
//! A network namespace belongs to a thread. Processes and threads that the test starts inherit it.

use std::cell::RefCell;
use std::fs::{self, File};
use std::io::{BufRead, BufReader, Read, Write};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::thread;

use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

use super::report;

const HOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/support/namespace.sh");

/// The process that holds the namespace of a test. On drop it kills all other processes in the namespace, and ends.
#[derive(Debug)]
struct Namespace {
    holder: Child,
}

impl Namespace {
    /// Makes a namespace and moves this thread into it. Returns the reason if the system does not allow that.
    fn enter() -> Result<Self, String> {
        let mut holder = Command::new("unshare")
            .args(["--net", HOLDER])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| format!("unshare: {error}"))?;
        let (stdout, stderr) = (holder.stdout.take(), holder.stderr.take());
        let this = Self { holder };
        let mut line = String::new();
        let read = stdout.map(|stdout| BufReader::new(stdout).read_line(&mut line));
        if line != "ready\n" {
            let mut said = String::new();
            let _ = stderr.map(|mut stderr| stderr.read_to_string(&mut said));
            return Err(format!("{}{}", said.trim_end(), shown_error(read)));
        }
        let link = format!("/proc/{}/ns/net", this.holder.id());
        let file = File::open(link).map_err(|error| error.to_string())?;
        move_into_link_name_space(file.as_fd(), Some(LinkNameSpaceType::Network))
            .map_err(|error| format!("setns: {error}"))?;
        Ok(this)
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        drop(self.holder.stdin.take());
        let _ = self.holder.wait();
    }
}

/// The error as text, if there was one.
fn shown_error(read: Option<std::io::Result<usize>>) -> String {
    match read {
        Some(Err(error)) => error.to_string(),
        _ => String::new(),
    }
}

/// Gives the test of this thread a network namespace until its end, unless it has one. Where that is not allowed, tests
/// share the namespace of the test program. A panic is followed by a report from now on.
pub(crate) fn isolate() {
    thread_local!(static OWN: RefCell<Option<Namespace>> = const { RefCell::new(None) });
    static REFUSED: OnceLock<()> = OnceLock::new();
    // Only the threads that run tests have a name, that of the test. Benchmarks run in the main thread.
    if thread::current().name().is_none_or(|name| name == "main") {
        return;
    }
    report::install();
    if is_isolated() || REFUSED.get().is_some() {
        return;
    }
    match Namespace::enter() {
        Ok(namespace) => OWN.set(Some(namespace)),
        Err(reason) => *REFUSED.get_or_init(|| {
            // Not captured as the output of a test.
            let _ = writeln!(
                std::io::stderr(),
                "Tests share the computer's network, because a network namespace is not allowed: {reason}"
            );
        }),
    }
}

/// Whether this thread is in another network namespace than the test program.
pub(crate) fn is_isolated() -> bool {
    of(Path::new("/proc/thread-self")) != of(Path::new("/proc/self"))
}

/// The network namespace of a process or thread.
pub(super) fn of(process: &Path) -> Option<PathBuf> {
    fs::read_link(process.join("ns/net")).ok()
}
