//! A model of etcd: the leader's two keys, the journal, and large values. Transactions are linearizable. The `world`
//! decides when requests reach the model, and which answers arrive.

use std::collections::BTreeMap;

use crate::{
    checkpoint::format::{self, Record, RecordContent},
    cluster::{
        journal::{self, Keys, Manifest, Progress, Put},
        machine::{Alive, EtcdAnswer, Leader, Op, RevisionGuard, Settings, View},
        member::{Evidence, MemberEntry, MemberEntryChange, Read, WatchedEntry},
    },
};
use ros1_master::master::{Displaced, Master, Request};

/// A request to etcd on its way.
#[derive(Clone, Debug)]
pub(super) struct Sent {
    pub(super) from: usize,
    /// The process that sent the request.
    pub(super) life: u64,
    pub(super) number: u64,
    pub(super) settings: Settings,
    pub(super) op: Op,
    pub(super) entry: Option<Put>,
    pub(super) parts: Vec<Put>,
    pub(super) requires: Option<Evidence>,
    pub(super) sent_at: u64,
    /// See [`Computer::unaware`](super::computer::Computer::unaware).
    pub(super) unaware: bool,
    /// When the sender gives up.
    pub(super) until: u64,
}

/// The content of a journal entry.
#[derive(Clone, Debug)]
pub(super) enum Held {
    Records(Vec<Record>),
    State(Box<Master>),
    /// A large value of which parts are gone. No computer can read it.
    Damaged,
}

/// An entry that was added to the journal.
#[derive(Debug)]
pub(super) struct LogEntry {
    pub(super) added: u64,
    /// The number of its last record.
    pub(super) seq: u64,
    pub(super) term: u64,
    /// The computer that added it.
    pub(super) writer: usize,
    pub(super) held: Held,
}

impl LogEntry {
    /// The number of one of its records.
    pub(super) fn seq_of(&self, part: usize) -> u64 {
        match &self.held {
            Held::Records(records) => records[part].seq,
            Held::State(_) | Held::Damaged => self.seq,
        }
    }
}

/// A copy of etcd's data.
#[derive(Clone, Debug)]
struct Copy {
    view: View,
    entries: BTreeMap<u64, (Held, usize)>,
    snapshot: Option<(u64, Master, Vec<Displaced>)>,
    state: Master,
    values: BTreeMap<String, Vec<u8>>,
    members: BTreeMap<String, (MemberEntry, u64)>,
}

#[derive(Debug)]
pub(super) struct Etcd {
    pub(super) keys: Keys,
    view: View,
    /// The journal's entries and their sizes, by the last record of each.
    entries: BTreeMap<u64, (Held, usize)>,
    snapshot: Option<(u64, Master, Vec<Displaced>)>,
    /// What a watch delivers: each journal entry with its number and revision.
    puts: Vec<(u64, u64, Held, usize)>,
    /// The revisions and numbers of deleted journal entries.
    deletes: Vec<(u64, u64)>,
    /// A watch from before this revision ends.
    compacted: u64,
    /// A backup.
    saved: Option<Box<Copy>>,
    /// The state that the journal leads to.
    pub(super) state: Master,
    values: BTreeMap<String, Vec<u8>>,
    members: BTreeMap<String, (MemberEntry, u64)>,
    /// The computers whose claims have succeeded, in order.
    pub(super) claims: Vec<usize>,
    /// All entries that were added to the journal.
    pub(super) log: Vec<LogEntry>,
    pub(super) now: u64,
    /// Whether all data was lost once.
    pub(super) lost: bool,
    /// When etcd began to answer after it had lost data last.
    pub(super) lost_at: u64,
    /// Whether no new journal has begun since.
    pub(super) is_lost: bool,
    /// When etcd answered again after an older copy had been restored.
    pub(super) replaced_at: u64,
    /// Whether an older copy was restored, and no computer has led with it yet or begun a new journal.
    pub(super) is_old: bool,
    /// Whether the leader of a new journal without a state could not know of the last loss.
    begins_unaware: bool,
    /// The places in the log where a new journal began, or an older one went on, and whether its leader could not know of
    /// the loss.
    pub(super) beginnings: Vec<(usize, bool)>,
}

impl Etcd {
    pub(super) fn new() -> Self {
        Self {
            keys: Keys::new("robot"),
            view: View::default(),
            entries: BTreeMap::new(),
            snapshot: None,
            puts: Vec::new(),
            deletes: Vec::new(),
            compacted: 0,
            saved: None,
            state: Master::default(),
            values: BTreeMap::new(),
            members: BTreeMap::new(),
            claims: Vec::new(),
            log: Vec::new(),
            now: 0,
            lost: false,
            lost_at: 0,
            is_lost: false,
            replaced_at: 0,
            is_old: false,
            begins_unaware: false,
            beginnings: Vec::new(),
        }
    }

