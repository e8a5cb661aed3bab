//! Applies [`Reach`] to the registered nodes: finds out to which computer each node's address leads from here, and names
//! the nodes that no other computer can reach at their addresses.

use std::{
    collections::BTreeMap,
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use rescue_core::health::Reach;
use tokio::time::timeout;

use super::Nodes;
use crate::{limit::rarely, resolver, ros_env::MasterUri, status::summary::Misaddressed};

/// The addresses to which the host of `api` leads from here. `None` if it has none within `limit`.
pub(crate) async fn addresses(api: &str, limit: Duration) -> Option<Vec<SocketAddr>> {
    let MasterUri { host, port } = MasterUri::parse(api).ok()?;
    let found = timeout(limit, resolver::addresses(&host, port)).await;
    let mut found = found.ok()?.ok()?;
    for address in &mut found {
        address.set_ip(address.ip().to_canonical());
    }
    Some(found)
}

impl Nodes {
    /// The names registered at `port`, each with the computer from which it has registered; `None` for this one.
    fn origins(&self, port: &str) -> BTreeMap<String, Option<IpAddr>> {
        self.ledger.with_mirror(|mirror| {
            let origins = mirror
                .nodes_at(port)
                .map(|(node, _)| (node.to_owned(), mirror.registered_from(node)));
            origins.collect()
        })
    }

    /// What the address with this `port` proves about each node that is registered there.
    pub(super) async fn reaches(&self, port: &str) -> BTreeMap<String, Reach> {
        let origins = self.origins(port);
        if origins.values().flatten().next().is_some() {
            self.locate(port).await;
        }
        let reaches = origins.into_iter();
        reaches
            .map(|(node, from)| (node, self.local.reach(port, from)))
            .collect()
    }

    /// What the address with this `port` proves about a node that has registered from the computer `from`.
    pub(super) async fn reach(&self, port: &str, from: Option<IpAddr>) -> Reach {
        if from.is_some() {
            self.locate(port).await;
        }
        self.local.reach(port, from)
    }

    /// Finds out where `port` is.
    async fn locate(&self, port: &str) {
        if let Some(addresses) = addresses(port, self.timeout).await {
            self.local.set_addresses(port, addresses);
        }
    }

    /// Whether a notification for the node at `port` reaches that node, or nobody.
    pub(super) async fn leads_to_node(&self, port: &str) -> bool {
        let reaches = self.reaches(port).await;
        reaches.is_empty() || reaches.into_values().any(Reach::may_be_notified)
    }
}

/// Logs nodes that have just been found to be misaddressed.
pub(super) fn log_misaddressed(new: &[Misaddressed]) {
    for Misaddressed {
        node, api, from, ..
    } in new
    {
        rarely!(
            warn,
            node,
            api,
            %from,
            "a node of another computer has registered under an address that means this one, so no other computer can reach it, and it cannot be checked from here; set ROS_IP on its computer and restart it"
        );
    }
}
