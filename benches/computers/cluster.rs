//! Three computers on loopback, each with an etcd and a `rosrescue core`.

use std::{
    fmt,
    os::unix::fs::symlink,
    thread::sleep,
    time::{Duration, Instant},
};

use clap::ValueEnum;
use rustix::process::Signal;
use serde::Serialize;
use serde_json::{Value as Json, json};
use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};

use crate::{
    servers::{LIMIT, Servers},
    shared::{
        nodes::synthetic,
        support::{
            Client, FakeNode, Rescue, Scratch, Setup, eventually, eventually_some, free_port,
            signal, status,
        },
    },
};

pub(crate) const COUNT: usize = 3;
/// The default of `--cluster-ttl`.
pub(crate) const TIME_TO_LIVE: Duration = Duration::from_secs(2);
/// A file system in memory.
const MEMORY: &str = "/dev/shm";
/// Time to wait after a change of the leader, because every node is then asked whether it is alive.
const SETTLE: Duration = Duration::from_secs(1);

/// Where etcd stores its data.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Data {
    /// In Cargo's target folder
    Disk,
    /// In `/dev/shm`
    Memory,
}

impl fmt::Display for Data {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Disk => "disk",
            Self::Memory => "memory",
        })
    }
}

/// The value of `--cluster-sync`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Sync {
    Always,
    Interval,
}

impl fmt::Display for Sync {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Always => "always",
            Self::Interval => "interval",
        })
    }
}

/// How long etcd's leader must be silent before etcd elects another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Election {
    /// 1 s, etcd's default.
    Usual,
    /// 500 ms.
    Quick,
}

impl Election {
    fn arguments(self) -> &'static [&'static str] {
        match self {
            Self::Usual => &[],
            Self::Quick => &["--heartbeat-interval=50", "--election-timeout=500"],
        }
    }
}

/// Three etcd servers.
pub(crate) struct Engine {
    pub(crate) servers: Servers,
    pub(crate) runtime: Runtime,
    _memory: Option<TempDir>,
}

impl Engine {
    pub(crate) fn start(data: Data, election: Election) -> Self {
        let scratch = Scratch::new();
        let memory = (data == Data::Memory).then(|| {
            let folder = TempDir::new_in(MEMORY).expect("a folder in memory");
            for index in 0..COUNT {
                let name = Servers::folder(index);
                let place = folder.path().join(&name);
                std::fs::create_dir(&place).expect("a folder in memory");
                symlink(place, scratch.path(name)).expect("a link to it");
            }
            folder
        });
        let runtime = Builder::new_current_thread().enable_all().build();
        let runtime = runtime.expect("a runtime");
        let servers = runtime.block_on(Servers::with(scratch, COUNT, "http", election.arguments()));
        Self {
            servers,
            runtime,
            _memory: memory,
        }
    }

    /// The number of the member that leads etcd.
    fn leader(&self) -> usize {
        self.runtime.block_on(self.servers.leader())
    }

    /// Makes member `index` lead etcd.
    fn let_lead(&self, index: usize) {
        let leads = self.leader();
        if leads == index {
            return;
        }
        let members = self.servers.post("cluster/member/list", &json!({}));
        let members = members["members"].as_array().expect("a list of members");
        let name = Servers::folder(index);
        let member = members.iter().find(|member| member["name"] == *name);
        let target = &member.expect("the member")["ID"];
        self.servers.post_to(
            leads,
            "maintenance/transfer-leadership",
            &json!({ "targetID": target }),
        );
        eventually("another member leads etcd", || self.leader() == index);
    }

    fn is_whole(&self) -> bool {
        let client = self.servers.client();
        let all = self.runtime.block_on(client.status(LIMIT));
        all.iter().all(Result::is_ok)
    }
}

struct Computer {
    // Fields are dropped in this order. The scratch folder comes last and ends everything that is left.
    rescue: Rescue,
    scratch: Scratch,
}

/// The computers, and nodes that run on none of them.
pub(crate) struct Cluster {
    // Fields are dropped in this order.
    computers: Vec<Computer>,
    nodes: Vec<FakeNode>,
    engine: Engine,
    pub(crate) sync: Sync,
    pub(crate) data: Data,
    pub(crate) election: Election,
}

