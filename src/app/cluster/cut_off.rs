//! Writes that were answered while this computer was alone: kept beside the checkpoint until they have been
//! sent to whoever leads.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use hyper::header::HeaderValue;

use crate::{
    checkpoint::{
        format::{Checkpoint, Entry},
        session,
        store::Store,
    },
    cluster::merge,
    ledger::Change,
    limit::rarely,
    master::{Master, Request, is_success},
    ros_env::MasterUri,
    upstream::Upstream,
};

/// Pause before a write that was not answered is sent again.
const AGAIN: Duration = Duration::from_millis(200);
/// Longest time for a connection.
const PROBE_TIMEOUT: Duration = Duration::from_secs(1);

pub(super) struct CutOff {
    /// The state when this computer was cut off.
    pub(super) base: Master,
    /// What was answered since, in order.
    pub(super) calls: Vec<Request>,
    /// Those of an earlier time.
    earlier: usize,
    store: Option<Store>,
}

fn path_of(checkpoint: &Path) -> PathBuf {
    let mut name = checkpoint.as_os_str().to_owned();
    name.push(".alone");
    name.into()
}

impl CutOff {
    /// What an earlier process has left. `goes_on`: whether its session does; if not, the file is kept under
    /// another name.
    pub(super) async fn left(checkpoint: &Path, goes_on: bool) -> Option<Self> {
        let path = path_of(checkpoint);
        let opened = tokio::task::spawn_blocking(move || {
            if !path.exists() {
                return None;
            }
            Some(Store::open(&path))
        });
        let (mut store, loaded) = match opened.await.ok()?? {
            Ok((store, loaded)) => (store, loaded?),
            Err(error) => {
                tracing::error!(%error, "the writes of a time alone cannot be read, and are not sent");
                return None;
            }
        };
        if !goes_on {
            match store.set_aside("session") {
                Ok(Some(kept)) => tracing::warn!(
                    kept = %kept.display(),
                    "writes of a time alone belong to a session that is over; they are kept, and not sent"
                ),
                Ok(None) => {}
                Err(error) => tracing::error!(%error, "the writes of a time alone cannot be kept"),
            }
            return None;
        }
        let base = session::rebuild(loaded.checkpoint, Vec::new()).mirror;
        let calls = loaded.records.into_iter();
        let calls: Vec<Request> = calls
            .filter_map(|record| match record.entry {
                Entry::Call { call, .. } => Some(Request::from(call)),
                Entry::Session(_) => None,
            })
            .collect();
        let mut this = Self {
            earlier: calls.len(),
            base,
            calls: Vec::new(),
            store: None,
        };
        this.begin(store).await;
        this.append(calls);
        tracing::info!(
            calls = this.calls.len(),
            "an earlier process was alone; its writes are sent when a computer leads"
        );
        Some(this)
    }

    /// This computer is cut off in the state `base`.
    pub(super) async fn new(checkpoint: &Path, base: Master) -> Self {
        let path = path_of(checkpoint);
        let mut this = Self {
            base,
            calls: Vec::new(),
            earlier: 0,
            store: None,
        };
        let opened = tokio::task::spawn_blocking(move || Store::open_over(&path)).await;
        match opened {
            Ok(Ok(store)) => this.begin(store).await,
            Ok(Err(error)) => say_unkept(&error),
            Err(_) => {}
        }
        this
    }

    async fn begin(&mut self, mut store: Store) {
        let checkpoint = Checkpoint {
            seq: store.seq(),
            snapshot: self.base.snapshot(),
            ..Checkpoint::default()
        };
        let begun = tokio::task::spawn_blocking(move || {
            let begun = store.begin(&checkpoint);
            (store, begun)
        });
        if let Ok((store, begun)) = begun.await {
            if let Err(error) = begun {
                say_unkept(&error);
            }
            self.store = Some(store);
        }
    }

    /// Another time alone begins, before the writes of the last one were sent.
    pub(super) fn again(&mut self) {
        self.earlier = self.calls.len();
    }

    /// Keeps what was answered.
    pub(super) fn add<'a>(&mut self, changes: impl IntoIterator<Item = &'a Change>) {
        let calls = changes.into_iter().filter_map(|change| match change {
            Change::Call(record) => match &record.entry {
                Entry::Call { call, .. } => Some(Request::from(call.clone())),
                Entry::Session(_) => None,
            },
            // It comes from a master, not from a node.
            Change::State { .. } => None,
        });
        self.append(calls.collect());
    }

    fn append(&mut self, calls: Vec<Request>) {
        let entries: Vec<_> = calls.iter().cloned().map(|call| Entry::call(call.into())).collect();
        if let Some(store) = self.store.as_mut().filter(|_| !entries.is_empty())
            && let Err(error) = store.append(&entries)
        {
            say_unkept(&error);
        }
        self.calls.extend(calls);
    }

    /// What was answered this time is in the journal after all. Returns what is left of earlier times.
    pub(super) fn resumed(mut self) -> Option<Self> {
        self.calls.truncate(self.earlier);
        Some(self).filter(|left| !left.calls.is_empty())
    }

    /// Sends what still holds to `uri`, which is our own, in order. `now`: the state that the others have.
    /// Returns how many did not hold. Until [`remove`] the file stays.
    pub(super) fn send(
        self,
        now: &Master,
        uri: MasterUri,
    ) -> impl Future<Output = u64> + Send + 'static {
        let merged = merge::merge(&self.base, now, &self.calls);
        async move {
            let lost = merged.lost.len() as u64;
            for merge::Lost { call, why } in merged.lost {
                tracing::warn!(
                    method = call.method().name(),
                    node = call.caller().unwrap_or_default(),
                    %why,
                    "a write that was answered while this computer was alone does not hold"
                );
            }
            let sent = merged.send.len();
            let upstream = Upstream::new(
                uri,
                HeaderValue::from_static("writes-of-a-time-alone"),
                PROBE_TIMEOUT,
                1,
            );
            let mut connection = None;
            for call in merged.send {
                let wire = call.clone().into();
                let reply = loop {
                    if connection.is_none() {
                        connection = upstream.connect().await.ok();
                    }
                    if let Some(open) = &mut connection
                        && let Ok(reply) = open.call(&wire).await
                    {
                        break reply;
                    }
                    connection = None;
                    tokio::time::sleep(AGAIN).await;
                };
                if !is_success(&reply) {
                    tracing::warn!(
                        method = call.method().name(),
                        node = call.caller().unwrap_or_default(),
                        "a write that was answered while this computer was alone is refused by the leader"
                    );
                }
            }
            tracing::info!(sent, lost, "the writes of a time alone were sent to the leader");
            lost
        }
    }
}

/// Removes what was kept beside `checkpoint`: all of it has been sent.
pub(super) fn remove(checkpoint: &Path) {
    let path = path_of(checkpoint);
    let previous = crate::checkpoint::store::previous_of(&path);
    for path in [path, previous] {
        if let Err(error) = std::fs::remove_file(&path)
            && error.kind() != std::io::ErrorKind::NotFound
        {
            tracing::warn!(
                path = %path.display(),
                %error,
                "writes that were sent cannot be removed and would be sent again; remove the file"
            );
        }
    }
}

fn say_unkept(error: &dyn std::fmt::Display) {
    rarely!(
        error,
        %error,
        "writes that are answered alone cannot be kept on the disk: a crash of rosrescue itself would lose \
         them; free or repair the disk"
    );
}
