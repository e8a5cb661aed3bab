//! Child processes whose output is recorded.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal};

use super::patience::{eventually, eventually_some};
use super::scratch::{FIRST_OF_KERNEL, HOME, hold_port};

/// Sends `signal` to one process. It is not an error if the process is gone.
pub(crate) fn signal(pid: u32, signal: Signal) {
    let pid = i32::try_from(pid)
        .ok()
        .and_then(Pid::from_raw)
        .expect("a process id");
    let _ = rustix::process::kill_process(pid, signal);
}

/// Sends SIGSTOP and waits until all threads have stopped, which takes a moment for those on other cores.
#[track_caller]
pub(crate) fn stop(pid: u32) {
    signal(pid, Signal::STOP);
    let tasks = format!("/proc/{pid}/task");
    eventually("every thread of a process has stopped", || {
        fs::read_dir(&tasks)
            .expect("a living process")
            .flatten()
            .all(|task| state(&task.path()).is_none_or(|state| state == 'T'))
    });
}

/// Whether there is a process with this id that is not a zombie.
pub(crate) fn alive(pid: u32) -> bool {
    state(Path::new(&format!("/proc/{pid}"))).is_some_and(|state| state != 'Z')
}

/// The state letter of a process or thread. `None` if it is gone.
fn state(folder: &Path) -> Option<char> {
    let stat = fs::read_to_string(folder.join("stat")).ok()?;
    // The name of the command comes first, in parentheses, and may itself contain any characters.
    stat.rsplit(')').next()?.trim_start().chars().next()
}

/// The ports that the kernel chose for the process, and at which it listens.
fn listening_ports(pid: u32) -> Vec<u16> {
    let files = fs::read_dir(format!("/proc/{pid}/fd"));
    let files = files.into_iter().flatten().flatten();
    let files = files.filter_map(|file| fs::read_link(file.path()).ok());
    let open: Vec<_> = files.collect();
    let table = fs::File::open(format!("/proc/{pid}/net/tcp")).into_iter();
    let lines = table.flat_map(|table| BufReader::new(table).lines().skip(1));
    // Listening sockets come first. Tens of thousands of others may follow.
    let sockets = lines.map_while(|line| {
        let line = line.ok()?;
        let columns: Vec<_> = line.split_whitespace().collect();
        let [_, local, _, "0A", .., inode] = columns.get(..10)? else {
            return None;
        };
        let port = u16::from_str_radix(local.rsplit(':').next()?, 16).ok()?;
        Some((port, Path::new(&format!("socket:[{inode}]")).to_owned()))
    });
    let own = sockets.filter(|(port, socket)| *port >= FIRST_OF_KERNEL && open.contains(socket));
    own.map(|(port, _)| port).collect()
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stream {
    Out,
    Err,
}

#[derive(Debug)]
struct Line {
    at: Duration,
    stream: Stream,
    text: String,
}

/// A child process, running or ended. It is killed on drop; after a panic its output is shown.
#[derive(Debug)]
pub(crate) struct Process {
    name: String,
    /// The scratch folder of the test.
    folder: Option<Box<Path>>,
    child: Child,
    ended: Option<ExitStatus>,
    /// The ports that no other process may get after this one has ended.
    ports: Vec<u16>,
    lines: Arc<Mutex<Vec<Line>>>,
    readers: [JoinHandle<()>; 2],
}

impl Process {
    #[track_caller]
    pub(crate) fn start(name: impl Into<String>, command: &mut Command) -> Self {
        let name = name.into();
        let folder = command.get_envs().find(|(key, _)| *key == HOME);
        let folder = folder.and_then(|(_, value)| value.map(|path| Path::new(path).into()));
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap_or_else(|error| panic!("cannot start {name} ({command:?}): {error}"));
        let lines = Arc::new(Mutex::new(Vec::new()));
        let start = Instant::now();
        let readers = [
            collect(child.stdout.take().unwrap(), Stream::Out, start, &lines),
            collect(child.stderr.take().unwrap(), Stream::Err, start, &lines),
        ];
        Self {
            name,
            folder,
            child,
            ended: None,
            ports: Vec::new(),
            lines,
            readers,
        }
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// A value in KiB from `/proc/PID/status`, such as `VmRSS` or its maximum so far, `VmHWM`.
    #[track_caller]
    pub(crate) fn kib(&self, name: &str) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.pid())).unwrap();
        let line = status.lines().find(|line| line.starts_with(name)).unwrap();
        line.split_whitespace().nth(1).unwrap().parse().unwrap()
    }

    /// Makes the ports at which the process listens now refuse connections after it has ended, until the end of the test.
    /// Otherwise another node could get a dead node's port and be taken for it.
    pub(crate) fn hold_ports(&mut self) {
        self.ports = listening_ports(self.pid());
    }

    pub(crate) fn signal(&self, which: Signal) {
        if self.ended.is_none() {
            signal(self.pid(), which);
        }
    }

    /// Sends SIGKILL and waits for the end of the process.
    pub(crate) fn kill(&mut self) {
        self.signal(Signal::KILL);
        self.wait();
    }

    /// Sends SIGTERM and waits up to [`PATIENCE`] for the end of the process.
    #[track_caller]
    pub(crate) fn terminate(&mut self) -> ExitStatus {
        self.signal(Signal::TERM);
        self.wait()
    }

    /// The exit status. `None` while the process runs.
    pub(crate) fn exited(&mut self) -> Option<ExitStatus> {
        if self.ended.is_none() {
            self.ended = self.child.try_wait().expect("cannot wait for a child");
            if self.ended.is_some() {
                self.ports.drain(..).for_each(hold_port);
            }
        }
        self.ended
    }

    /// Waits until the process ends by itself. Returns its exit status.
    #[track_caller]
    pub(crate) fn wait(&mut self) -> ExitStatus {
        let what = format!("{} ends", self.name);
        eventually_some(&what, || self.exited())
    }

    /// Waits until the process ends by itself and all its output has been read. Every process that has
    /// inherited its pipes must have ended too.
    #[track_caller]
    pub(crate) fn wait_output(&mut self) -> ExitStatus {
        let status = self.wait();
        let what = format!("all output of {} has been read", self.name);
        eventually(&what, || self.readers.iter().all(JoinHandle::is_finished));
        status
    }

    /// The lines that the process has written to standard output so far.
    pub(crate) fn stdout(&self) -> Vec<String> {
        self.text(Some(Stream::Out))
    }

    /// The lines that the process has written to standard error so far.
    pub(crate) fn stderr(&self) -> Vec<String> {
        self.text(Some(Stream::Err))
    }

    /// All lines that the process has written so far.
    pub(crate) fn output(&self) -> Vec<String> {
        self.text(None)
    }

    fn text(&self, stream: Option<Stream>) -> Vec<String> {
        let lines = self.lines.lock().unwrap();
        lines
            .iter()
            .filter(|line| stream.is_none_or(|stream| line.stream == stream))
            .map(|line| line.text.clone())
            .collect()
    }

    /// Waits for a line on either stream that `wanted` accepts. Panics if the process ends first.
    #[track_caller]
    pub(crate) fn wait_line(&mut self, what: &str, wanted: impl Fn(&str) -> bool) -> String {
        let what = format!("{} says {what}", self.name);
        eventually_some(&what, || {
            // The process's last output may still be in the pipe when it has ended.
            let is_complete = self.readers.iter().all(JoinHandle::is_finished);
            let ended = self.exited().filter(|_| is_complete);
            let found = self.output().into_iter().find(|line| wanted(line));
            if let (None, Some(status)) = (&found, ended) {
                panic!("did not happen: {what}; the process ended with {status}");
            }
            found
        })
    }

    /// The output as text to show when a test fails.
    pub(crate) fn log(&self) -> String {
        let lines = self.lines.lock().unwrap();
        let mut log = format!("---- {} (process {})\n", self.name, self.pid());
        // A talker prints thousands of lines. The first and the last one of a run are enough.
        let run = |line: &Line| {
            line.text
                .split(' ')
                .next()
                .map(|word| ["got", "pause", "sent"].contains(&word))
        };
        for (number, line) in lines.iter().enumerate() {
            let around = [number.wrapping_sub(1), number, number + 1];
            if around
                .iter()
                .all(|&near| lines.get(near).and_then(run) == Some(true))
            {
                continue;
            }
            let sign = if line.stream == Stream::Out { ' ' } else { '!' };
            log += &format!("{:9.3} {sign} {}\n", line.at.as_secs_f64(), line.text);
        }
        log
    }
}

