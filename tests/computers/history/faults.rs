//! Random failures.

use std::time::Duration;

use rustix::process::Signal;

use super::clients::Clients;
use crate::chance::Chance;
use crate::disks::Disk;
use crate::etcd::delete_keys;
use crate::fleet::Fleet;
use crate::network::{COUNT, Quality};
use crate::support::{Process, alive, eventually, signal, stop};

/// A failure, with the number of the computer that it hits.
#[derive(Clone, Copy, Debug)]
pub(super) enum Fault {
    /// SIGKILL for the worker.
    Worker(usize),
    /// SIGKILL for the guardian and the worker. rosrescue is started again.
    Guardian(usize),
    /// SIGKILL for all processes. The kernel closes their connections.
    Killed(usize),
    /// The power fails: no connection is closed.
    Power(usize),
    /// The power fails, and the disk lacks the checkpoint's last records.
    OlderDisk(usize),
    /// The worker is stopped.
    Paused(usize),
    /// All processes are stopped, also etcd.
    Frozen(usize),
    OneWay(usize, usize),
    Pair(usize, usize),
    Cable(usize),
    Bad(usize, Quality),
    /// The computer reaches the others, but no etcd.
    NoEtcd(usize),
    Etcd(usize),
    AllEtcds,
    /// All etcds lose their data, and are set up again as the guide says.
    Wiped,
    /// The keys of a running etcd with this prefix are deleted.
    Keys(&'static str),
    /// An older copy of all etcds is restored, in this time.
    OlderCopy(Duration),
    Handover(usize),
}

impl Fault {
    /// A random failure that is over within a few seconds.
    pub(super) fn roll_short(chance: &mut Chance) -> Self {
        loop {
            let fault = Self::roll(chance);
            let is_short = matches!(
                fault,
                Self::Worker(_)
                    | Self::Killed(_)
                    | Self::Power(_)
                    | Self::OlderDisk(_)
                    | Self::Paused(_)
                    | Self::OneWay(..)
                    | Self::Cable(_)
                    | Self::Etcd(_)
                    | Self::Handover(_)
            );
            if is_short {
                return fault;
            }
        }
    }

    pub(super) fn roll(chance: &mut Chance) -> Self {
        let one = chance.below(COUNT);
        let other = (one + 1 + chance.below(COUNT - 1)) % COUNT;
        match chance.below(36) {
            0..3 => Self::Worker(one),
            3..5 => Self::Guardian(one),
            5..7 => Self::Killed(one),
            7..9 => Self::Power(one),
            9..12 => Self::OlderDisk(one),
            12..15 => Self::Paused(one),
            15..17 => Self::Frozen(one),
            17..20 => Self::OneWay(one, other),
            20..22 => Self::Pair(one, other),
            22..24 => Self::Cable(one),
            24..26 => Self::Bad(
                one,
                Quality {
                    delay: chance.of(&[2, 20, 100]),
                    jitter: chance.of(&[0, 20]),
                    loss: chance.of(&[0, 3, 15]),
                },
            ),
            26 => Self::NoEtcd(one),
            27 => Self::Etcd(one),
            28 => Self::AllEtcds,
            29 => Self::Wiped,
            30..33 => Self::Keys(chance.of(&[
                "/robot/",
                "/robot/journal/",
                "/robot/snapshot",
                "/robot/leader",
                "/robot/alive",
                "/robot/origin",
            ])),
            33 => Self::OlderCopy(chance.time(Duration::from_secs(8))),
            _ => Self::Handover(one),
        }
    }

