//! The bounded set of connections on which reads travel to the master.

use std::sync::{Mutex, PoisonError};

use bytes::Bytes;
use thiserror::Error;
use tokio::sync::Semaphore;

use super::{
    gate::{Gate, State},
    upstream::{CallError, ConnectError, Connection, Head, RawReply, Upstream},
};
use crate::master::Mark;

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
    #[error("the master behind a new connection does not bear our mark")]
    Unmarked,
}

/// Connects and makes sure that the incarnation behind the connection is the one that was brought
/// to the mirror's state. Nothing else may be said on a new connection first: the master may have
/// died and come back between two looks.
pub async fn connect_verified(upstream: &Upstream, mark: &Mark) -> Result<Connection, VerifyError> {
    let mut connection = upstream.connect().await?;
    match Mark::is_found(&connection.call(&mark.lookup()).await?) {
        true => Ok(connection),
        false => Err(VerifyError::Unmarked),
    }
}

/// Connections for reads: few, because a Python master serves many badly.
#[derive(Debug)]
pub struct Pool {
    permits: Semaphore,
    /// Idle connections, with the incarnation that they reach.
    idle: Mutex<Vec<(u64, Connection)>>,
}

impl Pool {
    /// At most `size` connections.
    pub fn new(size: usize) -> Self {
        Self {
            permits: Semaphore::new(size),
            idle: Mutex::new(Vec::with_capacity(size)),
        }
    }

    /// Sends a read to the master of `incarnation`. A read may be sent twice: once more when an
    /// idle connection turns out to have been closed.
    pub async fn forward(
        &self,
        upstream: &Upstream,
        mark: &Mark,
        gate: &mut Gate,
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
            let mut connection = connect_verified(upstream, mark).await?;
            let reply = connection.forward(head, body.clone()).await?;
            self.put_idle(incarnation, connection, &reply);
            Ok(reply)
        };
        let shut = async {
            while gate.look() == (State::Open { incarnation }) {
                gate.changed().await;
            }
        };
        tokio::select! {
            reply = attempt => reply,
            () = shut => Err(ReadError::Shut),
        }
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
}
