//! Reads the journal, and brings the ledger there while another computer leads.

use std::time::Instant;

use super::{AGAIN, Member, apply, cut_off::note};
use crate::{
    checkpoint::format::Record,
    cluster::{
        etcd::{self, Change, WatchEnd},
        journal::{self, Manifest, Progress},
        machine::{Input, Leader},
        merge::Changes,
        namesake,
        replica::{Loaded, Replica, ReplicaError},
    },
    master::Master,
};

/// The journal as far as a task has read it.
pub(super) struct Present {
    replica: Replica,
    progress: Progress,
    pub(super) state: Master,
}

impl Present {
    /// The number of the last record.
    pub(super) fn seq(&self) -> u64 {
        self.progress.seq
    }

    /// Reads it to a moment after this. What the watch has told may be of long before. Notes what is new in
    /// `changes`.
    pub(super) async fn catch_up(&mut self, changes: &mut Changes) {
        loop {
            if let Ok(loaded) = self.replica.load(self.progress).await {
                let state = loaded
                    .checkpoint
                    .map(|of| Master::from_snapshot(of.snapshot));
                let is_read = match state.transpose() {
                    Ok(Some(state)) => {
                        changes.note_difference(&self.state, &state);
                        self.state = state;
                        true
                    }
                    Ok(None) => true,
                    Err(_) => false,
                };
                if is_read {
                    note(changes, &loaded.records);
                    apply(&mut self.state, &loaded.records);
                    self.progress = loaded.progress;
                    return;
                }
            }
            tokio::time::sleep(AGAIN).await;
        }
    }
}

impl Member {
    /// Has the journal read if it is not known as far as it must be.
    pub(super) fn catch_up(&mut self) {
        let wanted = self.wanted.unwrap_or_default();
        let news = self.wanted.is_some() || self.reported != self.progress.seq;
        if news && self.loaded && !self.records() && self.progress.seq >= wanted {
            (self.wanted, self.reported) = (None, self.progress.seq);
            self.inbox.push_back(Input::Followed(self.progress.seq));
        }
        if self.loaded && self.progress.seq >= self.view.seq() {
            self.decide();
        }
        if self.wanted.is_some() && self.progress.seq < self.wanted.unwrap_or(0) {
            self.load_at.get_or_insert_with(Instant::now);
        }
        let due = self.load_at.is_some_and(|at| at <= Instant::now());
        if due && self.loading.is_none() {
            self.load_at = None;
            let (replica, known) = (self.replica.clone(), self.progress);
            self.loading = Some(Box::pin(async move { replica.load(known).await }));
        }
    }

    /// The journal as far as it has been read.
    pub(super) fn present(&self) -> Present {
        Present {
            replica: self.replica.clone(),
            progress: self.progress,
            state: self.held.clone(),
        }
    }

    /// The journal has changed.
    pub(super) fn changed(&mut self, changes: Result<Vec<Change>, WatchEnd>) {
        let changes = match changes {
            Ok(changes) => changes,
            Err(end) => {
                if let WatchEnd::Failed(error) = end {
                    self.trouble.set(&error.into());
                }
                self.watch = None;
                self.load_at = Some(Instant::now() + AGAIN);
                return;
            }
        };
        self.trouble.clear();
        let keys = self.replica.keys.clone();
        for change in &changes {
            if let Err(error) = etcd::absorb(change, &mut self.view, &keys) {
                self.trouble.set(&error.into());
            }
            self.known.member(&keys, &change.key, change.kv.as_ref());
        }
        self.look_at_view();
        for change in changes {
            let Some(kv) = change.kv.filter(|kv| keys.seq_of(&kv.key).is_some()) else {
                continue;
            };
            if keys
                .seq_of(&kv.key)
                .is_some_and(|seq| seq <= self.progress.seq)
            {
                continue;
            }
            // What is large is read apart, and so is what does not follow.
            let records = match Manifest::read(&kv.value) {
                Some(_) => None,
                None => journal::records(&kv.key, &kv.value).ok(),
            };
            let new = records.and_then(|of| self.progress.take(of, kv.value.len()).ok());
            match new {
                Some(new) => self.follow(&new),
                None => {
                    self.load_at.get_or_insert_with(Instant::now);
                    break;
                }
            }
        }
    }

