//! Recognises an etcd that has lost its data, because its members are new or were restored from an old snapshot: its
//! revision is lower than one seen before.
//!
//! The most recent state of a living computer becomes the new truth. Each computer writes into its member entry what it
//! holds. After the time to live, the computer that holds the most claims leadership. The others wait longer.

use std::{collections::BTreeMap, time::Instant};

use super::{Action, Heard, Holds, Member, News};
use crate::cluster::{
    journal::Progress,
    machine::{self, EtcdAnswer, View},
    mutant::Mutant,
    standing::Place,
};

/// How long a computer that knows less of the lost journal waits for the one that knows the most, in times to live.
const PATIENCE: u32 = 3;

#[derive(Debug, Default)]
pub(super) struct Lost {
    /// When the loss was noticed, how much of the lost journal this computer knows, and the last record of the new
    /// journal at that time.
    now: Option<(Instant, Holds, u64)>,
    /// How much of the lost journal the other computers know, by their names.
    others: BTreeMap<String, Holds>,
    /// Whether another computer is known to hold more of the lost journal.
    second: bool,
    /// How often etcd has lost its data.
    pub(super) times: u64,
}

impl Lost {
    pub(super) fn holds(&self) -> Option<Holds> {
        self.now.map(|(_, holds, _)| holds)
    }

    pub(super) fn since(&self) -> Option<Instant> {
        self.now.map(|(since, ..)| since)
    }

    /// After etcd lost its data: whether this computer still has to wait, because the new journal, read up to `progress`,
    /// does not contain the state that a new leader writes into it first.
    pub(super) fn waits_for(&self, progress: Progress) -> bool {
        self.now.is_some_and(|(.., seq)| progress.seq <= seq)
    }

    pub(super) fn hear(&mut self, heard: &Heard) {
        let holds = heard.said.as_ref().and_then(|said| said.holds);
        match holds {
            Some(holds) => self.others.insert(heard.name.clone(), holds),
            None => self.others.remove(&heard.name),
        };
    }
}

impl Member {
    /// Reads etcd again if `answer` shows an older revision than a known one. Either the answer is late, or etcd has lost
    /// its data.
    pub(super) fn doubt_etcd(&mut self, now: Instant, answer: &EtcdAnswer) {
        if let EtcdAnswer::Is(view) = answer
            && view.revision < self.view().revision
        {
            self.reading.load_by(now);
        }
    }

    /// Whether etcd's `view` is older than revision `floor`, which etcd had reached before.
    pub(super) fn has_lost(&self, view: &View, floor: u64) -> bool {
        view.revision < floor && !Mutant::TrustsLostEtcd.lives()
    }

    /// Starts over with the new etcd, which shows the keys in `view`, and with this computer's state.
    pub(super) fn start_over(&mut self, now: Instant, view: &View) {
        let holds = match self.reading.loaded {
            true => Holds {
                term: self.place.term,
                seq: self.journal.progress.seq,
            },
            false => Holds {
                term: self.own.term,
                seq: self.own.seq,
            },
        };
        self.tell(News::EtcdLost);
        let until = now + self.settings().ttl;
        let view = view.clone();
        self.reading.forget(&view);
        self.drive(now, machine::Input::Lost { view, until });
        self.machine.hold_claims(until);
        self.lost.times += 1;
        let epoch = self.lost.times;
        let journal = std::mem::take(&mut self.journal);
        if std::mem::take(&mut self.reading.loaded) {
            if !self.own_wins {
                (self.own.state, self.own.restored) = (journal.state, true);
            }
            // The mirror goes on answering. That of a process which has just started may be older than the new journal.
            self.place = Place {
                epoch,
                ..Place::default()
            };
        }
        (self.own_wins, self.own.term) = (true, 0);
        self.reading.load_by(now);
        self.lost.now = Some((now, holds, 0));
        self.lost.second = false;
        self.act(Action::Say);
    }

    /// Whether etcd has lost its data. If so, notes how far the new journal has been read.
    pub(super) fn is_starting_over(&mut self) -> bool {
        let seq = self.journal.progress.seq;
        if let Some((.., upto)) = &mut self.lost.now {
            *upto = seq;
        }
        self.lost.now.is_some()
    }

    /// Lets a computer that knows more of the lost journal claim leadership first.
    pub(super) fn update_lost(&mut self, now: Instant) {
        let Some((since, holds, _)) = self.lost.now else {
            return;
        };
        if !self.own_wins || self.role == machine::Role::Leading {
            self.lost.now = None;
            return self.chores.say_at(now);
        }
        let name = &self.settings().name;
        let mine = (holds, name);
        let others = self.lost.others.iter();
        let mut others = others.map(|(name, holds)| (*holds, name));
        if !self.lost.second && others.any(|other| other > mine) {
            self.lost.second = true;
            let until = since + self.settings().ttl * PATIENCE;
            self.machine.hold_claims(until);
        }
    }
}
