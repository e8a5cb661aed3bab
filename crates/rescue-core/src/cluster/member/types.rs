//! Inputs and actions of [`Member`](super::Member).

use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::{
    checkpoint::format::Record,
    cluster::{
        journal::{Progress, Put},
        machine::{EtcdAnswer, Op, Settings, View},
        merge::wire::{self, Ask, WriteOutcome},
        namesake::{Key, Sign},
        sharing::Change,
        standing::Standing,
    },
};
use ros1_master::master::{Displaced, Master, Request};

/// Writes of this computer's nodes that were sent to a leader.
#[derive(Clone, Debug, Default)]
pub struct ForwardedWrites {
    /// The leader may run them, or have run them.
    pub unanswered: Vec<Request>,
    /// The leader has answered them, in this order, and the journal as this computer has read it lacks them. With
    /// `--cluster-sync interval` etcd may lack them, too.
    pub answered: Vec<Request>,
}

/// What this computer's checkpoint holds at the start.
#[derive(Clone, Debug, Default)]
pub struct LocalCheckpoint {
    /// The state in the ledger.
    pub state: Master,
    /// Whether the state belongs to a session that continues.
    pub restored: bool,
    /// The term of the last leader whose journal this computer had read to its end, or of its own last leadership. 0 if there
    /// was none.
    pub term: u64,
    /// See [`View::journal_number`]; of the journal of that term.
    pub journal_number: u64,
    /// The last record of the journal that the state contains, counted on while this computer was cut off.
    pub seq: u64,
}

/// Partition writes, as they are stored beside the checkpoint.
#[derive(Clone, Debug, Default)]
pub struct PartitionWrites {
    /// The state before them.
    pub base: Master,
    /// The last record of the journal that this computer held. 0 if it is unknown.
    pub held: u64,
    pub calls: Vec<Request>,
}

/// A computer's entry among the members, as JSON at `ROBOT/members/NAME`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MemberEntry {
    pub uri: String,
    pub version: String,
    pub role: String,
    pub seq: u64,
    /// See [`Settings::boot`].
    pub boot: String,
    /// Set while etcd has lost its data: the position in the lost journal up to which this computer holds the state.
    pub holds: Option<Holdings>,
    /// The origin of a journal that this computer could not read from its beginning, or 0. Its leader checks that.
    pub unreadable: u64,
    /// Changes when this process stops notifying nodes, because it no longer leads or is no longer cut off, and with
    /// each start. The leader then notifies all nodes of the present state, because they may have heard an older one
    /// last. Empty until the leader has this computer's partition writes: before, its nodes would lose the publishers that
    /// were started meanwhile.
    pub notifies: String,
}

/// A position in a journal that etcd has lost: the journal's number, its leader's term and a record number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Holdings {
    #[serde(default)]
    pub journal_number: u64,
    pub term: u64,
    pub seq: u64,
}

/// What a claim requires of the entries among the members if it begins a new journal after a loss. Otherwise etcd has lost
/// data again since, perhaps a journal that this computer has not seen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Evidence {
    /// The entry that this computer has written last, which it has done since it noticed the loss.
    pub own: MemberEntry,
    /// The revision up to which this computer has read the entries. None may have been written since.
    pub read_up_to: u64,
}

/// What a computer has written about itself: its entry among the members.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemberEntryChange {
    pub name: String,
    /// `None` if the entry was deleted.
    pub entry: Option<MemberEntry>,
    /// The revision of the entry's last change.
    pub revision: u64,
}

impl MemberEntryChange {
    /// Returns evidence of another computer with this one's name, if this entry, which has the name in `own`, belongs
    /// to another computer.
    pub(super) fn sign_of_namesake(&self, own: &Settings) -> Option<Sign> {
        let entry = self.entry.as_ref()?;
        let is_own = own.is_of_this_computer(&self.name, &entry.uri, &entry.boot);
        (!is_own).then(|| Sign {
            key: Key::Member,
            uri: entry.uri.clone(),
            revision: self.revision,
        })
    }
}

/// A journal entry as the watch on etcd delivers it.
#[derive(Clone, Debug)]
pub enum WatchedEntry {
    Records {
        records: Vec<Record>,
        bytes: usize,
    },
    /// An entry that must be read separately, up to this record.
    Apart(u64),
}

impl WatchedEntry {
    /// Whether the first record of this entry has the number `seq`.
    pub(super) fn begins_with(&self, seq: u64) -> bool {
        match self {
            Self::Records { records, .. } => records.first().is_some_and(|first| first.seq == seq),
            Self::Apart(_) => false,
        }
    }
}

