//! What the ledger's lock protects.

use std::{sync::Arc, time::Instant};

use rescue_core::{
    checkpoint::format::{Announced, Checkpoint, PendingWrite, RecordContent, Session},
    cluster::sharing::Source,
    health::port_of,
    order::Order,
    replay::{self, Token},
};
use ros1_master::{
    master::{Master, Request, Snapshot},
    xmlrpc::Reply,
};
use tokio::sync::Notify;

use super::{
    activity::{Activity, Noticed},
    disk_jobs::Journal,
    divergences::Divergences,
    durability::{Mark, Whole},
    late::Outstanding,
    mutant::Mutant,
    pending::{PendingWrites, TooMany},
    shared::Shared,
};
use crate::{
    clock,
    gate::{self, State},
};

/// The mirror, the journal, and what keeps them consistent.
pub(super) struct Inner {
    pub(super) mirror: Master,
    pub(super) session: Session,
    /// `None` if no checkpoint could be opened. Then the state is unprotected.
    pub(super) journal: Option<Journal>,
    /// Number of the last record, whether or not it was written. It counts without a journal, too: the next process
    /// compares the numbers of pending writes with numbers that this session has used before.
    pub(super) seq: u64,
    pub(super) shared: Shared,
    /// Changes whenever the mirror changes.
    pub(super) version: u64,
    pub(super) whole: Whole,
    /// The write on its way to the master that the journal already holds, and the mirror does not.
    pub(super) ahead: Option<Arc<Request>>,
    pub(super) pending: PendingWrites,
    /// The record of the last pending write that the master is known to have run. The journal gets to know it when there
    /// is time.
    pub(super) acknowledged: u64,
    pub(super) activity: Activity,
    pub(super) order: Order,
    pub(super) diverged: Divergences,
    /// Whether calls pass to the master. While it is frozen, the mirror must not change.
    pub(super) gate: gate::Tx,
    /// Whether the present master may differ from the mirror and must be read again.
    pub(super) doubted: bool,
    pub(super) outstanding: Outstanding,
    pub(super) state_from: StateFrom,
    /// Whether the session has changed and the change is not in the journal yet.
    pub(super) session_unwritten: bool,
}

/// Where the mirror's state comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum StateFrom {
    /// From calls since the start of this process. No master has served.
    ThisProcess,
    /// From a checkpoint. It has not been compared with a master yet, and a living one may be newer.
    Checkpoint,
    /// From a master. The last one to which calls have passed has this number.
    Master { incarnation: u64 },
}

/// Who notifies nodes of a call's effects.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Notifier {
    /// The master, which has run the call.
    Master,
    /// The master, when it runs the call.
    MasterLater,
    /// rosrescue, in place of a master. `changes` says whether the call changes the mirror.
    Rosrescue { changes: bool },
}

impl Inner {
    /// See [`Ledger::new`](super::Ledger::new).
    pub(super) fn new(mirror: Master, session: Session, pending: Vec<PendingWrite>) -> Self {
        // A master gets the whole state if there are too many.
        let (pending, too_many) = match PendingWrites::restored(pending) {
            Ok(pending) => (pending, false),
            Err(TooMany) => (PendingWrites::default(), true),
        };
        // With a store, the numbers go on from its last one.
        let seq = pending.last().max(session.last_seq());
        let mut inner = Self {
            mirror,
            session,
            journal: None,
            seq,
            shared: Shared::Single,
            version: 0,
            whole: Whole::default(),
            ahead: None,
            pending,
            acknowledged: 0,
            activity: Activity::default(),
            order: Order::default(),
            diverged: Divergences::default(),
            gate: gate::gate(),
            doubted: false,
            outstanding: Outstanding::default(),
            state_from: StateFrom::ThisProcess,
            session_unwritten: false,
        };
        if too_many {
            inner.raise_incarnation();
        }
        inner
    }

    /// Applies `call` to the mirror. `notifier` says who notifies the nodes.
    pub(super) fn apply(
        &mut self,
        now: Instant,
        call: &Request,
        notifier: Notifier,
        wake_nodes: &Notify,
    ) -> Reply {
        let standing_in = match notifier {
            Notifier::Rosrescue { changes } => Some(changes),
            Notifier::Master | Notifier::MasterLater => None,
        };
        let mut noticed = Noticed::new(standing_in.is_some());
        noticed.left_to_master = self.order.is_left_to_master();
        noticed.displaced = self.activity.displaced_by(&self.mirror, call);
        self.activity.note_lost(&self.mirror, call);
        let reply = self.mirror.apply_telling(call, &mut noticed);
        self.version += u64::from(standing_in.unwrap_or(true));
        match noticed.take_calls() {
            Some(calls) => {
                for (api, subject, call) in calls {
                    let port = port_of(&api);
                    match standing_in {
                        // A living master may still have older notifications to send, among them those of the write
                        // that made this one redundant. `Order` tells a state only after them.
                        Some(false) => self.order.notify_of_state(port, subject),
                        _ => self.order.notify(now, port, subject, call),
                    }
                    wake_nodes.notify_one();
                }
            }
            None if notifier == Notifier::MasterLater => {}
            None => {
                for (subject, nodes) in noticed.subjects() {
                    self.order.master_notifies(now, &subject, nodes);
                }
                if self.order.has_new_repeat() {
                    wake_nodes.notify_one();
                }
            }
        }
        let registered = |node: &str| self.mirror.api_of(node).is_some();
        if self.activity.applied(now, call, noticed, registered) {
            wake_nodes.notify_one();
        }
        reply
    }

