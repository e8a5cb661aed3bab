//! Builds the present status.

use std::{
    collections::BTreeMap,
    sync::{Mutex, PoisonError},
    time::Instant,
};

use rescue_core::health::Health;
use ros1_master::master::Master;

use super::Pages;
use crate::{
    clock,
    gate::State,
    ledger::disk_jobs::StoreState,
    nodes::liveness::Life,
    status::{
        DiskStatus,
        computers::Computers,
        condition::{NodesTrouble, Situation, condition},
        summary::{JournalStatus, NodeHealth, NodesStatus, SCHEMA, Status},
    },
};

/// Shortest time, in seconds, over which the calls per second are counted.
const SAMPLE: f64 = 1.0;
/// Number of callers listed as the slowest.
const SLOWEST: usize = 20;

/// Calls per second, counted between two requests for the status. Without requests, counting costs nothing.
#[derive(Debug)]
pub(crate) struct Rate(Mutex<Sample>);

#[derive(Debug)]
struct Sample {
    at: Instant,
    calls: u64,
    rate: f64,
}

impl Rate {
    pub(crate) fn new(now: Instant) -> Self {
        Self(Mutex::new(Sample {
            at: now,
            calls: 0,
            rate: 0.0,
        }))
    }

    /// The rate at `now`, when `calls` is the total number of calls.
    fn rate_at(&self, now: Instant, calls: u64) -> f64 {
        let mut last = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let seconds = now.saturating_duration_since(last.at).as_secs_f64();
        if seconds >= SAMPLE {
            let new = calls.saturating_sub(last.calls) as f64;
            *last = Sample {
                at: now,
                calls,
                rate: new / seconds,
            };
        }
        (last.rate * 10.0).round() / 10.0
    }
}

impl Pages {
    pub(super) fn status(&self) -> Status {
        let counters = self.stats.list().into_iter();
        let counters = counters.map(|(name, _, value)| (name.to_owned(), value.into()));
        let gate = self.gate.state();
        let gate_since = self.gate.opened_or_shut_at().into_std();
        let stands_in = gate.is_injecting() || matches!(gate, State::StandingIn | State::Late);
        let facts = self.board.read();
        let unprotected = self.ledger.unprotected();
        let master = self.upstream.address().to_string();
        let lives = self.nodes.lives();
        let situation = Situation {
            gate,
            gate_since,
            unprotected: unprotected.clone(),
            master: master.clone(),
            nodes: self.nodes.trouble(&lives),
        };
        let rescues = facts.reports.iter().filter(|report| report.is_rescue());
        let last = (facts.recoveries > 0)
            .then(|| facts.reports.back())
            .flatten();
        Status {
            schema: SCHEMA,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            mode: facts.mode,
            pid: std::process::id(),
            started: clock::wall_time_of(facts.started),
            uptime: facts.started.elapsed().as_secs_f64(),
            uri: self.uri.clone(),
            condition: condition(&situation, &facts),
            master,
            master_pid: last.map(|report| report.master_pid),
            master_speaks: last.map(|report| report.master_speaks.clone()),
            bypassing: facts.bypassing.clone(),
            master_is_open: facts.master_is_open,
            open: gate.is_open(),
            ready: facts.answers_calls(gate),
            elsewhere: gate == State::Elsewhere,
            standing_in_since: stands_in.then(|| clock::wall_time_of(gate_since)),
            pending_writes: self.ledger.pending(),
            crash_loop: facts.crash_loop.is_some(),
            deaths: facts.deaths,
            worker_restarts: facts.earlier.worker_restarts,
            checkpoint: self.checkpoint.clone(),
            unprotected,
            journal: self.journal(&facts.disk),
            guarded: facts.guarded.is_guarded(),
            guarded_by: facts.guarded.to_string(),
            state: self.ledger.with_mirror(Master::counts),
            nodes: Self::nodes_status(situation.nodes, &lives),
            recoveries: facts.recoveries,
            last_recovery: last.cloned(),
            rescues: facts.rescues,
            last_rescues: rescues.cloned().collect(),
            late_answers: facts.late_answers.clone(),
            calls_per_second: self.rate.rate_at(Instant::now(), self.stats.calls.value()),
            slowest_callers: self.clients.slowest(SLOWEST),
            clients: self.clients.list(),
            counters: counters.collect(),
            cluster: facts.cluster.as_ref().map(Computers::from),
        }
    }

    fn nodes_status(trouble: NodesTrouble, lives: &BTreeMap<String, Life>) -> NodesStatus {
        let of = |health| {
            let names = lives.iter().filter(|(_, life)| life.health == health);
            names.map(|(name, _)| name.clone()).collect::<Vec<_>>()
        };
        let ill = lives
            .iter()
            .filter(|(_, life)| life.health != Health::Alive);
        let ill = ill.map(|(name, life)| {
            let health = NodeHealth {
                health: life.health,
                since: clock::wall_time_of(life.since).round(),
            };
            (name.clone(), health)
        });
        NodesStatus {
            unreachable: of(Health::Unreachable),
            dead_nodes: of(Health::Dead),
            unchecked_nodes: of(Health::Unchecked),
            alive_nodes: of(Health::Alive).len(),
            node_health: ill.collect(),
            unregistered_nodes: trouble.unregistered,
            feuds: trouble.feuds,
            lost_addresses: trouble.lost_addresses,
            misaddressed_nodes: trouble.misaddressed,
        }
    }

    fn journal(&self, disk: &DiskStatus) -> JournalStatus {
        let seen = self.ledger.seen_store().unwrap_or_default();
        let StoreState {
            seq,
            journal_bytes: bytes,
            snapshot_bytes,
            ..
        } = seen;
        let (at, from) = disk.compacted.unzip();
        JournalStatus {
            records: seq.saturating_sub(from.unwrap_or(seq)),
            bytes,
            snapshot_bytes,
            last_compaction: at.map(clock::wall_time_of),
            disk_free_bytes: disk.free,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn calls_a_second_are_counted_between_two_that_ask() {
        let start = Instant::now();
        let rate = Rate::new(start);
        let at = |ms, calls| rate.rate_at(start + Duration::from_millis(ms), calls);
        assert_eq!(at(100, 50), 0.0, "too early to say");
        assert_eq!(at(2_000, 100), 50.0);
        assert_eq!(at(2_500, 900), 50.0, "what was said last");
        assert_eq!(at(4_000, 200), 50.0);
        assert_eq!(at(14_000, 201), 0.1);
    }
}