    /// The computers that the failure hits. No other failure may hit them at the same time.
    fn computers(&self) -> Vec<usize> {
        match *self {
            Self::AllEtcds | Self::Wiped | Self::Keys(_) | Self::OlderCopy(_) => vec![0, 1, 2],
            // Two failures must not change the same cable.
            Self::OneWay(one, other) | Self::Pair(one, other) => vec![one, other],
            Self::NoEtcd(_) => vec![0, 1, 2],
            Self::Worker(one)
            | Self::Guardian(one)
            | Self::Killed(one)
            | Self::Power(one)
            | Self::OlderDisk(one)
            | Self::Paused(one)
            | Self::Frozen(one)
            | Self::Cable(one)
            | Self::Bad(one, _)
            | Self::Etcd(one)
            | Self::Handover(one) => vec![one],
        }
    }

    /// Begins the failure. Returns it if it lasts.
    #[track_caller]
    pub(super) fn begin(
        self,
        fleet: &mut Fleet,
        clients: &Clients,
        chance: &mut Chance,
    ) -> Option<Lasting> {
        let mut lasting = Lasting {
            fault: self,
            pids: Vec::new(),
            cable: None,
        };
        match self {
            Self::Worker(one) => {
                signal(fleet.computers[one].worker(), Signal::KILL);
                return None;
            }
            Self::Guardian(one) => {
                let computer = &mut fleet.computers[one];
                let worker = computer.worker();
                signal(computer.guardian(), Signal::KILL);
                signal(worker, Signal::KILL);
                eventually("the worker has ended", || !alive(worker));
                computer.restart_rescue();
                return None;
            }
            Self::Killed(one) => fleet.computers[one].power_off(),
            Self::Power(one) => power_off(fleet, one),
            Self::OlderDisk(one) => {
                let worker = fleet.computers[one].worker();
                stop(worker);
                let disk = Disk::of(&fleet.computers[one]);
                signal(worker, Signal::CONT);
                std::thread::sleep(chance.time(Duration::from_secs(1)));
                // What a computer answers while it is cut off is on no other disk.
                let alone = fleet.computers[one].role_is("alone");
                power_off(fleet, one);
                if !alone {
                    disk.put_back(&fleet.computers[one]);
                }
            }
            Self::Paused(one) => lasting.pids = vec![fleet.computers[one].worker()],
            Self::Frozen(one) => lasting.pids = fleet.computers[one].processes(),
            Self::OneWay(from, to) => fleet.network.cut_way(from, to),
            Self::Pair(one, other) => fleet.network.cut_pair(one, other),
            Self::Cable(one) => fleet.network.cut_cable(one),
            Self::Bad(one, quality) => {
                let seed = chance.below(1 << 30) as u64;
                lasting.cable = Some(fleet.network.worsen(one, &quality, seed));
            }
            Self::NoEtcd(one) => {
                for other in (0..COUNT).filter(|other| *other != one) {
                    fleet.network.cut_port(one, other, 2379);
                }
                fleet.computers[one].kill_etcd();
            }
            Self::Etcd(one) => fleet.computers[one].kill_etcd(),
            Self::AllEtcds => fleet.computers.iter_mut().for_each(|it| it.kill_etcd()),
            Self::Wiped => {
                wipe(fleet, clients);
                return None;
            }
            Self::Keys(prefix) => {
                // A write that only a computer without power knew would be lost.
                fleet.await_whole();
                delete_keys(fleet, prefix);
                return None;
            }
            Self::OlderCopy(time) => {
                restore_older(fleet, clients, chance, time);
                return None;
            }
            Self::Handover(one) => {
                // There may be no computer to hand over to.
                let (status, said) = fleet.computers[one].rosrescue(&["handover"]);
                println!("handover: {status:?}, {said}");
                return None;
            }
        }
        for pid in lasting.pids.iter().filter(|pid| alive(**pid)) {
            stop(*pid);
        }
        Some(lasting)
    }
}

/// A failure that lasts.
#[derive(Debug)]
pub(super) struct Lasting {
    pub(super) fault: Fault,
    /// The stopped processes.
    pids: Vec<u32>,
    /// The process that forwards the packets of a bad cable.
    cable: Option<Process>,
}

impl Lasting {
    /// Whether this failure must end before `fault` can begin.
    pub(super) fn meets(&self, fault: &Fault) -> bool {
        let concerned = fault.computers();
        self.fault
            .computers()
            .iter()
            .any(|it| concerned.contains(it))
    }

