//! Failures of computers, of the network and of etcd.

use std::time::Duration;

use super::{COMPUTERS, Event, MS, World};
use crate::cluster::{
    machine::{Commit, WhenAlone},
    member::Input,
};

#[derive(Clone, Debug)]
pub(in super::super) struct ScheduleOptions {
    pub(in super::super) seed: u64,
    pub(in super::super) commit: Commit,
    pub(in super::super) alone: WhenAlone,
    pub(in super::super) faults: bool,
    /// Whether etcd loses data, too: keys are deleted, or an older copy is restored.
    pub(in super::super) data_loss: bool,
    /// Whether processes also stop in order.
    pub(in super::super) stops: bool,
    /// Whether two computers have the same name.
    pub(in super::super) twins: bool,
    pub(in super::super) ttl: Duration,
    /// Whether to print all events.
    pub(in super::super) traced: bool,
}

#[derive(Debug, Default)]
pub(in super::super) struct Counts {
    pub(in super::super) leaderships: u64,
    pub(in super::super) alone: u64,
    pub(in super::super) acknowledged: u64,
    pub(in super::super) reads: u64,
    pub(in super::super) merged: u64,
    pub(in super::super) reported: u64,
    /// How often a process has stopped in order.
    pub(in super::super) stopped: u64,
    /// How often a computer noticed that etcd had lost its data.
    pub(in super::super) etcds_lost: u64,
    /// How often etcd's keys were deleted, and how often an older copy was restored.
    pub(in super::super) deleted: u64,
    pub(in super::super) restored: u64,
    /// The longest time that a call waited on a computer that did not hang, with `--alone serve`.
    pub(in super::super) waited: Duration,
}

impl Counts {
    pub(in super::super) fn add(&mut self, other: &Self) {
        self.leaderships += other.leaderships;
        self.alone += other.alone;
        self.acknowledged += other.acknowledged;
        self.reads += other.reads;
        self.merged += other.merged;
        self.reported += other.reported;
        self.stopped += other.stopped;
        self.etcds_lost += other.etcds_lost;
        self.deleted += other.deleted;
        self.restored += other.restored;
        self.waited = self.waited.max(other.waited);
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) enum Fault {
    Kill(usize),
    /// The computer's power fails, so its disk goes back to the last sync.
    PowerCut(usize),
    AllPowerCut,
    CutFromEtcd(usize),
    CutPair(usize, usize),
    /// No message from the first computer reaches the second.
    CutOneWay(usize, usize),
    /// The computer is cut off from the other computers and from etcd.
    CutOff(usize),
    EtcdAway,
}

#[derive(Debug, Default)]
pub(super) struct Network {
    /// How many failures cut each computer off from etcd.
    from_etcd: [u32; COMPUTERS],
    /// How many failures cut the way from one computer to another.
    ways: [[u32; COMPUTERS]; COMPUTERS],
    etcd_away: u32,
    slow_until: u64,
    slow_by: u64,
    etcd_slow_until: u64,
    etcd_slow_by: u64,
    healed: Option<u64>,
}

impl Network {
    pub(super) fn reaches_etcd(&self, at: usize) -> bool {
        self.healed.is_some() || (self.etcd_away == 0 && self.from_etcd[at] == 0)
    }

    pub(super) fn joins(&self, from: usize, to: usize) -> bool {
        self.healed.is_some() || self.ways[from][to] == 0
    }

    pub(super) fn slow(&self, now: u64) -> u64 {
        match now < self.slow_until {
            true => self.slow_by,
            false => 0,
        }
    }

    pub(super) fn etcd_slow(&self, now: u64) -> u64 {
        match now < self.etcd_slow_until {
            true => self.etcd_slow_by,
            false => 0,
        }
    }

    /// Whether the last failure ended more than `time` ago.
    pub(super) fn healed_for(&self, now: u64, time: u64) -> bool {
        self.healed.is_some_and(|at| now > at + time)
    }

    fn cut(&mut self, fault: Fault, by: i32) {
        let add = |count: &mut u32| *count = count.checked_add_signed(by).unwrap();
        match fault {
            Fault::Kill(_) | Fault::PowerCut(_) | Fault::AllPowerCut => {}
            Fault::CutFromEtcd(at) => add(&mut self.from_etcd[at]),
            Fault::CutPair(a, b) => {
                add(&mut self.ways[a][b]);
                add(&mut self.ways[b][a]);
            }
            Fault::CutOneWay(from, to) => add(&mut self.ways[from][to]),
            Fault::CutOff(at) => {
                add(&mut self.from_etcd[at]);
                for other in (0..COMPUTERS).filter(|other| *other != at) {
                    add(&mut self.ways[at][other]);
                    add(&mut self.ways[other][at]);
                }
            }
            Fault::EtcdAway => add(&mut self.etcd_away),
        }
    }
}

impl World {
    pub(super) fn etcd_is_lost(&mut self, at: usize) {
        self.counts.etcds_lost += 1;
        // What it answered as the leader of the lost journal has a partition of its own, too.
        self.computers[at].times_alone += 1;
        self.history.forgets(at, self.now);
    }

