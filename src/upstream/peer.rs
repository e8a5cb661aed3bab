//! Calls to the rosrescue of another computer.

use std::{
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use bytes::Bytes;
use hyper::StatusCode;
use ros1_master::master::{CALLER_ID, Method, Request};
use thiserror::Error;

use super::{CallError, ConnectError, Connection, Head, RawReply, Upstream};
use crate::ros_env::MasterUri;

/// Maximum number of idle connections that are kept.
const IDLE_MOST: usize = 64;
/// Prefix of the path of calls for the leader of a term. The term follows.
const PATH: &str = "/cluster/";
/// A connection ends a [`PROBE`] after this many unanswered ones, and the kernel drops what the other end has not
/// acknowledged. That must be before this computer is cut off and answers a forwarded call itself: otherwise the leader
/// would run the old call when the network is back.
const SILENT_PROBES: u32 = 1;
/// Longest time for another computer to answer a probe.
const PROBE: Duration = Duration::from_secs(1);

/// The term in a path, if the request is meant for the leader of that term.
pub(crate) fn term_of(path: &str) -> Option<u64> {
    path.strip_prefix(PATH)?.parse().ok()
}

/// Status of an answer by a computer that does not lead in that term.
pub(crate) const NOT_LEADING: StatusCode = StatusCode::MISDIRECTED_REQUEST;

/// Header in a leader's answer: the number of the last journal record that the other computers had or did not need when
/// the leader answered. The caller may know of that record, so it must not be shown an older state.
pub(crate) const SEQ_HEADER: &str = "x-rosrescue-seq";

/// Header in a leader's answer: the answer's number. The follower that passes the answer on reports the number once the
/// caller has the answer. Some notifications must not be sent earlier.
pub(crate) const ANSWER_HEADER: &str = "x-rosrescue-answer";

/// Header of a forwarded call: the caller's address, for the journal. It is absent if the caller is on the computer that
/// forwards the call.
pub(crate) const CALLER_HEADER: &str = "x-rosrescue-caller";

/// Header of a forwarded call: how long it may still wait for a master, in milliseconds. One clock counts on both
/// computers.
pub(crate) const HOLD_HEADER: &str = "x-rosrescue-hold";

/// Why another computer did not answer.
#[derive(Debug, Error)]
#[error("{why}")]
pub(crate) struct PeerError {
    why: Why,
    /// Whether the other computer may have run the call.
    pub(crate) may_have_run: bool,
}

#[derive(Debug, Error)]
enum Why {
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Call(#[from] CallError),
    #[error("it is not the leader in term {term}")]
    NotLeading { term: u64 },
}

/// The rosrescue of another computer.
#[derive(Debug)]
pub(crate) struct Peer {
    pub(crate) uri: MasterUri,
    upstream: Upstream,
    idle: Mutex<Vec<Connection>>,
    late: AtomicBool,
}

impl Peer {
    fn idle(&self) -> MutexGuard<'_, Vec<Connection>> {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the last answer of the other computer was late.
    pub(crate) fn is_late(&self) -> bool {
        self.late.load(Ordering::Relaxed)
    }

    pub(crate) fn set_late(&self, late: bool) {
        self.late.store(late, Ordering::Relaxed);
    }

    /// Sends a call to the other computer as the leader of `term`.
    pub(crate) async fn forward(
        &self,
        term: u64,
        head: &Head,
        body: &Bytes,
    ) -> Result<RawReply, PeerError> {
        let head = Head {
            path: format!("{PATH}{term}"),
            ..head.clone()
        };
        let idle = {
            let mut idle = self.idle();
            idle.retain_mut(|connection| !connection.is_closed());
            idle.pop()
        };
        let mut may_have_run = false;
        if let Some(mut connection) = idle {
            match connection.forward(&head, body.clone()).await {
                Ok(reply) => return self.take_reply(term, connection, reply, may_have_run),
                Err(_) => may_have_run = true,
            }
        }
        let connected = self.upstream.connect().await;
        let mut connection = connected.map_err(|error| PeerError {
            why: error.into(),
            may_have_run,
        })?;
        let reply = connection.forward(&head, body.clone()).await;
        let reply = reply.map_err(|error| PeerError {
            why: error.into(),
            may_have_run: true,
        })?;
        self.take_reply(term, connection, reply, may_have_run)
    }

    fn take_reply(
        &self,
        term: u64,
        connection: Connection,
        reply: RawReply,
        may_have_run: bool,
    ) -> Result<RawReply, PeerError> {
        self.set_late(false);
        let usable = reply.leaves_connection_usable();
        if reply.status == NOT_LEADING {
            let why = Why::NotLeading { term };
            return Err(PeerError { why, may_have_run });
        }
        let mut idle = self.idle();
        if usable && idle.len() < IDLE_MOST {
            idle.push(connection);
        }
        Ok(reply)
    }

    /// Whether the other computer confirms that it leads in `term`.
    pub(crate) async fn leads(&self, term: u64) -> bool {
        let call = Request::new(Method::GetPid, [CALLER_ID]);
        let body = Bytes::from(call.encode());
        self.forward(term, &Head::default(), &body).await.is_ok()
    }
}

/// Connects to the rosrescue of the present leader.
#[derive(Debug)]
pub(crate) struct Peers {
    probe_timeout: Duration,
    present: Mutex<Option<Arc<Peer>>>,
}

impl Peers {
    pub(crate) fn new(probe_timeout: Duration) -> Self {
        Self {
            probe_timeout,
            present: Mutex::default(),
        }
    }

    /// The rosrescue at `uri`. Drops the connections to any other rosrescue.
    pub(crate) fn peer_at(&self, uri: &MasterUri) -> Arc<Peer> {
        let mut present = self.present.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(peer) = present.as_ref().filter(|peer| peer.uri == *uri) {
            return peer.clone();
        }
        let peer = Arc::new(Peer {
            uri: uri.clone(),
            upstream: Upstream::new(uri.clone(), self.probe_timeout.min(PROBE), SILENT_PROBES),
            idle: Mutex::default(),
            late: AtomicBool::new(false),
        });
        *present = Some(peer.clone());
        peer
    }
}
