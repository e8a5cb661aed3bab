//! One simulated computer: a network namespace and a PID namespace. All its processes end at once when its power fails.

use std::fs;
use std::path::PathBuf;
use std::process::{Command, ExitStatus};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use rustix::process::Signal;

use crate::network::{COUNT, Network, address, within};
use crate::support::{
    Client, Library, Node, Process, Scratch, State, alive, behind, command, eventually,
    eventually_some, path_with_quick_rosversion, request, signal,
};

pub(crate) const NAMES: [&str; COUNT] = ["a", "b", "c"];

/// The port of rosrescue on each computer.
pub(crate) const PORT: u16 = 11311;

/// The port of rosmaster on the leader.
const MASTER_PORT: u16 = 11411;

/// The state of the cluster as one rosrescue reports it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Seen {
    pub(crate) role: String,
    pub(crate) leader: Option<String>,
    pub(crate) behind: u64,
    /// How many computers it knows, with itself.
    pub(crate) known: usize,
}

impl Seen {
    /// Reads the part of `/status.json` that the tests use.
    fn read(page: &serde_json::Value) -> Option<Self> {
        let cluster = page.get("cluster")?;
        let leader = cluster["leader"]["name"].as_str();
        Some(Self {
            role: cluster["role"].as_str()?.to_owned(),
            leader: leader.map(str::to_owned),
            behind: cluster["behind"].as_u64()?,
            known: cluster["computers"].as_array()?.len(),
        })
    }
}

/// Start and end of a time span. `None` while it lasts.
type Span = (Instant, Option<Instant>);

/// The times during which calls to a computer's rosrescue may fail.
#[derive(Clone, Debug, Default)]
pub(crate) struct Downtimes(Arc<Mutex<Vec<Span>>>);

impl Downtimes {
    pub(crate) fn begin(&self) {
        if !self.lasts() {
            self.0.lock().unwrap().push((Instant::now(), None));
        }
    }

    pub(crate) fn end(&self) {
        if let Some((_, end)) = self.0.lock().unwrap().last_mut() {
            end.get_or_insert_with(Instant::now);
        }
    }

    pub(crate) fn lasts(&self) -> bool {
        matches!(self.0.lock().unwrap().last(), Some((_, None)))
    }

    /// Whether one of the downtimes overlaps the time from `start` to `end`.
    pub(crate) fn touch(&self, start: Instant, end: Instant) -> bool {
        let downtimes = self.0.lock().unwrap();
        let touches = |&(from, to): &Span| from <= end && to.is_none_or(|to| start <= to);
        downtimes.iter().any(touches)
    }
}

#[derive(Debug)]
pub(crate) struct Computer {
    pub(crate) index: usize,
    pub(crate) name: &'static str,
    pub(crate) namespace: String,
    pub(crate) downtimes: Downtimes,
    pub(crate) talker: Option<Node>,
    pub(crate) listener: Option<Node>,
    rescue: Option<Process>,
    /// The log lines of earlier rosrescue processes, which have ended.
    earlier: Vec<String>,
    etcd: Option<Process>,
    /// The init process of the PID namespace. All other processes end with it.
    power: Option<Process>,
    boots: u32,
    scratch: Arc<Scratch>,
    /// Further options for rosrescue.
    pub(crate) options: Vec<String>,
    /// Further options for etcd.
    pub(crate) etcd_options: Vec<String>,
    /// The computer's `--cluster-name`.
    pub(crate) called: String,
    /// The value of `--cluster`, if a test sets a wrong one.
    pub(crate) cluster: Option<String>,
}

impl Computer {
    pub(crate) fn new(index: usize, network: &Network, scratch: &Arc<Scratch>) -> Self {
        let name = NAMES[index];
        fs::create_dir_all(scratch.path(name).join("log")).unwrap();
        let downtimes = Downtimes::default();
        downtimes.begin();
        Self {
            index,
            name,
            namespace: network.namespace(index),
            downtimes,
            talker: None,
            listener: None,
            rescue: None,
            earlier: Vec::new(),
            etcd: None,
            power: None,
            boots: 0,
            scratch: Arc::clone(scratch),
            options: Vec::new(),
            etcd_options: Vec::new(),
            called: name.to_owned(),
            cluster: None,
        }
    }

