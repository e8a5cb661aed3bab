//! One request of the write queue to the master, and its reply.

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

/// The result of a round trip.
pub(super) struct Done {
    /// The connection, if it is reusable, and its incarnation.
    pub(super) connection: Option<(u64, Connection)>,
    pub(super) result: Result<Received, RoundTripError>,
}

pub(super) enum Received {
    Reply(RawReply),
    /// The master's state.
    Held(Box<Master>),
}

/// Why a round trip failed.
#[derive(Debug, Error)]
pub(super) enum RoundTripError {
    /// There is no connection to the right incarnation.
    #[error(transparent)]
    Connect(#[from] VerifyError),
    #[error(transparent)]
    Call(#[from] CallError),
    /// Reading the master's state failed.
    #[error(transparent)]
    Look(#[from] InspectError),
}

impl RoundTripError {
    /// Whether the master may have run what was sent.
    pub(super) fn may_have_run(&self) -> bool {
        matches!(self, Self::Call(error) if !matches!(error, CallError::NotSent(_)))
    }
}

/// Sends `request`; without one, reads the master's state. The future owns what it needs, so that dropping it
/// ends the connection.
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

/// The state of the master behind `connection`.
async fn held(link: &Link, connection: &mut Connection) -> Result<Master, InspectError> {
    let previous = link.ledger.with_mirror(Clone::clone);
    let first = inspect::first(connection, &link.ledger.token()).await?;
    inspect::second(first, connection, &previous).await
}
