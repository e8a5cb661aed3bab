//! The ROS of a robot with rosrescue, in either mode, whose parts a test can kill and bring back.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::Signal;

use super::node::{Library, Node};
use super::patience::{PATIENCE, eventually, eventually_some};
use super::process::{alive, signal};
use super::rescue::{Rescue, Setup};
use super::ros::{NODES, Rosmaster, find_program};
use super::rpc::Client;
use super::scratch::{Scratch, free_port};
use super::state::State;

/// Which command of rosrescue runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    /// `rosrescue core`: rosrescue starts and restarts the master.
    Core,
    /// `rosrescue proxy`: the test starts and restarts the master.
    Proxy,
}

/// rosrescue and its master.
#[derive(Debug)]
pub(crate) struct Robot {
    mode: Mode,
    // Fields are dropped in this order: processes that restart others first, the scratch folder last.
    pub(crate) rescue: Rescue,
    master: Option<Rosmaster>,
    master_port: u16,
    /// Program and arguments of the master of a proxy.
    program: (PathBuf, Vec<String>),
    /// While this file exists, the next master of a core waits (`tests/nodes/waiting_rosmaster.py`).
    away: Option<PathBuf>,
    pub(crate) scratch: Scratch,
}

impl Robot {
    #[track_caller]
    pub(crate) fn start(mode: Mode) -> Self {
        Self::start_with(mode, &[])
    }

    /// Starts a robot, with further options for rosrescue.
    #[track_caller]
    pub(crate) fn start_with(mode: Mode, options: &[&str]) -> Self {
        Self::begin(mode, options, find_program("rosmaster"), &[])
    }

    /// Starts a robot whose masters run `program` with `arguments`, in either mode.
    #[track_caller]
    pub(crate) fn start_under(mode: Mode, program: &str, arguments: &[&str]) -> Self {
        Self::start_under_with(mode, program, arguments, &[])
    }

    /// Like [`Self::start_under`], with further options for rosrescue.
    #[track_caller]
    pub(crate) fn start_under_with(
        mode: Mode,
        program: &str,
        arguments: &[&str],
        options: &[&str],
    ) -> Self {
        let program = Path::new(NODES).join(program);
        match mode {
            Mode::Core => {
                let supervised = ["--rosmaster", program.to_str().unwrap()];
                Self::start_with(mode, &[&supervised, arguments, options].concat())
            }
            Mode::Proxy => Self::begin(mode, options, program, arguments),
        }
    }

    /// Starts a robot whose master stays away after it was killed, until [`Self::revive_master`] is called,
    /// even in core mode.
    #[track_caller]
    pub(crate) fn start_for_outages(mode: Mode) -> Self {
        let mut robot = Self::start_under(mode, "waiting_rosmaster.py", &[]);
        robot.stay_away();
        robot
    }

    #[track_caller]
    fn begin(mode: Mode, options: &[&str], program: PathBuf, arguments: &[&str]) -> Self {
        let scratch = Scratch::new();
        let master_port = free_port();
        let arguments: Vec<_> = arguments.iter().map(|&word| word.to_owned()).collect();
        let program = (program, arguments);
        let (master, setup) = match mode {
            Mode::Core => (None, Setup::core(&scratch, master_port)),
            Mode::Proxy => (
                Some(start_master(&scratch, master_port, &program)),
                Setup::proxy(&scratch, master_port),
            ),
        };
        let rescue = setup.args(options).start();
        let robot = Self {
            mode,
            rescue,
            master,
            master_port,
            program,
            away: None,
            scratch,
        };
        if mode == Mode::Core {
            robot.bare().await_roscore_params();
        }
        if mode == Mode::Core && !options.contains(&"--no-rosout") {
            // The subscription is the last thing that rosout registers.
            let is_running = |nodes: Vec<_>| !nodes.is_empty();
            eventually("rosout is running", || {
                State::read_subscribers(&robot.bare(), "/rosout").is_some_and(is_running)
            });
        }
        robot
    }

    /// The port that nodes use.
    pub(crate) fn port(&self) -> u16 {
        self.rescue.port()
    }

    /// A client that talks to rosrescue.
    pub(crate) fn client(&self) -> Client {
        self.rescue.client()
    }

    /// A client that talks directly to the real master.
    pub(crate) fn bare(&self) -> Client {
        Client::new(self.master_port)
    }

    /// The state of the real master.
    #[track_caller]
    pub(crate) fn state(&self) -> State {
        State::read(&self.bare())
    }

    /// The state of the real master, as soon as it stops changing.
    #[track_caller]
    pub(crate) fn settled_state(&self) -> State {
        let mut last = None;
        eventually_some("the master's state stops changing", || {
            let now = State::try_read(&self.bare()).ok()?;
            if last.as_ref() == Some(&now) {
                return last.take();
            }
            last = Some(now);
            sleep(Duration::from_millis(300));
            None
        })
    }

