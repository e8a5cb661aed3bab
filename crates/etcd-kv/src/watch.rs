//! Watches etcd for changes, across lost connections, members and restarts.

use std::{ops::Range, pin::Pin, time::Duration};

use base64::{Engine, engine::general_purpose::STANDARD};
use bytes::{Bytes, BytesMut};
use http_body_util::BodyExt;
use hyper::body::Incoming;
use serde_json::json;
use tokio::time::Instant;

use super::{
    Client, EtcdError, Kv,
    wire::{self, Streamed, WatchAnswer},
};

/// Longest message, in bytes. etcd splits messages at 2 MiB, which is 2.7 MiB in base64.
const MESSAGE_BYTES_MAX: usize = 8 << 20;
/// After this silence, and again each time, an open watch sends a request. If another endpoint answers it, the watch goes
/// there: a member that has lost its cluster says nothing and answers nothing.
const ASK_EVERY: Duration = Duration::from_millis(500);
/// Pause before a watch is opened again.
const PAUSE: Duration = Duration::from_millis(100);

/// A key that has changed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KeyChange {
    pub key: String,
    pub revision: u64,
    /// The new value. `None` if the key was deleted.
    pub kv: Option<Kv>,
}

/// Why a watch has ended.
#[derive(Debug)]
pub enum WatchEnd {
    /// etcd has compacted the next revision, so the state must be read again.
    Compacted,
    /// The watch has failed, and opening it again would not help.
    Failed(EtcdError),
}

struct Open {
    endpoint: usize,
    lines: Lines,
    silence: Silence,
}

/// The lines of an answer.
struct Lines {
    body: Incoming,
    buffer: BytesMut,
}

/// Ends when the stream must be left because of its silence. Its value is whether another endpoint answers requests.
type Silence = Pin<Box<dyn Future<Output = bool> + Send>>;
type Opening = Pin<Box<dyn Future<Output = Result<Incoming, EtcdError>> + Send>>;

/// A watch. Changes arrive in order. After a lost connection some may arrive twice.
pub struct Watch {
    client: Client,
    range: Range<String>,
    /// Keys of which only deletions are received.
    deletions: Option<Range<String>>,
    /// The next revision to receive.
    next: u64,
    quiet: Duration,
    open: Option<Open>,
    /// The stream that is being opened, and the index of its endpoint. It is kept here, like [`Open::silence`], because
    /// [`Self::next`] may be cancelled and called again at any time. A silent member must be noticed even then.
    opening: Option<(usize, Opening)>,
    failures: usize,
}

impl Watch {
    pub(super) fn new(client: Client, range: Range<String>, next: u64, quiet: Duration) -> Self {
        Self {
            client,
            range,
            deletions: None,
            next,
            quiet,
            open: None,
            opening: None,
            failures: 0,
        }
    }

    /// Also receives deletions of keys in `range`. They may arrive before or after other changes of the same time.
    #[must_use]
    pub fn with_deletions(self, range: Range<String>) -> Self {
        let deletions = Some(range);
        Self { deletions, ..self }
    }

    /// Waits for the next changes. Cancel safe.
    ///
    /// # Errors
    ///
    /// [`WatchEnd`] if no more changes will come.
    pub async fn next(&mut self) -> Result<Vec<KeyChange>, WatchEnd> {
        loop {
            let Some(open) = &mut self.open else {
                self.open().await?;
                continue;
            };
            let read = tokio::select! {
                biased;
                read = open.lines.next() => read,
                is_elsewhere = &mut open.silence => {
                    if is_elsewhere {
                        self.open = None;
                        continue;
                    }
                    Err("etcd was silent".to_owned())
                }
            };
            let answer = match read {
                Ok(Some(line)) => {
                    open.silence = silence(&self.client, &self.range, self.quiet, open.endpoint);
                    wire::parse::<Streamed<WatchAnswer>>(&line)
                }
                Ok(None) => {
                    self.close("the stream has ended");
                    continue;
                }
                Err(why) => {
                    self.close(&why);
                    continue;
                }
            };
            match answer {
                Ok(Streamed { result }) if result.canceled => self.canceled(&result)?,
                Ok(Streamed { result }) => {
                    self.failures = 0;
                    let changes = self.changes(&result).map_err(WatchEnd::Failed)?;
                    if !changes.is_empty() {
                        return Ok(changes);
                    }
                }
                // The stream reports an error when the member stops.
                Err(error) => self.close(&error.to_string()),
            }
        }
    }

    fn close(&mut self, why: &str) {
        tracing::debug!(why, from = self.range.start, "a watch of etcd has ended");
        self.open = None;
        self.failures += 1;
    }

