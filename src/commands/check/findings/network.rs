//! Judges whether the computers of the robot reach each other.

use std::collections::BTreeMap;

use super::{
    super::{
        facts::{Host, SetupFacts},
        reach::{Outcome, Reached},
    },
    Findings,
    todo::{address_of_this, first_address},
};
use crate::{commands::counted, status::summary::shortened};

/// Subject of findings about how this computer reaches others.
const NETWORK: &str = "network";

impl Findings {
    /// Reports computers of the robot that cannot be reached from here.
    pub(super) fn reached(&mut self, facts: &SetupFacts) {
        let mut hosts: BTreeMap<&str, Vec<&Reached>> = BTreeMap::new();
        for reached in &facts.reached {
            hosts
                .entry(&reached.address.host)
                .or_default()
                .push(reached);
        }
        let ports = &facts.ports_of_nodes;
        for (host, all) in hosts {
            let own = all.iter().find_map(|it| it.from);
            let own = own.map_or_else(|| address_of_this(facts), |own| own.to_string());
            let blocked = all.iter().filter(|it| it.outcome != Outcome::Answered);
            let list: Vec<_> = blocked
                .map(|it| format!("{} ({})", it.address.port, it.of))
                .collect();
            if list.is_empty() {
                let tried = counted(all.len(), "port");
                self.ok(NETWORK, format!("{host} answers at {tried} of nodes"));
                continue;
            }
            let is_on = all.iter().any(|it| match it.outcome {
                Outcome::Answered => true,
                Outcome::Blocked { is_on } => is_on,
            });
            let (list, number) = (shortened(&list), list.len());
            if is_on {
                self.bad(
                    NETWORK,
                    format!(
                        "{host} is on, but does not answer at {number} of {} tried: {list}. A firewall drops the \
                         packets",
                        counted(all.len(), "port")
                    ),
                    format!(
                        "the robot's computers need the master's port and TCP {ports} in both directions: on {host}, \
                         run `sudo ufw allow from {own}`, or without ufw `sudo iptables -I INPUT -s {own} -j ACCEPT`"
                    ),
                );
            } else {
                self.warn(
                    NETWORK,
                    format!("{host} does not answer at {list}: it is off, out of reach, or behind a firewall"),
                    format!(
                        "`ping -c 3 {host}`. Its firewall has to let in TCP {ports} and the master's port from {own}"
                    ),
                );
            }
        }
        let Some((firewall, other)) = facts.firewall.zip(other_host(facts)) else {
            return;
        };
        let from = first_address(Some(other));
        let allow = match firewall {
            "ufw" => {
                format!("`sudo ufw status` shows what it allows; `sudo ufw allow from {from}`")
            }
            _ => format!("`sudo firewall-cmd --zone=trusted --add-source={from}`"),
        };
        self.note(
            NETWORK,
            format!(
                "this computer's firewall ({firewall}) has to let in TCP {ports} and the master's port from {}",
                other.name
            ),
            allow,
        );
    }
}

pub(super) fn other_host(facts: &SetupFacts) -> Option<&Host> {
    let hosts = facts.node_hosts.iter().map(|(host, _)| host);
    let mut far = hosts.chain(&facts.master_host);
    far.find(|host| host.addresses.is_ok() && !host.is_here)
}
