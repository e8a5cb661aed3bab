//! One request of the write queue to the master and its reply.

use bytes::Bytes;
use thiserror::Error;

use super::Link;
use crate::{
    master::Master,
    upstream::{
        CallError, Connection, Head, RawReply,
        inspect::{self, InspectError},
        pool::{VerifyError, verified},
    },
};

/// What a round trip ends in.
pub(super) struct Done {
    /// The connection, if it can be used again, and the incarnation that it reaches.
    pub(super) connection: Option<(u64, Connection)>,
    pub(super) result: Result<Received, RoundTripError>,
}

/// What it was made for.
pub(super) enum Received {
    Reply(RawReply),
    /// What the master holds.
    Held(Box<Master>),
}

/// Why a round trip failed.
#[derive(Debug, Error)]
pub(super) enum RoundTripError {
    /// There was no connection to the right incarnation.
    #[error(transparent)]
    Connect(#[from] VerifyError),
    /// The calls got no reply.
    #[error(transparent)]
    Call(#[from] CallError),
    /// The look at the master failed.
    #[error(transparent)]
    Look(#[from] InspectError),
}

impl RoundTripError {
    /// Whether the master may have run what was sent.
    pub(super) fn may_have_run(&self) -> bool {
        matches!(self, Self::Call(error) if !matches!(error, CallError::NotSent(_)))
    }
}

/// Sends `request`, or without one looks at what the master holds. The future owns what it needs, so
/// that dropping it ends the connection.
pub(super) async fn round_trip(
    link: Link,
    incarnation: u64,
    connection: Option<(u64, Connection)>,
    request: Option<(Head, Bytes)>,
) -> Done {
    let connected = match connection {
        Some((_, connection)) => Ok(connection),
        None => connect(&link).await,
    };
    let mut connection = match connected {
        Ok(connection) => connection,
        Err(error) => {
            return Done {
                connection: None,
                result: Err(error.into()),
            };
        }
    };
    let result = match request {
        Some((head, body)) => {
            let reply = connection.forward(&head, body).await;
            reply.map(Received::Reply).map_err(Into::into)
        }
        None => {
            let held = held(&link, &mut connection).await;
            held.map(|held| Received::Held(held.into()))
                .map_err(Into::into)
        }
    };
    let usable = match &result {
        Ok(Received::Reply(reply)) => reply.leaves_connection_usable(),
        Ok(Received::Held(_)) => true,
        Err(_) => false,
    };
    Done {
        connection: usable.then_some((incarnation, connection)),
        result,
    }
}

async fn connect(link: &Link) -> Result<Connection, VerifyError> {
    let connection = link.upstream.connect_for_writes().await?;
    verified(connection, &link.ledger.token()).await
}

/// What the master behind `connection` holds.
async fn held(link: &Link, connection: &mut Connection) -> Result<Master, InspectError> {
    let previous = link.ledger.with_mirror(Clone::clone);
    let first = inspect::first(connection, &link.ledger.token()).await?;
    inspect::second(first, connection, &previous).await
}
