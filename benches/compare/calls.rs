//! Measures one kind of call at a time, over few and many connections, with the parties taking turns.

use std::{io, time::Duration};

use ros1_master::xmlrpc::{self, Struct, Value};
use serde::{Serialize, Serializer};

use crate::{
    party::{Kind, Party},
    shared::{
        cpu::Cpu,
        load::{Load, NUMBER, Script},
        numbers::at,
        support::{Client, encode_call, params},
    },
};

const SMALL: &str = "/compare/small";
const TEXT: &str = "/compare/text";
const MANY: &str = "/compare/many";
/// Number of `setParam` calls in the multicall, before its last call.
const LAUNCH: usize = 100;

/// The kind of call to measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Call {
    GetPid,
    GetParam,
    /// Reads a text of this many KB, such as a `robot_description`.
    GetText(usize),
    /// Reads 10,000 parameters.
    GetAll,
    SetParam,
    /// Calls `registerPublisher` and `unregisterPublisher` in turn.
    Register,
    /// Makes the multicall with which `roslaunch` sets parameters.
    Launch,
}

/// The calls to measure, with their numbers of connections. Combinations that take seconds per call are left
/// out.
pub(crate) const WHOLE: &[(Call, &[usize])] = &[
    (Call::GetPid, &[1, 8, 64, 512]),
    (Call::GetParam, &[1, 8, 64, 512]),
    (Call::GetText(100), &[1, 8, 64, 512]),
    (Call::GetText(5_000), &[1, 8]),
    (Call::GetAll, &[1, 8]),
    (Call::SetParam, &[1, 8, 64, 512]),
    (Call::Register, &[1, 8, 64, 512]),
    (Call::Launch, &[1, 8]),
];

/// The calls to measure with this version and an earlier one.
pub(crate) const VERSIONS: &[(Call, &[usize])] = &[
    (Call::GetParam, &[1, 64]),
    (Call::SetParam, &[1, 64]),
    (Call::Register, &[1, 64]),
    (Call::Launch, &[1]),
];

/// The calls to measure on a small computer.
pub(crate) const SMALLER: &[(Call, &[usize])] = &[
    (Call::GetPid, &[1, 8]),
    (Call::GetParam, &[1, 8, 64]),
    (Call::GetText(100), &[1]),
    (Call::GetAll, &[1]),
    (Call::SetParam, &[1, 8, 64]),
    (Call::Register, &[1, 8, 64]),
    (Call::Launch, &[1]),
];

impl std::fmt::Display for Call {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::GetPid => f.write_str("getPid"),
            Self::GetParam => f.write_str("getParam, 250 bytes"),
            Self::GetText(kb @ ..1_000) => write!(f, "getParam, {kb} KB"),
            Self::GetText(kb) => write!(f, "getParam, {} MB", kb / 1_000),
            Self::GetAll => f.write_str("getParam('/'), 10,000"),
            Self::SetParam => f.write_str("setParam"),
            Self::Register => f.write_str("registerPublisher"),
            Self::Launch => f.write_str("multicall of 101"),
        }
    }
}

impl Serialize for Call {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl Call {
    /// Sets the parameters that the call reads.
    fn prepare(self, client: &Client) {
        match self {
            Self::GetParam => client.set_param(SMALL, 1),
            Self::GetText(kb) => client.set_param(TEXT, text(kb * 1_000)),
            Self::GetAll => many(client, MANY, 10_000),
            Self::GetPid | Self::SetParam | Self::Register | Self::Launch => {}
        }
    }

    /// Deletes large parameters, which no other call needs.
    fn clean(self, client: &Client) {
        let large = match self {
            Self::GetText(_) => TEXT,
            Self::GetAll => MANY,
            _ => return,
        };
        client.ok("deleteParam", params!["/compare", large]);
    }

