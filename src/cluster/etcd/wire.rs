//! Requests and answers as the gateway has them: bytes in base64, and most integers as text.

use std::ops::Range;

use base64::{Engine, engine::general_purpose::STANDARD};
use serde::{Deserialize, Deserializer, Serialize, de::DeserializeOwned};
use serde_json::{Value, json};

use super::{EtcdError, Found, Status};
use crate::cluster::{
    journal::{Keys, Put},
    machine::{Alive, Answer, Guard, Leader, Op, Settings, View},
};

/// A key with its value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Kv {
    pub key: String,
    pub value: Vec<u8>,
    /// The revision of its last change.
    pub revision: u64,
}

/// The value of `leader`.
#[derive(Debug, Serialize, Deserialize)]
struct LeaderValue {
    name: String,
    id: String,
    claim: u64,
    uri: String,
    #[serde(default)]
    boot: String,
    version: String,
}

/// The value of `alive`.
#[derive(Debug, Serialize, Deserialize)]
struct AliveValue {
    beat: u64,
    seq: u64,
    released: Option<String>,
    /// A version that does not write it settles the session when it leads.
    #[serde(default = "settled_before")]
    settled: bool,
}

fn settled_before() -> bool {
    true
}

fn base64(bytes: impl AsRef<[u8]>) -> String {
    STANDARD.encode(bytes)
}

pub(super) fn put(put: &Put) -> Value {
    json!({ "request_put": { "key": base64(&put.key), "value": base64(&put.value) } })
}

pub(super) fn leased(put: &Put, lease: i64) -> Value {
    let (key, value) = (base64(&put.key), base64(&put.value));
    json!({ "key": key, "value": value, "lease": lease.to_string() })
}

pub(super) fn delete(range: &Range<String>) -> Value {
    let (key, end) = (base64(&range.start), base64(&range.end));
    json!({ "request_delete_range": { "key": key, "range_end": end } })
}

/// `revision` 0: the present one.
pub(super) fn range(range: &Range<String>, revision: u64, limit: usize) -> Value {
    json!({
        "key": base64(&range.start), "range_end": base64(&range.end),
        "revision": revision.to_string(), "limit": limit.to_string(),
    })
}

/// The first key in `range`, without its value.
pub(super) fn first_key(range: &Range<String>) -> Value {
    json!({
        "key": base64(&range.start), "range_end": base64(&range.end), "limit": "1", "keys_only": true,
    })
}

/// Whether `key` exists, as the asked member alone knows: it needs no majority.
pub(super) fn local_count(key: &str) -> Value {
    json!({ "key": base64(key), "serializable": true, "count_only": true })
}

fn get(key: &str) -> Value {
    json!({ "request_range": { "key": base64(key) } })
}

fn is_at(key: &str, revision: u64) -> Value {
    json!({
        "key": base64(key), "target": "MOD", "result": "EQUAL", "mod_revision": revision.to_string(),
    })
}

fn json_put(key: String, value: &impl Serialize) -> Value {
    // Cannot fail: texts and numbers.
    let value = serde_json::to_vec(value).unwrap_or_default();
    put(&Put { key, value })
}

/// Both keys, read.
pub(super) fn read(keys: &Keys) -> Value {
    json!({ "success": [get(&keys.leader()), get(&keys.alive())] })
}

/// `changes`, if `leader` has this term.
pub(super) fn guarded(keys: &Keys, term: u64, changes: &[Value]) -> Value {
    json!({ "compare": [is_at(&keys.leader(), term)], "success": changes })
}