    /// Waits until the real master's state is `wanted`; panics with the difference. A health check that changes it
    /// takes seconds, so this looks only every 200 ms.
    #[track_caller]
    pub(crate) fn await_state(&self, wanted: &State, when: &str) {
        let start = Instant::now();
        loop {
            let now = State::try_read(&self.bare());
            if now.as_ref().is_ok_and(|now| now == wanted) {
                return;
            }
            if start.elapsed() > PATIENCE {
                wanted.assert_same(&now.expect("the state of the master"), when);
            }
            sleep(Duration::from_millis(200));
        }
    }

    #[track_caller]
    pub(crate) fn node(&self, library: Library, node: &str, arguments: &[&str]) -> Node {
        Node::start(&self.scratch, library, self.port(), node, arguments)
    }

    #[track_caller]
    pub(crate) fn spawn_node(&self, library: Library, node: &str, arguments: &[&str]) -> Node {
        Node::spawn(&self.scratch, library, self.port(), node, arguments)
    }

    /// The process id of the real master.
    #[track_caller]
    pub(crate) fn master_pid(&self) -> u32 {
        eventually_some("the master reports its process id", || {
            self.bare().master_pid()
        })
    }

    /// Makes the master of a robot that was started under `waiting_rosmaster.py` stay away after its next
    /// death, until [`Self::revive_master`] is called.
    pub(crate) fn stay_away(&mut self) {
        self.away = (self.mode == Mode::Core).then(|| self.scratch.path("away"));
    }

    /// Kills the real master with SIGKILL.
    #[track_caller]
    pub(crate) fn kill_master(&mut self) {
        if let Some(away) = &self.away {
            fs::write(away, "").unwrap();
        }
        match &mut self.master {
            Some(master) => master.kill(),
            None => signal(self.master_pid(), Signal::KILL),
        }
    }

    /// Kills the real master with SIGKILL, and waits until the mirror stands in.
    #[track_caller]
    pub(crate) fn take_master_away(&mut self) {
        self.kill_master();
        eventually("the mirror stands in", || !self.is_open());
    }

    /// Kills a core's master whose process id is known, with SIGKILL. It may already be a zombie.
    pub(crate) fn kill_master_at_once(&mut self, pid: u32) {
        signal(pid, Signal::KILL);
        if let Some(master) = &mut self.master {
            master.kill();
        }
    }

    /// Brings a new master: a proxy's is started by the test, a core's by rosrescue.
    #[track_caller]
    pub(crate) fn revive_master(&mut self) {
        if self.mode == Mode::Proxy {
            let master = start_master(&self.scratch, self.master_port, &self.program);
            self.master = Some(master);
        }
        if let Some(away) = &self.away {
            fs::remove_file(away).unwrap();
        }
    }

    /// Starts a new master for a proxy. A core has begun to start one already.
    #[track_caller]
    pub(crate) fn revive_proxied_master(&mut self) {
        if self.mode == Mode::Proxy {
            self.revive_master();
        }
    }

    /// Waits until a master other than `dead` serves through rosrescue.
    #[track_caller]
    pub(crate) fn await_recovery(&self, dead: u32) {
        let client = self.client();
        eventually("rosrescue names a new master", || {
            client
                .master_pid()
                .is_some_and(|pid| pid != dead && alive(pid))
        });
        self.await_gate();
    }

    /// Waits until calls pass to the master.
    #[track_caller]
    pub(crate) fn await_gate(&self) {
        eventually("rosrescue lets calls pass", || self.is_open());
    }

    /// Kills the master with SIGKILL, and waits for a new one with its state.
    #[track_caller]
    pub(crate) fn crash_master(&mut self) {
        let dead = self.master_pid();
        self.kill_master_at_once(dead);
        self.revive_master();
        self.await_recovery(dead);
    }

    /// The status. `None` if rosrescue does not answer.
    pub(crate) fn status(&self) -> Option<serde_json::Value> {
        let page = super::rpc::request("GET /status.json HTTP/1.1", &[], b"");
        let page = self.client().exchange(&page).ok()?;
        serde_json::from_slice(&page.body).ok()
    }

    /// Whether the gate is open.
    pub(crate) fn is_open(&self) -> bool {
        self.status().is_some_and(|status| status["open"] == true)
    }

    /// A counter of the status page.
    #[track_caller]
    pub(crate) fn counter(&self, name: &str) -> u64 {
        let status = self.status().expect("a status page");
        status["counters"][name].as_u64().expect("a counter")
    }

    /// Ids of all processes of this robot.
    pub(crate) fn processes(&self) -> BTreeSet<u32> {
        self.scratch
            .survivors()
            .into_iter()
            .map(|(pid, _)| pid)
            .collect()
    }
}

/// Starts a proxy's master: `program` with its arguments.
#[track_caller]
fn start_master(
    scratch: &Scratch,
    port: u16,
    (program, arguments): &(PathBuf, Vec<String>),
) -> Rosmaster {
    Rosmaster::start_with(scratch, port, |command| {
        *command = Command::new(program);
        scratch.prepare(command);
        command.args(["--core", "-p", &port.to_string()]);
        command.args(arguments);
    })
}