    /// Whether the mirror must not change.
    pub(super) fn is_frozen(&self) -> bool {
        self.gate.state() == State::Frozen
    }

    /// Whether a living master may be newer than the mirror.
    pub(super) fn is_unconfirmed(&self) -> bool {
        self.state_from == StateFrom::Checkpoint
    }

    /// Notes that the present master holds the mirror's state, and runs no calls.
    pub(super) fn note_equal(&mut self) {
        self.doubted = false;
        self.outstanding = Outstanding::Awaited;
    }

    pub(super) fn adopt(&mut self, state: Master) -> Vec<String> {
        let mut difference = Vec::new();
        let differs = self.mirror != state;
        if differs {
            difference = replay::difference(&self.mirror, &state);
            self.version += 1;
        }
        let (python, old) = (self.mirror.python(), self.mirror.is_old());
        // An equal `state` replaces the mirror too, because the new one may be known more exactly.
        let before = std::mem::replace(&mut self.mirror, state);
        self.mirror.keep_identity(&before);
        self.mirror.keep_origins(&before);
        self.mirror.set_python(python);
        self.mirror.set_old(old);
        if differs {
            self.changed_unrecorded();
        }
        difference
    }

    pub(super) fn add_pending(&mut self, writes: impl IntoIterator<Item = Request>) {
        let last = self.seq;
        if self.pending.extend(writes, last).is_err() {
            // If the present master answers again, it gets the mirror's whole state.
            self.raise_incarnation();
            self.write_session();
        }
    }

    /// Lets the next record be preceded by one that says which pending writes the master has run. Returns whether the
    /// journal does not know that yet.
    pub(super) fn note_acknowledged(&mut self) -> bool {
        let is_new = self.acknowledged > self.session.delivered && !Mutant::NotesNothingRun.lives();
        if is_new {
            self.session.delivered = self.acknowledged;
            self.session_unwritten = true;
        }
        is_new
    }

    /// The number of the next incarnation. A master may have each one that was announced.
    pub(super) fn next_incarnation(&self) -> u64 {
        let announced = self.session.announced.map_or(0, |it| it.incarnation);
        self.session.incarnation.max(announced) + 1
    }

    /// Begins the next incarnation, whose master is about to get the state of this moment. The injection must wait until
    /// the returned record is on the disk.
    ///
    /// Otherwise this process could die in between, the next one answer writes and die before it has examined that
    /// master, and the one after it could not tell which pending writes the master has run.
    pub(super) fn announce(&mut self) -> Mark {
        self.note_acknowledged();
        let announced = Announced {
            incarnation: self.next_incarnation(),
            at: self.seq,
        };
        let session = Session {
            announced: Some(announced),
            ..self.session_record()
        };
        if !Mutant::AnnouncesNothing.lives() {
            self.append(vec![RecordContent::Session(session.into())]);
        }
        let disk = self.last_seq();
        self.raise_incarnation();
        Mark { disk, shared: None }
    }

    pub(super) fn raise_incarnation(&mut self) {
        if self.outstanding.take_late().is_some() {
            self.outstanding = Outstanding::Abandoned;
        }
        self.pending.clear();
        self.acknowledged = 0;
        self.session.incarnation = self.next_incarnation();
        self.session.announced = None;
        self.session.delivered = self.seq;
        self.session_unwritten = true;
    }

    pub(super) fn update_session(&mut self, change: impl FnOnce(&mut Session)) {
        change(&mut self.session);
        self.session_unwritten = true;
        self.write_session();
    }

    pub(super) fn write_session(&mut self) {
        if std::mem::take(&mut self.session_unwritten) {
            let session = self.session_record();
            self.append(vec![RecordContent::Session(session.into())]);
        }
    }

    /// The session as the journal gets it now.
    pub(super) fn session_record(&self) -> Session {
        Session {
            // While a complete checkpoint is due, the file lacks changes that have no record.
            cluster_seq: match self.whole.is_due() {
                true => 0,
                false => self.cluster_seq(),
            },
            at: clock::wall_millis(),
            ..self.session.clone()
        }
    }