    /// Begins a random failure that ends after a while.
    pub(super) fn fault(&mut self) {
        if !self.plan.faults || self.network.healed.is_some() {
            return;
        }
        let pause = (100 + self.dice.below(1500)) * MS;
        self.after(pause, Event::Fault);
        if self.etcd.log.is_empty() {
            // As long as the journal is empty, only the first leader has the initial state.
            return;
        }
        let at = self.dice.below(COMPUTERS as u64) as usize;
        // The leader fails more often than others.
        let leader = self.leaders().first().copied();
        let at = leader.filter(|_| self.dice.one_in(2)).unwrap_or(at);
        let other = (at + 1 + self.dice.below(COMPUTERS as u64 - 1) as usize) % COMPUTERS;
        // Without data loss, a seed keeps its schedule.
        let kinds = if self.plan.data_loss { 16 } else { 14 };
        let fault = match self.dice.below(kinds) {
            0 | 1 if self.plan.stops && self.dice.one_in(2) => return self.stop(at),
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
                self.disturbs(at, time);
                self.trace(|| format!("{at} hangs for {} ms", time / MS));
                return;
            }
            7 => {
                self.network.slow_until = self.now + self.dice.below(4000) * MS;
                self.network.slow_by = self.dice.below(2200) * MS;
                return self.disturb_all(self.network.slow_until + self.network.slow_by);
            }
            8 => {
                self.network.etcd_slow_until = self.now + self.dice.below(6000) * MS;
                self.network.etcd_slow_by = self.dice.below(4000) * MS;
                return self.disturb_all(self.network.etcd_slow_until + self.network.etcd_slow_by);
            }
            9 => Fault::PowerCut(at),
            10 => match self.dice.one_in(3) {
                true => Fault::AllPowerCut,
                false => Fault::CutOneWay(at, other),
            },
            11 => {
                self.etcd.compact();
                return;
            }
            12 => Fault::CutOneWay(other, at),
            13 => return self.hand_over(at),
            14 => {
                let all = self.dice.one_in(2);
                return self.delete_keys(all);
            }
            _ => return self.save_or_restore_etcd(),
        };
        self.trace(|| format!("{fault:?}"));
        let time = (20 + self.dice.below(4000)) * MS;
        self.strike(fault, time);
    }

    fn strike(&mut self, fault: Fault, time: u64) {
        match fault {
            Fault::Kill(at) => self.kill(at),
            Fault::PowerCut(at) => self.cut_power(at),
            Fault::AllPowerCut => (0..COMPUTERS).for_each(|at| self.cut_power(at)),
            _ => self.network.cut(fault, 1),
        }
        match fault {
            Fault::Kill(at) | Fault::PowerCut(at) | Fault::CutFromEtcd(at) | Fault::CutOff(at) => {
                self.disturbs(at, time);
            }
            Fault::AllPowerCut => self.disturb_all(self.now + time),
            Fault::CutPair(..) | Fault::CutOneWay(..) | Fault::EtcdAway => {}
        }
        self.after(time, Event::End(fault));
    }

    /// Notes that a computer cannot do its part when etcd loses data: it does not run, or does not reach etcd.
    pub(super) fn disturbs(&mut self, at: usize, time: u64) {
        let disturbed = &mut self.computers[at].disturbed_until;
        *disturbed = (*disturbed).max(self.now + time);
    }

    fn disturb_all(&mut self, until: u64) {
        (0..COMPUTERS).for_each(|at| self.disturbs(at, until - self.now));
    }

    /// Makes a backup of etcd, or restores one. Then etcd is away for a while, sometimes so long that computers are
    /// cut off.
    fn save_or_restore_etcd(&mut self) {
        // Before a new journal has begun, an older one counts as the new one of another computer.
        let is_lost = self.etcd.is_lost && self.now < self.etcd.lost_at + 5000 * MS;
        if is_lost {
            return;
        }
        if !self.etcd.is_saved() || self.dice.one_in(3) {
            return self.etcd.save();
        }
        let most = if self.dice.one_in(2) { 500 } else { 6000 };
        let time = Duration::from_millis(20 + self.dice.below(most));
        let is_bumped = self.dice.one_in(2);
        self.trace(|| format!("an older copy of etcd is restored in {time:?}"));
        self.restore_etcd(time, is_bumped);
    }

    fn cut_power(&mut self, at: usize) {
        self.kill(at);
        let computer = &mut self.computers[at];
        computer.disk = computer.synced.clone();
        // The computer's nodes have died, too.
        self.history.loses_power(at, computer.synced_at, self.now);
    }

    /// Begins one failure that lasts some seconds.
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

    /// Cuts the power of all computers. The leader's comes back at once.
    pub(in super::super) fn cut_all_power(&mut self) {
        let leader = self.leaders()[0];
        (0..COMPUTERS).for_each(|at| self.cut_power(at));
        self.start(leader);
    }

