//! Changes the leader while clients make calls through the computers that survive.

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

use ros1_master::xmlrpc::{Reply, Value};
use serde::Serialize;

use crate::{
    cluster::{Cluster, Election},
    shared::{
        caller::{Caller, Seen},
        support::{encode_call, eventually, params},
    },
};

/// The parameter that the readers read.
const READ: &str = "/computers/value";
/// The parameter that the writer sets.
const WRITTEN: &str = "/computers/count";
/// Minimum time for which calls are observed.
const SPAN: Duration = Duration::from_millis(500);

/// What the clients saw of one change of the leader, in milliseconds.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Round {
    /// From the beginning of the change to the answer to the first write that was made after it.
    pub(crate) first_write: f64,
    /// The longest time of a write, or between the answers to two writes.
    pub(crate) write: f64,
    pub(crate) pause: f64,
    /// The longest time of a read.
    pub(crate) read: f64,
    /// Number of calls without an answer, and of answers that report no success.
    pub(crate) failed: usize,
    pub(crate) refused: usize,
}

#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Takeover {
    pub(crate) election: Election,
    /// Whether the etcd member that died with the computer was leading etcd.
    pub(crate) led_etcd: bool,
    /// Whether a survivor was cut off meanwhile and answered by itself, because etcd's own election took longer.
    pub(crate) alone: bool,
    pub(crate) round: Round,
    /// The duration of the takeover according to the next leader's status, in milliseconds: from the last sign of life
    /// of the previous leader.
    pub(crate) said: f64,
}

/// The clients: one writer through one follower, and one reader through each.
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

    /// Waits until each client has an answer to a call that began after this moment.
    fn wait(&self) {
        let now = Instant::now();
        eventually("all clients have been answered", || {
            let mut all = self.readers.iter().chain([&self.writer]);
            all.all(|caller| caller.answered_since(now))
        });
    }

    /// What the clients saw of the change that began at `begin`. Every answered write must be there.
    fn end(self, cluster: &Cluster, begin: Instant) -> Round {
        self.wait();
        sleep(SPAN);
        let write = self.writer.seen_since(begin);
        let reads = self.readers.each_ref().map(|of| of.seen_since(begin));
        let last = self.writer.last();
        drop(self);
        // Writes that a computer has answered while it was cut off reach the leader a little later.
        eventually("every answered write is there", || {
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

/// Kills the leading computer, together with the member that leads etcd or with another member.
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

/// Makes the leading computer hand over, like `rosrescue handover`.
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
