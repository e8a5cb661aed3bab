//! A bounded pool of connections for reads.

use std::sync::{
    Arc, Mutex, PoisonError,
    atomic::{AtomicUsize, Ordering},
};

use bytes::Bytes;
use thiserror::Error;
use tokio::sync::Semaphore;

use super::{CallError, ConnectError, Connection, Head, RawReply, Upstream};
use crate::replay::Token;
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
    /// The gate was shut meanwhile.
    #[error("the gate was shut")]
    Shut,
}

/// Why there is no connection to the served incarnation.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum VerifyError {
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Call(#[from] CallError),
    /// It is another incarnation, which does not hold the state yet.
    #[error("the master behind a new connection does not bear the present incarnation's token")]
    OtherIncarnation,
}

/// Connects and verifies that the incarnation is the one that holds the mirror's state. Must be the first
/// call on a new connection: the master may have restarted unnoticed.
pub(crate) async fn connect_verified(
    upstream: &Upstream,
    token: &Token,
) -> Result<Connection, VerifyError> {
    verified(upstream.connect().await?, token).await
}

/// Returns `connection` if its incarnation bears `token`.
pub(crate) async fn verified(
    mut connection: Connection,
    token: &Token,
) -> Result<Connection, VerifyError> {
    match Token::is_found(&connection.call(&token.lookup().into()).await?) {
        true => Ok(connection),
        false => Err(VerifyError::OtherIncarnation),
    }
}

/// Connections for reads. Few: a Python master is slow with many.
pub struct Pool {
    upstream: Arc<Upstream>,
    ledger: Arc<Ledger>,
    gate: gate::Rx,
    permits: Semaphore,
    /// Idle connections, each with its incarnation.
    idle: Mutex<Vec<(u64, Connection)>>,
    /// Number of reads that have waited too long.
    stalled: AtomicUsize,
}

/// See [`Pool::stalled`].
pub struct Stalled<'a>(&'a Pool);

impl Drop for Stalled<'_> {
    fn drop(&mut self) {
        self.0.stalled.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Pool {
    /// At most `size` connections to `upstream`, each verified to reach the incarnation of `ledger`.
    pub fn new(size: usize, upstream: Arc<Upstream>, ledger: Arc<Ledger>, gate: gate::Rx) -> Self {
        Self {
            upstream,
            ledger,
            gate,
            permits: Semaphore::new(size),
            idle: Mutex::new(Vec::with_capacity(size)),
            stalled: AtomicUsize::new(0),
        }
    }

    /// Whether a read has waited for the master too long.
    pub fn is_stalled(&self) -> bool {
        self.stalled.load(Ordering::Relaxed) > 0
    }

    /// Notes that a read has waited for the master too long, until the result is dropped.
    pub fn stalled(&self) -> Stalled<'_> {
        self.stalled.fetch_add(1, Ordering::Relaxed);
        Stalled(self)
    }

    fn take_idle(&self, incarnation: u64) -> Option<Connection> {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        idle.retain_mut(|(of, connection)| *of == incarnation && !connection.is_closed());
        idle.pop().map(|(_, connection)| connection)
    }

    fn put_idle(&self, incarnation: u64, connection: Connection, reply: &RawReply) {
        if reply.leaves_connection_usable() {
            let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
            idle.push((incarnation, connection));
        }
    }

    /// Sends a read to the master of `incarnation`. A read is sent once more if an idle connection turns out
    /// to be closed.
    pub async fn forward(
        &self,
        incarnation: u64,
        head: &Head,
        body: &Bytes,
    ) -> Result<RawReply, ReadError> {
        let attempt = async {
            // Never closed.
            let _permit = self.permits.acquire().await;
            if let Some(mut connection) = self.take_idle(incarnation)
                && let Ok(reply) = connection.forward(head, body.clone()).await
            {
                self.put_idle(incarnation, connection, &reply);
                return Ok(reply);
            }
            let mut connection = connect_verified(&self.upstream, &self.ledger.token()).await?;
            let reply = connection.forward(head, body.clone()).await?;
            self.put_idle(incarnation, connection, &reply);
            Ok(reply)
        };
        let mut gate = self.gate.clone();
        tokio::select! {
            reply = attempt => reply,
            _ = gate.wait_for(|state| state != (State::Open { incarnation })) => Err(ReadError::Shut),
        }
    }
}
