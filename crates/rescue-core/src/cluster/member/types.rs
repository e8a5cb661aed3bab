//! Inputs and actions of [`Member`](super::Member).

use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::{
    checkpoint::format::Record,
    cluster::{
        journal::{Progress, Put},
        machine::{Answer, Op, Settings, View},
        merge::wire::{self, Ask, Outcome},
        namesake::{Key, Sign},
        sharing::Change,
        standing::Standing,
    },
    master::{Displaced, Master, Request},
};

/// What this computer's checkpoint holds when it begins to take part.
#[derive(Clone, Debug, Default)]
pub struct Own {
    /// The state in the ledger.
    pub state: Master,
    /// Whether the state is of a session that goes on.
    pub restored: bool,
    /// The last term in which this computer led.
    pub term: u64,
    /// How much of the journal the state holds.
    pub seq: u64,
}

/// What a computer says of itself, in JSON at `ROBOT/members/NAME`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Said {
    pub uri: String,
    pub version: String,
    pub role: String,
    pub seq: u64,
    /// See [`Settings::boot`].
    #[serde(default)]
    pub boot: String,
    /// etcd has lost its data. This computer holds the state of this place in what was lost.
    #[serde(default)]
    pub holds: Option<Holds>,
}

/// A place in a journal that etcd has lost: the term of its leader, and the number of a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Holds {
    pub term: u64,
    pub seq: u64,
}

/// An entry among the members.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Heard {
    pub name: String,
    /// None if it is there no more.
    pub said: Option<Said>,
    /// Of its last change.
    pub revision: u64,
}

impl Heard {
    /// That this entry, under the name of `own`, is another computer's.
    pub(super) fn sign_of_namesake(&self, own: &Settings) -> Option<Sign> {
        let said = self.said.as_ref()?;
        let is_own = own.is_of_this_computer(&self.name, &said.uri, &said.boot);
        (!is_own).then(|| Sign {
            key: Key::Member,
            uri: said.uri.clone(),
            revision: self.revision,
        })
    }
}

/// An entry of the journal, as the watch shows it.
#[derive(Clone, Debug)]
pub enum Entry {
    Records {
        records: Vec<Record>,
        bytes: usize,
    },
    /// One that has to be read apart, up to this record.
    Apart(u64),
}

/// The journal as far as it was not known.
#[derive(Clone, Debug)]
pub struct Read {
    /// Both keys, at the same moment.
    pub view: View,
    /// The state that the records go on from, and who was displaced before; none if they go on from what was known.
    pub state: Option<(Master, Vec<Displaced>)>,
    pub records: Vec<Record>,
    pub progress: Progress,
    pub heard: Vec<Heard>,
}

/// What happened.
#[derive(Debug)]
#[allow(
    clippy::large_enum_variant,
    reason = "few exist at a time, and none is stored"
)]
pub enum Input {
    /// Take part from now on.
    Begin,
    /// To request `number` of the machine.
    Answer { number: u64, answer: Answer },
    /// The watch shows both keys, what was added to the journal, and what computers say.
    Watched {
        view: View,
        entries: Vec<Entry>,
        heard: Vec<Heard>,
    },
    /// The watch has ended.
    WatchEnded,
    /// To [`Action::Load`]; none if etcd could not be read.
    Loaded(Option<Read>),
    /// The ledger has recorded these.
    Recorded(Vec<Change>),
    /// To [`Action::TakeAsState`].
    AsState(Option<Change>),
    /// To [`Action::AskForwarded`]: writes of this computer's nodes that a leader has not answered.
    Forwarded(Vec<Request>),
    /// To [`Action::Prepare`]: whether this process still leads, if that is known.
    Prepared(Option<bool>),
    /// To [`Action::Decide`].
    Decided { seq: u64, goes_on: bool },
    /// To [`Action::Probe`] `number`: whether the leader's rosrescue answers, and says that it leads.
    Probed { number: u64, leads: bool },
    /// To [`Action::Merge`] `number`; none if the leader has not answered.
    Merged {
        number: u64,
        answer: Option<wire::Answer>,
    },
    /// To [`Action::WriteSnapshot`]: what it was of, and its bytes; none if it was not written.
    SnapshotWritten(Option<(Progress, usize)>),
    /// Give up leading in favour of this computer, or of any if it is empty. `refused`: why that computer cannot
    /// lead.
    HandOver { to: String, refused: Option<String> },
    /// rosrescue is to stop.
    Stop,
    /// To [`Action::EndRosout`].
    RosoutEnded,
    /// The time of [`Member::deadline`](super::Member::deadline) has come.
    Wake,
}