    pub(crate) fn address(&self) -> String {
        address(self.index)
    }

    /// The path of a file or folder of this computer.
    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.scratch.path(self.name).join(name)
    }

    /// Switches the computer on. No program is started yet.
    #[track_caller]
    pub(crate) fn boot(&mut self) {
        // The init process must reap its children. Each boot has its own boot id, which would otherwise be the
        // kernel's, the same in all namespaces.
        const INIT: &str = r#"mount --bind "$0" /proc/sys/kernel/random/boot_id && trap "" CHLD &&
            echo booted && exec sleep infinity"#;
        self.boots += 1;
        let boot_id = self.path("boot_id");
        let id = format!("{:08x}-0000-4000-8000-{:012x}\n", self.boots, self.index);
        fs::write(&boot_id, id).unwrap();
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.namespace, "unshare", "--pid"]);
        command.args(["--fork", "--kill-child", "--mount-proc", "sh", "-c", INIT]);
        self.scratch.prepare(command.arg(boot_id));
        let mut power = Process::start(format!("computer {}", self.name), &mut command);
        power.wait_line("`booted`", |line| line == "booted");
        self.power = Some(power);
    }

    /// Kills all processes of the computer with SIGKILL at once.
    #[track_caller]
    pub(crate) fn power_off(&mut self) {
        self.downtimes.begin();
        let Some(mut power) = self.power.take() else {
            return;
        };
        if let Some(init) = child_of(&power) {
            signal(init, Signal::KILL);
        }
        // The init process ends after all other processes of the namespace.
        power.wait();
        self.etcd = None;
        self.bury_rescue();
        self.talker = None;
        self.listener = None;
    }

    pub(crate) fn is_on(&self) -> bool {
        self.power.is_some()
    }

    /// Wraps `command` so that it runs on this computer.
    fn inside(&self, inner: &Command) -> Command {
        let power = self.power.as_ref().expect("the computer is off");
        let init = child_of(power).expect("the first process of a computer");
        let mut command = Command::new("nsenter");
        command.args(["--target", &init.to_string(), "--net", "--pid", "--mount"]);
        command
            .arg(format!("--wd={}", self.path("").display()))
            .arg("--");
        behind(command, inner)
    }

    fn set_environment(&self, command: &mut Command) {
        command
            .env("ROS_IP", self.address())
            .env("ROS_MASTER_URI", format!("http://localhost:{PORT}"))
            .env("ROS_HOME", self.path(""))
            .env("ROS_LOG_DIR", self.path("log"));
    }

    #[track_caller]
    pub(crate) fn start_etcd(&mut self) {
        let url = |index, port| format!("http://{}:{port}", address(index));
        let (client, peer) = (url(self.index, 2379), url(self.index, 2380));
        let cluster: Vec<_> = (0..COUNT)
            .map(|index| format!("{}={}", NAMES[index], url(index, 2380)))
            .collect();
        // etcd's thousands of log lines go to a file and are not shown when a test fails.
        let mut command = Command::new("sh");
        command.args(["-c", r#"log=$0; exec "$@" >>"$log" 2>&1"#]);
        command.arg(self.path("etcd.log"));
        command.args(["etcd", "--logger", "zap", "--name", self.name, "--data-dir"]);
        command.arg(self.path("etcd"));
        command.args([
            "--listen-client-urls",
            &client,
            "--advertise-client-urls",
            &client,
        ]);
        command.args([
            "--listen-peer-urls",
            &peer,
            "--initial-advertise-peer-urls",
            &peer,
        ]);
        command.args(["--initial-cluster", &cluster.join(",")]);
        command.args(&self.etcd_options);
        self.scratch.prepare(&mut command);
        let etcd = Process::start(format!("etcd of {}", self.name), &mut self.inside(&command));
        self.etcd = Some(etcd);
    }

    /// The process id of the worker in the test's PID namespace.
    #[track_caller]
    pub(crate) fn worker(&self) -> u32 {
        let rescue = self.rescue.as_ref().expect("a rosrescue");
        eventually_some("the guardian has a worker", || {
            children(child_of(rescue)?).into_iter().find(|pid| {
                let name = fs::read_to_string(format!("/proc/{pid}/comm"));
                name.is_ok_and(|name| name.trim_end() == "rosrescue")
            })
        })
    }

    /// The process id of the guardian in the test's PID namespace.
    #[track_caller]
    pub(crate) fn guardian(&self) -> u32 {
        let rescue = self.rescue.as_ref().expect("a rosrescue");
        eventually_some("there is a guardian", || child_of(rescue))
    }

    /// Kills this computer's rosmaster with SIGKILL.
    #[track_caller]
    pub(crate) fn kill_master(&self) {
        let is_master = |pid: &u32| {
            let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            String::from_utf8_lossy(&line).contains("/rosmaster")
        };
        let master = self.processes().into_iter().find(is_master);
        signal(master.expect("a rosmaster"), Signal::KILL);
    }

    /// Removes the data of this computer's etcd, which must not run.
    pub(crate) fn wipe_etcd(&self) {
        assert!(self.etcd.is_none(), "etcd runs");
        fs::remove_dir_all(self.path("etcd")).unwrap();
    }

    /// Copies the data of this computer's etcd, which must not run.
    pub(crate) fn save_etcd(&self) {
        assert!(self.etcd.is_none(), "etcd runs");
        let saved = self.path("etcd.saved");
        // There is none yet at the first time.
        let _ = fs::remove_dir_all(&saved);
        copy_folder(&self.path("etcd"), &saved);
    }

    /// Puts back the data of [`Self::save_etcd`].
    pub(crate) fn restore_etcd(&self) {
        self.wipe_etcd();
        copy_folder(&self.path("etcd.saved"), &self.path("etcd"));
    }

    /// The ids, in the test's PID namespace, of all processes of the computer except its init process, and of the
    /// `nsenter` processes that started them.
    pub(crate) fn processes(&self) -> Vec<u32> {
        let power = self.power.as_ref().expect("the computer is off");
        let init = child_of(power).expect("the first process of a computer");
        let space = |pid: u32| fs::read_link(format!("/proc/{pid}/ns/pid")).ok();
        let own = space(init);
        let all = self.scratch.survivors().into_iter().map(|(pid, _)| pid);
        let inside: Vec<u32> = all
            .filter(|&pid| pid != init && space(pid) == own)
            .collect();
        // An `nsenter` outside stops itself when its child stops, and would never continue. So it must be stopped
        // before its child.
        let parents = inside.iter().filter_map(|&pid| parent_of(pid));
        let outside = parents.filter(|pid| *pid != init && !inside.contains(pid));
        [outside.collect(), inside.clone()].concat()
    }

    /// Kills etcd with SIGKILL.
    #[track_caller]
    pub(crate) fn kill_etcd(&mut self) {
        let mut etcd = self.etcd.take().expect("an etcd");
        send(&etcd, Signal::KILL);
        etcd.wait();
    }

    /// The exit status of this computer's etcd. `None` while it runs.
    pub(crate) fn etcd_ended(&mut self) -> Option<ExitStatus> {
        self.etcd.as_mut()?.exited()
    }

    /// Whether this computer's etcd belongs to a majority.
    pub(crate) fn etcd_is_healthy(&self) -> bool {
        let page = self.within(|| {
            let get = request("GET /health HTTP/1.1", &[], b"");
            let mut wire = Client::at(&self.address(), 2379).connect().ok()?;
            wire.set_patience(std::time::Duration::from_secs(10));
            wire.send(&get).ok()?;
            wire.response().ok()
        });
        page.is_some_and(|page| page.text().contains(r#""health":"true""#))
    }

    /// Starts rosrescue without waiting.
    #[track_caller]
    pub(crate) fn start_rescue(&mut self) {
        let cluster = match &self.cluster {
            Some(cluster) => cluster.clone(),
            None => format!("{}/robot", endpoints().join(",")),
        };
        let mut command = command(&self.scratch, PORT, &["core", "--cluster", &cluster]);
        command.env("PATH", path_with_quick_rosversion());
        command.args([
            "--advertise",
            &self.address(),
            "--cluster-name",
            &self.called,
        ]);
        command.args(["-p", &PORT.to_string()]);
        command.args(["--master-port", &MASTER_PORT.to_string()]);
        command.arg("--checkpoint").arg(self.path("chkpt.yaml"));
        command.args(&self.options);
        self.set_environment(&mut command);
        let name = format!("rosrescue of {}", self.name);
        self.rescue = Some(Process::start(name, &mut self.inside(&command)));
    }

    /// Waits until rosrescue answers calls.
    #[track_caller]
    pub(crate) fn await_answers(&mut self) {
        let name = self.name;
        let rescue = self.rescue.as_mut().expect("a rosrescue");
        let namespace = self.namespace.clone();
        eventually(&format!("rosrescue of {name} answers"), || {
            let ended = rescue.exited();
            assert!(ended.is_none(), "rosrescue of {name} ended: {ended:?}");
            let params = vec!["/test".into()];
            within(&namespace, || {
                Client::new(PORT).ask("getPid", params).is_some()
            })
        });
        self.downtimes.end();
    }

    /// Waits until rosrescue ends by itself and its log is complete. Returns the exit status.
    #[track_caller]
    pub(crate) fn await_end(&mut self) -> Option<i32> {
        let rescue = self.rescue.as_mut().expect("a rosrescue");
        rescue.wait_output().code()
    }

    /// Stops rosrescue with SIGTERM and waits for its end.
    #[track_caller]
    pub(crate) fn stop_rescue(&mut self) {
        self.downtimes.begin();
        let rescue = self.rescue.as_mut().expect("a rosrescue");
        send(rescue, Signal::TERM);
        rescue.wait();
        self.bury_rescue();
    }

    /// Starts rosrescue again after it has ended, or is about to end.
    #[track_caller]
    pub(crate) fn restart_rescue(&mut self) {
        let rescue = self.rescue.as_mut().expect("a rosrescue");
        rescue.wait();
        self.bury_rescue();
        self.start_rescue();
    }

    /// Keeps the log of a rosrescue that has ended.
    fn bury_rescue(&mut self) {
        self.assert_no_panic();
        let rescue = self.rescue.take();
        self.earlier
            .extend(rescue.iter().flat_map(|it| it.output()));
    }

    /// Runs `rosrescue ARGUMENTS` on this computer until it ends. Returns exit status and output.
    #[track_caller]
    pub(crate) fn rosrescue(&self, arguments: &[&str]) -> (Option<i32>, String) {
        let mut command = command(&self.scratch, PORT, arguments);
        self.set_environment(&mut command);
        let name = format!("rosrescue {arguments:?} on {}", self.name);
        let mut process = Process::start(name, &mut self.inside(&command));
        let status = process.wait_output();
        (status.code(), process.output().join("\n"))
    }

    /// Starts a node and waits until it is ready.
    #[track_caller]
    pub(crate) fn node(&self, library: Library, node: &str, arguments: &[&str]) -> Node {
        let mut command = library.command(&self.scratch, PORT, node);
        command.args(arguments);
        self.set_environment(&mut command);
        Node::run(&mut self.inside(&command))
    }

    /// Panics if a node has ended, for example because it was told to shut down.
    #[track_caller]
    pub(crate) fn assert_nodes_live(&mut self) {
        let nodes = self.talker.iter_mut().chain(&mut self.listener);
        for node in nodes {
            let ended = node.exited();
            assert!(ended.is_none(), "a node ended: {ended:?}\n{}", node.log());
        }
    }

    /// A client of this computer's rosrescue. It must be used [`within`](Self::within) the computer.
    pub(crate) fn client(&self) -> Client {
        Client::new(PORT)
    }

    #[track_caller]
    pub(crate) fn within<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        within(&self.namespace, work)
    }

    #[track_caller]
    pub(crate) fn set_param(&self, key: &str, value: i32) {
        self.within(|| self.client().set_param(key, value));
    }

    pub(crate) fn param(&self, key: &str) -> Option<ros1_master::xmlrpc::Value> {
        self.within(|| self.client().param(key))
    }

    /// The state that this computer's rosrescue shows to its clients.
    pub(crate) fn state(&self) -> std::io::Result<State> {
        self.within(|| State::try_read(&self.client()))
    }

    /// The state of this computer's rosmaster, read without rosrescue.
    pub(crate) fn master_state(&self) -> std::io::Result<State> {
        self.within(|| State::try_read(&Client::new(MASTER_PORT)))
    }

    /// The content of `/status.json`. `None` if rosrescue does not answer.
    pub(crate) fn status(&self) -> Option<serde_json::Value> {
        let get = request("GET /status.json HTTP/1.1", &[], b"");
        let page = self.within(|| self.client().exchange(&get)).ok()?;
        serde_json::from_slice(&page.body).ok()
    }

    /// The state of the cluster as this computer's rosrescue reports it.
    pub(crate) fn seen(&self) -> Option<Seen> {
        Seen::read(&self.status()?)
    }

    pub(crate) fn role_is(&self, role: &str) -> bool {
        self.seen().is_some_and(|seen| seen.role == role)
    }

    /// The lines with `text` in the log of the present rosrescue.
    pub(crate) fn logged(&self, text: &str) -> Vec<String> {
        let lines = self.rescue.iter().flat_map(|rescue| rescue.output());
        lines.filter(|line| line.contains(text)).collect()
    }

    /// Like [`Self::logged`], with the logs of earlier rosrescue processes of this computer.
    pub(crate) fn ever_logged(&self, text: &str) -> Vec<String> {
        let earlier = self.earlier.iter().filter(|line| line.contains(text));
        earlier.cloned().chain(self.logged(text)).collect()
    }

    #[track_caller]
    fn assert_no_panic(&self) {
        let panics = self.logged("panicked at");
        assert!(panics.is_empty(), "rosrescue of {}: {panics:?}", self.name);
    }
}

impl Drop for Computer {
    fn drop(&mut self) {
        if std::thread::panicking() {
            // The processes are kept until they are dropped, because they print their output then.
            if let Some(init) = self.power.as_ref().and_then(child_of) {
                signal(init, Signal::KILL);
            }
        } else {
            self.power_off();
        }
    }
}

/// The client URLs of all members of etcd.
pub(crate) fn endpoints() -> Vec<String> {
    let all = (0..COUNT).map(|index| format!("http://{}:2379", address(index)));
    all.collect()
}

/// The child of `ip netns exec … unshare` or `nsenter`, which stay as the parents of what they start.
fn copy_folder(from: &std::path::Path, to: &std::path::Path) {
    let copied = Command::new("cp").arg("-a").args([from, to]).status();
    assert!(copied.unwrap().success());
}

fn child_of(parent: &Process) -> Option<u32> {
    children(parent.pid()).first().copied()
}

fn parent_of(pid: u32) -> Option<u32> {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let parent = status.lines().find_map(|line| line.strip_prefix("PPid:"))?;
    parent.trim().parse().ok()
}

fn children(pid: u32) -> Vec<u32> {
    let children = format!("/proc/{pid}/task/{pid}/children");
    let children = fs::read_to_string(children).unwrap_or_default();
    let pids = children.split_whitespace().map(str::parse);
    pids.collect::<Result<_, _>>().unwrap_or_default()
}

/// Sends a signal to a process on the computer that was started with `nsenter`.
#[track_caller]
pub(crate) fn send(process: &Process, which: Signal) {
    let child = eventually_some("a process has been started on a computer", || {
        child_of(process)
    });
    assert!(alive(child), "the process has ended:\n{}", process.log());
    signal(child, which);
}
