//! Measures the time of a call through the leader and through a follower, compared with a single computer.

use std::{fmt, time::Duration};

use serde::Serialize;

use crate::{
    cluster::{Cluster, Data, Sync},
    shared::{
        load::{Load, NUMBER, Script},
        numbers::at,
        support::{Client, Rescue, Scratch, Setup, encode_call, eventually, free_port, params},
    },
};

const READ: &str = "/computers/small";
pub(crate) const CONNECTIONS: [usize; 2] = [1, 64];

/// A `rosrescue core` without `--cluster`.
pub(crate) struct Single {
    // Fields are dropped in this order.
    rescue: Rescue,
    _scratch: Scratch,
}

impl Single {
    pub(crate) fn start() -> Self {
        let scratch = Scratch::new();
        let rescue = Setup::core(&scratch, free_port()).guarded().start();
        let client = rescue.client();
        eventually("roscore's parameters are set", || {
            client.param("/rosdistro").is_some()
        });
        Self {
            rescue,
            _scratch: scratch,
        }
    }
}

/// The computer to which clients make their calls.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Through {
    Single,
    Leader,
    Follower,
}

impl Through {
    pub(crate) const ALL: [Self; 3] = [Self::Single, Self::Leader, Self::Follower];
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub(crate) enum Call {
    #[serde(rename = "setParam")]
    Write,
    #[serde(rename = "getParam")]
    Read,
}

impl fmt::Display for Call {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Write => "setParam",
            Self::Read => "getParam",
        })
    }
}

/// The results for a number of clients, in milliseconds.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Cost {
    pub(crate) sync: Sync,
    pub(crate) data: Data,
    pub(crate) call: Call,
    pub(crate) connections: usize,
    pub(crate) through: Through,
    pub(crate) median: f64,
    pub(crate) p99: f64,
    pub(crate) largest: f64,
    pub(crate) calls_per_second: f64,
}

/// The calls that client `number` makes.
pub(crate) fn script(call: Call, number: usize) -> Script {
    let name = format!("/computers/node_{number}");
    let name = name.as_str();
    Script::new([match call {
        Call::Write => {
            let key = format!("/computers/of/node_{number}");
            encode_call("setParam", params![name, key, NUMBER])
        }
        Call::Read => encode_call("getParam", params![name, READ]),
    }])
}

pub(crate) fn measure(single: &Single, cluster: &Cluster, seconds: f64, turns: usize) -> Vec<Cost> {
    let leader = cluster.leader();
    let parties = [
        single.rescue.client(),
        cluster.client(leader),
        cluster.client(Cluster::followers(leader)[0]),
    ];
    parties.iter().for_each(|client| client.set_param(READ, 17));
    let mut costs = Vec::new();
    for call in [Call::Write, Call::Read] {
        for connections in CONNECTIONS {
            let (sync, data) = (cluster.sync, cluster.data);
            eprintln!("{call}, {connections} connections, {sync}, {data}");
            let mut seen = Through::ALL.map(|_| (Vec::new(), 0.0));
            let time = Duration::from_secs_f64(seconds / turns as f64);
            for turn in 0..turns {
                // In each turn another party begins.
                for place in 0..parties.len() {
                    let place = (place + turn) % parties.len();
                    let (times, length) = &mut seen[place];
                    let (calls, took) = one_turn(&parties[place], call, connections, time);
                    times.extend(calls);
                    *length += took.as_secs_f64();
                }
            }
            costs.extend(Through::ALL.into_iter().zip(seen).map(
                |(through, (mut times, length))| {
                    times.sort();
                    Cost {
                        sync,
                        data,
                        call,
                        connections,
                        through,
                        median: at(&times, 0.5),
                        p99: at(&times, 0.99),
                        largest: at(&times, 1.0),
                        calls_per_second: times.len() as f64 / length,
                    }
                },
            ));
        }
    }
    assert_eq!(cluster.leader(), leader, "another computer took over");
    costs
}

fn one_turn(
    client: &Client,
    call: Call,
    connections: usize,
    time: Duration,
) -> (Vec<Duration>, Duration) {
    let scripts = (0..connections)
        .map(|number| script(call, number))
        .collect();
    let mut load = Load::connect(client.port(), scripts).expect("connections");
    // Parties that pool connections open as many as so many callers need.
    load.run(time / 5).expect("answers");
    let done = load.run(time).expect("answers");
    (done.calls, done.time)
}
