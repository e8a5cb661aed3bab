//! The robot's keys in etcd. Carries out the requests of the cluster's state machine as transactions on the keys
//! `origin`, `leader` and `alive`.

use std::{
    ops::{Deref, Range},
    time::Duration,
};

use etcd_kv::{Client, Compare, Txn, TxnOp};
pub use etcd_kv::{
    Credentials, EtcdError, Found, KeyChange, Kv, MemberStatus, Options, Tls, Tried, Watch,
    WatchEnd,
};
use rescue_core::cluster::{
    journal::{Keys, Put},
    machine::{Alive, EtcdAnswer, Leader, Op, RevisionGuard, Settings, View},
    member::Evidence,
};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

/// Maximum number of robots that [`Etcd::robots`] lists.
const ROBOTS_MOST: usize = 16;
/// Upper end of the key range with all robots: `0` follows `/` in ASCII.
const ROBOTS_END: &str = "0";

/// An etcd client that knows the robot's keys.
#[derive(Clone, Debug)]
pub struct Etcd(Client);

impl Deref for Etcd {
    type Target = Client;

    fn deref(&self) -> &Client {
        &self.0
    }
}

impl Etcd {
    /// Creates a client. It connects at its first request.
    ///
    /// # Errors
    ///
    /// The errors of [`Client::new`].
    pub fn new(options: &Options) -> Result<Self, EtcdError> {
        Client::new(options).map(Self)
    }

    /// Carries out a request of the state machine. `entry` is what a heartbeat adds to the journal, and `requires` a condition
    /// of a claim.
    ///
    /// # Errors
    ///
    /// Why etcd gave no answer. The state machine gets [`EtcdAnswer::Silence`] for it.
    pub async fn run(
        &self,
        keys: &Keys,
        settings: &Settings,
        op: &Op,
        entry: Option<&Put>,
        requires: Option<&Evidence>,
        limit: Duration,
    ) -> Result<EtcdAnswer, EtcdError> {
        let (txn, seq) = transaction(keys, settings, op, entry, requires);
        let done = self.txn(&txn, limit).await?;
        if done.succeeded && done.gets.is_empty() {
            let revision = done.revision;
            return Ok(EtcdAnswer::Applied { revision, seq });
        }
        view(keys, done.revision, done.gets.iter().flatten()).map(EtcdAnswer::Is)
    }

