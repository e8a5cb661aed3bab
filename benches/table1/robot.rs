//! `rosrescue core` with nodes, and the death of its master.

use std::{
    fmt,
    path::Path,
    process::Command,
    thread::{available_parallelism, sleep},
    time::{Duration, Instant},
};

use rosrescue::{
    clock,
    xmlrpc::{Reply, Value},
};
use rustix::process::Signal;
use serde_json::Value as Json;

use crate::shared::{
    nodes::{synthetic, topics},
    support::{
        Client, FakeNode, NODES, Process, Rescue, Scratch, Setup, State, encode_call, eventually,
        eventually_some, free_port, http_request, params, request, signal,
    },
};

/// After a recovery every node is asked for a sign of life. That delays no call, but it would be in
/// the way of what is measured next on the same processor cores. Longer than the second between two
/// probes: a robot at rest has been probed since its master last called a node.
const SETTLE: Duration = Duration::from_millis(1500);

/// A parameter that is set already.
const PARAM: &str = "/table1";

/// What the nodes are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Registrations, and a server that answers for the node; nothing else happens on the machine.
    Synthetic,
    /// rospy processes with live connections, each publishing 20 messages a second.
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

/// When things happened, in milliseconds since the SIGKILL.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Recovery {
    /// rosrescue noticed.
    pub(crate) detected: f64,
    /// The new master's port was open.
    pub(crate) port_open: f64,
    /// The new master held the whole state, read back and compared.
    pub(crate) gate_open: f64,
    /// A node that had called when the master died got its answer from the new one.
    pub(crate) answered: f64,
}

/// Nodes, ended when they are dropped.
#[derive(Debug)]
#[expect(dead_code, reason = "held, not looked at")]
enum Nodes {
    Synthetic(Vec<FakeNode>),
    Real(Vec<Process>),
}

/// A robot.
#[derive(Debug)]
pub(crate) struct Robot {
    // In the order of the drops: the scratch folder last, which ends what is left.
    _nodes: Nodes,
    rescue: Rescue,
    pub(crate) master: Client,
    pub(crate) scratch: Scratch,
}

impl Robot {
    /// Starts rosrescue and its nodes, and waits until all of it is there.
    pub(crate) fn start(kind: Kind, count: usize) -> Self {
        let scratch = Scratch::new();
        let master_port = free_port();
        let rescue = Setup::core(&scratch, master_port).start();
        let client = rescue.client();
        eventually("`rosversion` has been asked", || {
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
        // rosout has one of each, and both services that every node has.
        let wanted = [
            ("nodes", count + 1),
            ("publishers", 3 * count + 1),
            ("subscribers", 2 * count + 1),
            ("services", 2 * count + 2),
        ];
        eventually("every registration has come", || {
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

    /// Makes the master tell every subscriber of its publishers again, as in a life of hours: it keeps
    /// a connection to each node that it has called, and closes them all when it dies.
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

    /// Waits until nothing of what was started or killed before is still at work.
    pub(crate) fn settle(&self) {
        sleep(SETTLE);
    }

    /// What the real master holds.
    pub(crate) fn state(&self) -> State {
        State::read(&self.master)
    }

    /// The process id of the real master.
    pub(crate) fn master_pid(&self) -> u32 {
        self.master.master_pid().expect("the master's process id")
    }

    /// SIGKILL to the master, while a node calls it. Panics if anything of its state is lost.
    pub(crate) fn kill_master(&mut self) -> Recovery {
        let (before, pid) = (self.state(), self.master_pid());
        let recoveries = self.status()["recoveries"].as_u64().unwrap();
        let mut node = self.rescue.client().connect().expect("a connection");
        // The same value as before: the state is to be the same.
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
        let status = eventually_some("the recovery has been reported", || {
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

/// Starts so many at a time that each gets on: a rospy node takes half a second of a core.
fn real(scratch: &Scratch, port: u16, count: usize) -> Vec<Process> {
    let at_once = 2 * available_parallelism().map_or(2, usize::from);
    let mut nodes: Vec<Process> = Vec::new();
    for number in 0..count {
        eventually("the nodes before are ready", || {
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