    /// Whether the journal has this call.
    pub(super) fn holds(&self, call: &Request) -> bool {
        self.log.iter().rev().any(|entry| match &entry.held {
            Held::Records(records) => records.iter().any(|record| match &record.entry {
                RecordContent::Call { call: of, .. } => of.params() == call.params(),
                RecordContent::Session(_) => false,
            }),
            Held::State(_) | Held::Damaged => false,
        })
    }

    /// When the entry at this place of the log was added. 0 if there is none yet.
    pub(super) fn added(&self, place: usize) -> u64 {
        self.log.get(place).map_or(0, |entry| entry.added)
    }

    pub(super) fn view(&self) -> &View {
        &self.view
    }

    pub(super) fn seq(&self) -> u64 {
        self.view.seq()
    }

    /// Loses all data.
    pub(super) fn lose(&mut self) {
        *self = Self {
            claims: std::mem::take(&mut self.claims),
            log: std::mem::take(&mut self.log),
            beginnings: std::mem::take(&mut self.beginnings),
            now: self.now,
            lost: true,
            ..Self::new()
        };
    }

    pub(super) fn is_saved(&self) -> bool {
        self.saved.is_some()
    }

    /// Makes a backup.
    pub(super) fn save(&mut self) {
        self.saved = Some(Box::new(Copy {
            view: self.view.clone(),
            entries: self.entries.clone(),
            snapshot: self.snapshot.clone(),
            state: self.state.clone(),
            values: self.values.clone(),
            members: self.members.clone(),
        }));
    }

    /// Restores the backup. etcd can give a restored copy a higher revision than before.
    pub(super) fn restore(&mut self, is_bumped: bool) {
        let Copy {
            view,
            entries,
            snapshot,
            state,
            values,
            members,
        } = *self.saved.clone().unwrap();
        let revision = match is_bumped {
            true => self.view.revision + 1000,
            false => view.revision,
        };
        self.compacted = revision;
        (self.puts, self.deletes) = (Vec::new(), Vec::new());
        self.members = members;
        (self.view, self.entries, self.snapshot) = (view, entries, snapshot);
        (self.state, self.values) = (state, values);
        self.view.revision = revision;
        self.is_old = true;
    }

    /// Deletes all keys, or those that `deletes` names.
    pub(super) fn delete(&mut self, mut deletes: impl FnMut(&str) -> bool) {
        self.view.revision += 1;
        let revision = self.view.revision;
        if deletes("origin") {
            (self.view.origin, self.view.journal_number) = (0, 0);
        }
        if deletes("leader") {
            self.view.leader = None;
        }
        if deletes("alive") {
            self.view.alive = None;
        }
        if self.snapshot.is_some() && deletes("snapshot") {
            self.snapshot = None;
            self.deletes.push((revision, u64::MAX));
        }
        if deletes("members") {
            self.members.clear();
        }
        let gone = self.entries.keys().filter(|_| deletes("journal"));
        for seq in gone.copied().collect::<Vec<_>>() {
            self.entries.remove(&seq);
            self.deletes.push((revision, seq));
        }
    }

    /// The number of the last journal entry that was deleted after revision `after`, up to revision `upto`.
    pub(super) fn deleted(&self, after: u64, upto: u64) -> Option<u64> {
        let deletes = self.deletes.iter();
        let new = deletes.filter(|(revision, _)| (after + 1..=upto).contains(revision));
        new.map(|(_, seq)| *seq).max()
    }

    /// Writes the parts of a large value.
    pub(super) fn put(&mut self, parts: Vec<Put>) {
        for part in parts {
            self.view.revision += 1;
            self.values.insert(part.key, part.value);
        }
    }

    /// Writes a computer's member entry.
    pub(super) fn put_member_entry(&mut self, name: &str, entry: MemberEntry) {
        self.view.revision += 1;
        let revision = self.view.revision;
        self.members.insert(name.to_owned(), (entry, revision));
    }