/// The result of one read of etcd: the part of the journal that this computer did not know yet.
#[derive(Clone, Debug)]
pub struct Read {
    /// etcd's keys `origin`, `leader` and `alive`, all as of one revision.
    pub view: View,
    /// Whether the journal could be read from its beginning. If not, only `view` and `members` count.
    pub is_readable: bool,
    /// The state before the records, and the nodes that lost their names to other nodes shortly before. `None` if the
    /// records follow the known journal.
    pub state: Option<(Master, Vec<Displaced>)>,
    pub records: Vec<Record>,
    pub progress: Progress,
    pub members: Vec<MemberEntryChange>,
}

impl Read {
    /// A read that found no journal.
    pub(super) fn empty() -> Self {
        Self {
            view: View::default(),
            is_readable: true,
            state: None,
            records: Vec::new(),
            progress: Progress::default(),
            members: Vec::new(),
        }
    }
}

/// An event that the member must handle.
#[derive(Debug)]
#[allow(
    clippy::large_enum_variant,
    reason = "few exist at a time, and none is stored"
)]
pub enum Input {
    /// The member starts.
    Begin,
    /// The answer to request `number` of the machine.
    Answer { number: u64, answer: EtcdAnswer },
    /// The watch on etcd delivers the keys `origin`, `leader` and `alive`, new journal entries, and changed member entries.
    Watched {
        view: View,
        /// With the revision at which each was written.
        entries: Vec<(u64, WatchedEntry)>,
        /// The highest number of a record that a deleted key held; see [`Keys::record_of`](crate::cluster::journal::Keys::record_of).
        deleted: Option<u64>,
        members: Vec<MemberEntryChange>,
    },
    /// The watch on etcd has ended.
    WatchEnded,
    /// The result of [`Action::Load`]. `None` if etcd could not be read.
    Loaded(Option<Read>),
    /// The ledger has recorded these changes.
    Recorded(Vec<Change>),
    /// The result of [`Action::TakeAsState`].
    AsState(Option<Change>),
    /// The result of [`Action::CollectForwarded`], with its state.
    Forwarded {
        base: Master,
        writes: ForwardedWrites,
    },
    /// The result of [`Action::Prepare`] `number`: whether this process still leads. `None` if that is unknown.
    Prepared { number: u64, leads: Option<bool> },
    /// The result of [`Action::Decide`].
    Decided { seq: u64, goes_on: bool },
    /// The result of [`Action::Probe`] `number`: whether the leader's rosrescue answered that it leads.
    Probed { number: u64, leads: bool },
    /// The result of [`Action::Merge`] `number`. `None` if the leader did not answer.
    Merged {
        number: u64,
        answer: Option<wire::MergeAnswer>,
    },
    /// The result of [`Action::WriteSnapshot`]: how much of the journal the snapshot contains, and its size in bytes.
    /// `None` if it was not written.
    SnapshotWritten(Option<(Progress, usize)>),
    /// Someone asks for a handover to the computer `to`, or to any if `to` is empty. `refused` says why that computer
    /// cannot lead.
    HandOver { to: String, refused: Option<String> },
    /// rosrescue was asked to stop.
    Stop,
    /// The result of [`Action::EndRosout`].
    RosoutEnded,
    /// The deadline of [`Member::deadline`](super::Member::deadline) has passed.
    Wake,
}

impl Input {
    /// The member entries in this input.
    pub fn member_entries(&self) -> &[MemberEntryChange] {
        match self {
            Self::Watched { members, .. } => members,
            Self::Loaded(Some(read)) => &read.members,
            _ => &[],
        }
    }
}

/// Why a master is started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    Started,
    TakenOver,
    WasCutOff,
}

/// An event to log for the operator.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum News {
    /// This computer is cut off.
    Alone {
        serves: bool,
    },
    NotAlone,
    /// This computer leads from now on. `before` is the previous leader and when it was last heard of; `released` says
    /// whether it gave up leadership by itself.
    Leads {
        before: Option<(String, Instant)>,
        released: bool,
    },
    LeadsAgain,
    Deposed,
    /// etcd has lost its data. The most recent state of a living computer will replace it.
    EtcdLost,
    /// The master was killed, because another computer may lead.
    Lapsed,
    /// The start waits until `until`, because the computer at `uri` may have the same name.
    Suspect {
        uri: String,
        until: Instant,
    },
    /// A change is too large for the journal.
    TooLarge(String),
    /// The partition writes have been merged: `sent` were accepted, `lost` were not.
    Merged {
        sent: u64,
        lost: u64,
    },
}

