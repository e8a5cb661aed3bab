//! Keeps or prepares the connection for the next call.

use std::time::Duration;

use tokio::time::Instant;
use tokio_util::task::AbortOnDropHandle;

use super::{RawReply, Upstream, VerifyError, verify::Verified};

/// Longest age at which a prepared connection is still used, because a master may close idle connections. `core` starts
/// rosmaster with `-t 5`, and timeouts below a second make no sense.
const AGE_MAX: Duration = Duration::from_millis(500);

/// A connection for the next call.
#[derive(Debug)]
pub(crate) enum NextConnection {
    /// The connection of the last call, which the master has left open.
    Kept(Box<Verified>),
    /// A new connection, made before it is needed because the master closes each one after one answer. So the next call
    /// does not wait until the master has accepted it. The instant is when connecting began.
    Ahead(AbortOnDropHandle<Result<Verified, VerifyError>>, Instant),
}

impl NextConnection {
    /// The connection for the next call, after `reply` has arrived on `verified`: the same connection if the master
    /// leaves it open, or a new one made by `connect`. `None` if the next call has to connect.
    pub(crate) fn after_reply(
        verified: Verified,
        reply: &RawReply,
        connect: impl Future<Output = Result<Verified, VerifyError>> + Send + 'static,
    ) -> Option<Self> {
        if reply.leaves_connection_usable() {
            return Some(Self::Kept(Box::new(verified)));
        }
        let useful = reply.status.is_success() && verified.stays_verified();
        let connect = async {
            // The answer goes to the client first.
            tokio::task::yield_now().await;
            connect.await
        };
        let ahead = || AbortOnDropHandle::new(crate::task::spawn(connect));
        useful.then(|| Self::Ahead(ahead(), Instant::now()))
    }

    /// Whether the connection has ended or may end soon: `upstream`'s master closes connections that are idle for too long.
    pub(crate) fn is_stale(&mut self, upstream: &Upstream) -> bool {
        match self {
            Self::Kept(verified) => {
                let connection = &mut verified.connection;
                connection.is_closed() || upstream.may_close(connection.last_used())
            }
            Self::Ahead(_, since) => since.elapsed() > AGE_MAX,
        }
    }

    /// Waits for the connection. `None` if it has ended or could not be made.
    pub(crate) async fn ready(self) -> Option<Verified> {
        match self {
            Self::Kept(verified) => Some(*verified),
            Self::Ahead(made, _) => {
                let mut verified = made.await.ok()?.ok()?;
                (!verified.connection.is_closed()).then_some(verified)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use hyper::{HeaderMap, StatusCode};

    use super::*;
    use crate::upstream::{
        test_master,
        verify::{self, Verification},
    };
    use rescue_core::replay::Token;

    fn reply(keeps_alive: bool) -> RawReply {
        RawReply {
            keeps_alive,
            status: StatusCode::OK,
            reason: None,
            headers: HeaderMap::new(),
            body: bytes::Bytes::new(),
        }
    }

    async fn connect(upstream: Arc<Upstream>) -> Result<Verified, VerifyError> {
        let connection = upstream.connect().await?;
        verify::connection(connection, &upstream, &Token::new("session", 1)).await
    }

    #[tokio::test]
    async fn a_master_that_closes_each_connection_has_accepted_the_next_before_it_is_needed() {
        let (listener, _sentinel, upstream, sentinel) = test_master().await;
        let after = async |reply, by| {
            upstream.set_verification(Some(by));
            let last = connect(upstream.clone()).await.unwrap();
            let (last_end, _) = listener.accept().await.unwrap();
            (
                NextConnection::after_reply(last, &reply, connect(upstream.clone())),
                last_end,
            )
        };
        let by_sentinel = || Verification::Sentinel(sentinel.clone());

        let (next, _open) = after(reply(true), by_sentinel()).await;
        assert!(matches!(next, Some(NextConnection::Kept(_))));
        let mut next = next.unwrap();
        assert!(!next.is_stale(&upstream));
        let hasty = Upstream::new(upstream.address(), Duration::from_secs(1), 3);
        assert!(next.is_stale(&hasty.with_socket_timeout(Some(Duration::ZERO))));

        let (next, _) = after(reply(false), by_sentinel()).await;
        let (accepted, _) = listener.accept().await.unwrap();
        let Some(NextConnection::Ahead(made, since)) = next else {
            panic!("{next:?}")
        };
        // This test may have waited for the processor.
        let mut next = NextConnection::Ahead(made, since + 100 * AGE_MAX);
        assert!(!next.is_stale(&upstream));
        let verified = next.ready().await.unwrap();
        drop(accepted);

        // A connection that the master may close soon is not used.
        let (next, _) = after(reply(false), by_sentinel()).await;
        let Some(NextConnection::Ahead(made, since)) = next else {
            panic!("{next:?}")
        };
        assert!(NextConnection::Ahead(made, since - 2 * AGE_MAX).is_stale(&upstream));

        // A tunnel may lead to another master before the connection is used.
        let (next, _) = after(reply(false), Verification::TokenAfterwards).await;
        assert!(next.is_none());
        drop(verified);
    }
}