    #[track_caller]
    pub(super) fn end(self, fleet: &mut Fleet) {
        // `nsenter` continues last. See `Computer::processes`.
        for pid in self.pids.iter().rev() {
            signal(*pid, Signal::CONT);
        }
        match self.fault {
            Fault::Killed(one) => switch_on(fleet, one),
            Fault::Power(one) | Fault::OlderDisk(one) => {
                fleet.network.mend_cable(one);
                switch_on(fleet, one);
            }
            Fault::OneWay(from, to) => fleet.network.mend_way(from, to),
            Fault::Pair(one, other) => fleet.network.mend_pair(one, other),
            Fault::Cable(one) => fleet.network.mend_cable(one),
            Fault::Bad(one, _) => {
                let cable = self.cable.expect("a bad cable");
                fleet.network.mend_quality(one, cable);
            }
            Fault::NoEtcd(one) => {
                for other in (0..COUNT).filter(|other| *other != one) {
                    fleet.network.mend_port(one, other, 2379);
                }
                fleet.computers[one].start_etcd();
            }
            Fault::Etcd(one) => fleet.computers[one].start_etcd(),
            Fault::AllEtcds => fleet.computers.iter_mut().for_each(|it| it.start_etcd()),
            _ => {}
        }
    }
}

fn power_off(fleet: &mut Fleet, one: usize) {
    fleet.network.cut_cable(one);
    fleet.computers[one].power_off();
}

/// Does not wait for answers, because another failure may last.
fn switch_on(fleet: &mut Fleet, one: usize) {
    let computer = &mut fleet.computers[one];
    computer.boot();
    computer.start_etcd();
    computer.start_rescue();
}

/// Makes a copy of all etcds, and restores it after some seconds with new writes.
#[track_caller]
fn restore_older(fleet: &mut Fleet, clients: &Clients, chance: &mut Chance, time: Duration) {
    fleet.await_whole();
    for computer in &mut fleet.computers {
        computer.kill_etcd();
    }
    for computer in &mut fleet.computers {
        computer.save_etcd();
        computer.start_etcd();
    }
    fleet.await_whole();
    std::thread::sleep(chance.time(Duration::from_secs(5)));
    for computer in &mut fleet.computers {
        computer.kill_etcd();
    }
    clients.restore();
    for computer in &fleet.computers {
        computer.restore_etcd();
    }
    std::thread::sleep(time);
    for computer in &mut fleet.computers {
        computer.start_etcd();
    }
    // A computer that starts before a new journal has begun shows the copy first.
    fleet.await_whole();
}

/// Sets etcd up again, as docs/several-computers.md says under "Backup".
#[track_caller]
fn wipe(fleet: &mut Fleet, clients: &Clients) {
    for computer in &mut fleet.computers {
        computer.await_answers();
    }
    let leader = fleet.await_whole();
    for other in fleet.others(leader) {
        fleet.computers[other].stop_rescue();
    }
    fleet.computers[leader].stop_rescue();
    clients.forget_terms();
    for computer in &mut fleet.computers {
        computer.kill_etcd();
        computer.wipe_etcd();
    }
    for computer in &mut fleet.computers {
        computer.start_etcd();
    }
    fleet.await_etcd();
    let options = fleet.computers[leader].options.clone();
    let always = ["--restore", "always"].map(str::to_owned);
    fleet.computers[leader].options.extend(always);
    fleet.computers[leader].start_rescue();
    let computer = &fleet.computers[leader];
    // Before that, etcd may lack its state.
    let (status, said) = computer.rosrescue(&["wait"]);
    assert_eq!(status, Some(0), "{said}");
    fleet.computers[leader].options = options;
    for other in fleet.others(leader) {
        fleet.computers[other].start_rescue();
    }
}