impl Process {
    /// Prints the end of the output. All of it goes to a file.
    pub(crate) fn show_end(&self, ended: Option<ExitStatus>) {
        const SHOWN: usize = 60;
        let log = self.log();
        let lines: Vec<_> = log.lines().collect();
        let file = self.folder.as_ref();
        let file = file.map(|folder| folder.join(format!("output-of-{}", self.pid())));
        if let Some(file) = file.filter(|file| fs::write(file, &log).is_ok() && lines.len() > SHOWN)
        {
            eprintln!("{}\n     … all of it is in {}", lines[0], file.display());
            eprintln!("{}", lines[lines.len() - SHOWN..].join("\n"));
        } else {
            eprint!("{log}");
        }
        eprintln!("     (ended before the test: {ended:?})");
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let ended = self.exited();
        if ended.is_none() {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
        if thread::panicking() {
            self.show_end(ended);
        }
    }
}

fn collect(
    from: impl Read + Send + 'static,
    stream: Stream,
    start: Instant,
    lines: &Arc<Mutex<Vec<Line>>>,
) -> JoinHandle<()> {
    let lines = Arc::clone(lines);
    thread::spawn(move || {
        let mut from = BufReader::new(from);
        let mut bytes = Vec::new();
        // The end of the pipe and an error both mean that there is nothing more to read.
        while from
            .read_until(b'\n', &mut bytes)
            .is_ok_and(|count| count > 0)
        {
            let text = String::from_utf8_lossy(&bytes).trim_end().to_owned();
            lines.lock().unwrap().push(Line {
                at: start.elapsed(),
                stream,
                text,
            });
            bytes.clear();
        }
    })
}

/// Runs `inner` by `outer`, which takes a command after its own arguments.
pub(crate) fn behind(mut outer: Command, inner: &Command) -> Command {
    outer.arg(inner.get_program()).args(inner.get_args());
    for (key, value) in inner.get_envs() {
        match value {
            Some(value) => outer.env(key, value),
            None => outer.env_remove(key),
        };
    }
    if let Some(folder) = inner.get_current_dir() {
        outer.current_dir(folder);
    }
    outer
}
