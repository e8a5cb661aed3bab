//! Inputs and actions of the machine.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

/// When a write is acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Commit {
    /// When a majority of etcd has it.
    Always,
    /// At once, while nobody else can lead; it is committed within 200 ms.
    Interval,
}

/// What a computer does with writes while it is cut off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WhenAlone {
    /// It answers them, and sends them to the leader when it can.
    Serve,
    /// It lets them wait.
    Refuse,
}

#[derive(Clone, Debug)]
pub struct Settings {
    /// This computer. No other one has this name.
    pub name: String,
    /// This process. No other one, earlier or later, has this id.
    pub id: String,
    /// Where nodes and other computers find it.
    pub uri: String,
    /// The kernel's id of this boot, by which copies of one disk differ; empty if the address is an IP address,
    /// since no two computers can have the same one.
    pub boot: String,
    /// Of rosrescue.
    pub version: String,
    /// How long the leader may be silent.
    pub ttl: Duration,
    pub commit: Commit,
    pub alone: WhenAlone,
}

impl Settings {
    /// Whether a process of this computer, the present or an earlier one, has this name, address and boot.
    pub fn is_of_this_computer(&self, name: &str, uri: &str, boot: &str) -> bool {
        let same_boot = boot.is_empty() || self.boot.is_empty() || self.boot == boot;
        self.name == name && self.uri == uri && same_boot
    }
}

/// What the key `leader` holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Leader {
    /// The revision of the key.
    pub term: u64,
    pub name: String,
    /// The process, and which claim of it this was.
    pub id: String,
    pub claim: u64,
    pub uri: String,
    pub boot: String,
    pub version: String,
}

/// What the key `alive` holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Alive {
    /// The revision of the key.
    pub revision: u64,
    /// Which transaction of the leader wrote it.
    pub beat: u64,
    /// The journal's last record.
    pub seq: u64,
    /// The leader has given up leading in favour of this computer, or of any if it is empty.
    pub released: Option<String>,
    /// The session goes on that the journal holds. If not, that is still to be decided.
    pub settled: bool,
}

/// Both keys at one revision of etcd.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct View {
    pub revision: u64,
    pub leader: Option<Leader>,
    pub alive: Option<Alive>,
}

impl View {
    /// The revisions that a transaction expects.
    pub fn guard(&self) -> Guard {
        Guard {
            leader: self.leader.as_ref().map_or(0, |leader| leader.term),
            alive: self.alive.as_ref().map_or(0, |alive| alive.revision),
        }
    }

    /// The journal's last record.
    pub fn seq(&self) -> u64 {
        self.alive.as_ref().map_or(0, |alive| alive.seq)
    }
}

/// A transaction succeeds only if both keys have these revisions; 0: there is no such key.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Guard {
    pub leader: u64,
    pub alive: u64,
}

/// A request to etcd. One is under way at a time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Op {
    /// Read both keys; not from a member that may be behind.
    Read,
    /// Write `leader` with this claim, and `alive` with beat 0 and the journal's last record `seq`.
    Claim {
        guard: Guard,
        claim: u64,
        seq: u64,
        settled: bool,
    },
    /// Write `alive`, and the records after the last beat up to `seq`, or up to an earlier one if they are too
    /// many. One that is sent again may have other records: at most one of them is made.
    Beat {
        guard: Guard,
        beat: u64,
        seq: u64,
        released: Option<String>,
        settled: bool,
    },
}

/// What etcd has answered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Answer {
    /// The transaction was made, at this revision; the journal ends with this record.
    Applied { revision: u64, seq: u64 },
    /// The transaction was not made, or it was a read: this is how the keys are.
    Is(View),
    /// Nobody answered, or nobody could tell; it may have been made, or still be.
    Silence,
}

/// What happened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Input {
    /// The mirror holds the journal up to this record, as this computer's checkpoint has it.
    Start(u64),
    /// To request `number`.
    Answer { number: u64, answer: Answer },
    /// The watch shows the keys.
    View(View),
    /// The mirror holds the journal up to this record.
    Followed(u64),
    /// Whether the session goes on that the journal holds up to record `seq`. It is needed when this computer
    /// catches up and [`Machine::session`](super::Machine::session) is unknown.
    Decided { seq: u64, goes_on: bool },
    /// The ledger holds calls of this computer up to this record, to be committed, or made while alone.
    Recorded(u64),
    /// Whether the rosrescue of the leader answers this one, and says that it leads.
    Peer(bool),
    /// etcd has lost its data, and shows this. Nothing is claimed before a moment.
    Lost { view: View, until: Instant },
    /// Give up leading, in favour of this computer, or of any if it is empty.
    HandOver(String),
    /// The time of [`Machine::deadline`](super::Machine::deadline) has come.
    Wake,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Nothing is known yet.
    Joining,
    /// Calls go to the leader. While there is none, reads are answered by the mirror and writes wait.
    Following,
    /// It has claimed with success, reads the rest of the journal, and decides whether its session goes on.
    CatchingUp,
    Leading,
    /// Cut off from the majority, or from the leader.
    Alone,
}

impl Role {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Joining,
        Self::Following,
        Self::CatchingUp,
        Self::Leading,
        Self::Alone,
    ];

    /// As in JSON and in metrics.
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

/// What the shell must do, in order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Action {
    /// Send a request; its answer is [`Input::Answer`] with this number, after [`super::ANSWER_LIMIT`] at the
    /// latest.
    Send {
        number: u64,
        op: Op,
    },
    /// Bring the mirror to this record of the journal, and say so by [`Input::Followed`].
    CatchUp(u64),
    Become(Role),
    /// Answer the calls up to this record.
    Acknowledge(u64),
    /// Calls of this computer after `committed` are in no journal. Those up to `acknowledged` were answered:
    /// they are merged with what the journal holds by now, and sent to whoever leads. The others are calls
    /// that still wait. The mirror must be made anew from the journal.
    Yield {
        committed: u64,
        acknowledged: u64,
    },
    /// Another one may lead now.
    Released,
}
