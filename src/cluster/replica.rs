//! The robot's state in etcd: reads it, appends to the journal, and replaces a long journal by a snapshot.

use std::time::Duration;

use rescue_core::{
    checkpoint::format::{self, Checkpoint, Record},
    cluster::{
        journal::{self, JournalError, Keys, Manifest, Progress, Put},
        machine::{EtcdAnswer, Op, Settings, View},
        member::Evidence,
    },
};
use thiserror::Error;

use super::etcd::{self, Etcd, EtcdError, Found, Kv};

/// How often a read starts over because etcd was compacted meanwhile.
const ATTEMPTS: usize = 5;

#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReplicaError {
    #[error(transparent)]
    Etcd(#[from] EtcdError),
    #[error(transparent)]
    Journal(#[from] JournalError),
    #[error("the snapshot in etcd cannot be used: {why}")]
    Snapshot { why: String },
    #[error(
        "the journal in etcd ends with record {found}, and record {expected} was committed: something has \
         deleted keys, or etcd was restored from a backup"
    )]
    Short { found: u64, expected: u64 },
}

impl ReplicaError {
    /// Whether keys of the journal are missing, or are not what rosrescue has written.
    fn is_damage(&self) -> bool {
        let journal = matches!(self, Self::Journal(error) if error.is_damage());
        journal || matches!(self, Self::Short { .. })
    }
}

/// What [`Replica::load`] has read: the part of the state in etcd that its caller did not know yet.
#[derive(Debug)]
pub struct LoadedState {
    /// The keys `origin`, `leader` and `alive`, read at the same moment.
    pub view: View,
    /// Why the journal cannot be read from its beginning, if it cannot. Then only `view` and `members` count.
    pub damage: Option<ReplicaError>,
    /// The snapshot that the records follow. `None` if they follow the known state.
    pub checkpoint: Option<Checkpoint>,
    pub records: Vec<Record>,
    /// What each computer has written about itself.
    pub members: Vec<Kv>,
    pub progress: Progress,
}

/// The state of one robot in etcd.
#[derive(Clone, Debug)]
pub struct Replica {
    pub client: Etcd,
    pub keys: Keys,
    /// Longest time for one request.
    pub limit: Duration,
}

impl Replica {
    /// Reads the journal after `known`. A watch can continue from the view's revision.
    ///
    /// # Errors
    ///
    /// Why the state is unknown.
    pub async fn load(&self, known: Progress) -> Result<LoadedState, ReplicaError> {
        let mut attempt = 1;
        loop {
            match self.try_load(known).await {
                Err(ReplicaError::Etcd(EtcdError::Compacted)) if attempt < ATTEMPTS => {
                    attempt += 1;
                }
                done => return done,
            }
        }
    }

    async fn try_load(&self, known: Progress) -> Result<LoadedState, ReplicaError> {
        // A long journal takes many requests, so what is known is not read again.
        let unknown = self.keys.small_after(known.seq);
        let found = self.client.ranges(&unknown, None, self.limit).await?;
        let mut loaded = LoadedState {
            view: etcd::view_of(&found, &self.keys)?,
            damage: None,
            checkpoint: None,
            records: Vec::new(),
            members: Vec::new(),
            progress: known,
        };
        let members = self.keys.member("");
        let said = found.kvs.iter().filter(|kv| kv.key.starts_with(&members));
        loaded.members = said.cloned().collect();
        match self.read_journal(&found, known, &mut loaded).await {
            Err(error) if error.is_damage() => loaded.damage = Some(error),
            read => read?,
        }
        Ok(loaded)
    }

    /// Adds the journal after `known` to `loaded`.
    async fn read_journal(
        &self,
        found: &Found,
        known: Progress,
        loaded: &mut LoadedState,
    ) -> Result<(), ReplicaError> {
        let snapshot = self.keys.snapshot();
        let snapshot = found.kvs.iter().find(|kv| kv.key == snapshot);
        let manifest = snapshot.map(|kv| self.manifest(kv)).transpose()?;
        if let Some(manifest) = manifest.filter(|manifest| manifest.seq > known.seq) {
            let bytes = self.assemble(&manifest, found.revision).await?;
            loaded.progress = Progress::after_snapshot(manifest.seq, bytes.len());
            loaded.checkpoint = Some(checkpoint(&bytes)?);
        }
        for kv in &found.kvs {
            let seq = self.keys.seq_of(&kv.key);
            let Some(seq) = seq.filter(|seq| *seq > loaded.progress.seq) else {
                continue;
            };
            if let Some(manifest) = Manifest::read(&kv.value).filter(Manifest::is_state) {
                let bytes = self.assemble(&manifest, found.revision).await?;
                loaded.progress.take_state(seq, bytes.len());
                loaded.checkpoint = Some(checkpoint(&bytes)?);
                loaded.records.clear();
            } else {
                let records = self.records(kv, found.revision).await?;
                loaded
                    .records
                    .extend(loaded.progress.take(records, kv.value.len())?);
            }
        }
        let (expected, found) = (loaded.view.seq(), loaded.progress.seq);
        match found < expected {
            true => Err(ReplicaError::Short { found, expected }),
            false => Ok(()),
        }
    }

