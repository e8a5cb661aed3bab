//! etcd has lost its data: its members are new, or were given an old snapshot. Its revision is lower than one that was
//! seen before.
//!
//! The most recent state of a computer that lives becomes the new truth. Each one says in its entry among the members
//! what it holds. After the time to live the one that holds most claims, and the others only if it does not.

use std::{collections::BTreeMap, time::Instant};

use super::{Action, Heard, Holds, Member, News};
use crate::cluster::{
    journal::Progress,
    machine::{self, Answer, View},
    mutant::Mutant,
    standing::Place,
};

/// How many times the time to live a computer that holds less leaves to the one that holds most.
const PATIENCE: u32 = 3;

#[derive(Debug, Default)]
pub(super) struct Lost {
    /// Since when that is known, what this computer holds, and the journal's end at that moment.
    now: Option<(Instant, Holds, u64)>,
    /// What others say that they hold.
    others: BTreeMap<String, Holds>,
    /// Another one holds more.
    second: bool,
    /// How often it has happened.
    pub(super) times: u64,
}

impl Lost {
    pub(super) fn holds(&self) -> Option<Holds> {
        self.now.map(|(_, holds, _)| holds)
    }

    pub(super) fn since(&self) -> Option<Instant> {
        self.now.map(|(since, ..)| since)
    }

    /// Whether the journal of another leader is still as it was when the loss was noticed.
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
    /// An answer that shows an older revision than is known may be an old one; if not, etcd has lost its data.
    pub(super) fn doubt_etcd(&mut self, now: Instant, answer: &Answer) {
        if let Answer::Is(view) = answer
            && view.revision < self.view().revision
        {
            self.reading.load_by(now);
        }
    }

    /// Whether etcd, which shows `view`, has lost what it held when the revision was `floor`.
    pub(super) fn has_lost(&self, view: &View, floor: u64) -> bool {
        view.revision < floor && !Mutant::TrustsLostEtcd.lives()
    }

    /// Begins anew with an etcd that shows `view`, and with what this computer holds.
    pub(super) fn begin_anew(&mut self, now: Instant, view: &View) {
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
        let journal = std::mem::take(&mut self.journal);
        if std::mem::take(&mut self.reading.loaded) && !self.own_wins {
            (self.own.state, self.own.restored) = (journal.state, true);
        }
        (self.own_wins, self.own.term) = (true, 0);
        self.reading.load_by(now);
        self.lost.times += 1;
        let epoch = self.lost.times;
        self.place = Place {
            epoch,
            ..Place::default()
        };
        self.lost.now = Some((now, holds, 0));
        self.lost.second = false;
        self.act(Action::Say);
    }

    /// The journal of the new etcd has been read up to here, if there is a new one.
    pub(super) fn begun_anew(&mut self) -> bool {
        let seq = self.journal.progress.seq;
        if let Some((.., upto)) = &mut self.lost.now {
            *upto = seq;
        }
        self.lost.now.is_some()
    }

    /// Leaves the claim to a computer that holds more, for a while.
    pub(super) fn tend_lost(&mut self, now: Instant) {
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