    /// The calls that client `number` makes.
    pub(crate) fn script(self, number: usize) -> Script {
        let node = format!("/compare/node_{number}");
        let name = node.as_str();
        let get = |key: &str| vec![encode_call("getParam", params![name, key])];
        let bodies = match self {
            Self::GetPid => vec![encode_call("getPid", params![name])],
            Self::GetParam => get(SMALL),
            Self::GetText(_) => get(TEXT),
            Self::GetAll => get("/"),
            Self::SetParam => {
                let key = format!("/compare/of/node_{number}");
                vec![encode_call("setParam", params![name, key, NUMBER])]
            }
            Self::Register => {
                let (topic, api) = (
                    format!("{node}/topic"),
                    format!("http://127.0.0.1:{}/", 1 + number),
                );
                let (topic, api) = (topic.as_str(), api.as_str());
                let topic_type = "std_msgs/String";
                vec![
                    encode_call("registerPublisher", params![name, topic, topic_type, api]),
                    encode_call("unregisterPublisher", params![name, topic, api]),
                ]
            }
            Self::Launch => {
                let space = format!("/compare/launch_{number}");
                let set = |key| {
                    let key = format!("{space}/key_{key}");
                    xmlrpc::Call::new("setParam", params![name, key, NUMBER])
                };
                let delete = xmlrpc::Call::new("deleteParam", params![name, space.clone()]);
                let calls = (0..LAUNCH).map(set).chain([delete]);
                vec![xmlrpc::encode_call(&xmlrpc::Call::multicall(calls))]
            }
        };
        Script::new(bodies)
    }
}

/// A text like a robot's description, with as many characters that must be escaped.
fn text(bytes: usize) -> String {
    let mut text = String::new();
    // Each line is six bytes longer in XML.
    let mut escaped = 0;
    while escaped < bytes {
        let line = "<origin xyz=\"0.0125 -0.03 0.251\" rpy=\"0 0 1.5707\"/>\n";
        text += line;
        escaped += line.len() + 6;
    }
    text
}

/// Sets `count` parameters below `key`, of the usual types, in groups of at most a hundred.
pub(crate) fn many(client: &Client, key: &str, count: usize) {
    const GROUP: usize = 100;
    for group in 0..count.div_ceil(GROUP) {
        let value = |number: usize| match (i32::try_from(number), number % 4) {
            (Ok(number), 0) => Value::from(number),
            (Ok(number), 1) => Value::from(f64::from(number) / 8.0),
            (_, 2) => Value::from(true),
            _ => Value::from(format!("value {number}")),
        };
        let numbers = group * GROUP..count.min((group + 1) * GROUP);
        let members = numbers.map(|number| (format!("key_{number}"), value(number)));
        let members = Value::Struct(Struct::from_iter(members));
        client.set_param(&format!("{key}/group_{group}"), members);
    }
}

/// The results of one party in one turn.
#[derive(Clone, Debug, Serialize)]
struct Turn {
    calls: usize,
    seconds: f64,
    median_ms: f64,
    p99_ms: f64,
    own_cpu_seconds: f64,
    master_cpu_seconds: f64,
    reconnections: usize,
}

/// The results of one party in all its turns.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Seen {
    pub(crate) party: Kind,
    pub(crate) median_ms: f64,
    pub(crate) p99_ms: f64,
    pub(crate) largest_ms: f64,
    pub(crate) calls_per_second: f64,
    /// Processor time per call of everything in front of the master, in µs.
    pub(crate) own_cpu_us: f64,
    /// Processor time per call of the master, in µs.
    pub(crate) master_cpu_us: f64,
    turns: Vec<Turn>,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct Cell {
    pub(crate) call: Call,
    pub(crate) connections: usize,
    pub(crate) parties: Vec<Seen>,
}

impl Cell {
    pub(crate) fn of(&self, kind: Kind) -> &Seen {
        let mut parties = self.parties.iter();
        parties.find(|seen| seen.party == kind).expect("a party")
    }
}

/// Measures every combination in `plan`, with `seconds` for each party, divided among `turns` turns.
pub(crate) fn measure(
    parties: &[Party],
    plan: &[(Call, &[usize])],
    seconds: f64,
    turns: usize,
) -> Vec<Cell> {
    let mut cells = Vec::new();
    for (call, connections) in plan {
        for party in parties {
            call.prepare(&party.client);
        }
        for &connections in *connections {
            eprintln!("{call}, {connections} connections");
            cells.push(cell(parties, *call, connections, seconds, turns));
        }
        for party in parties {
            call.clean(&party.client);
        }
    }
    cells
}

fn cell(parties: &[Party], call: Call, connections: usize, seconds: f64, turns: usize) -> Cell {
    let time = Duration::from_secs_f64(seconds / turns as f64);
    let mut seen: Vec<_> = parties.iter().map(|_| (Vec::new(), Vec::new())).collect();
    for turn in 0..turns {
        // In each turn another party begins.
        for place in 0..parties.len() {
            let place = (place + turn) % parties.len();
            let (times, turns) = &mut seen[place];
            let party = &parties[place];
            let (calls, turn) = one_turn(party, call, connections, time)
                .unwrap_or_else(|error| panic!("{}, {call}: {error}", party.kind));
            times.extend(calls);
            turns.push(turn);
        }
    }
    let seen = parties.iter().zip(seen);
    Cell {
        call,
        connections,
        parties: seen
            .map(|(party, (times, turns))| Seen::new(party.kind, times, turns))
            .collect(),
    }
}

fn one_turn(
    party: &Party,
    call: Call,
    connections: usize,
    time: Duration,
) -> io::Result<(Vec<Duration>, Turn)> {
    let scripts = (0..connections).map(|number| call.script(number)).collect();
    let mut load = Load::connect(party.client.port(), scripts)?;
    // Parties that pool connections open as many as so many callers need.
    load.run(time / 5)?;
    let (own, master) = (party.own(), [party.master_pid]);
    let before = (Cpu::read(&own), Cpu::read(&master));
    let done = load.run(time)?;
    // Read while all are connected, because the master has a thread for each connection.
    let after = (Cpu::read(&own), Cpu::read(&master));
    drop(load);
    let mut sorted = done.calls.clone();
    sorted.sort();
    let turn = Turn {
        calls: sorted.len(),
        seconds: done.time.as_secs_f64(),
        reconnections: done.reconnections,
        median_ms: at(&sorted, 0.5),
        p99_ms: at(&sorted, 0.99),
        own_cpu_seconds: after.0.since(&before.0).as_secs_f64(),
        master_cpu_seconds: after.1.since(&before.1).as_secs_f64(),
    };
    Ok((done.calls, turn))
}

impl Seen {
    fn new(party: Kind, mut times: Vec<Duration>, turns: Vec<Turn>) -> Self {
        times.sort();
        let sum = |of: fn(&Turn) -> f64| turns.iter().map(of).sum::<f64>();
        let calls = times.len() as f64;
        Self {
            party,
            median_ms: at(&times, 0.5),
            p99_ms: at(&times, 0.99),
            largest_ms: at(&times, 1.0),
            calls_per_second: calls / sum(|turn| turn.seconds),
            own_cpu_us: sum(|turn| turn.own_cpu_seconds) * 1e6 / calls,
            master_cpu_us: sum(|turn| turn.master_cpu_seconds) * 1e6 / calls,
            turns,
        }
    }
}
