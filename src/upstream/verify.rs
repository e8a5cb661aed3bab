//! Verifies that the present incarnation answers a call, and no other master.

use std::sync::Arc;

use bytes::Bytes;
use rescue_core::replay::Token;
use thiserror::Error;

use super::{CallError, ConnectError, Connection, Head, RawReply, Upstream, sentinel::Sentinel};

/// Why it is unknown whether a connection leads to the master process that holds the present state.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum VerifyError {
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Call(#[from] CallError),
    /// Another master process answered. It does not hold the present state yet.
    #[error("the master behind a new connection does not have the present incarnation's token")]
    OtherIncarnation,
    /// The master process that held the present state has ended.
    #[error("the master's sentinel has ended")]
    Ended,
}

/// How rosrescue verifies that a call reaches the master process that holds the present state.
#[derive(Clone, Debug)]
pub(crate) enum Verification {
    /// The master keeps connections open (HTTP/1.1). Before the first call on a connection, rosrescue checks that this
    /// master has the present [`Token`].
    TokenFirst,
    /// The master closes each connection after one answer (HTTP/1.0), and the sentinel is connected to the process that
    /// listens. While the sentinel is open, no other process can have accepted a connection.
    Sentinel(Arc<Sentinel>),
    /// The master closes each connection after one answer, and runs on another computer or its process cannot be seen.
    /// After each answer, rosrescue checks that the master has the present [`Token`].
    TokenAfterwards,
}

impl Verification {
    /// Chooses how to verify calls. `keeps_alive` says that the master answers more than one call on a connection.
    /// `sees_master` says that the sentinel is connected to the master's own process and not to a tunnel.
    pub(crate) fn choose(keeps_alive: bool, sees_master: bool, sentinel: &Arc<Sentinel>) -> Self {
        match (keeps_alive, sees_master) {
            (true, _) => Self::TokenFirst,
            (false, true) => Self::Sentinel(sentinel.clone()),
            (false, false) => Self::TokenAfterwards,
        }
    }
}

/// A connection to the master process that holds the present state, as far as that can be known before a call.
#[derive(Debug)]
pub(crate) struct Verified {
    pub(crate) connection: Connection,
    by: Verification,
}

impl Verified {
    /// Whether the connection, once verified, leads to the same master process as long as it is open. A tunnel may lead
    /// an unused connection elsewhere.
    pub(crate) fn stays_verified(&self) -> bool {
        !matches!(self.by, Verification::TokenAfterwards)
    }

    /// Sends `body` unchanged, and returns the reply unchanged if it comes from the master that has `token`.
    pub(crate) async fn forward(
        &mut self,
        upstream: &Upstream,
        token: &Token,
        head: &Head,
        body: Bytes,
    ) -> Result<RawReply, CallError> {
        let reply = self.connection.forward(head, body).await?;
        self.confirm(upstream, token).await?;
        Ok(reply)
    }

    /// Checks that answers since the verification come from the master that has `token`.
    pub(crate) async fn confirm(
        &self,
        upstream: &Upstream,
        token: &Token,
    ) -> Result<(), CallError> {
        let confirmed = match &self.by {
            Verification::TokenFirst => Ok(()),
            Verification::Sentinel(sentinel) => is_open(sentinel),
            // The process that has the token now has held the port since it got the token.
            Verification::TokenAfterwards => match upstream.connect().await {
                Ok(mut connection) => verify_token(&mut connection, token).await,
                Err(error) => Err(error.into()),
            },
        };
        confirmed.map_err(|error| CallError::Unverified(error.into()))
    }
}

/// Verifies a new `connection`, because another master may listen there by now.
pub(crate) async fn connection(
    mut connection: Connection,
    upstream: &Upstream,
    token: &Token,
) -> Result<Verified, VerifyError> {
    let by = upstream.verification().ok_or(VerifyError::Ended)?;
    match &by {
        Verification::TokenFirst => verify_token(&mut connection, token).await?,
        // The sentinel is still open after connecting, so the connection leads to the same process.
        Verification::Sentinel(sentinel) => is_open(sentinel)?,
        Verification::TokenAfterwards => {}
    }
    Ok(Verified { connection, by })
}

/// Probes whether the master has `token`.
pub(crate) async fn probe(upstream: &Upstream, token: &Token) -> Result<(), VerifyError> {
    let _open = upstream.begin_call();
    verify_token(&mut upstream.connect().await?, token).await
}

async fn verify_token(connection: &mut Connection, token: &Token) -> Result<(), VerifyError> {
    match Token::is_found(&connection.call(&token.lookup()).await?) {
        true => Ok(()),
        false => Err(VerifyError::OtherIncarnation),
    }
}

fn is_open(sentinel: &Sentinel) -> Result<(), VerifyError> {
    sentinel.is_open().then_some(()).ok_or(VerifyError::Ended)
}
