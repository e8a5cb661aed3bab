//! Judges the names and addresses that nodes register.

use super::{
    super::facts::{Host, SetupFacts},
    Findings, list,
    network::other_host,
    todo::{first_address, host_entry, set_address},
};

/// A name lookup that takes longer than this, in milliseconds, is a finding: it delays every call to the node.
const SLOW: u128 = 1000;

impl Findings {
    /// Checks the name that nodes of this computer register.
    pub(super) fn own_name(&mut self, facts: &SetupFacts) {
        let (own, env) = (&facts.own, &facts.env);
        let is_set = env.hostname.is_some() || env.ip.is_some();
        let (subject, name) = match is_set {
            true if env.hostname.is_some() => ("ROS_HOSTNAME", &own.name),
            true => ("ROS_IP", &own.name),
            false => ("host name", &own.name),
        };
        if name.contains(' ') {
            // The finding about the variable reports the spaces.
            return;
        }
        let set_address = set_address(facts) + &self.lasting(facts, subject);
        match &own.addresses {
            Err(why) => self.bad(
                subject,
                format!("{name} has no address ({why}): no other node reaches the nodes of this computer"),
                match facts.local {
                    Some(local) => {
                        format!("{}, or {set_address}", host_entry(&local.to_string(), name))
                    }
                    None => set_address,
                },
            ),
            Ok(_) if !own.is_here => self.bad(
                subject,
                format!("{}, which is not this computer", leads(own)),
                match name.parse::<std::net::IpAddr>() {
                    Ok(_) => set_address,
                    Err(_) => format!("{set_address}. `grep -n {name} /etc/hosts` shows a wrong entry"),
                },
            ),
            Ok(_) if own.is_loopback() => {
                let what = format!("{}, which other computers cannot reach", leads(own));
                match other_host(facts) {
                    Some(other) => {
                        let other = &other.name;
                        let what = format!("{what}, but {other} is part of the robot");
                        self.bad(subject, what, set_address);
                    }
                    None if is_set => self.note(subject, what, ""),
                    None => self.warn(
                        subject,
                        format!("{what} (Debian's /etc/hosts)"),
                        format!("fine for a robot with one computer; otherwise {set_address}"),
                    ),
                }
            }
            Ok(_) => self.ok(subject, leads(own)),
        }
        self.slow(subject, own);
    }

    /// Checks whether the registered address of this computer may change.
    pub(super) fn lease(&mut self, facts: &SetupFacts) {
        let Some(lease) = &facts.lease else { return };
        let how = match (lease.is_leased, lease.is_wireless) {
            (true, true) => "a leased (DHCP) address of Wi-Fi",
            (true, false) => "a leased (DHCP) address",
            _ => "an address of Wi-Fi",
        };
        let (address, interface, name) = (&lease.address, &lease.interface, &facts.own.name);
        let (subject, what) = match (&facts.env.hostname, &facts.env.ip) {
            (None, Some(_)) => ("ROS_IP", address.clone()),
            (Some(_), _) if name == address => ("ROS_HOSTNAME", address.clone()),
            (Some(_), _) => ("ROS_HOSTNAME", format!("{name} is {address},")),
            (None, None) => ("host name", format!("{name} is {address},")),
        };
        let link = if name == address { " is" } else { "" };
        self.warn(
            subject,
            format!(
                "{what}{link} {how} ({interface}): when it changes, no node reaches this computer's nodes"
            ),
            format!(
                "reserve it in the DHCP server for the hardware address that `cat \
                 /sys/class/net/{interface}/address` prints"
            ),
        );
    }

    fn slow(&mut self, subject: &'static str, host: &Host) {
        if host.addresses.is_ok() && host.took.as_millis() > SLOW {
            self.warn(
                subject,
                format!(
                    "the lookup of {} takes {} ms",
                    host.name,
                    host.took.as_millis()
                ),
                format!(
                    "every new connection waits this long: {}",
                    host_entry(&first_address(Some(host)), &host.name)
                ),
            );
        }
    }

    pub(super) fn nodes(&mut self, facts: &SetupFacts) {
        for (host, nodes) in &facts.node_hosts {
            let nodes = nodes.join(", ");
            if let Err(why) = &host.addresses {
                let name = &host.name;
                self.bad(
                    "nodes",
                    format!("{nodes} registered at {name}, which has no address here ({why})"),
                    format!(
                        "where the nodes run, `export ROS_IP=$(hostname -I | cut -d' ' -f1)` and start them again; or \
                         {}",
                        host_entry("ADDRESS", name)
                    ),
                );
            }
            self.slow("nodes", host);
        }
        let known = facts
            .node_hosts
            .iter()
            .filter(|(host, _)| host.addresses.is_ok());
        let known: Vec<_> = known.map(|(host, _)| &*host.name).collect();
        if !known.is_empty() && known.len() == facts.node_hosts.len() {
            self.ok(
                "nodes",
                format!(
                    "all hosts of the nodes have addresses: {}",
                    known.join(", ")
                ),
            );
        }
    }
}

/// Describes a name with its addresses, or an address.
fn leads(host: &Host) -> String {
    let addresses = list(host.addresses.as_deref().unwrap_or_default());
    match addresses == host.name {
        true => addresses,
        false => format!("{} is {addresses}", host.name),
    }
}
