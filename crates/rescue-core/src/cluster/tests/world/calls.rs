//! Calls that write: who records and answers them, and what becomes of those that were answered alone.

use std::time::Duration;

use super::super::super::machine::{Commit, Input, Role, WhenAlone};
use super::super::computer::Own;
use super::super::etcd::Write;
use super::{Event, World};

impl World {
    /// What the leader knows to be in the journal is a part of it.
    pub(super) fn settle(&mut self, at: usize) {
        let computer = &mut self.computers[at];
        while computer.machine.term().is_some() && computer.followed < computer.machine.committed()
        {
            let own = computer.own.remove(0);
            let journaled = self.etcd.journal[computer.followed as usize];
            assert_eq!(own.write, journaled, "seed {}", self.plan.seed);
            computer.base[self.calls[own.write].key] = own.write + 1;
            computer.followed += 1;
            computer.answered = computer.answered.saturating_sub(1);
        }
    }

    pub(super) fn record(&mut self, at: usize, write: Write, origin: usize) {
        let computer = &mut self.computers[at];
        if computer.own.iter().any(|own| own.write == write) {
            return;
        }
        computer.own.push(Own { write, origin });
        let seq = computer.followed + computer.own.len() as u64;
        self.input(at, Input::Recorded(seq));
    }

    pub(super) fn acknowledge(&mut self, at: usize, seq: u64) {
        let computer = &self.computers[at];
        let alone = computer.role == Role::Alone;
        let upto = seq.saturating_sub(computer.followed) as usize;
        let answered: Vec<_> = computer.own[computer.answered.min(upto)..upto].to_vec();
        self.computers[at].answered = upto;
        for Own { write, origin } in answered {
            if self.plan.traced {
                println!("{:>9} us, {at}: answers {write} of {origin}", self.now);
            }
            self.counts.acknowledged += 1;
            let call = &mut self.calls[write];
            // A beat of a leader that is alone may still arrive.
            let committed = self.etcd.journal.contains(&write);
            call.alone |= alone;
            call.led |= !alone;
            if !alone {
                let computer = &self.computers[at];
                let term = computer.machine.term().unwrap();
                // What is in the journal is safe, whoever says so.
                let sole = term >= self.term && self.plan.commit == Commit::Interval;
                assert!(
                    committed || sole,
                    "seed {}: two leaders answer",
                    self.plan.seed
                );
                self.term = self.term.max(term);
            }
            let delay = self.delay();
            if origin == at {
                self.done(at, write);
            } else if self.network.joins(at, origin) {
                self.after(delay, Event::Done(origin, write));
            }
        }
    }

    /// Does what can be done about the calls that wait, and about pending ones.
    pub(super) fn flush(&mut self, at: usize) {
        let computer = &self.computers[at];
        let waiting = computer.waiting.clone();
        match computer.role {
            _ if computer.machine.takes_writes() => {
                waiting
                    .into_iter()
                    .for_each(|write| self.record(at, write, at));
            }
            Role::Following => {
                if let Some(to) = self.peer_of(at) {
                    for write in waiting {
                        let delay = self.delay();
                        self.after(delay, Event::Forward(at, to, write));
                    }
                }
            }
            _ => {}
        }
        self.merge(at);
    }

    /// Sends the first pending write, unless what it is about was changed meanwhile.
    pub(super) fn merge(&mut self, at: usize) {
        loop {
            let computer = &mut self.computers[at];
            let Some(write) = computer.pending.first().copied() else {
                return;
            };
            if computer.followed < computer.machine.view().seq() {
                return;
            }
            let key = self.calls[write].key;
            let (was, is) = (computer.cut_off[key], computer.base[key]);
            let own = computer.pending.iter().any(|pending| pending + 1 == is);
            if was != is && !own {
                computer.pending.remove(0);
                self.calls[write].reported = true;
                if self.plan.traced {
                    println!("{:>9} us, {at}: reports {write}", self.now);
                }
                self.counts.reported += 1;
                continue;
            }
            match computer.role {
                Role::Leading if computer.machine.takes_writes() => self.record(at, write, at),
                Role::Following => {
                    if let Some(to) = self.peer_of(at) {
                        let delay = self.delay();
                        self.after(delay, Event::Forward(at, to, write));
                    }
                }
                _ => {}
            }
            return;
        }
    }

    /// A call of this computer's nodes was answered.
    pub(super) fn done(&mut self, at: usize, write: Write) {
        let computer = &mut self.computers[at];
        if computer.up {
            let waits = computer.waiting.contains(&write);
            let made = self.calls[write].made;
            if waits && self.plan.alone == WhenAlone::Serve && computer.undisturbed_since <= made {
                let waited = Duration::from_micros(self.now - made);
                self.counts.waited = self.counts.waited.max(waited);
            }
            computer.waiting.retain(|waits| *waits != write);
            let before = computer.pending.len();
            computer.pending.retain(|waits| *waits != write);
            self.counts.merged += (before - computer.pending.len()) as u64;
        }
    }
}
