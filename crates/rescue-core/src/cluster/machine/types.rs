//! Inputs and actions of the machine.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

/// When a write is acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Commit {
    /// When a majority of etcd has the write.
    Always,
    /// At once, while no other computer can lead. The write is in etcd within 200 ms.
    Interval,
}

/// What a computer does with writes while it is cut off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WhenAlone {
    /// The mirror answers writes, and the leader gets them later.
    Serve,
    /// Writes wait until this computer reaches the others again, or fail after `--hold`.
    Refuse,
}

#[derive(Clone, Debug)]
pub struct Settings {
    /// The unique name of this computer.
    pub name: String,
    /// The unique id of this process.
    pub id: String,
    /// The address for nodes and other computers.
    pub uri: String,
    /// The kernel's id of this boot, which differs between copies of one disk. Empty if the address is an IP address,
    /// which is unique anyway.
    pub boot: String,
    /// The version of rosrescue.
    pub version: String,
    /// The time to live: how long the leader may be silent.
    pub ttl: Duration,
    pub commit: Commit,
    pub alone: WhenAlone,
}

impl Settings {
    /// Whether this name, address and boot belong to a process of this computer, present or earlier.
    pub fn is_of_this_computer(&self, name: &str, uri: &str, boot: &str) -> bool {
        let same_boot = boot.is_empty() || self.boot.is_empty() || self.boot == boot;
        self.name == name && self.uri == uri && same_boot
    }
}

/// The content of the key `leader`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Leader {
    /// The term: the revision of the key `leader`.
    pub term: u64,
    pub name: String,
    /// The id of the process, and the number of its claim.
    pub id: String,
    pub claim: u64,
    /// The number of the journal's last record at the claim.
    pub claimed_at: u64,
    pub uri: String,
    pub boot: String,
    pub version: String,
}

/// The content of the key `alive`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Alive {
    /// The revision of the key `alive`.
    pub revision: u64,
    /// The number of the leader's transaction that wrote this key.
    pub beat: u64,
    /// The number of the journal's last record.
    pub seq: u64,
    /// Set if the leader has given up leadership: the computer that should lead next, or empty for any.
    pub released: Option<String>,
    /// Whether the journal's session is known to continue. If not, that must still be decided.
    pub settled: bool,
}

/// The keys `origin`, `leader` and `alive` at one revision of etcd.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct View {
    pub revision: u64,
    /// The revision of the key `origin`, which is written once per journal, so it identifies the journal. 0 if the key
    /// is missing.
    pub origin: u64,
    /// The number of the journal, in the key `origin`: one more than those of all journals that its first leader knew of.
    /// It tells an older copy of a lost journal from a new journal. 0 without a journal.
    pub journal_number: u64,
    pub leader: Option<Leader>,
    pub alive: Option<Alive>,
}

impl View {
    /// What a transaction requires, so that it succeeds only if no key was changed or deleted.
    pub fn guard(&self) -> RevisionGuard {
        RevisionGuard {
            origin: self.origin,
            leader: self.term(),
            alive: self.alive.as_ref().map_or(0, |alive| alive.revision),
            seq: self.seq(),
        }
    }

    /// The leader's term. 0 if there is no leader.
    pub fn term(&self) -> u64 {
        self.leader.as_ref().map_or(0, |leader| leader.term)
    }

    /// Whether this can be a later view of the journal of `earlier`. rosrescue never deletes a key of the journal, and
    /// never writes an earlier value, so otherwise keys were deleted, or an older copy of etcd was restored.
    pub fn continues(&self, earlier: &Self) -> bool {
        let (after, before) = (self.guard(), earlier.guard());
        let journal = (self.origin, self.journal_number);
        let same = before.origin == 0 || journal == (earlier.origin, earlier.journal_number);
        // An older copy gives revisions out again.
        let leader = after.leader != before.leader || self.leader == earlier.leader;
        let alive = after.alive != before.alive || self.alive == earlier.alive;
        // Nor does a later leader's journal continue a longer one.
        let began = self.leader.as_ref().map_or(0, |leader| leader.claimed_at);
        let begins_later = after.leader == before.leader || began >= before.seq;
        let same = same && leader && alive && begins_later;
        let later = after.leader >= before.leader && after.alive >= before.alive;
        same && later && after.seq >= before.seq && self.revision >= earlier.revision
    }

    /// Whether some of the keys are missing. Each journal has all of them.
    pub fn is_torn(&self) -> bool {
        let is_there = [self.origin > 0, self.leader.is_some(), self.alive.is_some()];
        is_there.contains(&true) && is_there.contains(&false)
    }

    /// The number of the journal's last record.
    pub fn seq(&self) -> u64 {
        self.alive.as_ref().map_or(0, |alive| alive.seq)
    }
}