/// The transaction of `op`, and the journal's last record after it.
pub(super) fn request(
    keys: &Keys,
    settings: &Settings,
    op: &Op,
    entry: Option<&Put>,
) -> (Value, u64) {
    let alive = |beat, seq, released: &Option<String>, settled| {
        let released = released.clone();
        json_put(
            keys.alive(),
            &AliveValue {
                beat,
                seq,
                released,
                settled,
            },
        )
    };
    let txn = |guard: &Guard, changes: Vec<Value>| {
        json!({
            "compare": [is_at(&keys.leader(), guard.leader), is_at(&keys.alive(), guard.alive)],
            "success": changes,
            "failure": [get(&keys.leader()), get(&keys.alive())],
        })
    };
    match op {
        Op::Read => (read(keys), 0),
        Op::Claim {
            guard,
            claim,
            seq,
            settled,
        } => {
            let Settings {
                name,
                id,
                uri,
                boot,
                version,
                ..
            } = settings.clone();
            let claim = *claim;
            let leader = LeaderValue {
                name,
                id,
                claim,
                uri,
                boot,
                version,
            };
            let alive = alive(0, *seq, &None, *settled);
            let changes = vec![json_put(keys.leader(), &leader), alive];
            (txn(guard, changes), *seq)
        }
        Op::Beat {
            guard,
            beat,
            seq,
            released,
            settled,
        } => {
            let last = entry.and_then(|entry| keys.seq_of(&entry.key));
            let seq = last.unwrap_or(*seq);
            let entry = entry.map(put);
            let alive = alive(*beat, seq, released, *settled);
            let changes = entry.into_iter().chain([alive]);
            (txn(guard, changes.collect()), seq)
        }
    }
}

pub(super) fn parse<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, EtcdError> {
    serde_json::from_slice(bytes).map_err(|error| not_etcd(&error.to_string()))
}

fn not_etcd(why: &str) -> EtcdError {
    EtcdError::NotEtcd {
        endpoint: "an endpoint".to_owned(),
        why: why.to_owned(),
    }
}

/// An integer, as a number or as a text.
fn number<'de, T, D>(from: D) -> Result<T, D::Error>
where
    T: std::str::FromStr + Default,
    D: Deserializer<'de>,
{
    let text = match Value::deserialize(from)? {
        Value::String(text) => text,
        Value::Number(number) => number.to_string(),
        _ => return Ok(T::default()),
    };
    text.parse()
        .map_err(|_| serde::de::Error::custom("no integer"))
}

#[derive(Debug, Default, Deserialize)]
pub(super) struct Header {
    #[serde(default, deserialize_with = "number")]
    revision: u64,
    #[serde(default, deserialize_with = "number")]
    member_id: u64,
    #[serde(default, deserialize_with = "number")]
    cluster_id: u64,
}

#[derive(Debug, Deserialize)]
pub(super) struct RawKv {
    key: String,
    /// An empty value is left out.
    #[serde(default)]
    value: String,
    #[serde(default, deserialize_with = "number")]
    mod_revision: u64,
}

impl RawKv {
    pub(super) fn read(&self) -> Result<Kv, EtcdError> {
        let key = STANDARD.decode(&self.key).ok();
        let key = key.and_then(|key| String::from_utf8(key).ok());
        let value = STANDARD.decode(&self.value).ok();
        let (Some(key), Some(value)) = (key, value) else {
            return Err(not_etcd("a key or value is not in base64"));
        };
        let revision = self.mod_revision;
        Ok(Kv {
            key,
            value,
            revision,
        })
    }
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct RangeAnswer {
    header: Header,
    kvs: Vec<RawKv>,
    more: bool,
}

impl RangeAnswer {
    /// The id of the cluster that the asked member belongs to.
    pub(super) fn cluster(&self) -> Result<u64, EtcdError> {
        match self.header.cluster_id {
            0 => Err(not_etcd("its answer names no cluster")),
            id => Ok(id),
        }
    }

