//! Work beside the calls: this computer's own entry among the members, snapshots, and etcd's compaction.

use std::{
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use tokio::task::JoinSet;

use super::{Member, Role};
use crate::{
    checkpoint::format::Checkpoint,
    cluster::{
        journal::{Progress, Put},
        replica::ReplicaError,
    },
    limit::{Pair, alarm, all_clear, rarely},
    status::cluster::MemberFacts,
};

/// How often the leader has etcd forget what is older than this.
const FORGET: Duration = Duration::from_secs(300);
/// Pause after a snapshot that could not be written.
const SNAPSHOT_PAUSE: Duration = Duration::from_secs(5);
/// How long etcd may take for what nobody waits for.
const LIMIT: Duration = Duration::from_secs(5);

/// Why etcd request failed, and when it has given anything last.
#[derive(Debug)]
pub(super) struct Trouble(Mutex<(Option<(Instant, String)>, Instant)>);

/// That etcd does not answer, and that it does again.
static TROUBLE: Pair = Pair::new();

impl Default for Trouble {
    fn default() -> Self {
        Self(Mutex::new((None, Instant::now())))
    }
}

impl Trouble {
    fn lock(&self) -> MutexGuard<'_, (Option<(Instant, String)>, Instant)> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn set(&self, error: &ReplicaError) {
        self.say(error.to_string());
    }

    fn say(&self, text: String) {
        let (trouble, _) = &mut *self.lock();
        match trouble {
            Some((_, said)) => *said = text,
            None => {
                alarm!(warn, TROUBLE, error = text, "etcd request failed; retrying");
                *trouble = Some((Instant::now(), text));
            }
        }
    }

    /// Whether etcd has given nothing for longer than `limit`. Says so: a request may go on for longer.
    pub(super) fn is_silent(&self, limit: Duration) -> bool {
        let (known, heard) = self.lock().clone();
        let silent = heard.elapsed();
        if silent > limit && known.is_none() {
            self.say(format!(
                "it has not answered for {:.1} s",
                silent.as_secs_f64()
            ));
        }
        silent > limit
    }

    pub(super) fn clear(&self) {
        let (trouble, heard) = &mut *self.lock();
        *heard = Instant::now();
        if let Some((since, _)) = trouble.take() {
            all_clear!(info, TROUBLE, after = ?since.elapsed(), "etcd answers again");
        }
    }

    pub(super) fn get(&self) -> Option<(Instant, String)> {
        self.lock().0.clone()
    }
}

/// What was done beside.
pub(super) enum Done {
    /// A snapshot of so many bytes, of the state at this progress.
    Snapshot(Progress, usize),
    Nothing,
}

/// See the [module](self).
#[derive(Default)]
pub(super) struct Background {
    pub(super) tasks: JoinSet<Option<Done>>,
    /// When to write this computer's entry among the members.
    say_at: Option<Instant>,
    /// A snapshot is being written.
    snapshot: bool,
    /// One has failed: none before this moment.
    snapshot_at: Option<Instant>,
    /// The revision of etcd at the last look, and when to have it forget what is older.
    forget: Option<(Instant, u64)>,
}

impl Background {
    pub(super) fn due(&self) -> Option<Instant> {
        let forget = self.forget.map(|(at, _)| at);
        [self.say_at, forget].into_iter().flatten().min()
    }

    /// Brings this computer's entry among the members up to date as soon as possible.
    pub(super) fn say_now(&mut self) {
        self.say_at = Some(Instant::now());
    }
}

impl Member {
    /// Begins what is due.
    pub(super) fn work_beside(&mut self, now: Instant) {
        // It would hide the entry of another computer with this name.
        let may_say = self.namesakes.as_ref().is_some_and(|of| of.is_over(now));
        if self.background.say_at.is_none_or(|at| at <= now) {
            self.background.say_at = Some(now + MemberFacts::SAYS_EVERY);
            if may_say {
                self.say();
            }
        }
        let term = self.machine.term();
        let leading = term.filter(|_| self.machine.role() == Role::Leading);
        let Some(term) = leading else {
            self.background.forget = None;
            return;
        };
        let is_early = self.background.snapshot_at.is_some_and(|at| now < at);
        if !self.background.snapshot && !is_early && self.progress.wants_snapshot() {
            self.background.snapshot = true;
            let (replica, progress) = (self.replica.clone(), self.progress);
            let checkpoint = Checkpoint {
                seq: progress.seq,
                snapshot: self.held.snapshot(),
                displaced: self.displaced.at(now),
                ..Checkpoint::default()
            };
            self.background.tasks.spawn(async move {
                match replica.write_snapshot(term, &checkpoint).await {
                    Ok(bytes) => bytes.map(|bytes| Done::Snapshot(progress, bytes)),
                    Err(error) => {
                        rarely!(warn, %error, "the snapshot in etcd could not be written; it is tried again");
                        None
                    }
                }
            });
        }
        match self.background.forget {
            Some((at, revision)) if at <= now => {
                self.background.forget = Some((now + FORGET, self.view.revision));
                let client = self.replica.client.clone();
                self.background.tasks.spawn(async move {
                    if let Err(error) = client.compact(revision, LIMIT).await {
                        tracing::debug!(%error, "compaction of etcd");
                    }
                    Some(Done::Nothing)
                });
            }
            None => self.background.forget = Some((now + FORGET, self.view.revision)),
            Some(_) => {}
        }
    }

    pub(super) fn done(&mut self, done: Option<Done>) {
        match done {
            Some(Done::Snapshot(then, bytes)) => {
                self.background.snapshot = false;
                self.progress.snapshot_written(then, bytes);
            }
            Some(Done::Nothing) => {}
            // An etcd that is full refuses at once.
            None => {
                self.background.snapshot = false;
                self.background.snapshot_at = Some(Instant::now() + SNAPSHOT_PAUSE);
            }
        }
    }

    /// Writes this computer's entry among the members.
    fn say(&mut self) {
        let value = self.known.own(self.machine.role(), self.progress.seq);
        let put = Put {
            key: self.replica.keys.member(&self.settings.name),
            value,
        };
        let client = self.replica.client.clone();
        self.background.tasks.spawn(async move {
            let said = async {
                let lease = client.grant(MemberFacts::AWAY_AFTER, LIMIT).await?;
                client.put_with_lease(&put, lease, LIMIT).await
            };
            if let Err(error) = said.await {
                tracing::debug!(%error, "the entry among the members");
            }
            Some(Done::Nothing)
        });
    }
}