    pub(super) fn look_at_view(&mut self) {
        let leader = self.view.leader.as_ref();
        let other = leader.filter(|leader| leader.id != self.settings.id);
        self.known.look(&self.view);
        if self.ours && other.is_some_and(|leader| !self.was_self(leader)) {
            self.ours = false;
            self.adopt_held();
        }
        self.inbox.push_back(Input::View(self.view.clone()));
    }

    /// New records of the journal.
    pub(super) fn follow(&mut self, records: &[Record]) {
        self.hold_records(records);
        if let Some(cut_off) = &mut self.cut_off {
            cut_off.note(records);
        }
        if self.follows() {
            // Only if this computer has the master by now.
            let _ = self.given.context.ledger.follow(records);
        }
    }

    pub(super) fn have_loaded(&mut self, loaded: Result<Loaded, ReplicaError>) {
        let loaded = match loaded {
            Ok(loaded) => loaded,
            Err(error) => {
                self.trouble.set(&error);
                self.load_at = Some(Instant::now() + AGAIN);
                return;
            }
        };
        self.trouble.clear();
        if self.watch.is_none() {
            let range = self.replica.keys.small();
            let client = &self.replica.client;
            self.watch = Some(client.watch(range, loaded.view.revision, self.settings.ttl));
        }
        for kv in &loaded.members {
            self.known.member(&self.replica.keys, &kv.key, Some(kv));
        }
        if loaded.view.revision >= self.view.revision {
            self.view = loaded.view;
        }
        let first = !std::mem::replace(&mut self.loaded, true);
        if first {
            self.begin_watch_for_namesake();
            self.look_for_typo();
            let leader = self.view.leader.as_ref();
            // etcd's journal is the truth. Our checkpoint may only hold more of it, written in the same term.
            let ours = self.given.context.ledger.session().cluster_seq;
            self.ours =
                leader.is_none_or(|leader| self.was_self(leader) && ours >= self.view.seq());
        }
        if let Some(checkpoint) = loaded.checkpoint
            && loaded.progress.seq >= self.progress.seq
        {
            let state = match Master::from_snapshot(checkpoint.snapshot) {
                Ok(state) => state,
                Err(error) => {
                    tracing::error!(%error, "the state in etcd is no state of a master; please report this");
                    return;
                }
            };
            let before = std::mem::replace(&mut self.held, state);
            if let Some(cut_off) = self.cut_off.as_mut().filter(|_| !first) {
                cut_off.note_difference(Some(&before), &self.held);
                cut_off.note(&loaded.records);
            }
            self.displaced.add(Instant::now(), checkpoint.displaced);
            self.hold_records(&loaded.records);
            self.progress = loaded.progress;
            self.adopt_held();
        } else if let Ok(new) = self.progress.take(loaded.records, 0) {
            match first {
                // The ledger may hold something else.
                true => {
                    self.hold_records(&new);
                    self.adopt_held();
                }
                false => self.follow(&new),
            }
        }
        if let Some(cut_off) = self.cut_off.as_mut().filter(|_| first) {
            cut_off.note_difference(None, &self.held);
        }
        if self
            .namesakes
            .as_ref()
            .is_none_or(|of| of.is_over(Instant::now()))
        {
            self.start();
        }
        self.look_at_view();
    }

    /// Holds the start back if another computer may have this one's name.
    fn begin_watch_for_namesake(&mut self) {
        let (now, ttl) = (Instant::now(), self.settings.ttl);
        let watch = namesake::Watch::new(now, ttl, self.signs_of_namesake());
        if let (Some(until), Some(uri)) = (watch.hold(), watch.suspect()) {
            let name = &self.settings.name;
            tracing::info!(
                name,
                uri,
                "the cluster knows this computer's name at another address; the start waits up to {:.0?} to see \
                 whether another computer has it",
                until - now
            );
            self.start_by = self.start_by.map(|_| until);
        }
        self.namesakes = Some(watch);
    }

    pub(super) fn start(&mut self) {
        if self.start_by.take().is_some() {
            self.inbox.push_back(Input::Start(0));
        }
    }

    /// Whether an earlier process of this computer leads, and nobody has since the ledger was recorded.
    pub(super) fn was_self(&self, leader: &Leader) -> bool {
        let term = self.given.context.ledger.session().term;
        leader.id != self.settings.id && leader.name == self.settings.name && leader.term == term
    }
}
