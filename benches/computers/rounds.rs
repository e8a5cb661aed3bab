//! Who leads changes, under calls through the computers that survive.

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

use rosrescue::xmlrpc::{Reply, Value};
use serde::Serialize;

use crate::{
    cluster::{Cluster, Election},
    shared::{
        caller::{Caller, Seen},
        support::{encode_call, eventually, params},
    },
};

/// What the readers read.
const READ: &str = "/computers/value";
/// What the writer sets.
const WRITTEN: &str = "/computers/count";
/// How long calls are watched at least.
const SPAN: Duration = Duration::from_millis(500);

/// What was seen of one change, in milliseconds.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Round {
    /// From the beginning of the change to the answer to the first write that was made after it.
    pub(crate) first_write: f64,
    /// The longest time of a write, and between the answers to two.
    pub(crate) write: f64,
    pub(crate) pause: f64,
    /// The longest time of a read.
    pub(crate) read: f64,
    /// Calls without an answer, and answers that were no success.
    pub(crate) failed: usize,
    pub(crate) refused: usize,
}

#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Takeover {
    pub(crate) election: Election,
    /// The member of etcd that died with the computer led etcd.
    pub(crate) led_etcd: bool,
    /// A survivor was cut off meanwhile, and answered for itself: etcd took longer for its own election.
    pub(crate) alone: bool,
    pub(crate) round: Round,
    /// What the status page of the next leader says, in milliseconds: from the last sign of the one before.
    pub(crate) said: f64,
}

/// The clients: a writer through one follower, and a reader through each of them.
struct Callers {
    writer: Caller,
    readers: [Caller; 2],
}

impl Callers {
    fn start(cluster: &Cluster, leader: usize) -> Self {
        cluster.client(leader).set_param(READ, 1);
        let followers = Cluster::followers(leader);
        let write = |number| encode_call("setParam", params!["/computers", WRITTEN, number]);
        let read = |_| encode_call("getParam", params!["/computers", READ]);
        let callers = Self {
            writer: Caller::start(cluster.client(followers[0]), write),
            readers: followers.map(|index| Caller::start(cluster.client(index), read)),
        };
        callers.wait();
        sleep(SPAN);
        callers
    }

    /// Until calls of all of them that began after this moment are answered.
    fn wait(&self) {
        let now = Instant::now();
        eventually("all clients are answered", || {
            let mut all = self.readers.iter().chain([&self.writer]);
            all.all(|caller| caller.answered_since(now))
        });
    }

    /// What they saw of the change that began at `begin`; every write that was answered must be there.
    fn end(self, cluster: &Cluster, begin: Instant) -> Round {
        self.wait();
        sleep(SPAN);
        let write = self.writer.seen_since(begin);
        let reads = self.readers.each_ref().map(|of| of.seen_since(begin));
        let last = self.writer.last();
        drop(self);
        // What was answered by one that was cut off comes to the leader a little later.
        eventually("every write that was answered is there", || {
            let held = cluster.client(cluster.leader()).param(WRITTEN);
            held.and_then(|value| value.as_int()) >= last
        });
        let all = || reads.iter().chain([&write]);
        Round {
            first_write: write.first,
            write: write.longest,
            pause: write.pause,
            read: reads.iter().map(|of| of.longest).fold(0.0, f64::max),
            failed: all().map(|of: &Seen| of.failed).sum(),
            refused: all().map(|of| of.refused).sum(),
        }
    }
}

/// The leading computer dies, with the member that leads etcd or with another one.
pub(crate) fn takeover(cluster: &mut Cluster, number: usize, led_etcd: bool) -> Takeover {
    cluster.place_leader_of_etcd(led_etcd);
    let leader = cluster.leader();
    let callers = Callers::start(cluster, leader);
    let survivors = Cluster::followers(leader);
    let times_cut_off = |cluster: &Cluster| -> usize {
        survivors
            .iter()
            .map(|index| cluster.times_cut_off(*index))
            .sum()
    };
    let alone = times_cut_off(cluster);
    let begin = cluster.kill(leader);
    let round = callers.end(cluster, begin);
    let alone = times_cut_off(cluster) > alone;
    let said = cluster.said() * 1e3;
    cluster.start_again(leader);
    cluster.settle();
    eprintln!("takeover {number}, etcd's leader as well: {led_etcd}, alone: {alone}: {round:.1?}");
    Takeover {
        election: cluster.election,
        led_etcd,
        alone,
        round,
        said,
    }
}

/// The leading computer gives up leading, as `rosrescue handover` has it.
pub(crate) fn handover(cluster: &Cluster, number: usize) -> Round {
    let leader = cluster.leader();
    let callers = Callers::start(cluster, leader);
    let follower = cluster.client(Cluster::followers(leader)[0]);
    let begin = Instant::now();
    let reply = follower.call("rosrescue/handover", params!["/computers", ""]);
    let success =
        matches!(&reply, Ok(Reply::Value(Value::Array(of))) if of.first() == Some(&Value::Int(1)));
    assert!(success, "{reply:?}");
    let round = callers.end(cluster, begin);
    assert_ne!(cluster.leader(), leader);
    cluster.settle();
    eprintln!("handover {number}: {round:.1?}");
    round
}
