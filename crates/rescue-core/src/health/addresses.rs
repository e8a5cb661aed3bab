//! Nodes that are registered at an address that this computer has lost, for example because DHCP gave it another one.
//! The nodes live, and their connections may too, but nobody can connect to them at that address.

use std::{
    collections::{BTreeMap, BTreeSet},
    net::IpAddr,
    time::Instant,
};

/// The addresses of this computer's nodes, and which of them are lost.
#[derive(Debug, Default)]
pub struct NodeAddresses(BTreeMap<String, At>);

#[derive(Debug)]
struct At {
    addresses: BTreeSet<IpAddr>,
    lost: Option<Instant>,
}

/// What has changed since the last update. Each entry is a node's address up to the port.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct AddressChanges {
    pub lost: Vec<String>,
    pub returned: Vec<String>,
}

impl NodeAddresses {
    /// Notes the addresses of this computer at which the node at `port` can be reached.
    pub fn set(&mut self, port: &str, addresses: impl IntoIterator<Item = IpAddr>) {
        let addresses: BTreeSet<_> = addresses.into_iter().collect();
        if addresses.is_empty() {
            return;
        }
        let lost = self.0.get(port).and_then(|at| at.lost);
        self.0.insert(port.to_owned(), At { addresses, lost });
    }

    /// Forgets ports at which no node is registered any more.
    pub fn retain(&mut self, registered: impl Fn(&str) -> bool) {
        self.0.retain(|port, _| registered(port));
    }

    /// Finds out which addresses this computer has at `now`.
    pub fn update(&mut self, is_own: impl Fn(IpAddr) -> bool, now: Instant) -> AddressChanges {
        let all: BTreeSet<_> = self.0.values().flat_map(|at| &at.addresses).collect();
        let own: BTreeSet<_> = all.into_iter().filter(|it| is_own(**it)).copied().collect();
        let mut changes = AddressChanges::default();
        for (port, at) in &mut self.0 {
            match (at.addresses.is_disjoint(&own), at.lost) {
                (true, None) => {
                    at.lost = Some(now);
                    changes.lost.push(port.clone());
                }
                (false, Some(_)) => {
                    at.lost = None;
                    changes.returned.push(port.clone());
                }
                _ => {}
            }
        }
        changes
    }

    /// Whether the address of the node at `port` is lost. Another computer may have it now.
    pub fn is_lost(&self, port: &str) -> bool {
        self.0.get(port).is_some_and(|at| at.lost.is_some())
    }

    /// The ports with lost addresses, each with one address and since when it is lost.
    pub fn lost_ports(&self) -> impl Iterator<Item = (&str, IpAddr, Instant)> {
        let lost = self.0.iter();
        lost.filter_map(|(port, at)| Some((port.as_str(), *at.addresses.first()?, at.lost?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_lost_and_returns() {
        let ip = |text: &str| text.parse::<IpAddr>().unwrap();
        let now = Instant::now();
        let mut nodes = NodeAddresses::default();
        nodes.set("far", []);
        nodes.set("a", [ip("10.0.0.7")]);
        nodes.set("b", [ip("127.0.0.1"), ip("10.0.0.7")]);
        let had = |addresses: &'static [&str]| {
            move |address: IpAddr| addresses.iter().any(|own| ip(own) == address)
        };
        let before = had(&["127.0.0.1", "10.0.0.7"]);
        assert_eq!(nodes.update(before, now), AddressChanges::default());
        let changes = nodes.update(had(&["127.0.0.1", "10.0.0.9"]), now);
        assert_eq!(
            (changes.lost, changes.returned),
            (vec!["a".to_owned()], vec![])
        );
        // The address of a name that is looked up again.
        nodes.set("a", [ip("10.0.0.7")]);
        let lost: Vec<_> = nodes.lost_ports().collect();
        assert_eq!(lost, [("a", ip("10.0.0.7"), now)]);
        assert!(nodes.is_lost("a") && !nodes.is_lost("b") && !nodes.is_lost("far"));
        let changes = nodes.update(before, now);
        assert_eq!(
            (changes.lost, changes.returned),
            (vec![], vec!["a".to_owned()])
        );
        nodes.retain(|port| port == "b");
        assert_eq!(nodes.update(|_| false, now).lost, ["b"]);
    }
}
