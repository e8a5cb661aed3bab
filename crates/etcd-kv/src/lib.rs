//! A client for etcd's JSON gateway: transactions, ranges, leases and watches over HTTP/1, with TLS.
//!
//! A request goes to the endpoint that answered last. If that endpoint does not answer soon, the next one gets the
//! request as well. So a request may run twice, and two runs must have the same effect as one.

mod connection;
mod error;
mod tls;
mod watch;
mod wire;

use std::{
    ops::Range,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use bytes::Bytes;
use serde_json::json;
use tokio::task::JoinSet;

pub use connection::Credentials;
use connection::Endpoint;
pub use error::EtcdError;
pub use tls::Tls;
pub use watch::{KeyChange, Watch, WatchEnd};
pub use wire::{Compare, Kv, Txn, TxnOp, TxnResult};

/// Time without an answer after which the next endpoint is asked as well. For comparison, a transaction takes 1 to 20
/// ms.
const NEXT_AFTER: Duration = Duration::from_millis(250);
/// Pause after all endpoints have failed. It counts as part of the request's time limit.
const ROUND_PAUSE: Duration = Duration::from_millis(100);
/// Maximum number of keys in one page of an answer to a range request. The values of a page take 16 MiB at most.
const PAGE: usize = 32;

/// Settings of a client.
#[derive(Clone, Debug)]
pub struct Options {
    /// The endpoints, each `http://HOST:PORT` or `https://HOST:PORT`.
    pub endpoints: Vec<String>,
    pub access: Credentials,
}

/// A client for an etcd cluster.
#[derive(Clone, Debug)]
pub struct Client {
    endpoints: Arc<[Endpoint]>,
    /// The endpoint that answered last.
    preferred: Arc<AtomicUsize>,
}

/// Keys that were read at the same moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found {
    pub revision: u64,
    pub kvs: Vec<Kv>,
}

/// The result of trying one endpoint on its own.
#[derive(Debug)]
pub struct Tried {
    pub endpoint: String,
    /// The id of the endpoint's cluster, or why the endpoint does not serve clients.
    pub cluster: Result<u64, EtcdError>,
}

/// The status that an etcd member reports.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemberStatus {
    pub endpoint: String,
    pub version: String,
    pub db_bytes: u64,
    pub is_leader: bool,
    /// The problems that the member reports.
    pub errors: Vec<String>,
}

impl Client {
    /// Creates a client. It connects at its first request.
    ///
    /// # Errors
    ///
    /// If an endpoint is not a URL, or certificates cannot be read.
    pub fn new(options: &Options) -> Result<Self, EtcdError> {
        let access = Arc::new(options.access.clone());
        let tls = access.tls.settings()?;
        let endpoints = options.endpoints.iter();
        let endpoints = endpoints.map(|url| Endpoint::new(url, &access, tls.as_ref()));
        let endpoints: Vec<_> = endpoints.collect::<Result<_, _>>()?;
        if endpoints.is_empty() {
            return Err(EtcdError::Options("no etcd endpoint is given".to_owned()));
        }
        Ok(Self {
            endpoints: endpoints.into(),
            preferred: Arc::default(),
        })
    }

    /// Carries out a transaction. etcd may run it more than once.
    ///
    /// # Errors
    ///
    /// If etcd gave no result. It is then unknown whether the transaction was carried out.
    pub async fn txn(&self, txn: &Txn, limit: Duration) -> Result<TxnResult, EtcdError> {
        let answer: wire::TxnAnswer = self.ask("kv/txn", &txn.request(), limit).await?;
        answer.read()
    }

    /// The first key in `range`, without its value.
    ///
    /// # Errors
    ///
    /// If the key could not be read.
    pub async fn first_key(
        &self,
        range: &Range<String>,
        limit: Duration,
    ) -> Result<Option<String>, EtcdError> {
        let request = wire::first_key(range);
        let page: wire::RangeAnswer = self.ask("kv/range", &request, limit).await?;
        let (_, _, kvs) = page.read()?;
        Ok(kvs.into_iter().next().map(|kv| kv.key))
    }