impl Cluster {
    pub(crate) fn start(sync: Sync, data: Data, election: Election, nodes: usize) -> Self {
        eprintln!("three computers, {sync}, etcd's data in {data}");
        let engine = Engine::start(data, election);
        let computers = (0..COUNT).map(|index| {
            let scratch = Scratch::new();
            let url = engine.servers.endpoints(index).join(",") + "/robot";
            let setup = Setup::core(&scratch, free_port()).guarded();
            let setup = setup
                .args(["--cluster", &url, "--cluster-sync", &sync.to_string()])
                .arg(format!("--cluster-name=pc-{}", index + 1))
                .arg(format!("--cluster-ttl={}", TIME_TO_LIVE.as_secs()));
            let rescue = setup.spawn();
            Computer { rescue, scratch }
        });
        let mut cluster = Self {
            election,
            computers: computers.collect(),
            nodes: Vec::new(),
            engine,
            sync,
            data,
        };
        cluster.settle();
        cluster.nodes = synthetic(&cluster.client(cluster.leader()), nodes);
        cluster.settle();
        cluster
    }

    pub(crate) fn client(&self, index: usize) -> Client {
        self.computers[index].rescue.client()
    }

    pub(crate) fn checkpoint(&self, index: usize) -> std::path::PathBuf {
        self.computers[index].rescue.checkpoint()
    }

    /// The number of the leading computer.
    pub(crate) fn leader(&self) -> usize {
        eventually_some("a computer leads", || {
            (0..COUNT).find(|index| self.role(*index).as_deref() == Some("leading"))
        })
    }

    /// The numbers of the other computers, in a fixed order.
    pub(crate) fn followers(leader: usize) -> [usize; COUNT - 1] {
        [(leader + 1) % COUNT, (leader + 2) % COUNT]
    }

    fn role(&self, index: usize) -> Option<String> {
        let role = self.cluster_status(index)?["role"].as_str()?.to_owned();
        Some(role)
    }

    fn cluster_status(&self, index: usize) -> Option<Json> {
        // rosrescue may not listen yet.
        self.client(index).connect().ok()?;
        Some(status(&self.client(index))["cluster"].clone())
    }

    /// Waits until one computer leads and has a master, the others follow it, and all nodes were asked.
    pub(crate) fn settle(&self) {
        eventually("all members of etcd are up", || self.engine.is_whole());
        let leader = self.leader();
        eventually("the leader has a master", || {
            let client = self.client(leader);
            status(&client)["open"] == true && client.param("/rosdistro").is_some()
        });
        eventually("the other computers follow", || {
            let mut followers = Self::followers(leader).into_iter();
            followers.all(|index| {
                let status = self.cluster_status(index).unwrap_or_default();
                status["role"] == "following" && status["behind"] == 0
            })
        });
        // rosout has one publisher.
        let publishers = 3 * self.nodes.len() + 1;
        eventually("all nodes and rosout are registered", || {
            status(&self.client(leader))["state"]["publishers"] == publishers
        });
        sleep(SETTLE);
    }

    /// Makes the leading computer's member lead etcd, or another member.
    pub(crate) fn place_leader_of_etcd(&self, with_leader: bool) {
        let leader = self.leader();
        let index = match with_leader {
            true => leader,
            false => Self::followers(leader)[0],
        };
        self.engine.let_lead(index);
    }

    /// Sends SIGKILL to everything that runs on this computer. Returns when that began.
    pub(crate) fn kill(&mut self, index: usize) -> Instant {
        let processes = self.computers[index].scratch.survivors();
        let begin = Instant::now();
        for (pid, _) in processes {
            signal(pid, Signal::KILL);
        }
        self.engine.servers.kill(index);
        begin
    }

    /// Starts the computer again.
    pub(crate) fn start_again(&mut self, index: usize) {
        self.engine.servers.start(index);
        let rescue = &mut self.computers[index].rescue;
        rescue.wait();
        rescue.start_again();
    }

    /// How often this computer has logged that it is cut off.
    pub(crate) fn times_cut_off(&self, index: usize) -> usize {
        let lines = self.computers[index].rescue.output().into_iter();
        lines.filter(|line| line.contains("ALONE:")).count()
    }

    /// The time of the last takeover in seconds, as reported by the leading computer.
    pub(crate) fn said(&self) -> f64 {
        let status = self.cluster_status(self.leader()).unwrap_or_default();
        let seconds = status["last_takeover"]["seconds"].as_f64();
        seconds.unwrap_or(f64::NAN)
    }
}
