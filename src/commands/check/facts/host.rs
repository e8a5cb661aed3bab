//! Hosts: names and addresses, with what they resolve to.

use std::{
    collections::BTreeMap,
    net::IpAddr,
    time::{Duration, Instant},
};

use tokio::{task::JoinSet, time::timeout};

use super::LOOKUP_LIMIT;
use crate::{resolver, ros_env::MasterUri};

/// Maximum number of nodes that are named for each host.
const NAMED: usize = 3;

/// A name or an address, with the addresses that it resolves to.
#[derive(Clone, Debug)]
pub(crate) struct Host {
    pub(crate) name: String,
    pub(crate) addresses: Result<Vec<IpAddr>, String>,
    /// Whether one of the addresses belongs to this computer.
    pub(crate) is_here: bool,
    pub(crate) took: Duration,
}

impl Host {
    pub(super) async fn find(name: &str) -> Self {
        let start = Instant::now();
        let found = match timeout(LOOKUP_LIMIT, resolver::addresses(name, 0)).await {
            Ok(found) => found.map_err(|error| error.to_string()),
            Err(_) => Err(format!(
                "no name server answered in {} s",
                LOOKUP_LIMIT.as_secs()
            )),
        };
        let addresses = found.map(|found| found.iter().map(|at| at.ip()).collect::<Vec<_>>());
        let mut all = addresses.iter().flatten();
        Self {
            name: name.to_owned(),
            is_here: all.any(|address| resolver::is_own(*address)),
            addresses,
            took: start.elapsed(),
        }
    }

    pub(crate) fn is_loopback(&self) -> bool {
        let addresses = self.addresses.as_deref().unwrap_or_default();
        !addresses.is_empty() && addresses.iter().all(IpAddr::is_loopback)
    }
}

/// Hosts of `nodes`, each with some of its nodes.
pub(super) async fn hosts_of(nodes: &[(String, MasterUri)]) -> Vec<(Host, Vec<String>)> {
    let mut hosts = BTreeMap::<_, Vec<String>>::new();
    for (name, address) in nodes {
        let nodes = hosts.entry(address.host.clone()).or_default();
        if nodes.len() < NAMED {
            nodes.push(name.clone());
        }
    }
    let mut lookups = JoinSet::new();
    for (host, nodes) in hosts {
        lookups.spawn(async move { (Host::find(&host).await, nodes) });
    }
    let mut hosts = lookups.join_all().await;
    hosts.sort_by(|(a, _), (b, _)| a.name.cmp(&b.name));
    hosts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn hosts_are_told_by_their_addresses() {
        let local = Host::find("127.0.0.1").await;
        assert!(local.is_here && local.is_loopback());
        // This network is reserved for documentation.
        let far = Host::find("192.0.2.1").await;
        assert!(!far.is_here && !far.is_loopback());
        let nobody = Host::find("nobody.invalid").await;
        assert!(!nobody.is_here && !nobody.is_loopback() && nobody.addresses.is_err());
    }
}