    /// Writes `puts` one after the other, each only if `leader` still has this term. Returns whether `leader` had it
    /// each time.
    ///
    /// # Errors
    ///
    /// Why it is unknown whether all were written.
    pub async fn put(
        &self,
        keys: &Keys,
        term: u64,
        puts: &[Put],
        limit: Duration,
    ) -> Result<bool, EtcdError> {
        for put in puts {
            let txn = guarded(keys, term, vec![write(put)]);
            if !self.txn(&txn, limit).await?.succeeded {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Deletes `ranges` if `leader` still has this term. Returns whether they were deleted.
    ///
    /// # Errors
    ///
    /// Why it is unknown whether they were deleted.
    pub async fn delete(
        &self,
        keys: &Keys,
        term: u64,
        ranges: &[Range<String>],
        limit: Duration,
    ) -> Result<bool, EtcdError> {
        let deletes = ranges.iter().cloned().map(TxnOp::Delete).collect();
        let done = self.txn(&guarded(keys, term, deletes), limit).await?;
        Ok(done.succeeded)
    }

    /// Reads the keys `origin`, `leader` and `alive`.
    ///
    /// # Errors
    ///
    /// Why they could not be read.
    pub async fn view(&self, keys: &Keys, limit: Duration) -> Result<View, EtcdError> {
        let done = self.txn(&read_leader_keys(keys), limit).await?;
        view(keys, done.revision, done.gets.iter().flatten())
    }

    /// Writes a key that etcd deletes when `lease` ends.
    ///
    /// # Errors
    ///
    /// Why it is unknown whether the key was written.
    pub async fn put_with_lease(
        &self,
        put: &Put,
        lease: i64,
        limit: Duration,
    ) -> Result<(), EtcdError> {
        self.0
            .put_with_lease(&put.key, &put.value, lease, limit)
            .await
    }

    /// Tries each endpoint on its own, so it needs no majority.
    pub async fn try_each(&self, keys: &Keys, limit: Duration) -> Vec<Tried> {
        self.0.try_each(&keys.leader(), limit).await
    }

    /// Names of the robots that have or had a leader in this etcd, up to `ROBOTS_MOST`.
    ///
    /// # Errors
    ///
    /// Why they are unknown; for example, the etcd user may read only one robot's keys.
    pub async fn robots(&self, limit: Duration) -> Result<Vec<String>, EtcdError> {
        let mut robots = Vec::new();
        let mut from = "/".to_owned();
        // Jumps from robot to robot instead of reading each key: a robot may have a thousand.
        for _ in 0..ROBOTS_MOST {
            let key = self
                .first_key(&(from..ROBOTS_END.to_owned()), limit)
                .await?;
            let key = key.as_deref().and_then(|key| key.strip_prefix('/'));
            let Some(name) = key.and_then(|key| key.split('/').next()) else {
                break;
            };
            let view = self.view(&Keys::new(name), limit).await;
            if view.is_ok_and(|view| view.leader.is_some()) {
                robots.push(name.to_owned());
            }
            // `0` follows `/`.
            from = format!("/{name}0");
        }
        robots.sort();
        Ok(robots)
    }
}

/// Finds the keys `origin`, `leader` and `alive` among all keys with the robot's prefix.
///
/// # Errors
///
/// If rosrescue did not write them.
pub fn view_of(found: &Found, keys: &Keys) -> Result<View, EtcdError> {
    view(keys, found.revision, found.kvs.iter())
}

/// Updates a view with a changed key.
///
/// # Errors
///
/// If rosrescue did not write the key.
pub fn absorb(change: &KeyChange, view: &mut View, keys: &Keys) -> Result<(), EtcdError> {
    view.revision = view.revision.max(change.revision);
    absorb_key(view, keys, &change.key, change.kv.as_ref())
}

/// The value of `leader`.
#[derive(Debug, Serialize, Deserialize)]
struct LeaderValue {
    name: String,
    id: String,
    claim: u64,
    /// The number of the journal's last record at the claim.
    claimed_at: u64,
    uri: String,
    boot: String,
    version: String,
}

/// The value of `origin`.
#[derive(Debug, Serialize, Deserialize)]
struct OriginValue {
    /// For people only.
    began_by: String,
    /// See [`View::journal_number`].
    journal_number: u64,
}

/// The value of `alive`.
#[derive(Debug, Serialize, Deserialize)]
struct AliveValue {
    beat: u64,
    seq: u64,
    released: Option<String>,
    /// Whether it is decided that the journal's session continues.
    settled: bool,
}

fn write(put: &Put) -> TxnOp {
    TxnOp::Put {
        key: put.key.clone(),
        value: put.value.clone(),
    }
}

fn json(value: &impl Serialize) -> Vec<u8> {
    // Texts and numbers always serialize.
    serde_json::to_vec(value).unwrap_or_default()
}

/// The value of `leader` after this claim, at which the journal ended with record `claimed_at`.
fn leader_value(settings: &Settings, claim: u64, claimed_at: u64) -> Vec<u8> {
    let Settings {
        name,
        id,
        uri,
        boot,
        version,
        ..
    } = settings.clone();
    json(&LeaderValue {
        name,
        id,
        claim,
        claimed_at,
        uri,
        boot,
        version,
    })
}

fn get_view(keys: &Keys) -> Vec<TxnOp> {
    [keys.origin(), keys.leader(), keys.alive()]
        .map(TxnOp::Get)
        .into()
}

/// A transaction that reads `origin`, `leader` and `alive`.
fn read_leader_keys(keys: &Keys) -> Txn {
    Txn {
        success: get_view(keys),
        ..Txn::default()
    }
}

/// A transaction that makes `changes` only if `leader` has this term.
fn guarded(keys: &Keys, term: u64, changes: Vec<TxnOp>) -> Txn {
    Txn {
        compare: vec![Compare::Modified(keys.leader(), term)],
        success: changes,
        failure: Vec::new(),
    }
}

/// The condition that the journal is as `guard` says. Without its last entry, it cannot be read.
fn unchanged(keys: &Keys, guard: &RevisionGuard) -> Vec<Compare> {
    let keys_at = [
        (keys.origin(), guard.origin),
        (keys.leader(), guard.leader),
        (keys.alive(), guard.alive),
    ];
    let last = (guard.seq > 0).then(|| Compare::Exists(keys.journal(guard.seq)));
    let modified = keys_at.map(|(key, revision)| Compare::Modified(key, revision));
    modified.into_iter().chain(last).collect()
}

/// Builds the transaction of `op`. Also returns the number of the journal's last record after it.
fn transaction(
    keys: &Keys,
    settings: &Settings,
    op: &Op,
    entry: Option<&Put>,
    requires: Option<&Evidence>,
) -> (Txn, u64) {
    let alive = |beat, seq, released: &Option<String>, settled| {
        let released = released.clone();
        let value = AliveValue {
            beat,
            seq,
            released,
            settled,
        };
        TxnOp::Put {
            key: keys.alive(),
            value: json(&value),
        }
    };
    let txn = |compare: Vec<Compare>, changes: Vec<TxnOp>| Txn {
        compare,
        success: changes,
        failure: get_view(keys),
    };
    match op {
        Op::Read => (read_leader_keys(keys), 0),
        Op::Claim {
            guard,
            claim,
            begins,
            seq,
            settled,
        } => {
            let leader = TxnOp::Put {
                key: keys.leader(),
                value: leader_value(settings, *claim, *seq),
            };
            let alive = alive(0, *seq, &None, *settled);
            let mut changes = vec![leader, alive];
            if let Some(journal_number) = *begins {
                let began_by = settings.name.clone();
                let value = json(&OriginValue {
                    began_by,
                    journal_number,
                });
                let key = keys.origin();
                changes.push(TxnOp::Put { key, value });
                changes.extend(keys.of_journal().map(TxnOp::Delete));
            }
            let mut compare = unchanged(keys, guard);
            if let Some(Evidence { own, read_up_to }) = requires {
                let (key, value) = (keys.member(&settings.name), json(own));
                compare.push(Compare::Is { key, value });
                compare.push(Compare::Unchanged(keys.members(), *read_up_to));
            }
            (txn(compare, changes), *seq)
        }
        Op::Beat {
            guard,
            claim,
            claimed_at,
            beat,
            seq,
            released,
            settled,
        } => {
            let last = entry.and_then(|entry| keys.seq_of(&entry.key));
            let seq = last.unwrap_or(*seq);
            let alive = alive(*beat, seq, released, *settled);
            let changes = entry.map(write).into_iter().chain([alive]);
            let mut compare = unchanged(keys, guard);
            compare.push(Compare::Is {
                key: keys.leader(),
                value: leader_value(settings, *claim, *claimed_at),
            });
            (txn(compare, changes.collect()), seq)
        }
    }
}

fn parse<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, EtcdError> {
    serde_json::from_slice(bytes).map_err(|error| EtcdError::NotEtcd {
        endpoint: "an endpoint".to_owned(),
        why: error.to_string(),
    })
}

fn view<'a>(
    keys: &Keys,
    revision: u64,
    kvs: impl Iterator<Item = &'a Kv>,
) -> Result<View, EtcdError> {
    let mut view = View {
        revision,
        ..View::default()
    };
    for kv in kvs {
        absorb_key(&mut view, keys, &kv.key, Some(kv))?;
    }
    Ok(view)
}

/// Adds a key to a view, if it is one of the view's. `kv` is `None` if the key was deleted.
fn absorb_key(view: &mut View, keys: &Keys, key: &str, kv: Option<&Kv>) -> Result<(), EtcdError> {
    if key == keys.origin() {
        view.origin = kv.map_or(0, |kv| kv.revision);
        // Any other content is that of a journal without a number.
        let value = kv.and_then(|kv| serde_json::from_slice::<OriginValue>(&kv.value).ok());
        view.journal_number = value.map_or(0, |value| value.journal_number);
    } else if key == keys.leader() {
        view.leader = match kv {
            None => None,
            Some(kv) => {
                let value: LeaderValue = parse(&kv.value)?;
                Some(Leader {
                    term: kv.revision,
                    name: value.name,
                    id: value.id,
                    claim: value.claim,
                    claimed_at: value.claimed_at,
                    uri: value.uri,
                    boot: value.boot,
                    version: value.version,
                })
            }
        };
    } else if key == keys.alive() {
        view.alive = match kv {
            None => None,
            Some(kv) => {
                let value: AliveValue = parse(&kv.value)?;
                Some(Alive {
                    revision: kv.revision,
                    beat: value.beat,
                    seq: value.seq,
                    released: value.released,
                    settled: value.settled,
                })
            }
        };
    }
    Ok(())
}
