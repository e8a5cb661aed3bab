//! Requests and answers in the form of etcd's JSON gateway: bytes as base64, and most integers as text.

use std::ops::Range;

use base64::{Engine, engine::general_purpose::STANDARD};
use serde::{Deserialize, Deserializer, de::DeserializeOwned};
use serde_json::{Value, json};

use super::{EtcdError, MemberStatus};

/// A key with its value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Kv {
    pub key: String,
    pub value: Vec<u8>,
    /// Revision of the last change.
    pub revision: u64,
}

/// Writes and reads that run at one moment if a condition holds.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Txn {
    /// The condition. All of it must hold.
    pub compare: Vec<Compare>,
    /// Operations if the condition holds.
    pub success: Vec<TxnOp>,
    /// Operations if the condition is false.
    pub failure: Vec<TxnOp>,
}

/// A part of a transaction's condition.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Compare {
    /// The key was last changed at this revision, or does not exist if the revision is 0.
    Modified(String, u64),
    /// The key exists.
    Exists(String),
    /// The key has this value.
    Is { key: String, value: Vec<u8> },
    /// No key in the range was changed after this revision.
    Unchanged(Range<String>, u64),
}

/// An operation of a transaction.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TxnOp {
    /// Reads a key.
    Get(String),
    /// Writes a key.
    Put { key: String, value: Vec<u8> },
    /// Deletes all keys in a range.
    Delete(Range<String>),
}

/// The result of a transaction.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TxnResult {
    /// Whether the condition held.
    pub succeeded: bool,
    /// etcd's revision after the transaction.
    pub revision: u64,
    /// The results of the [`TxnOp::Get`]s. `None` for a key that does not exist.
    pub gets: Vec<Option<Kv>>,
}

impl Txn {
    pub(super) fn request(&self) -> Value {
        let ops = |ops: &[TxnOp]| ops.iter().map(TxnOp::request).collect::<Vec<_>>();
        let compare = self.compare.iter().map(Compare::request);
        json!({
            "compare": compare.collect::<Vec<_>>(),
            "success": ops(&self.success),
            "failure": ops(&self.failure),
        })
    }
}

impl TxnOp {
    fn request(&self) -> Value {
        match self {
            Self::Get(key) => json!({ "request_range": { "key": base64(key) } }),
            Self::Put { key, value } => {
                json!({ "request_put": { "key": base64(key), "value": base64(value) } })
            }
            Self::Delete(range) => {
                let (key, end) = (base64(&range.start), base64(&range.end));
                json!({ "request_delete_range": { "key": key, "range_end": end } })
            }
        }
    }
}

fn base64(bytes: impl AsRef<[u8]>) -> String {
    STANDARD.encode(bytes)
}

pub(super) fn leased(key: &str, value: &[u8], lease: i64) -> Value {
    json!({ "key": base64(key), "value": base64(value), "lease": lease.to_string() })
}

/// Requests a range. Revision 0 stands for the present one.
pub(super) fn range(range: &Range<String>, revision: u64, limit: usize) -> Value {
    json!({
        "key": base64(&range.start), "range_end": base64(&range.end),
        "revision": revision.to_string(), "limit": limit.to_string(),
    })
}

/// Requests the first key in `range`, without its value.
pub(super) fn first_key(range: &Range<String>) -> Value {
    json!({
        "key": base64(&range.start), "range_end": base64(&range.end), "limit": "1", "keys_only": true,
    })
}

/// Asks whether `key` exists, according to the asked member alone. Needs no majority.
pub(super) fn local_count(key: &str) -> Value {
    json!({ "key": base64(key), "serializable": true, "count_only": true })
}

impl Compare {
    fn request(&self) -> Value {
        match self {
            Self::Modified(key, revision) => json!({
                "key": base64(key), "target": "MOD", "result": "EQUAL", "mod_revision": revision.to_string(),
            }),
            Self::Exists(key) => json!({
                "key": base64(key), "target": "CREATE", "result": "GREATER", "create_revision": "0",
            }),
            Self::Is { key, value } => json!({
                "key": base64(key), "target": "VALUE", "result": "EQUAL", "value": base64(value),
            }),
            Self::Unchanged(range, revision) => json!({
                "key": base64(&range.start), "range_end": base64(&range.end),
                "target": "MOD", "result": "LESS", "mod_revision": revision.saturating_add(1).to_string(),
            }),
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

/// Reads an integer that is written as a number or as text.
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
pub(super) struct ResponseHeader {
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
    /// etcd leaves out an empty value.
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
    header: ResponseHeader,
    kvs: Vec<RawKv>,
    more: bool,
}

impl RangeAnswer {
    /// The id of the cluster that the asked member belongs to.
    pub(super) fn cluster(&self) -> Result<u64, EtcdError> {
        match self.header.cluster_id {
            0 => Err(not_etcd("its answer has no cluster id")),
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
    header: ResponseHeader,
    succeeded: bool,
    responses: Vec<OpAnswer>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct OpAnswer {
    response_range: Option<RangeAnswer>,
}

impl TxnAnswer {
    pub(super) fn read(&self) -> Result<TxnResult, EtcdError> {
        let ranges = self
            .responses
            .iter()
            .filter_map(|answer| answer.response_range.as_ref());
        let gets = ranges.map(|range| range.kvs.first().map(RawKv::read).transpose());
        Ok(TxnResult {
            succeeded: self.succeeded,
            revision: self.header.revision,
            gets: gets.collect::<Result<_, _>>()?,
        })
    }
}

/// An etcd member, as the port for peers lists it.
#[derive(Debug, Deserialize)]
pub(super) struct PeerMember {
    #[serde(rename = "peerURLs")]
    _urls: Vec<String>,
}

#[derive(Debug, Deserialize)]
pub(super) struct LeaseAnswer {
    #[serde(rename = "ID", default, deserialize_with = "number")]
    pub(super) id: i64,
}

/// One answer of a stream.
#[derive(Debug, Deserialize)]
pub(super) struct Streamed<T> {
    pub(super) result: T,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct StatusAnswer {
    header: ResponseHeader,
    version: String,
    #[serde(rename = "dbSize", deserialize_with = "number")]
    db_size: u64,
    #[serde(deserialize_with = "number")]
    leader: u64,
    errors: Vec<String>,
}

impl StatusAnswer {
    pub(super) fn read(self, endpoint: &str) -> Result<MemberStatus, EtcdError> {
        if self.version.is_empty() {
            return Err(not_etcd("its status has no version"));
        }
        Ok(MemberStatus {
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
    /// Whether the next message continues the same revision.
    pub(super) fragment: bool,
    pub(super) cancel_reason: String,
    #[serde(deserialize_with = "number")]
    pub(super) compact_revision: u64,
    pub(super) events: Vec<WatchEvent>,
}

#[derive(Debug, Deserialize)]
pub(super) struct WatchEvent {
    /// `DELETE`, or empty.
    #[serde(rename = "type", default)]
    pub(super) kind: String,
    pub(super) kv: RawKv,
}
