//! Periodic work: this computer's entry among the members, snapshots, compaction of etcd, and how long the file of
//! partition writes stays.

use std::time::{Duration, Instant};

use super::{Action, Member, MemberEntry, notifying::Notifying};
use crate::cluster::{journal::Progress, machine::Role};

/// How often a computer updates its entry among the members.
pub const PUBLISH_EVERY: Duration = Duration::from_secs(5);
/// How often the leader compacts etcd, and the age from which revisions are dropped.
const FORGET: Duration = Duration::from_secs(300);
/// Pause after a snapshot that could not be written.
const SNAPSHOT_PAUSE: Duration = Duration::from_secs(5);

/// When each chore is due, and what the last one did.
#[derive(Debug, Default)]
pub(super) struct Chores {
    /// When to write this computer's entry among the members.
    pub(super) publish_at: Option<Instant>,
    /// That entry as it was written last.
    pub(super) published: Option<MemberEntry>,
    /// Whether a snapshot is being written.
    pub(super) snapshot: bool,
    /// The last record that a snapshot of this computer holds or will hold. Its entry and those before are deleted.
    pub(super) replaced: u64,
    /// After a failed snapshot, when the next one may begin.
    pub(super) snapshot_at: Option<Instant>,
    /// The revision up to which to compact etcd, and when.
    pub(super) forget: Option<(Instant, u64)>,
    /// The record with which the journal has all writes that a lone leader kept in a file.
    pub(super) kept_until: Option<u64>,
    /// What the entries among the members say about notifications.
    pub(super) notifying: Notifying,
}

impl Chores {
    pub(super) fn due(&self) -> Option<Instant> {
        let forget = self.forget.map(|(at, _)| at);
        [self.publish_at, forget].into_iter().flatten().min()
    }

    /// Has this computer's entry among the members updated at `now`.
    pub(super) fn publish_entry_by(&mut self, now: Instant) {
        self.publish_at = Some(now);
    }

    /// Keeps the file of partition writes as it is until the journal has record `seq`. If the leader lost its power before,
    /// the writes would be lost without a report.
    pub(super) fn keep_until(&mut self, seq: u64) {
        self.kept_until = Some(seq);
    }

    /// Whether the file of partition writes must stay as it is.
    pub(super) fn keeps_file(&self) -> bool {
        self.kept_until.is_some()
    }
}

impl Member {
    /// Writes this computer's entry among the members and, if it leads, a snapshot, and compacts etcd, each when it is
    /// due.
    pub(super) fn update_chores(&mut self, now: Instant) {
        // Before the watch for a namesake is over, the entry could overwrite that of another computer.
        let watch = self.namesake.watch.as_ref();
        let may_say = watch.is_some_and(|of| of.is_over(now));
        if self.chores.publish_at.is_none_or(|at| at <= now) {
            self.chores.publish_at = Some(now + PUBLISH_EVERY);
            if may_say {
                self.publish_entry();
            }
        }
        if let Some(seq) = self.chores.kept_until {
            let leads = self.machine.role() == Role::Leading;
            if !leads || self.journal.progress.seq >= seq {
                self.chores.kept_until = None;
                self.store_all_writes();
            }
        }
        let term = self.machine.term();
        let Some(term) = term.filter(|_| self.machine.role() == Role::Leading) else {
            self.chores.forget = None;
            return;
        };
        let is_early = self.chores.snapshot_at.is_some_and(|at| now < at);
        let progress = self.journal.progress;
        if !self.chores.snapshot && !is_early && progress.wants_snapshot() {
            self.chores.snapshot = true;
            self.chores.replaced = progress.seq;
            self.act(Action::WriteSnapshot {
                term,
                progress,
                state: self.journal.state.clone(),
                displaced: self.journal.displaced.at(now),
            });
        }
        let revision = self.view().revision;
        match self.chores.forget {
            Some((at, before)) if at <= now => {
                self.chores.forget = Some((now + FORGET, revision));
                self.act(Action::CompactEtcd(before));
            }
            None => self.chores.forget = Some((now + FORGET, revision)),
            Some(_) => {}
        }
    }

    pub(super) fn publish_entry(&mut self) {
        let entry = self.member_entry();
        self.chores.published = Some(entry.clone());
        self.act(Action::PublishMemberEntry(entry));
    }

    pub(super) fn snapshot_written(&mut self, now: Instant, written: Option<(Progress, usize)>) {
        self.chores.snapshot = false;
        match written {
            Some((then, bytes)) => self.journal.progress.snapshot_written(then, bytes),
            // A full etcd refuses at once, so the next attempt must wait.
            None => self.chores.snapshot_at = Some(now + SNAPSHOT_PAUSE),
        }
    }
}
