//! Tries the ports of the robot's other computers.

use std::{
    fs, io,
    net::{IpAddr, Ipv4Addr, Ipv6Addr, UdpSocket},
    sync::Arc,
    time::Duration,
};

use tokio::{net::TcpStream, sync::Semaphore, task::JoinSet, time::timeout};

use crate::{resolver, ros_env::MasterUri};

/// Longest time for a connection. A computer that is on answers within milliseconds.
const LIMIT: Duration = Duration::from_secs(3);
/// Number of ports that are tried at the same time.
const AT_ONCE: usize = 64;
/// Maximum number of ports that are tried.
const MOST: usize = 1000;

/// A port of another computer that nodes of this computer must reach.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Reached {
    pub(super) address: MasterUri,
    /// The master, or the node that registered the port.
    pub(super) of: String,
    /// This computer's address in packets to that computer.
    pub(super) from: Option<IpAddr>,
    pub(super) outcome: Outcome,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    /// The computer answered: it accepted or refused the connection.
    Answered,
    /// The computer did not answer at this port. `is_on` says whether it answered ARP.
    Blocked { is_on: bool },
}

/// Tries `ports`, each with its owner. Leaves out hosts without an address and this computer.
pub(super) async fn try_all(ports: Vec<(String, MasterUri)>) -> Vec<Reached> {
    let permits = Arc::new(Semaphore::new(AT_ONCE));
    let mut tries = JoinSet::new();
    for (of, address) in ports.into_iter().take(MOST) {
        let permits = permits.clone();
        tries.spawn(async move {
            // The semaphore is never closed.
            let _permit = permits.acquire().await;
            let (from, outcome) = outcome(&address).await?;
            Some(Reached {
                address,
                of,
                from,
                outcome,
            })
        });
    }
    let mut all: Vec<_> = tries.join_all().await.into_iter().flatten().collect();
    all.sort_by(|a, b| (&a.address.host, a.address.port).cmp(&(&b.address.host, b.address.port)));
    all
}

/// This computer's address in packets to `address`. Sends none.
pub(super) fn source_to(address: IpAddr) -> Option<IpAddr> {
    let any: IpAddr = match address {
        IpAddr::V4(_) => Ipv4Addr::UNSPECIFIED.into(),
        IpAddr::V6(_) => Ipv6Addr::UNSPECIFIED.into(),
    };
    let socket = UdpSocket::bind((any, 0)).ok()?;
    socket.connect((address, 9)).ok()?;
    Some(socket.local_addr().ok()?.ip())
}

async fn outcome(address: &MasterUri) -> Option<(Option<IpAddr>, Outcome)> {
    let found = timeout(LIMIT, resolver::addresses(&address.host, address.port)).await;
    let found = found.ok()?.ok()?;
    let first = found.first()?.ip();
    if found.iter().any(|at| resolver::is_own(at.ip())) {
        return None;
    }
    let is_refused = |error: &io::Error| error.kind() == io::ErrorKind::ConnectionRefused;
    let outcome = match timeout(LIMIT, TcpStream::connect(&*found)).await {
        Ok(Ok(_)) => Outcome::Answered,
        Ok(Err(error)) if is_refused(&error) => Outcome::Answered,
        _ => Outcome::Blocked {
            is_on: answers_arp(
                &fs::read_to_string("/proc/net/arp").unwrap_or_default(),
                first,
            ),
        },
    };
    Some((source_to(first), outcome))
}

/// Whether the computer at `address` of this network has answered the kernel's question for its hardware address. It does
/// so even if its firewall drops everything else. `table` is `/proc/net/arp`.
fn answers_arp(table: &str, address: IpAddr) -> bool {
    let address = address.to_string();
    table.lines().any(|line| {
        let words: Vec<_> = line.split_whitespace().collect();
        // 0x2: the entry is complete.
        words.first() == Some(&&*address) && words.get(2) == Some(&"0x2")
    })
}

/// The ports that the kernel gives to nodes, such as `32768-60999`.
pub(super) fn ports_of_nodes() -> String {
    let range = fs::read_to_string("/proc/sys/net/ipv4/ip_local_port_range").unwrap_or_default();
    let range: Vec<_> = range.split_whitespace().collect();
    match range.as_slice() {
        [first, last] => format!("{first}-{last}"),
        _ => "1024-65535".to_owned(),
    }
}

/// The firewall that runs on this computer, if it is one of the usual ones.
pub(super) fn firewall() -> Option<&'static str> {
    let ufw = fs::read_to_string("/etc/ufw/ufw.conf").unwrap_or_default();
    if ufw.lines().any(|line| line.trim() == "ENABLED=yes") {
        return Some("ufw");
    }
    fs::exists("/run/firewalld")
        .is_ok_and(|exists| exists)
        .then_some("firewalld")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_computer_that_is_on_answers_arp() {
        let table = "IP address       HW type     Flags       HW address            Mask     Device\n\
             10.0.0.9         0x1         0x2         02:00:00:00:00:09     *        eth0\n\
             10.0.0.8         0x1         0x0         00:00:00:00:00:00     *        eth0\n";
        let is_on = |address: &str| answers_arp(table, address.parse().unwrap());
        assert!(is_on("10.0.0.9") && !is_on("10.0.0.8") && !is_on("10.0.0.90"));
    }
}