    /// All keys in `range` with their values, in order and as of one moment.
    ///
    /// # Errors
    ///
    /// [`EtcdError::Compacted`] if etcd has discarded the revision before all keys were read. Another error if they
    /// could not be read for another reason.
    pub async fn range(&self, range: &Range<String>, limit: Duration) -> Result<Found, EtcdError> {
        self.ranges(std::slice::from_ref(range), None, limit).await
    }

    /// All keys in these ranges with their values, one range after the other, as they were at `revision`. `None` stands
    /// for the present revision.
    ///
    /// # Errors
    ///
    /// The errors of [`Self::range`].
    pub async fn ranges(
        &self,
        ranges: &[Range<String>],
        mut revision: Option<u64>,
        limit: Duration,
    ) -> Result<Found, EtcdError> {
        let mut kvs: Vec<Kv> = Vec::new();
        for range in ranges {
            let mut from = range.start.clone();
            loop {
                let at = revision.unwrap_or_default();
                let request = wire::range(&(from..range.end.clone()), at, PAGE);
                let page: wire::RangeAnswer = self.ask("kv/range", &request, limit).await?;
                let (present, more, page) = page.read()?;
                revision.get_or_insert(present);
                kvs.extend(page);
                let Some(last) = kvs.last().filter(|_| more) else {
                    break;
                };
                // The next page begins with the first key after this one.
                from = format!("{}\0", last.key);
            }
        }
        let revision = revision.unwrap_or_default();
        Ok(Found { revision, kvs })
    }

    /// Creates a lease that ends by itself after about `ttl`, but after 2 s at the earliest. When the lease ends, etcd
    /// deletes the keys that were written with it.
    ///
    /// # Errors
    ///
    /// If etcd created no lease.
    pub async fn grant(&self, ttl: Duration, limit: Duration) -> Result<i64, EtcdError> {
        let request = json!({ "TTL": ttl.as_secs().max(1) });
        let lease: wire::LeaseAnswer = self.ask("lease/grant", &request, limit).await?;
        Ok(lease.id)
    }

    /// Writes a key that etcd deletes when `lease` ends.
    ///
    /// # Errors
    ///
    /// If etcd gave no result. It is then unknown whether the key was written.
    pub async fn put_with_lease(
        &self,
        key: &str,
        value: &[u8],
        lease: i64,
        limit: Duration,
    ) -> Result<(), EtcdError> {
        let _: serde_json::Value = self
            .ask("kv/put", &wire::leased(key, value, lease), limit)
            .await?;
        Ok(())
    }

    /// Makes etcd discard all revisions before `revision`. Without this, etcd's database keeps growing.
    ///
    /// # Errors
    ///
    /// If etcd gave no result, or refused.
    pub async fn compact(&self, revision: u64, limit: Duration) -> Result<(), EtcdError> {
        let request = json!({ "revision": revision.to_string() });
        match self
            .ask::<serde_json::Value>("kv/compaction", &request, limit)
            .await
        {
            Err(EtcdError::Compacted) | Ok(_) => Ok(()),
            Err(error) => Err(error),
        }
    }

    /// The status that each endpoint reports.
    pub async fn status(&self, limit: Duration) -> Vec<Result<MemberStatus, EtcdError>> {
        let mut asked = JoinSet::new();
        for index in 0..self.endpoints.len() {
            let client = self.clone();
            asked.spawn(async move { (index, client.status_of(index, limit).await) });
        }
        let mut found = asked.join_all().await;
        found.sort_by_key(|(index, _)| *index);
        found.into_iter().map(|(_, status)| status).collect()
    }

    async fn status_of(&self, index: usize, limit: Duration) -> Result<MemberStatus, EtcdError> {
        let Some(endpoint) = self.endpoints.get(index) else {
            return Err(EtcdError::Options("there is no such endpoint".to_owned()));
        };
        let bytes = endpoint
            .call("maintenance/status", "{}".into(), limit)
            .await?;
        wire::parse::<wire::StatusAnswer>(&bytes)?.read(endpoint.url())
    }

