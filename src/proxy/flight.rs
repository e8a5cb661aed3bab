//! One way to the master and back.

use std::sync::Arc;

use super::{
    Proxy,
    journey::{self, LaneItem, TravelError},
    look::{self, LookError},
    pool::connect_verified,
    upstream::{Connection, RawReply},
};
use crate::master::Master;

/// What a flight brings back.
pub(super) struct Landed {
    pub(super) connection: Option<(u64, Connection)>,
    pub(super) result: Result<Cargo, TravelError>,
}

/// What it was sent for.
pub(super) enum Cargo {
    Reply(RawReply),
    Resynced(Box<Master>),
}

/// One journey. The future owns what it needs, so that dropping it ends it.
pub(super) fn travel(
    proxy: Arc<Proxy>,
    incarnation: u64,
    connection: Option<(u64, Connection)>,
    items: &[LaneItem],
) -> impl Future<Output = Landed> + Send + 'static {
    let outbound = (!items.is_empty()).then(|| journey::outbound(items));
    async move {
        let connected = match connection {
            Some((_, connection)) => Ok(connection),
            None => connect_verified(&proxy.upstream, &proxy.mark).await,
        };
        let mut connection = match connected {
            Ok(connection) => connection,
            Err(error) => {
                return Landed {
                    connection: None,
                    result: Err(error.into()),
                };
            }
        };
        let result = match outbound {
            Some((head, body)) => connection
                .forward(&head, body)
                .await
                .map(Cargo::Reply)
                .map_err(Into::into),
            None => {
                let held = hold_of(&proxy, &mut connection).await;
                held.map(|held| Cargo::Resynced(held.into()))
                    .map_err(Into::into)
            }
        };
        let usable = match &result {
            Ok(Cargo::Reply(reply)) => reply.leaves_connection_usable(),
            Ok(Cargo::Resynced(_)) => true,
            Err(_) => false,
        };
        let connection = usable.then_some((incarnation, connection));
        Landed { connection, result }
    }
}

/// What the master behind `connection` holds.
async fn hold_of(proxy: &Proxy, connection: &mut Connection) -> Result<Master, LookError> {
    let previous = proxy.shadow.with_mirror(Clone::clone);
    let first = look::first(connection, &proxy.mark).await?;
    look::second(first, connection, &previous).await
}