impl Input {
    /// What computers say.
    pub fn heard(&self) -> &[Heard] {
        match self {
            Self::Watched { heard, .. } => heard,
            Self::Loaded(Some(read)) => &read.heard,
            _ => &[],
        }
    }
}

/// Why a master is begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    Started,
    TakenOver,
    WasCutOff,
}

/// What people are told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum News {
    /// This computer is alone.
    Alone {
        serves: bool,
    },
    NotAlone,
    /// It leads from now on. Who led before and was heard of when, and whether that one gave up in order.
    Leads {
        before: Option<(String, Instant)>,
        released: bool,
    },
    LeadsAgain,
    Deposed,
    /// etcd has lost its data; the most recent state of a living computer takes its place.
    EtcdLost,
    /// Its master is ended, since another computer may lead.
    Lapsed,
    /// The start waits for so long, since another computer may have this name.
    Suspect {
        uri: String,
        until: Instant,
    },
    /// A change cannot be written into the journal.
    TooLarge(String),
    /// The writes of a time alone are with the leader: so many were sent, so many are lost.
    Merged {
        sent: u64,
        lost: u64,
    },
}

/// What the shell must do, in order.
#[derive(Debug)]
#[allow(
    clippy::large_enum_variant,
    reason = "few exist at a time, and none is stored"
)]
pub enum Action {
    /// Write `parts` if there are any, in `term`, then carry out `op`, with `entry` for the journal. Its answer is
    /// [`Input::Answer`].
    Send {
        number: u64,
        op: Op,
        entry: Option<Put>,
        term: u64,
        parts: Vec<Put>,
    },
    /// Read what follows on this.
    Load(Progress),
    /// Watch both keys and the journal, from what they are here.
    Watch(View),
    /// Write the parts of a large change.
    Prepare {
        term: u64,
        parts: Vec<Put>,
    },
    /// Find out whether the session goes on that the journal holds up to `seq`, with this state. `closed`: the
    /// last leader has stopped in order.
    Decide {
        seq: u64,
        state: Master,
        closed: bool,
    },
    /// Show calls who has the master.
    Stand(Standing),
    /// Record nothing, acknowledge nothing that waits, and tell no node anything.
    Leave,
    /// Record calls from now on, with numbers after `seq`; the others hold `held`. `state`: what the ledger holds from
    /// now on, if it is something else than now.
    Lead {
        seq: u64,
        held: Master,
        state: Option<Master>,
    },
    /// Another computer has recorded these.
    Follow(Vec<Record>),
    /// This is the state where the master is.
    FollowState(Master),
    /// Answer the calls up to this record.
    Acknowledge(u64),
    /// Replace what the ledger has recorded and not given yet by its state.
    TakeAsState,
    AskForwarded,
    /// These were told to shut down lately, perhaps in vain.
    TellDisplaced(Vec<Displaced>),
    /// The checkpoint is one of this term.
    Term(u64),
    BeginMaster(Cause),
    /// End it at once.
    EndMaster,
    /// The mirror answers: there is no master.
    StandIn,
    /// No call is answered here.
    TurnAway,
    /// Whether nodes of the other computers are told nothing.
    ServeOwnOnly(bool),
    /// Keep these writes, answered alone since the state was `base`, in place of what is kept.
    KeepAll {
        base: Master,
        calls: Vec<Request>,
    },
    /// Keep these as well.
    Keep(Vec<Request>),
    /// Nothing need be kept any more.
    KeepNothing,
    /// Ask the leader to make these writes: its address and term, or none for this computer.
    Merge {
        number: u64,
        ask: Ask,
        to: Option<(String, u64)>,
    },
    /// This has become of writes that were answered alone.
    Report(Vec<(Request, Outcome)>),
    /// Ask the rosrescue at `uri` whether it leads in `term`, within a quarter of the time to live.
    Probe {
        number: u64,
        uri: String,
        term: u64,
    },
    /// Write this computer's entry among the members.
    Say,
    WriteSnapshot {
        term: u64,
        progress: Progress,
        state: Master,
        displaced: Vec<Displaced>,
    },
    /// Have etcd forget what is older than this revision.
    Forget(u64),
    /// The handover is done, or why it is not.
    HandedOver(Result<(), String>),
    /// End what roscore does besides, while calls still pass.
    EndRosout,
    Tell(News),
    /// Take part no longer.
    End,
    /// The same, for another computer there has this name.
    EndForNamesake(String),
}
