//! The robot's state in etcd: reading it, adding to it, and replacing a long journal by a snapshot.

use std::time::Duration;

use thiserror::Error;

use super::{
    etcd::{self, Etcd, EtcdError, Kv},
    journal::{self, JournalError, Keys, Manifest, Progress, Put},
    machine::{Answer, Op, Settings, View},
};
use crate::checkpoint::format::{self, Checkpoint, Record};

/// How often reading starts over because a snapshot was replaced meanwhile.
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

/// The state in etcd, as far as it was not known.
#[derive(Debug)]
pub struct Loaded {
    /// The keys of the machine, at the same moment.
    pub view: View,
    /// The state that the records go on from; none if they go on from what was known.
    pub checkpoint: Option<Checkpoint>,
    pub records: Vec<Record>,
    /// What the computers say of themselves.
    pub members: Vec<Kv>,
    pub progress: Progress,
}

/// The state of one robot.
#[derive(Clone, Debug)]
pub struct Replica {
    pub client: Etcd,
    pub keys: Keys,
    /// How long a request may take.
    pub limit: Duration,
}

impl Replica {
    /// Reads what follows on `known`. A watch goes on from the view's revision.
    ///
    /// # Errors
    ///
    /// Why the state is not known.
    pub async fn load(&self, known: Progress) -> Result<Loaded, ReplicaError> {
        let mut attempt = 1;
        loop {
            match self.try_load(known).await {
                // The leader has just written a snapshot, and deleted what this read was about to read.
                Err(ReplicaError::Journal(_) | ReplicaError::Etcd(EtcdError::Compacted { .. }))
                    if attempt < ATTEMPTS =>
                {
                    attempt += 1;
                }
                done => return done,
            }
        }
    }

    async fn try_load(&self, known: Progress) -> Result<Loaded, ReplicaError> {
        let found = self.client.range(&self.keys.small(), self.limit).await?;
        let mut loaded = Loaded {
            view: etcd::view_of(&found, &self.keys)?,
            checkpoint: None,
            records: Vec::new(),
            members: Vec::new(),
            progress: known,
        };
        let members = self.keys.member("");
        let said = found.kvs.iter().filter(|kv| kv.key.starts_with(&members));
        loaded.members = said.cloned().collect();
        let snapshot = self.keys.snapshot();
        let snapshot = found.kvs.iter().find(|kv| kv.key == snapshot);
        let manifest = snapshot.map(|kv| self.manifest(kv)).transpose()?;
        if let Some(manifest) = manifest.filter(|manifest| manifest.seq > known.seq) {
            let bytes = self.assemble(&manifest).await?;
            loaded.progress = Progress::after_snapshot(manifest.seq, bytes.len());
            loaded.checkpoint = Some(checkpoint(&bytes)?);
        }
        for kv in &found.kvs {
            let seq = self.keys.seq_of(&kv.key);
            let Some(seq) = seq.filter(|seq| *seq > loaded.progress.seq) else {
                continue;
            };
            if let Some(manifest) = Manifest::read(&kv.value).filter(Manifest::is_state) {
                let bytes = self.assemble(&manifest).await?;
                loaded.progress.take_state(seq, bytes.len());
                loaded.checkpoint = Some(checkpoint(&bytes)?);
                loaded.records.clear();
            } else {
                let records = self.records(kv).await?;
                loaded
                    .records
                    .extend(loaded.progress.take(records, kv.value.len())?);
            }
        }
        let (expected, found) = (loaded.view.seq(), loaded.progress.seq);
        match found < expected {
            true => Err(ReplicaError::Short { found, expected }),
            false => Ok(loaded),
        }
    }

    /// The records of an entry of the journal.
    ///
    /// # Errors
    ///
    /// Why they cannot be read.
    pub async fn records(&self, entry: &Kv) -> Result<Vec<Record>, ReplicaError> {
        let Some(manifest) = Manifest::read(&entry.value) else {
            return Ok(journal::records(&entry.key, &entry.value)?);
        };
        let whole = self.assemble(&manifest).await?;
        Ok(journal::records(&entry.key, &whole)?)
    }

    fn manifest(&self, kv: &Kv) -> Result<Manifest, ReplicaError> {
        Manifest::read(&kv.value).ok_or_else(|| {
            let why = format!("`{}` is not what rosrescue writes there", kv.key);
            ReplicaError::Snapshot { why }
        })
    }

    async fn assemble(&self, manifest: &Manifest) -> Result<Vec<u8>, ReplicaError> {
        let found = self
            .client
            .range(&self.keys.parts(manifest), self.limit)
            .await?;
        let parts: Vec<_> = found.kvs.into_iter().map(|kv| kv.value).collect();
        Ok(manifest.assemble(&self.keys, &parts)?)
    }

    /// Writes the parts of a record, which may take seconds: before the machine is told that there is the
    /// record, so that no beat waits for it. Returns whether this process still leads.
    ///
    /// # Errors
    ///
    /// Why it is not known whether it was written.
    pub async fn prepare(&self, term: u64, parts: &[Put]) -> Result<bool, ReplicaError> {
        Ok(self.client.put(&self.keys, term, parts, self.limit).await?)
    }

    /// Carries out a request of the machine. `entry`: what a beat adds to the journal, its parts prepared.
    ///
    /// # Errors
    ///
    /// Why there is no answer. For the machine that is [`Answer::Silence`].
    pub async fn run(
        &self,
        settings: &Settings,
        op: &Op,
        entry: Option<&Put>,
    ) -> Result<Answer, ReplicaError> {
        Ok(self
            .client
            .run(&self.keys, settings, op, entry, self.limit)
            .await?)
    }

    /// Writes a snapshot, and deletes what it replaces. `seq` of the checkpoint is the journal's record that
    /// it holds last. Returns its size; none if this process no longer leads.
    ///
    /// # Errors
    ///
    /// Why it is not known whether it was written.
    pub async fn write_snapshot(
        &self,
        term: u64,
        checkpoint: &Checkpoint,
    ) -> Result<Option<usize>, ReplicaError> {
        let seq = checkpoint.seq;
        let encoded = format::encode_checkpoint(checkpoint, 1).map_err(JournalError::Encode)?;
        let (mut puts, manifest) = journal::snapshot(&self.keys, seq, &encoded.bytes);
        // Last: it says that all the others are there.
        puts.push(manifest);
        if !self.client.put(&self.keys, term, &puts, self.limit).await? {
            return Ok(None);
        }
        let [journal, blobs] = self.keys.behind(seq);
        let replaced = [journal, blobs, self.keys.snapshots_before(seq)];
        let leads = self
            .client
            .delete(&self.keys, term, &replaced, self.limit)
            .await?;
        Ok(leads.then_some(encoded.bytes.len()))
    }
}

fn checkpoint(bytes: &[u8]) -> Result<Checkpoint, ReplicaError> {
    let refused = |why: String| ReplicaError::Snapshot { why };
    let decoded = format::decode(bytes).map_err(|error| refused(error.to_string()))?;
    decoded
        .checkpoint
        .map_err(|error| refused(error.to_string()))
}