    /// Carries out the transaction if the keys have the revisions that it expects.
    pub(super) fn run(&mut self, sent: &Sent) -> EtcdAnswer {
        let expected = match &sent.op {
            Op::Read => return EtcdAnswer::Is(self.view.clone()),
            Op::Claim { guard, .. } | Op::Beat { guard, .. } => *guard,
        };
        // A restored etcd gives revisions out again.
        let leads = match (&sent.op, &self.view.leader) {
            (Op::Beat { claim, .. }, Some(leader)) => {
                (&leader.id, leader.claim) == (&sent.settings.id, *claim)
            }
            _ => true,
        };
        let has_last = expected.seq == 0 || self.entries.contains_key(&expected.seq);
        let guard = RevisionGuard {
            seq: expected.seq,
            ..self.view.guard()
        };
        let has_evidence = sent.requires.as_ref().is_none_or(|required| {
            let own = self.members.get(&sent.settings.name);
            let mut members = self.members.values();
            own.is_some_and(|(entry, _)| *entry == required.own)
                && members.all(|(_, revision)| *revision <= required.read_up_to)
        });
        if guard != expected || !has_last || !leads || !has_evidence {
            return EtcdAnswer::Is(self.view.clone());
        }
        self.view.revision += 1;
        let revision = self.view.revision;
        match &sent.op {
            Op::Read => {}
            Op::Claim {
                claim,
                begins,
                seq,
                settled,
                ..
            } => {
                if let Some(journal_number) = *begins {
                    (self.view.origin, self.view.journal_number) = (revision, journal_number);
                    self.entries.clear();
                    (self.snapshot, self.state) = (None, Master::default());
                    self.values.clear();
                } else {
                    // An older copy gives revisions out again, so a claim that the network held up may suit it.
                    let is_late = sent.sent_at < self.replaced_at;
                    assert!(
                        is_late || *seq == self.seq(),
                        "a claim knows the journal's end"
                    );
                }
                self.claims.push(sent.from);
                let was_old = std::mem::take(&mut self.is_old);
                // A process whose claim the network held up since before a copy was restored takes it for the journal. So
                // does one that started after that.
                let is_late = was_old && sent.sent_at < self.replaced_at;
                self.begins_unaware = is_late;
                if was_old && begins.is_none() {
                    self.goes_on(sent.unaware || is_late);
                }
                let of = sent.settings.clone();
                self.view.leader = Some(Leader {
                    term: revision,
                    name: of.name,
                    id: of.id,
                    claim: *claim,
                    claimed_at: *seq,
                    uri: of.uri,
                    boot: of.boot,
                    version: of.version,
                });
                self.set_alive(0, *seq, None, *settled);
            }
            Op::Beat {
                beat,
                released,
                settled,
                ..
            } => {
                if std::mem::take(&mut self.is_old) {
                    // The leader of the copy has hung since before it was made, and goes on.
                    self.goes_on(true);
                }
                let mut seq = self.seq();
                if let Some(put) = &sent.entry {
                    seq = self.add(put);
                }
                self.set_alive(*beat, seq, released.clone(), *settled);
            }
        }
        let seq = self.seq();
        EtcdAnswer::Applied { revision, seq }
    }

    fn set_alive(&mut self, beat: u64, seq: u64, released: Option<String>, settled: bool) {
        let revision = self.view.revision;
        self.view.alive = Some(Alive {
            revision,
            beat,
            seq,
            released,
            settled,
        });
    }

    /// Adds an entry to the journal. Returns the number of its last record.
    fn add(&mut self, put: &Put) -> u64 {
        let seq = self.keys.seq_of(&put.key).unwrap();
        let (held, bytes) = match Manifest::read(&put.value) {
            None => {
                let records = journal::decode_records(&put.key, &put.value).unwrap();
                (Held::Records(records), put.value.len())
            }
            Some(manifest) => {
                let parts = self.values.range(self.keys.parts(&manifest));
                let parts: Vec<_> = parts.map(|(_, value)| value.clone()).collect();
                match (manifest.assemble(&self.keys, &parts), manifest.is_state()) {
                    (Err(_), _) => (Held::Damaged, put.value.len()),
                    (Ok(whole), false) => {
                        let records = journal::decode_records(&put.key, &whole).unwrap();
                        (Held::Records(records), whole.len())
                    }
                    (Ok(whole), true) => {
                        let checkpoint = format::decode(&whole).unwrap().checkpoint.unwrap();
                        let state = Master::from_snapshot(checkpoint.snapshot).unwrap();
                        (Held::State(Box::new(state)), whole.len())
                    }
                }
            }
        };
        match &held {
            Held::State(state) => {
                if self.entries.is_empty() && self.snapshot.is_none() {
                    self.beginnings.push((self.log.len(), self.begins_unaware));
                    self.is_lost = false;
                }
                self.state = (**state).clone();
            }
            Held::Records(records) => {
                let next = self.view.seq() + 1;
                assert_eq!(records[0].seq, next, "the journal has no gap");
                for record in records {
                    if let RecordContent::Call { call, .. } = &record.entry {
                        self.state.apply_telling(call, &mut ());
                    }
                }
            }
            Held::Damaged => {}
        }
        if !matches!(held, Held::Damaged) {
            self.log(seq, held.clone());
        }
        let revision = self.view.revision;
        self.puts.push((revision, seq, held.clone(), bytes));
        self.entries.insert(seq, (held, bytes));
        seq
    }

