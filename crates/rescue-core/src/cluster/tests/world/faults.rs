//! What befalls computers, the network and etcd.

use std::time::Duration;

use super::super::super::machine::{Commit, Input, WhenAlone};
use super::{COMPUTERS, Event, MS, World};

#[derive(Clone, Debug)]
pub(in super::super) struct Plan {
    pub(in super::super) seed: u64,
    pub(in super::super) commit: Commit,
    pub(in super::super) alone: WhenAlone,
    pub(in super::super) faults: bool,
    pub(in super::super) ttl: Duration,
    /// Whether it is printed what happens.
    pub(in super::super) traced: bool,
}

#[derive(Debug, Default)]
pub(in super::super) struct Counts {
    pub(in super::super) reigns: u64,
    pub(in super::super) alone: u64,
    pub(in super::super) acknowledged: u64,
    pub(in super::super) merged: u64,
    pub(in super::super) reported: u64,
    /// The longest time that a call waited where nothing hung, while computers that are alone serve.
    pub(in super::super) waited: Duration,
}

impl Counts {
    pub(in super::super) fn add(&mut self, other: &Self) {
        self.reigns += other.reigns;
        self.alone += other.alone;
        self.acknowledged += other.acknowledged;
        self.merged += other.merged;
        self.reported += other.reported;
        self.waited = self.waited.max(other.waited);
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) enum Fault {
    Kill(usize),
    CutFromEtcd(usize),
    CutPair(usize, usize),
    /// From the other computers and from etcd.
    CutOff(usize),
    EtcdAway,
}

#[derive(Debug, Default)]
pub(super) struct Network {
    /// How many failures keep a computer from etcd,
    from_etcd: [u32; COMPUTERS],
    /// and from another one; the smaller index first.
    pairs: [[u32; COMPUTERS]; COMPUTERS],
    etcd_away: u32,
    slow_until: u64,
    slow_by: u64,
    healed: Option<u64>,
}

impl Network {
    pub(super) fn reaches_etcd(&self, at: usize) -> bool {
        self.healed.is_some() || (self.etcd_away == 0 && self.from_etcd[at] == 0)
    }

    pub(super) fn joins(&self, a: usize, b: usize) -> bool {
        self.healed.is_some() || self.pairs[a.min(b)][a.max(b)] == 0
    }

    pub(super) fn slow(&self, now: u64) -> u64 {
        if now < self.slow_until {
            self.slow_by
        } else {
            0
        }
    }

    /// Whether all has been well for that long.
    pub(super) fn healed_for(&self, now: u64, time: u64) -> bool {
        self.healed.is_some_and(|at| now > at + time)
    }

    fn cut(&mut self, fault: Fault, by: i32) {
        let add = |count: &mut u32| *count = count.checked_add_signed(by).unwrap();
        match fault {
            Fault::Kill(_) => {}
            Fault::CutFromEtcd(at) => add(&mut self.from_etcd[at]),
            Fault::CutPair(a, b) => add(&mut self.pairs[a.min(b)][a.max(b)]),
            Fault::CutOff(at) => {
                add(&mut self.from_etcd[at]);
                for other in (0..COMPUTERS).filter(|other| *other != at) {
                    add(&mut self.pairs[at.min(other)][at.max(other)]);
                }
            }
            Fault::EtcdAway => add(&mut self.etcd_away),
        }
    }
}

impl World {
    /// Something breaks, for a while.
    pub(super) fn fault(&mut self) {
        if !self.plan.faults || self.network.healed.is_some() {
            return;
        }
        let pause = (100 + self.dice.below(1500)) * MS;
        self.after(pause, Event::Fault);
        let at = self.dice.below(COMPUTERS as u64) as usize;
        // Who leads is hit more often.
        let leader = self.leaders().first().copied();
        let at = leader.filter(|_| self.dice.one_in(2)).unwrap_or(at);
        let other = (at + 1 + self.dice.below(COMPUTERS as u64 - 1) as usize) % COMPUTERS;
        let fault = match self.dice.below(9) {
            0 | 1 => Fault::Kill(at),
            2 => Fault::CutFromEtcd(at),
            3 => Fault::CutPair(at, other),
            4 => Fault::CutOff(at),
            5 => Fault::EtcdAway,
            6 => {
                let time = (20 + self.dice.below(5000)) * MS;
                let computer = &mut self.computers[at];
                computer.hangs_until = computer.hangs_until.max(self.now + time);
                computer.undisturbed_since = computer.hangs_until;
                return;
            }
            7 => {
                self.network.slow_until = self.now + self.dice.below(4000) * MS;
                self.network.slow_by = self.dice.below(2200) * MS;
                return;
            }
            _ => return self.hand_over(at),
        };
        if self.plan.traced {
            println!("{:>9} us: {fault:?}", self.now);
        }
        let time = (20 + self.dice.below(4000)) * MS;
        self.strike(fault, time);
    }

    fn strike(&mut self, fault: Fault, time: u64) {
        match fault {
            Fault::Kill(at) => self.kill(at),
            _ => self.network.cut(fault, 1),
        }
        self.after(time, Event::End(fault));
    }

    /// One failure of some seconds.
    pub(in super::super) fn fail_once(&mut self) -> String {
        let leader = self.leaders()[0];
        let follower = (leader + 1) % COMPUTERS;
        let kinds = [
            Fault::Kill(leader),
            Fault::Kill(follower),
            Fault::CutFromEtcd(leader),
            Fault::CutFromEtcd(follower),
            Fault::CutPair(leader, follower),
            Fault::CutOff(leader),
            Fault::CutOff(follower),
            Fault::EtcdAway,
        ];
        let fault = kinds[self.dice.below(kinds.len() as u64) as usize];
        let time = (20 + self.dice.below(6000)) * MS;
        self.strike(fault, time);
        format!("{fault:?} for {} ms", time / MS)
    }

    pub(super) fn end(&mut self, fault: Fault) {
        match fault {
            Fault::Kill(at) => self.start(at),
            _ => self.network.cut(fault, -1),
        }
    }

    pub(in super::super) fn kill(&mut self, at: usize) {
        self.computers[at].up = false;
    }

    fn start(&mut self, at: usize) {
        if !self.computers[at].up {
            let settings = (self.plan.commit, self.plan.alone, self.plan.ttl);
            self.computers[at].start(at, &settings);
            let followed = self.computers[at].followed;
            self.input(at, Input::Start(followed));
        }
    }

    pub(in super::super) fn hand_over(&mut self, at: usize) {
        if self.computers[at].up {
            self.input(at, Input::HandOver(String::new()));
        }
    }

    /// All failures end, and no more follow.
    pub(in super::super) fn heal(&mut self) {
        self.network.healed = Some(self.now);
        self.network.slow_until = 0;
        for at in 0..COMPUTERS {
            self.computers[at].hangs_until = self.computers[at].hangs_until.min(self.now);
            self.start(at);
        }
    }
}