    /// Notes that the mirror holds etcd's journal up to record `seq`. The journal of this computer is told unless it counts
    /// the same number.
    pub(super) fn note_followed(&mut self, seq: u64) {
        self.session_unwritten |= self.cluster_seq() != seq;
        self.session.cluster_seq = seq;
    }

    pub(super) fn token(&self) -> Token {
        Token::new(&self.session.mark, self.session.incarnation)
    }

    /// The [`Token`] of the next incarnation.
    pub(super) fn next_token(&self) -> Token {
        Token::new(&self.session.mark, self.next_incarnation())
    }

    /// Notes that the mirror has changed without a record. The next complete checkpoint is due.
    pub(super) fn changed_unrecorded(&mut self) {
        self.whole.unrecorded = self.version;
        self.share_state();
    }

    /// Whether the journal already holds `call`, which is being answered. After this it no longer counts as ahead.
    pub(super) fn take_ahead(&mut self, call: &Request) -> bool {
        let is_it = |ahead: &mut Arc<Request>| std::ptr::eq(&raw const **ahead, call);
        self.ahead.take_if(is_it).is_some()
    }

    /// Notes that the mirror will not get the call that the journal holds ahead of it, if there is one. A complete
    /// checkpoint is due then.
    pub(super) fn withdraw(&mut self) -> bool {
        let is_ahead = self.ahead.take().is_some();
        if is_ahead {
            self.version += 1;
            self.changed_unrecorded();
        }
        is_ahead
    }

    /// Number of the journal's last record. `None` without a journal.
    pub(super) fn last_seq(&self) -> Option<u64> {
        self.journal.as_ref().map(|_| self.seq)
    }

    /// Identifies the last record, so that an answer can wait for it.
    pub(super) fn mark(&self) -> Mark {
        Mark {
            disk: self.last_seq(),
            shared: self.shared.last(),
        }
    }

    /// Passes `entries` to the journal. A failure is kept in the store, and does not fail the call.
    pub(super) fn append(&mut self, entries: Vec<RecordContent>) {
        self.append_from(entries, &[]);
    }

    /// Like [`Self::append`], with the source of each call. Missing sources stand for this computer.
    pub(super) fn append_from(&mut self, entries: Vec<RecordContent>, sources: &[&Source]) {
        // The session's record comes first, because it names the incarnation of the following entries.
        self.write_session();
        self.share(&entries, sources);
        if entries.is_empty() {
            return;
        }
        self.seq += entries.len() as u64;
        if let Some(journal) = &mut self.journal {
            journal.append(entries, self.seq);
        }
    }

    /// Whether another computer has the master.
    pub(super) fn is_elsewhere(&self) -> bool {
        matches!(self.shared, Shared::Elsewhere)
    }

    /// Whether other computers get the writes of this one.
    pub(super) fn is_replicated(&self) -> bool {
        matches!(self.shared, Shared::Here { .. })
    }

    /// Queues `entries` for the other computers. `sources` says for each of the first entries where it came from; the rest
    /// came from this computer.
    pub(super) fn share(&mut self, entries: &[RecordContent], sources: &[&Source]) {
        let Shared::Here { sharing, .. } = &mut self.shared else {
            return;
        };
        for (index, entry) in entries.iter().enumerate() {
            if let RecordContent::Call { call, label, .. } = entry {
                let source = sources.get(index).copied().unwrap_or(&Source::Here);
                sharing.record_labelled(call, source, *label);
            }
        }
    }

    /// Notes that the state has changed without a call.
    pub(super) fn share_state(&mut self) {
        if let Shared::Here { sharing, .. } = &mut self.shared {
            sharing.record_state(&self.mirror);
            // The state takes a number in that journal, so the session's record must be written again: later calls have
            // other numbers than that record tells.
            self.session_unwritten = true;
        }
    }

    /// See [`Session::cluster_seq`](rescue_core::checkpoint::format::Session::cluster_seq).
    pub(super) fn cluster_seq(&self) -> u64 {
        let last = self.shared.last();
        last.map_or(self.session.cluster_seq, |last| last.seq)
    }

    /// The checkpoint of this moment. A large state takes long to convert, so the returned function does that, which
    /// needs no lock.
    pub(super) fn checkpoint(&self) -> impl FnOnce() -> Checkpoint + Send + use<> {
        let mirror = self.mirror.clone();
        let rest = Checkpoint {
            seq: self.seq,
            session: Session {
                cluster_seq: self.cluster_seq(),
                at: clock::wall_millis(),
                ..self.session.clone()
            },
            pending: self.pending.numbered(),
            snapshot: Snapshot::default(),
            displaced: self.activity.displaced_lately(Instant::now()),
            follows: !self.whole.is_due(),
        };
        move || Checkpoint {
            snapshot: mirror.snapshot(),
            ..rest
        }
    }
}