    /// Reads the records of a journal entry that was read at `revision`.
    ///
    /// # Errors
    ///
    /// If they could not be read.
    pub async fn records(&self, entry: &Kv, revision: u64) -> Result<Vec<Record>, ReplicaError> {
        let Some(manifest) = Manifest::read(&entry.value) else {
            return Ok(journal::decode_records(&entry.key, &entry.value)?);
        };
        let whole = self.assemble(&manifest, revision).await?;
        Ok(journal::decode_records(&entry.key, &whole)?)
    }

    fn manifest(&self, kv: &Kv) -> Result<Manifest, ReplicaError> {
        Manifest::read(&kv.value).ok_or_else(|| {
            let why = format!("`{}` is not what rosrescue writes there", kv.key);
            ReplicaError::Snapshot { why }
        })
    }

    /// Reads the parts that `manifest` named at `revision`. The leader may have replaced them since.
    async fn assemble(&self, manifest: &Manifest, revision: u64) -> Result<Vec<u8>, ReplicaError> {
        let parts = [self.keys.parts(manifest)];
        let found = self.client.ranges(&parts, Some(revision), self.limit);
        let found = found.await?;
        let parts: Vec<_> = found.kvs.into_iter().map(|kv| kv.value).collect();
        Ok(manifest.assemble(&self.keys, &parts)?)
    }

    /// Writes the parts of a large record, which may take seconds. Call this before the state machine gets the record,
    /// so that no heartbeat waits for it. Returns whether this process still leads.
    ///
    /// # Errors
    ///
    /// Why it is unknown whether they were written.
    pub async fn prepare(&self, term: u64, parts: &[Put]) -> Result<bool, ReplicaError> {
        Ok(self.client.put(&self.keys, term, parts, self.limit).await?)
    }

    /// Carries out a request of the state machine. `entry` is what a heartbeat adds to the journal; its parts are
    /// already written. `requires` is a condition of a claim.
    ///
    /// # Errors
    ///
    /// Why etcd gave no answer. The state machine gets [`EtcdAnswer::Silence`] for it.
    pub async fn run(
        &self,
        settings: &Settings,
        op: &Op,
        entry: Option<&Put>,
        requires: Option<&Evidence>,
    ) -> Result<EtcdAnswer, ReplicaError> {
        Ok(self
            .client
            .run(&self.keys, settings, op, entry, requires, self.limit)
            .await?)
    }

    /// Writes an encoded checkpoint as the snapshot, and deletes what it replaces. `seq` is the last journal record in it.
    /// Returns whether this process still leads.
    ///
    /// # Errors
    ///
    /// Why it is unknown whether it was written.
    pub async fn write_snapshot(
        &self,
        term: u64,
        seq: u64,
        encoded: &[u8],
    ) -> Result<bool, ReplicaError> {
        let (mut puts, manifest) = journal::snapshot(&self.keys, seq, encoded);
        // The manifest comes last, because it declares the snapshot complete.
        puts.push(manifest);
        if !self.client.put(&self.keys, term, &puts, self.limit).await? {
            return Ok(false);
        }
        let [journal, blobs] = self.keys.behind(seq);
        let replaced = [journal, blobs, self.keys.snapshots_before(seq)];
        let leads = self.client.delete(&self.keys, term, &replaced, self.limit);
        Ok(leads.await?)
    }
}

fn checkpoint(bytes: &[u8]) -> Result<Checkpoint, ReplicaError> {
    let refused = |why: String| ReplicaError::Snapshot { why };
    let decoded = format::decode(bytes).map_err(|error| refused(error.to_string()))?;
    decoded
        .checkpoint
        .map_err(|error| refused(error.to_string()))
}