/// The revisions that the keys `origin`, `leader` and `alive` must have for a transaction to succeed. 0 stands for a
/// missing key.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct RevisionGuard {
    pub origin: u64,
    pub leader: u64,
    pub alive: u64,
    /// The number of the journal's last record, whose entry must exist. 0 if that is not required.
    pub seq: u64,
}

/// A request to etcd. Only one is under way at a time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Op {
    /// Read the keys `origin`, `leader` and `alive`. The answer must not come from a member of etcd that may be behind.
    Read,
    /// Write `leader` with this claim, and `alive` with heartbeat number 0 and the journal's last record `seq`.
    Claim {
        guard: RevisionGuard,
        claim: u64,
        /// Begins a new journal with this [`View::journal_number`]: writes `origin`, and deletes what is left of an earlier journal.
        begins: Option<u64>,
        seq: u64,
        settled: bool,
    },
    /// Write `alive`, and the records after the last heartbeat up to `seq`, or fewer if they are too many. A repeated
    /// heartbeat may carry other records; at most one of the two succeeds.
    Beat {
        guard: RevisionGuard,
        /// The claim of this process by which it leads. A restored etcd gives revisions out again, so the key `leader`
        /// must also have the content that this claim wrote.
        claim: u64,
        /// See [`Leader::claimed_at`].
        claimed_at: u64,
        beat: u64,
        seq: u64,
        released: Option<String>,
        settled: bool,
    },
}

/// The answer of etcd.
#[derive(Clone, Debug, PartialEq, Eq)]
#[allow(
    clippy::large_enum_variant,
    reason = "few exist at a time, and none is stored"
)]
pub enum EtcdAnswer {
    /// The transaction succeeded at this revision, and the journal ends with this record.
    Applied { revision: u64, seq: u64 },
    /// The keys `origin`, `leader` and `alive`, as the answer to a read or to a transaction that failed.
    Is(View),
    /// There was no usable answer. The transaction may have succeeded, or may still do so.
    Silence,
}

/// An event that the machine must know of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Input {
    /// The machine starts.
    Start,
    /// The answer to request `number`.
    Answer { number: u64, answer: EtcdAnswer },
    /// The watch on etcd has delivered the keys `leader` and `alive`.
    View(View),
    /// The mirror contains the journal up to this record.
    Followed(u64),
    /// Whether the journal's session continues, decided at record `seq`. Needed when this computer catches up and
    /// [`Machine::session`](super::Machine::session) is unknown.
    Decided { seq: u64, goes_on: bool },
    /// The ledger has recorded this computer's calls up to this record.
    Recorded(u64),
    /// Whether the leader's rosrescue answered a probe, and said that it leads.
    Peer(bool),
    /// etcd has lost its data and shows `view`. Do not claim before `until`. `left` is what is left of the lost journal.
    /// It is `None` if another journal has begun since.
    Lost {
        view: View,
        left: Option<RevisionGuard>,
        until: Instant,
    },
    /// Give up leadership to this computer, or to any if the name is empty.
    HandOver(String),
    /// The deadline of [`Machine::deadline`](super::Machine::deadline) has passed.
    Wake,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// This computer does not know yet who leads.
    Joining,
    /// Calls go to the leader. While no computer leads, the mirror answers reads and writes wait.
    Following,
    /// This computer's claim has succeeded. It reads the rest of the journal, and decides whether the session
    /// continues.
    CatchingUp,
    Leading,
    /// Cut off from etcd's majority, or from the leader.
    Alone,
}

impl Role {
    /// All roles.
    pub const ALL: [Self; 5] = [
        Self::Joining,
        Self::Following,
        Self::CatchingUp,
        Self::Leading,
        Self::Alone,
    ];

    /// The role's name in JSON and in metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Joining => "joining",
            Self::Following => "following",
            Self::CatchingUp => "catching_up",
            Self::Leading => "leading",
            Self::Alone => "alone",
        }
    }
}

/// What the member must do. Actions must be carried out in order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Action {
    /// Send a request. Its answer is [`Input::Answer`] with this number, within [`super::ANSWER_LIMIT`].
    Send {
        number: u64,
        op: Op,
    },
    /// Bring the mirror up to this record of the journal, then pass in [`Input::Followed`].
    CatchUp(u64),
    Become(Role),
    /// Let the answers to the calls up to this record go out.
    Acknowledge(u64),
    /// This computer's calls after `committed` are not in the journal. Those up to `acknowledged` were answered, so
    /// they are merged with the journal and sent to the next leader. The others still wait. The mirror must be
    /// rebuilt from the journal.
    HandBack {
        committed: u64,
        acknowledged: u64,
    },
    /// This computer has given up leadership, so another one may lead now.
    Released,
}
