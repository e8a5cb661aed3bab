//! `rosrescue core` with nodes, and the death of its master.

use std::{
    fmt,
    path::Path,
    process::Command,
    thread::{available_parallelism, sleep},
    time::{Duration, Instant},
};

use ros1_master::xmlrpc::{Reply, Value};
use rosrescue::clock;
use rustix::process::Signal;
use serde_json::Value as Json;

use crate::shared::{
    nodes::{synthetic, topics},
    support::{
        Client, FakeNode, NODES, Process, Rescue, Scratch, Setup, State, encode_call, eventually,
        eventually_some, free_port, http_request, params, request, signal,
    },
};

/// Time to wait after a recovery. Every node is then asked whether it is alive, which delays no call but
/// would disturb the next measurement on the same cores. It is longer than the second between two probes, so
/// that, as on a robot at rest, the master has been probed since it last called a node.
const SETTLE: Duration = Duration::from_millis(1500);

/// A parameter that is already set.
const PARAM: &str = "/table1";

/// The kind of nodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Registrations, and a server that answers for the nodes; nothing else happens on the computer.
    Synthetic,
    /// rospy processes with live connections, each of which publishes 20 messages per second.
    Real,
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Synthetic => "synthetic nodes",
            Self::Real => "real rospy nodes",
        })
    }
}

/// The times of events in milliseconds since the SIGKILL.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Recovery {
    /// rosrescue noticed the death.
    pub(crate) detected: f64,
    /// The new master's port was open.
    pub(crate) port_open: f64,
    /// The new master had the whole state, read back and compared.
    pub(crate) gate_open: f64,
    /// A node whose call was under way when the master died got its answer from the new one.
    pub(crate) answered: f64,
}

/// Nodes, which end when this is dropped.
#[derive(Debug)]
#[expect(dead_code, reason = "kept only so that they are dropped later")]
enum Nodes {
    Synthetic(Vec<FakeNode>),
    Real(Vec<Process>),
}

/// A robot.
#[derive(Debug)]
pub(crate) struct Robot {
    // Fields are dropped in this order. The scratch folder comes last and ends everything that is left.
    _nodes: Nodes,
    rescue: Rescue,
    pub(crate) master: Client,
    pub(crate) scratch: Scratch,
}

impl Robot {
    /// Starts rosrescue and its nodes, and waits until everything has registered.
    pub(crate) fn start(kind: Kind, count: usize) -> Self {
        let scratch = Scratch::new();
        let master_port = free_port();
        let rescue = Setup::core(&scratch, master_port).start();
        let client = rescue.client();
        eventually("roscore's parameters are set", || {
            client.param("/rosdistro").is_some()
        });
        client.set_param(PARAM, 1);
        let robot = Self {
            _nodes: match kind {
                Kind::Synthetic => Nodes::Synthetic(synthetic(&client, count)),
                Kind::Real => Nodes::Real(real(&scratch, rescue.port(), count)),
            },
            rescue,
            master: Client::new(master_port),
            scratch,
        };
        // rosout has one publisher and one subscriber, and both services that every node has.
        let wanted = [
            ("nodes", count + 1),
            ("publishers", 3 * count + 1),
            ("subscribers", 2 * count + 1),
            ("services", 2 * count + 2),
        ];
        eventually("every registration is there", || {
            let state = &robot.status()["state"];
            let is = |what: &str| {
                state[what]
                    .as_u64()
                    .and_then(|now| usize::try_from(now).ok())
            };
            wanted.iter().all(|(what, count)| is(what) == Some(*count))
        });
        robot
    }

    /// The status page.
    fn status(&self) -> Json {
        let page = request("GET /status.json HTTP/1.1", &[], b"");
        let page = self.rescue.client().exchange(&page).expect("a status page");
        serde_json::from_slice(&page.body).expect("JSON")
    }

    /// Makes the master notify every subscriber again, as it does over hours. It keeps a connection to each node that
    /// it has called, and closes all of them when it dies.
    pub(crate) fn let_live(&self) {
        let (client, state) = (self.rescue.client(), self.state());
        let of = |table: &[(String, String)], key: &str| {
            let found = table.iter().find(|(name, _)| name == key);
            found.map(|(_, value)| value.clone()).expect("a known name")
        };
        for (topic, nodes) in &state.publishers {
            let node = nodes[0].as_str();
            let (kind, api) = (of(&state.topic_types, topic), of(&state.nodes, node));
            client.ok(
                "registerPublisher",
                params![node, topic.as_str(), kind, api],
            );
        }
    }

    /// Waits until nothing that was started or killed before is still busy.
    pub(crate) fn settle(&self) {
        sleep(SETTLE);
    }

    /// The state of the real master.
    pub(crate) fn state(&self) -> State {
        State::read(&self.master)
    }

    /// The process id of the real master.
    pub(crate) fn master_pid(&self) -> u32 {
        self.master
            .master_pid()
            .expect("the master does not report its process id")
    }

    /// Kills the master with SIGKILL while a node calls it. Panics if any of its state is lost.
    pub(crate) fn kill_master(&mut self) -> Recovery {
        let (before, pid) = (self.state(), self.master_pid());
        let recoveries = self.status()["recoveries"].as_u64().unwrap();
        let mut node = self.rescue.client().connect().expect("a connection");
        // The value is the same as before, so that the state stays the same.
        let call = encode_call("setParam", params!["/node", PARAM, 1]);

        let (start, wall) = (Instant::now(), clock::wall_time());
        signal(pid, Signal::KILL);
        node.send(&http_request(&call)).expect("a call");
        let answer = node.response().expect("an answer").reply();
        let answered = start.elapsed().as_secs_f64() * 1e3;

        let Reply::Value(Value::Array(fields)) = &answer else {
            panic!("{answer:?}");
        };
        assert_eq!(fields[0], Value::Int(1), "{answer:?}");
        let status = eventually_some("the recovery has a report", || {
            Some(self.status()).filter(|status| status["recoveries"].as_u64() > Some(recoveries))
        });
        before.assert_same(&self.state(), "after the recovery");
        let report = &status["last_recovery"];
        let detected = (number(&report["detected_at"]) - wall) * 1e3;
        let phases = &report["phases"];
        Recovery {
            detected,
            port_open: detected + number(&phases["absence_ms"]),
            gate_open: detected + number(&phases["total_ms"]),
            answered,
        }
    }
}

fn number(json: &Json) -> f64 {
    json.as_f64().expect("a number")
}

/// Starts rospy nodes, a few at a time so that all make progress: each takes half a second of a core.
fn real(scratch: &Scratch, port: u16, count: usize) -> Vec<Process> {
    let at_once = 2 * available_parallelism().map_or(2, usize::from);
    let mut nodes: Vec<Process> = Vec::new();
    for number in 0..count {
        eventually("the previous nodes are ready", || {
            let not_ready = nodes.iter().filter(|node| node.stdout().is_empty());
            not_ready.count() < at_once
        });
        let mut command = Command::new("/usr/bin/python3");
        scratch.prepare(&mut command);
        command
            .env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"))
            .arg(Path::new(NODES).join("multi.py"))
            .arg(format!("__name:=node_{number:03}"));
        let [published, subscribed] = topics(number, count);
        command.args(published.map(|topic| format!("pub:{topic}")));
        command.args(subscribed.map(|topic| format!("sub:{topic}")));
        nodes.push(Process::start(format!("node {number}"), &mut command));
    }
    nodes
}
