//! A bounded pool of connections for reads.

use std::sync::{
    Arc, Mutex, PoisonError,
    atomic::{AtomicUsize, Ordering},
};

use bytes::Bytes;
use rescue_core::replay::Token;
use thiserror::Error;
use tokio::sync::Semaphore;

use super::{
    CallError, Head, RawReply, Upstream, VerifyError,
    next::NextConnection,
    verify::{self, Verified},
};
use crate::{
    gate::{self, State},
    ledger::Ledger,
};

/// Why a read got no reply from the master.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReadError {
    #[error(transparent)]
    Connect(#[from] VerifyError),
    #[error(transparent)]
    Call(#[from] CallError),
    /// Calls have stopped passing to the master since the read began.
    #[error("the master went away during the read")]
    Shut,
}

/// The pool of connections for reads. It is small, because a Python master is slow with many connections.
pub struct Pool {
    upstream: Arc<Upstream>,
    ledger: Arc<Ledger>,
    gate: gate::Rx,
    permits: Semaphore,
    /// Idle connections, each with the incarnation number of the master that it leads to.
    idle: Mutex<Vec<(u64, NextConnection)>>,
    /// Number of reads that are waiting too long for the master.
    stalled: AtomicUsize,
}

/// Counts a read that waits too long, until this value is dropped; see [`Pool::stalled`].
pub struct Stalled<'a>(&'a Pool);

impl Drop for Stalled<'_> {
    fn drop(&mut self) {
        self.0.stalled.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Pool {
    /// Creates a pool of at most `size` connections to `upstream`, each verified to reach the master that holds the
    /// state of `ledger`.
    pub fn new(size: usize, upstream: Arc<Upstream>, ledger: Arc<Ledger>) -> Self {
        Self {
            upstream,
            gate: ledger.gate(),
            ledger,
            permits: Semaphore::new(size),
            idle: Mutex::new(Vec::with_capacity(size)),
            stalled: AtomicUsize::new(0),
        }
    }

    /// Whether a read is waiting too long for the master.
    pub fn is_stalled(&self) -> bool {
        self.stalled.load(Ordering::Relaxed) > 0
    }

    /// Notes that a read waits too long for the master, until the result is dropped.
    pub fn stalled(&self) -> Stalled<'_> {
        self.stalled.fetch_add(1, Ordering::Relaxed);
        Stalled(self)
    }

    fn take_idle(&self, incarnation: u64) -> Option<NextConnection> {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        idle.retain_mut(|(of, next)| *of == incarnation && !next.is_stale(&self.upstream));
        idle.pop().map(|(_, next)| next)
    }

    fn put_idle(&self, incarnation: u64, token: Token, verified: Verified, reply: &RawReply) {
        let connect = connect(self.upstream.clone(), token);
        if let Some(next) = NextConnection::after_reply(verified, reply, connect) {
            let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
            idle.push((incarnation, next));
        }
    }

    /// Sends a read to the master of `incarnation`. Sends it once more if an idle connection turns out to be closed.
    pub async fn forward(
        &self,
        incarnation: u64,
        head: &Head,
        body: &Bytes,
    ) -> Result<RawReply, ReadError> {
        let attempt = async {
            let _open = self.upstream.begin_call();
            // The semaphore is never closed.
            let _permit = self.permits.acquire().await;
            let (upstream, token) = (&self.upstream, self.ledger.token());
            if let Some(next) = self.take_idle(incarnation)
                && let Some(mut verified) = next.ready().await
                && let Ok(reply) = verified.forward(upstream, &token, head, body.clone()).await
            {
                self.put_idle(incarnation, token, verified, &reply);
                return Ok(reply);
            }
            let mut verified = connect(upstream.clone(), token.clone()).await?;
            let reply = verified
                .forward(upstream, &token, head, body.clone())
                .await?;
            self.put_idle(incarnation, token, verified, &reply);
            Ok(reply)
        };
        let mut gate = self.gate.clone();
        tokio::select! {
            reply = attempt => reply,
            _ = gate.wait_for(|state| state != (State::Open { incarnation })) => Err(ReadError::Shut),
        }
    }
}

async fn connect(upstream: Arc<Upstream>, token: Token) -> Result<Verified, VerifyError> {
    let connection = upstream.connect().await?;
    verify::connection(connection, &upstream, &token).await
}
