//! Checks whether nodes of a recorded session are still alive.

use std::{
    collections::BTreeSet,
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use rescue_core::health::{Reach, port_of};
use ros1_master::master::{self, Master};
use tokio::task::JoinSet;

use crate::{
    nodes::{
        client::{self, Reaction},
        origin,
    },
    resolver,
};

/// How long nodes have to answer, including the lookup of their hosts. After a reboot, the first packets may be lost: the
/// kernel asks for a neighbour's hardware address once per second.
const LIFE_SIGN: Duration = Duration::from_secs(3);

/// Whether any node of `state` answers. After a reboot of this computer (`same_boot` is false) only
/// nodes on other computers count, because no local process survived and a local port may belong to
/// a new process.
pub(super) async fn any_alive(state: &Master, same_boot: bool) -> bool {
    let call = master::get_pid();
    let mut questions = JoinSet::new();
    let nodes = state.nodes();
    let ports: BTreeSet<_> = nodes
        .map(|(name, api)| (port_of(api), state.registered_from(name)))
        .collect();
    for (port, from) in ports {
        let (api, call) = (port.to_owned(), call.clone());
        questions.spawn(async move {
            // A node elsewhere that was registered from here may belong to another robot: a program synchronises masters.
            (same_boot || from.is_some() && resolver::is_elsewhere(&api, LIFE_SIGN).await)
                && answer_counts(&api, from).await
                && client::call(&api, &call, LIFE_SIGN).await == Reaction::Alive
        });
    }
    while let Some(alive) = questions.join_next().await {
        if alive.unwrap_or(false) {
            return true;
        }
    }
    false
}

/// Whether an answer from `api` may be that of a node which has registered from the computer `from`.
async fn answer_counts(api: &str, from: Option<IpAddr>) -> bool {
    let at = match from {
        Some(_) => origin::addresses(api, LIFE_SIGN).await,
        None => None,
    };
    let at: Vec<_> = at.iter().flatten().map(SocketAddr::ip).collect();
    Reach::classify(from, &at, resolver::is_own).answer_counts()
}