    fn canceled(&mut self, answer: &WatchAnswer) -> Result<(), WatchEnd> {
        if answer.compact_revision > 0 {
            return Err(WatchEnd::Compacted);
        }
        let reason = &answer.cancel_reason;
        let refused = ["user name is empty", "permission denied"];
        if refused.iter().any(|text| reason.contains(text)) {
            let code = if reason.contains("permission") { 7 } else { 3 };
            return Err(WatchEnd::Failed(EtcdError::answered(
                "the watch",
                code,
                reason,
            )));
        }
        if let Some(endpoint) = self
            .open
            .as_ref()
            .and_then(|open| self.client.endpoints.get(open.endpoint))
        {
            // The token may be too old.
            endpoint.forget_token();
        }
        self.close(reason);
        Ok(())
    }

    async fn open(&mut self) -> Result<(), WatchEnd> {
        let next = (self.client.preferred() + self.failures) % self.client.endpoints.len();
        if self.opening.is_none() {
            self.opening = Some((next, self.opening_of(next)));
        }
        let Some((index, opening)) = &mut self.opening else {
            return Ok(());
        };
        let (index, opened) = (*index, opening.await);
        self.opening = None;
        match opened {
            Ok(body) => {
                self.open = Some(Open {
                    endpoint: index,
                    lines: Lines {
                        body,
                        buffer: BytesMut::new(),
                    },
                    silence: silence(&self.client, &self.range, self.quiet, index),
                });
            }
            Err(error) if error.is_final() => return Err(WatchEnd::Failed(error)),
            Err(error) => self.close(&error.to_string()),
        }
        Ok(())
    }

    fn opening_of(&self, index: usize) -> Opening {
        let create = |range: &Range<String>, filters: &[&str]| {
            json!({ "create_request": {
                "key": STANDARD.encode(&range.start), "range_end": STANDARD.encode(&range.end),
                "start_revision": self.next.to_string(), "fragment": true, "filters": filters,
            }})
            .to_string()
        };
        let deletions = self.deletions.as_ref();
        let deletions = deletions.map(|range| create(range, &["NOPUT"]));
        let request = create(&self.range, &[]) + &deletions.unwrap_or_default();
        let (client, quiet) = (self.client.clone(), self.quiet);
        let pause = PAUSE.saturating_mul(u32::from(self.failures > 0));
        Box::pin(async move {
            tokio::time::sleep(pause).await;
            match client.endpoints.get(index) {
                Some(endpoint) => endpoint.stream("watch", request.into(), quiet).await,
                None => std::future::pending().await,
            }
        })
    }

    fn changes(&mut self, answer: &WatchAnswer) -> Result<Vec<KeyChange>, EtcdError> {
        let mut changes = Vec::with_capacity(answer.events.len());
        for event in &answer.events {
            let kv = event.kv.read()?;
            // The next message of a fragmented answer has the rest of this revision, so the watch still needs this
            // revision.
            // Deletions may arrive before earlier changes.
            if self.range.contains(&kv.key) {
                self.next = self.next.max(kv.revision + u64::from(!answer.fragment));
            }
            changes.push(KeyChange {
                key: kv.key.clone(),
                revision: kv.revision,
                kv: (event.kind != "DELETE").then_some(kv),
            });
        }
        Ok(changes)
    }
}

/// A silence that begins now, on a stream from `endpoint`.
fn silence(client: &Client, range: &Range<String>, quiet: Duration, endpoint: usize) -> Silence {
    let (client, range) = (client.clone(), range.clone());
    let end = Instant::now() + quiet;
    let asks = async move {
        loop {
            tokio::time::sleep(ASK_EVERY).await;
            let answer = client.first_key(&range, quiet).await;
            if answer.is_ok() && client.preferred() != endpoint {
                return;
            }
        }
    };
    Box::pin(async move { tokio::time::timeout_at(end, asks).await.is_ok() })
}

impl Lines {
    /// Reads the next line, which is one message. Cancel safe.
    async fn next(&mut self) -> Result<Option<Bytes>, String> {
        loop {
            if let Some(end) = self.buffer.iter().position(|byte| *byte == b'\n') {
                let line = self.buffer.split_to(end + 1);
                return Ok(Some(line.freeze()));
            }
            if self.buffer.len() > MESSAGE_BYTES_MAX {
                return Err("a message is too long".to_owned());
            }
            match self.body.frame().await {
                None => return Ok(None),
                Some(Err(error)) => return Err(error.to_string()),
                Some(Ok(frame)) => {
                    if let Ok(data) = frame.into_data() {
                        self.buffer.extend_from_slice(&data);
                    }
                }
            }
        }
    }
}
