//! The bounded set of connections on which reads travel to the master.

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

/// A read that got no reply from the master.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReadError {
    /// No connection.
    #[error(transparent)]
    Connect(#[from] VerifyError),
    /// No reply.
    #[error(transparent)]
    Call(#[from] CallError),
    /// The gate shut meanwhile.
    #[error("the gate was shut")]
    Shut,
}

/// A connection to the incarnation that is being served could not be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum VerifyError {
    /// No connection at all.
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// It did not answer.
    #[error(transparent)]
    Call(#[from] CallError),
    /// It is another incarnation, which does not hold the state yet.
    #[error("the master behind a new connection does not bear the present incarnation's token")]
    OtherIncarnation,
}

/// Connects and makes sure that the incarnation behind the connection is the one that was brought
/// to the mirror's state. Nothing else may be said on a new connection first: the master may have
/// died and come back between two looks.
pub(crate) async fn connect_verified(
    upstream: &Upstream,
    token: &Token,
) -> Result<Connection, VerifyError> {
    verified(upstream.connect().await?, token).await
}

/// `connection`, if it reaches the incarnation that bears `token`.
pub(crate) async fn verified(
    mut connection: Connection,
    token: &Token,
) -> Result<Connection, VerifyError> {
    match Token::is_found(&connection.call(&token.lookup().into()).await?) {
        true => Ok(connection),
        false => Err(VerifyError::OtherIncarnation),
    }
}

/// Connections for reads: few, because a Python master serves many badly.
pub struct Pool {
    upstream: Arc<Upstream>,
    ledger: Arc<Ledger>,
    gate: gate::Rx,
    permits: Semaphore,
    /// Idle connections, with the incarnation that they reach.
    idle: Mutex<Vec<(u64, Connection)>>,
    /// Reads that have waited for too long.
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

    /// Whether the master has not answered a read for longer than it should take.
    pub fn is_stalled(&self) -> bool {
        self.stalled.load(Ordering::Relaxed) > 0
    }

    /// The master has not answered a read for longer than it should take, until the result is dropped.
    pub fn stalled(&self) -> Stalled<'_> {
        self.stalled.fetch_add(1, Ordering::Relaxed);
        Stalled(self)
    }

    fn take_idle(&self, incarnation: u64) -> Option<Connection> {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        idle.retain(|(of, connection)| *of == incarnation && !connection.is_closed());
        idle.pop().map(|(_, connection)| connection)
    }

    fn put_idle(&self, incarnation: u64, connection: Connection, reply: &RawReply) {
        if reply.leaves_connection_usable() {
            let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
            idle.push((incarnation, connection));
        }
    }

    /// Sends a read to the master of `incarnation`. A read may be sent twice: once more when an idle
    /// connection turns out to have been closed.
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
