//! The robot with three computers, and the conditions that must hold for all of them.

use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use crate::computer::{Computer, NAMES};
use crate::network::{COUNT, Network};
use crate::support::{PATIENCE, Scratch, State, eventually, eventually_some};

/// The default of `--cluster-ttl`.
pub(crate) const TTL: Duration = Duration::from_secs(2);

/// The limit for a takeover after the time to live. It usually takes 300 ms, or 1.1 to 2.6 s if etcd must elect a new
/// leader too; on a busy machine it may take longer.
pub(crate) const TAKEOVER: Duration = Duration::from_secs(5);

/// The limit for a read on a busy machine; on an idle one, a read takes up to 0.1 s. A read that had to wait for a
/// takeover would exceed it.
pub(crate) const READ: Duration = TTL;

#[derive(Debug)]
pub(crate) struct Fleet {
    // Fields are dropped in this order.
    pub(crate) computers: Vec<Computer>,
    pub(crate) network: Network,
    pub(crate) scratch: Arc<Scratch>,
}

impl Fleet {
    /// Starts three computers with etcd, without rosrescue and nodes. `options` are for rosrescue.
    #[track_caller]
    pub(crate) fn empty(options: &[&str]) -> Self {
        Self::with(options, &[])
    }

    #[track_caller]
    fn with(options: &[&str], etcd_options: &[&str]) -> Self {
        let (network, scratch) = (Network::new(), Arc::new(Scratch::new()));
        let computers = (0..COUNT).map(|index| Computer::new(index, &network, &scratch));
        let mut fleet = Self {
            computers: computers.collect(),
            network,
            scratch,
        };
        for computer in &mut fleet.computers {
            computer.options = options.iter().map(|&option| option.to_owned()).collect();
            let etcd_options = etcd_options.iter();
            computer.etcd_options = etcd_options.map(|&option| option.to_owned()).collect();
            computer.boot();
            computer.start_etcd();
        }
        fleet.await_etcd();
        fleet
    }

    /// Starts three computers with etcd, rosrescue and nodes.
    #[track_caller]
    pub(crate) fn start(options: &[&str]) -> Self {
        Self::empty(options).whole()
    }

    /// Like [`Self::start`], with the settings of etcd that docs/several-computers.md recommends.
    #[track_caller]
    pub(crate) fn quick(options: &[&str]) -> Self {
        let etcd = [
            "--heartbeat-interval=50",
            "--election-timeout=500",
            "--pre-vote",
        ];
        Self::with(options, &etcd).whole()
    }

    #[track_caller]
    fn whole(mut self) -> Self {
        for index in 0..COUNT {
            self.computers[index].start_rescue();
        }
        for index in 0..COUNT {
            self.computers[index].await_answers();
        }
        self.await_whole();
        self.start_all_nodes();
        self
    }

    #[track_caller]
    pub(crate) fn await_etcd(&mut self) {
        for computer in &mut self.computers {
            let what = format!("etcd of {} is healthy", computer.name);
            eventually(&what, || {
                let ended = computer.etcd_ended();
                assert_eq!(
                    ended, None,
                    "etcd ended; `. tests/install_etcd.sh` unpacks one"
                );
                computer.etcd_is_healthy()
            });
        }
    }

    /// Switches a computer on again and starts etcd, rosrescue and its nodes.
    #[track_caller]
    pub(crate) fn bring_back(&mut self, index: usize) {
        let computer = &mut self.computers[index];
        computer.boot();
        computer.start_etcd();
        computer.start_rescue();
        computer.await_answers();
        self.start_nodes(index);
    }

    /// The computers that are switched on, except `index`.
    pub(crate) fn others(&self, index: usize) -> Vec<usize> {
        let on = |&other: &usize| other != index && self.computers[other].is_on();
        (0..COUNT).filter(on).collect()
    }

    /// The computer that says that it leads. `None` if there are none or several.
    pub(crate) fn leader(&self) -> Option<usize> {
        self.leader_of(&[0, 1, 2])
    }

    /// The one of `those` computers that says that it leads. `None` if there are none or several.
    pub(crate) fn leader_of(&self, those: &[usize]) -> Option<usize> {
        let mut leaders = those.iter().filter(|&&index| {
            let computer = &self.computers[index];
            computer.is_on() && computer.role_is("leading")
        });
        leaders.next().filter(|_| leaders.next().is_none()).copied()
    }

    #[track_caller]
    pub(crate) fn await_leader_of(&self, those: &[usize]) -> usize {
        eventually_some("one of the computers leads", || self.leader_of(those))
    }

    /// Waits until one computer leads, the others follow it and are not behind, and all know each other. Returns the
    /// leader; panics with what each computer reports.
    #[track_caller]
    pub(crate) fn await_whole(&self) -> usize {
        let start = Instant::now();
        loop {
            let seen: Vec<_> = self.computers.iter().map(Computer::seen).collect();
            let leading =
                |index: &usize| seen[*index].as_ref().is_some_and(|it| it.role == "leading");
            let mut leaders = (0..COUNT).filter(leading);
            let leader = leaders.next().filter(|_| leaders.next().is_none());
            let agrees = |index: usize| {
                let (Some(leader), Some(seen)) = (leader, &seen[index]) else {
                    return false;
                };
                let role = if index == leader {
                    "leading"
                } else {
                    "following"
                };
                seen.role == role
                    && seen.leader.as_deref() == Some(NAMES[leader])
                    && seen.behind == 0
                    && seen.known >= COUNT
            };
            if let Some(leader) = leader.filter(|_| (0..COUNT).all(agrees)) {
                return leader;
            }
            assert!(
                start.elapsed() < PATIENCE,
                "not all follow one leader: {seen:#?}"
            );
            sleep(Duration::from_millis(100));
        }
    }

    /// Waits until all computers and the leader's rosmaster have the same state, and returns it.
    #[track_caller]
    pub(crate) fn await_same_state(&self) -> State {
        let start = Instant::now();
        loop {
            let leader = self.await_whole();
            let states = self.computers.iter().map(|computer| {
                let state = computer.state();
                state.map_err(|error| format!("{}: {error}", computer.name))
            });
            let master = self.computers[leader].master_state();
            let master = master.map_err(|error| format!("rosmaster: {error}"));
            let mut states: Vec<_> = states.chain([master]).collect();
            if let Ok(first) = &states[0]
                && states.iter().all(|state| state.as_ref() == Ok(first))
            {
                return states.swap_remove(0).unwrap();
            }
            if start.elapsed() > PATIENCE {
                let first = states[0].clone().unwrap();
                for (index, state) in states.into_iter().enumerate() {
                    let who = NAMES.get(index).unwrap_or(&"the leader's rosmaster");
                    first.assert_same(&state.unwrap(), &format!("between a and {who}"));
                }
            }
            sleep(Duration::from_millis(100));
        }
    }

    /// Panics if a node of a computer has ended.
    #[track_caller]
    pub(crate) fn assert_nodes_live(&mut self) {
        for computer in &mut self.computers {
            computer.assert_nodes_live();
        }
    }
}

/// The computer that fails in this round: in turn the leader, one follower, the leader, the leader, the other follower
/// and the leader.
pub(crate) fn victim(round: usize, leader: usize) -> usize {
    let shift = usize::from(round % 3 == 1) * (1 + round / 3 % 2);
    (leader + shift) % COUNT
}