    /// Notes that an older journal goes on. `is_unaware` says that its leader cannot know of the loss.
    fn goes_on(&mut self, is_unaware: bool) {
        self.beginnings.push((self.log.len(), is_unaware));
        self.is_lost = false;
        self.log(self.seq(), Held::State(Box::new(self.state.clone())));
    }

    fn log(&mut self, seq: u64, held: Held) {
        self.log.push(LogEntry {
            added: self.now,
            seq,
            term: self.view.guard().leader,
            writer: *self.claims.last().unwrap(),
            held,
        });
    }

    /// Deletes the journal's last entry, and nothing else.
    pub(super) fn delete_last_entry(&mut self) {
        self.view.revision += 1;
        let (seq, revision) = (self.seq(), self.view.revision);
        assert!(self.entries.remove(&seq).is_some());
        self.deletes.push((revision, seq));
    }

    /// Replaces the journal by a snapshot. The last entry stays.
    pub(super) fn compact(&mut self) {
        let seq = self.seq();
        if self.entries.contains_key(&seq) && self.is_readable() {
            self.compacted = self.view.revision;
            self.view.revision += 1;
            self.snapshot = Some((seq, self.state.clone(), Vec::new()));
            self.entries.retain(|of, _| *of == seq);
            self.puts.clear();
        }
    }

    /// Whether the journal can be read from its beginning.
    pub(super) fn is_readable(&self) -> bool {
        self.read(Progress::default()).is_readable
    }

    /// Reads the journal after `known`.
    pub(super) fn read(&self, known: Progress) -> Read {
        let mut read = Read {
            view: self.view.clone(),
            is_readable: true,
            state: None,
            records: Vec::new(),
            progress: known,
            members: self.member_entries(0),
        };
        if let Some((seq, state, displaced)) = &self.snapshot
            && *seq > known.seq
        {
            read.progress = Progress::after_snapshot(*seq, 1000);
            read.state = Some((state.clone(), displaced.clone()));
        }
        for (seq, (held, bytes)) in self.entries.range(read.progress.seq + 1..) {
            match held {
                Held::State(state) => {
                    read.progress.take_state(*seq, *bytes);
                    read.state = Some(((**state).clone(), Vec::new()));
                    read.records.clear();
                }
                Held::Records(records) => match read.progress.take(records.clone(), *bytes) {
                    Ok(new) => read.records.extend(new),
                    Err(_) => {
                        read.is_readable = false;
                        return read;
                    }
                },
                Held::Damaged => {
                    read.is_readable = false;
                    return read;
                }
            }
        }
        read.is_readable = read.progress.seq >= self.seq();
        read
    }

    /// The entries of the journal after revision `after`, up to revision `upto`, as a watch shows them with their revisions. `None` if a
    /// snapshot has replaced them.
    pub(super) fn entries_after(&self, after: u64, upto: u64) -> Option<Vec<(u64, WatchedEntry)>> {
        if after < self.compacted {
            return None;
        }
        let new = self.puts.iter();
        let new = new.filter(|(revision, ..)| (after + 1..=upto).contains(revision));
        let entries = new.map(|(revision, seq, held, bytes)| {
            let entry = match held {
                Held::State(_) | Held::Damaged => WatchedEntry::Apart(*seq),
                Held::Records(records) => WatchedEntry::Records {
                    records: records.clone(),
                    bytes: *bytes,
                },
            };
            (*revision, entry)
        });
        Some(entries.collect())
    }

    /// The member entries that were written after a revision.
    pub(super) fn member_entries(&self, after: u64) -> Vec<MemberEntryChange> {
        let members = self.members.iter();
        let new = members.filter(|(_, (_, revision))| *revision > after);
        let changes = new.map(|(name, (entry, revision))| MemberEntryChange {
            name: name.clone(),
            entry: Some(entry.clone()),
            revision: *revision,
        });
        changes.collect()
    }
}