    pub(super) fn read(&self) -> Result<(u64, bool, Vec<Kv>), EtcdError> {
        let kvs = self.kvs.iter().map(RawKv::read).collect::<Result<_, _>>()?;
        Ok((self.header.revision, self.more, kvs))
    }
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct TxnAnswer {
    header: Header,
    pub(super) succeeded: bool,
    responses: Vec<OpAnswer>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct OpAnswer {
    response_range: Option<RangeAnswer>,
}

impl TxnAnswer {
    /// The answer to a request of the machine, after which the journal ends with `seq`.
    pub(super) fn read(&self, keys: &Keys, seq: u64) -> Result<Answer, EtcdError> {
        let reads = self
            .responses
            .iter()
            .any(|answer| answer.response_range.is_some());
        if self.succeeded && !reads {
            let revision = self.header.revision;
            return Ok(Answer::Applied { revision, seq });
        }
        self.view(keys).map(Answer::Is)
    }

    pub(super) fn view(&self, keys: &Keys) -> Result<View, EtcdError> {
        let ranges = self
            .responses
            .iter()
            .filter_map(|answer| answer.response_range.as_ref());
        let kvs = ranges.flat_map(|range| &range.kvs).map(RawKv::read);
        let kvs: Vec<_> = kvs.collect::<Result<_, _>>()?;
        let mut view = View {
            revision: self.header.revision,
            ..View::default()
        };
        for kv in &kvs {
            absorb(&mut view, keys, &kv.key, Some(kv))?;
        }
        Ok(view)
    }
}

/// Takes a key into a view, if it belongs there; none if it was deleted.
pub(super) fn absorb(
    view: &mut View,
    keys: &Keys,
    key: &str,
    kv: Option<&Kv>,
) -> Result<(), EtcdError> {
    if key == keys.leader() {
        view.leader = match kv {
            None => None,
            Some(kv) => {
                let value: LeaderValue = parse(&kv.value)?;
                Some(Leader {
                    term: kv.revision,
                    name: value.name,
                    id: value.id,
                    claim: value.claim,
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

impl Found {
    /// Both keys of the machine, of all below its prefix.
    ///
    /// # Errors
    ///
    /// If they are not what rosrescue writes there.
    pub fn view(&self, keys: &Keys) -> Result<View, EtcdError> {
        let mut view = View {
            revision: self.revision,
            ..View::default()
        };
        for kv in &self.kvs {
            absorb(&mut view, keys, &kv.key, Some(kv))?;
        }
        Ok(view)
    }
}

/// A member of etcd, as the port for its peers lists them.
#[derive(Debug, Deserialize)]
pub(super) struct Peer {
    #[serde(rename = "peerURLs")]
    _urls: Vec<String>,
}

#[derive(Debug, Deserialize)]
pub(super) struct LeaseAnswer {
    #[serde(rename = "ID", default, deserialize_with = "number")]
    pub(super) id: i64,
    /// None of a lease that there is not.
    #[serde(rename = "TTL", default, deserialize_with = "number")]
    pub(super) ttl: i64,
}

/// An answer of a stream.
#[derive(Debug, Deserialize)]
pub(super) struct Streamed<T> {
    pub(super) result: T,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct StatusAnswer {
    header: Header,
    version: String,
    #[serde(rename = "dbSize", deserialize_with = "number")]
    db_size: u64,
    #[serde(deserialize_with = "number")]
    leader: u64,
    errors: Vec<String>,
}

impl StatusAnswer {
    pub(super) fn read(self, endpoint: &str) -> Result<Status, EtcdError> {
        if self.version.is_empty() {
            return Err(not_etcd("its status has no version"));
        }
        Ok(Status {
            endpoint: endpoint.to_owned(),
            is_leader: self.leader != 0 && self.leader == self.header.member_id,
            version: self.version,
            db_bytes: self.db_size,
            errors: self.errors,
        })
    }
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct WatchAnswer {
    pub(super) canceled: bool,
    /// The next message goes on with the same revision.
    pub(super) fragment: bool,
    pub(super) cancel_reason: String,
    #[serde(deserialize_with = "number")]
    pub(super) compact_revision: u64,
    pub(super) events: Vec<WatchEvent>,
}

#[derive(Debug, Deserialize)]
pub(super) struct WatchEvent {
    /// `DELETE`, or nothing.
    #[serde(rename = "type", default)]
    pub(super) kind: String,
    pub(super) kv: RawKv,
}