/// What `app/cluster` must do. Actions must be carried out in order.
#[derive(Debug)]
#[allow(
    clippy::large_enum_variant,
    reason = "few exist at a time, and none is stored"
)]
pub enum Action {
    /// Write to etcd what the machine has decided. First the `parts` of a change that is too large for one transaction,
    /// provided that this computer still leads in `term`; then, in one transaction on the conditions of `op`, the keys of
    /// `op` and the journal's next `entry`. A claim also has the condition `requires`. Ends with [`Input::Answer`].
    Send {
        number: u64,
        op: Op,
        entry: Option<Put>,
        term: u64,
        parts: Vec<Put>,
        requires: Option<Evidence>,
    },
    /// Read the journal after the last record in this progress.
    Load(Progress),
    /// Watch the keys `leader` and `alive`, the journal and the member entries from this view's revision on.
    Watch(View),
    /// Write the parts of a large change to etcd.
    Prepare {
        number: u64,
        term: u64,
        parts: Vec<Put>,
    },
    /// Decide whether the session in the journal continues or a new one begins. Its state at record `seq` is `state`.
    /// `closed` says whether the last leader stopped cleanly.
    Decide {
        seq: u64,
        state: Master,
        closed: bool,
    },
    /// Publish who has the master and where calls go.
    PublishStanding(Standing),
    /// Stop recording and acknowledging calls, and stop notifying nodes. If it `binds`, no later read on this computer
    /// may show less than the mirror has shown.
    StopRecording {
        binds: bool,
    },
    /// Record calls from now on, with numbers after `seq`. The other computers have the state `held`. `state` replaces
    /// the ledger's state, if set.
    StartRecording {
        seq: u64,
        held: Master,
        state: Option<Master>,
    },
    /// Apply these records of another computer.
    Follow(Vec<Record>),
    /// Replace the ledger's state by this one: the journal's after record `seq`, with what this computer has answered and the
    /// journal lacks.
    FollowState {
        seq: u64,
        state: Master,
    },
    /// Let the answers to the calls up to this record go out.
    Acknowledge(u64),
    /// Take the changes that the ledger has recorded but not yet handed out as a single one: its state. Ends with
    /// [`Input::AsState`].
    TakeAsState,
    /// Find the writes of this computer's nodes that may be missing in the journal as this computer has read it. Ends
    /// with [`Input::Forwarded`], before any other input.
    CollectForwarded {
        base: Master,
    },
    /// Tell these nodes, which lost their names to other nodes, to shut down again, because they may have missed it.
    ShutDownDisplaced(Vec<Displaced>),
    /// Notify every node of the present state, because it may have heard an older one from another computer since.
    NotifyAll,
    /// Note in the checkpoint that it is of this term, and of the journal with this number, which it holds up to record `seq`.
    /// A computer that records calls counts the records itself.
    StoreTerm {
        term: u64,
        journal_number: u64,
        seq: u64,
    },
    BeginMaster(Cause),
    /// Kill the master at once.
    EndMaster,
    /// Let the mirror answer, because this computer has no master.
    AnswerFromMirror,
    /// Answer no call on this computer.
    AnswerNothing,
    /// Notify only this computer's own nodes if true, all nodes if false.
    NotifyOwnOnly(bool),
    /// Keep exactly these partition writes.
    ReplacePartitionWrites(PartitionWrites),
    /// Keep these partition writes, too, until a leader has them.
    AddPartitionWrites(Vec<Request>),
    /// Delete the partition writes, because none is left to send.
    DeletePartitionWrites,
    /// Ask the leader at this address and of this term to make these writes. `None` stands for this computer.
    Merge {
        number: u64,
        ask: Ask,
        to: Option<(String, u64)>,
    },
    /// Report the outcomes of partition writes.
    Report(Vec<(Request, WriteOutcome)>),
    /// Ask the rosrescue at `uri` whether it leads in `term`. Wait for a quarter of the time to live at most.
    Probe {
        number: u64,
        uri: String,
        term: u64,
    },
    /// Write this computer's entry among the members to etcd.
    PublishMemberEntry(MemberEntry),
    WriteSnapshot {
        term: u64,
        progress: Progress,
        state: Master,
        displaced: Vec<Displaced>,
    },
    /// Compact etcd up to this revision.
    CompactEtcd(u64),
    /// Answer a handover request with success, or with the reason why it failed.
    HandedOver(Result<(), String>),
    /// Stop roscore's other duties while calls still pass to the master.
    EndRosout,
    Log(News),
    /// Stop.
    End,
    /// Stop, because the computer at this address has the same name.
    EndForNamesake(String),
}
