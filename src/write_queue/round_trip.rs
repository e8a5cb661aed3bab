//! One request of the write queue to the master, and its reply.

use bytes::Bytes;
use rescue_core::replay::Token;
use ros1_master::master::Master;
use thiserror::Error;

use super::Link;
use crate::upstream::{
    CallError, Head, RawReply, VerifyError,
    inspect::{self, InspectError},
    next::NextConnection,
    verify::{self, Verified},
};

/// The result of a round trip.
pub(super) struct RoundTripResult {
    /// The next connection, if there is one already, with the number in the [token](rescue_core::replay::Token) of its
    /// master.
    pub(super) connection: Option<(u64, NextConnection)>,
    pub(super) result: Result<Received, RoundTripError>,
}

#[derive(Debug)]
pub(super) enum Received {
    Reply(RawReply),
    /// The master's state.
    Held(Box<Master>),
}

/// Why a round trip failed.
#[derive(Debug, Error)]
pub(super) enum RoundTripError {
    /// There is no connection to the right master.
    #[error(transparent)]
    Connect(#[from] VerifyError),
    #[error(transparent)]
    Call(#[from] CallError),
    /// Reading the master's state failed.
    #[error(transparent)]
    Inspect(#[from] InspectError),
}

impl RoundTripError {
    /// What the error means for the calls of the request.
    pub(super) fn failure(&self) -> Failure {
        match self {
            Self::Connect(_) => Failure::NotConnected,
            Self::Call(CallError::NotSent(_) | CallError::NotConnected(_)) => Failure::NotSent,
            Self::Call(_) => Failure::MayHaveRun,
            Self::Inspect(InspectError::NotAMaster(_)) => Failure::Unreadable,
            Self::Inspect(_) => Failure::NotRead,
        }
    }
}

/// What a failed request means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Failure {
    /// There is no connection to the right master.
    NotConnected,
    /// The master has not got the calls.
    NotSent,
    /// The master may have run the calls.
    MayHaveRun,
    /// The master's state could not be read.
    NotRead,
    /// The master lives, but its state cannot be read.
    Unreadable,
}

/// Sends `request`, or without one reads the master's state. The future owns the connection, so dropping the future
/// closes it.
pub(super) async fn round_trip(
    link: Link,
    incarnation: u64,
    connection: Option<NextConnection>,
    request: Option<(Head, Bytes)>,
) -> RoundTripResult {
    let upstream = link.upstream.clone();
    let _open = upstream.begin_call();
    let token = link.ledger.token();
    let ready = match connection {
        Some(next) => next.ready().await,
        None => None,
    };
    let connected = match ready {
        Some(verified) => Ok(verified),
        None => connect(link.clone(), token.clone()).await,
    };
    let mut verified = match connected {
        Ok(verified) => verified,
        Err(error) => {
            return RoundTripResult {
                connection: None,
                result: Err(error.into()),
            };
        }
    };
    let result = match request {
        Some((head, body)) => {
            let reply = verified.forward(&link.upstream, &token, &head, body).await;
            reply.map(Received::Reply).map_err(Into::into)
        }
        None => {
            let state = read_state(&link, &token, &mut verified).await;
            state
                .map(|state| Received::Held(state.into()))
                .map_err(Into::into)
        }
    };
    let connection = match &result {
        Ok(Received::Reply(reply)) => {
            NextConnection::after_reply(verified, reply, connect(link, token))
        }
        Ok(Received::Held(_)) => Some(NextConnection::Kept(Box::new(verified))),
        Err(_) => None,
    };
    RoundTripResult {
        connection: connection.map(|next| (incarnation, next)),
        result,
    }
}

async fn connect(link: Link, token: Token) -> Result<Verified, VerifyError> {
    let connection = link.upstream.connect_for_writes().await?;
    verify::connection(connection, &link.upstream, &token).await
}

/// Reads the state of the connected master.
async fn read_state(
    link: &Link,
    token: &Token,
    verified: &mut Verified,
) -> Result<Master, InspectError> {
    let previous = link.ledger.with_mirror(Clone::clone);
    let mut first = inspect::read_first(&mut verified.connection, token).await?;
    if !verified.connection.keeps_order() {
        first.arrange_like(&previous);
    }
    let state = inspect::read_second(first, &mut verified.connection, &previous).await?;
    verified.confirm(&link.upstream, token).await?;
    Ok(state)
}