    /// Cuts a computer off until the world heals.
    pub(in super::super) fn cut_off(&mut self, at: usize) {
        self.strike(Fault::CutOff(at), u64::from(u32::MAX));
    }

    /// Stops etcd for `time`.
    pub(in super::super) fn stop_etcd(&mut self, time: Duration) {
        self.strike(Fault::EtcdAway, time.as_micros() as u64);
    }

    /// Stops etcd, which comes back without its data.
    pub(in super::super) fn lose_etcd(&mut self) {
        let time = (20 + self.dice.below(6000)) * MS;
        self.strike(Fault::EtcdAway, time);
        self.etcd.lose();
        // Its terms start over.
        self.term = 0;
    }

    /// Restores the backup of etcd, which stops for `time`.
    pub(in super::super) fn restore_etcd(&mut self, time: Duration, is_bumped: bool) {
        self.strike(Fault::EtcdAway, time.as_micros() as u64);
        self.etcd.restore(is_bumped);
        self.etcd.lost_at = self.now + time.as_micros() as u64;
        self.etcd.is_lost = true;
        self.etcd.replaced_at = self.etcd.lost_at;
        self.counts.restored += 1;
        self.term = 0;
        for computer in &mut self.computers {
            // The copy may have the origin of the journal that was unreadable.
            computer.seen_unreadable = 0;
        }
    }

    /// Deletes all keys of a living etcd, or some.
    pub(in super::super) fn delete_keys(&mut self, all: bool) {
        let dice = &mut self.dice;
        self.etcd.delete(|_| all || dice.one_in(3));
        self.etcd.lost_at = self.now;
        self.etcd.is_lost = true;
        self.counts.deleted += 1;
        self.trace(|| format!("keys of etcd are deleted, all: {all}"));
        self.show_watches();
    }

    /// Deletes the journal's last entry. `is_in_snapshot` says whether a snapshot holds its records.
    pub(in super::super) fn delete_last_entry(&mut self, is_in_snapshot: bool) {
        if is_in_snapshot {
            self.etcd.compact();
        }
        self.etcd.delete_last_entry();
        self.etcd.lost_at = self.now;
        self.show_watches();
    }

    /// Kills a computer, and starts it again at once.
    pub(in super::super) fn restart(&mut self, at: usize) {
        self.kill(at);
        self.start(at);
    }

    pub(super) fn end(&mut self, fault: Fault) {
        match fault {
            Fault::Kill(at) | Fault::PowerCut(at) => self.start(at),
            Fault::AllPowerCut => (0..COMPUTERS).for_each(|at| self.start(at)),
            _ => self.network.cut(fault, -1),
        }
    }

    pub(in super::super) fn kill(&mut self, at: usize) {
        let computer = &mut self.computers[at];
        computer.up = false;
        computer.master = None;
        // The calls' connections end with the process, so their callers no longer wait.
        computer.waiting.clear();
    }

    fn start(&mut self, at: usize) {
        if !self.computers[at].up && !self.computers[at].refused {
            let plan = self.plan.clone();
            self.history.skips(at, self.now);
            self.computers[at].start(at, &plan);
            self.input(at, Input::Begin);
        }
    }

    /// Tells a process to stop, as `systemctl restart` does.
    pub(in super::super) fn stop(&mut self, at: usize) {
        let computer = &mut self.computers[at];
        if computer.up && !computer.stops {
            computer.stops = true;
            self.disturbs(at, 5000 * MS);
            self.trace(|| format!("{at} is told to stop"));
            self.input(at, Input::Stop);
        }
    }

    /// A process has stopped in order, and its disk is synced. It starts again after a while.
    pub(super) fn stopped(&mut self, at: usize) {
        self.trace(|| format!("{at} has stopped"));
        self.kill(at);
        let computer = &mut self.computers[at];
        computer.write_disk();
        computer.synced = computer.disk.clone();
        computer.synced_at = self.now;
        let time = (20 + self.dice.below(4000)) * MS;
        self.disturbs(at, time);
        self.counts.stopped += 1;
        self.after(time, Event::End(Fault::Kill(at)));
    }

    pub(in super::super) fn hand_over(&mut self, at: usize) {
        if self.computers[at].up {
            let to = String::new();
            let refused = None;
            self.input(at, Input::HandOver { to, refused });
        }
    }

    /// Ends all failures and allows no new ones.
    pub(in super::super) fn heal(&mut self) {
        self.network.healed = Some(self.now);
        for restored in [&mut self.etcd.lost_at, &mut self.etcd.replaced_at] {
            *restored = self.now.min(*restored);
        }
        (self.network.slow_until, self.network.etcd_slow_until) = (0, 0);
        for at in 0..COMPUTERS {
            self.computers[at].hangs_until = self.computers[at].hangs_until.min(self.now);
            self.start(at);
        }
    }
}
