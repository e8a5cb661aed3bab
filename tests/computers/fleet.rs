//! The robot: three computers, and what has to be so of all of them.

use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use crate::computer::{Computer, NAMES};
use crate::network::{COUNT, Network};
use crate::support::{PATIENCE, Scratch, State, eventually, eventually_some};

/// The time to live, as it is without an option.
pub(crate) const TTL: Duration = Duration::from_secs(2);

/// Another one leads after the time to live and 300 ms, or when etcd has elected a leader of its own (1.1 to 2.6 s). On a
/// machine that others use as well this may take longer.
pub(crate) const TAKEOVER: Duration = Duration::from_secs(5);

/// No read waits longer, on a machine that others use as well: alone on it, 0.1 s. One that waited for another
/// leader would take longer than this.
pub(crate) const READ: Duration = TTL;

#[derive(Debug)]
pub(crate) struct Fleet {
    // The order is that of the drops.
    pub(crate) computers: Vec<Computer>,
    pub(crate) network: Network,
    pub(crate) scratch: Arc<Scratch>,
}

impl Fleet {
    /// Three computers, each with an etcd, and nothing else. `options` are rosrescue's.
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

    /// A whole robot: rosrescue and nodes on each.
    #[track_caller]
    pub(crate) fn start(options: &[&str]) -> Self {
        Self::empty(options).whole()
    }

    /// As [`Self::start`], with the settings of etcd that docs/several-computers.md recommends.
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
    pub(crate) fn await_etcd(&self) {
        for computer in &self.computers {
            let what = format!("etcd of {} is healthy", computer.name);
            eventually(&what, || computer.etcd_is_healthy());
        }
    }

    /// A computer that was switched off comes back, with all that it had.
    #[track_caller]
    pub(crate) fn bring_back(&mut self, index: usize) {
        let computer = &mut self.computers[index];
        computer.boot();
        computer.start_etcd();
        computer.start_rescue();
        computer.await_answers();
        self.start_nodes(index);
    }

    /// Those who are on, without one.
    pub(crate) fn others(&self, index: usize) -> Vec<usize> {
        let on = |&other: &usize| other != index && self.computers[other].is_on();
        (0..COUNT).filter(on).collect()
    }

    /// Who says that it leads, if it is one.
    pub(crate) fn leader(&self) -> Option<usize> {
        self.leader_of(&[0, 1, 2])
    }

    /// Who of them says that it leads, if it is one.
    pub(crate) fn leader_of(&self, those: &[usize]) -> Option<usize> {
        let mut leaders = those.iter().filter(|&&index| {
            let computer = &self.computers[index];
            computer.is_on() && computer.role_is("leading")
        });
        leaders.next().filter(|_| leaders.next().is_none()).copied()
    }

    #[track_caller]
    pub(crate) fn await_leader_of(&self, those: &[usize]) -> usize {
        eventually_some("one of them leads", || self.leader_of(those))
    }

    /// Waits until one leads, and the others follow it and have all that it has. Panics with what they say.
    #[track_caller]
    pub(crate) fn await_whole(&self) -> usize {
        let start = Instant::now();
        loop {
            let seen: Vec<_> = self.computers.iter().map(Computer::seen).collect();
            let leader = self.leader();
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
            };
            if let Some(leader) = leader.filter(|_| (0..COUNT).all(agrees)) {
                return leader;
            }
            assert!(
                start.elapsed() < PATIENCE,
                "not all follow one leader: {seen:#?}"
            );
            sleep(Duration::from_millis(50));
        }
    }

    /// Waits until all computers say the same, and the leader's rosmaster says it, too. Answers what it is.
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

    /// Panics if a node that nobody has killed has ended.
    #[track_caller]
    pub(crate) fn assert_nodes_live(&mut self) {
        for computer in &mut self.computers {
            computer.assert_nodes_live();
        }
    }
}

/// `leader`, if this is the round for it, else one that follows: each is hit in turn, and the leader more often.
pub(crate) fn victim(round: usize, leader: usize) -> usize {
    let shift = usize::from(round % 3 == 1) * (1 + round / 3 % 2);
    (leader + shift) % COUNT
}