    /// Tries each endpoint on its own, by asking it whether `key` exists. etcd needs no majority for the answer.
    pub async fn try_each(&self, key: &str, limit: Duration) -> Vec<Tried> {
        let mut asked = JoinSet::new();
        for index in 0..self.endpoints.len() {
            let (client, key) = (self.clone(), key.to_owned());
            asked.spawn(async move { (index, client.try_one(index, &key, limit).await) });
        }
        let mut tried = asked.join_all().await;
        tried.sort_by_key(|(index, _)| *index);
        tried.into_iter().filter_map(|(_, tried)| tried).collect()
    }

    async fn try_one(&self, index: usize, key: &str, limit: Duration) -> Option<Tried> {
        let endpoint = self.endpoints.get(index)?;
        let request = wire::local_count(key);
        let answer = endpoint
            .call("kv/range", request.to_string().into(), limit)
            .await;
        let cluster = answer.and_then(|bytes| {
            let cluster =
                wire::parse(&bytes).and_then(|answer: wire::RangeAnswer| answer.cluster());
            cluster.map_err(|error| error.of(endpoint.url()))
        });
        Some(Tried {
            endpoint: endpoint.url().to_owned(),
            cluster,
        })
    }

    /// Watches `range` for changes after revision `after`. If an endpoint is silent for `quiet`, another one is asked.
    pub fn watch(&self, range: Range<String>, after: u64, quiet: Duration) -> Watch {
        Watch::new(self.clone(), range, after + 1, quiet)
    }

    fn preferred(&self) -> usize {
        self.preferred.load(Ordering::Relaxed) % self.endpoints.len()
    }

    /// Sends a request to one endpoint after the other until one answers.
    async fn ask<T: serde::de::DeserializeOwned>(
        &self,
        path: &'static str,
        request: &serde_json::Value,
        limit: Duration,
    ) -> Result<T, EtcdError> {
        let body = Bytes::from(request.to_string());
        let end = tokio::time::Instant::now() + limit;
        let mut asked: JoinSet<(usize, Result<Bytes, EtcdError>)> = JoinSet::new();
        let mut next = self.preferred();
        let mut failure = None;
        let mut ask_at = tokio::time::Instant::now();
        loop {
            tokio::select! {
                biased;
                () = tokio::time::sleep_until(end) => {
                    asked.abort_all();
                    return Err(failure.unwrap_or(EtcdError::Silent { limit }));
                }
                Some(done) = asked.join_next() => {
                    let Ok((index, body)) = done else { continue };
                    let url = self.endpoints.get(index).map_or("", |endpoint| endpoint.url());
                    let answer = body.and_then(|body| wire::parse(&body));
                    match answer.map_err(|error| error.of(url)) {
                        Ok(answer) => {
                            self.preferred.store(index, Ordering::Relaxed);
                            return Ok(answer);
                        }
                        Err(error) if error.is_final() => return Err(error),
                        Err(error) => {
                            let round = next % self.endpoints.len() == self.preferred();
                            let pause = if round { ROUND_PAUSE } else { Duration::ZERO };
                            ask_at = ask_at.min(tokio::time::Instant::now() + pause);
                            // The error of an endpoint that answered says more than the error of one that did not.
                            if failure.as_ref().is_none_or(EtcdError::is_unreachable) {
                                failure = Some(error);
                            }
                        }
                    }
                }
                () = tokio::time::sleep_until(ask_at) => {
                    let (client, body, index) = (self.clone(), body.clone(), next % self.endpoints.len());
                    let rest = end.saturating_duration_since(tokio::time::Instant::now());
                    asked.spawn(async move {
                        match client.endpoints.get(index) {
                            Some(endpoint) => (index, endpoint.call(path, body, rest).await),
                            None => (index, Err(EtcdError::Silent { limit: rest })),
                        }
                    });
                    next = next.wrapping_add(1);
                    let again = if self.endpoints.len() > 1 { NEXT_AFTER } else { limit };
                    ask_at = tokio::time::Instant::now() + again;
                }
            }
        }
    }
}
