//! Notices when this computer gets or loses addresses and links. Says which nodes are registered at a lost address, and
//! tells nodes what they may have missed as soon as an address or a link is back.

use std::{
    collections::{BTreeMap, VecDeque},
    io,
    sync::Arc,
    time::{Duration, Instant},
};

use rustix::{
    io::Errno,
    net::{AddressFamily, SocketFlags, SocketType, bind, netlink::SocketAddrNetlink, socket_with},
};
use tokio::net::unix::pipe::Receiver;

use super::{Nodes, notifications, origin};
use crate::{clock, limit::rarely, resolver, status::summary::LostAddress, wait};

/// When to look after a change. A route or a Wi-Fi connection may come a little later than the address.
const LOOKS: [Duration; 3] = [
    Duration::from_millis(50),
    Duration::from_millis(500),
    Duration::from_millis(1500),
];
/// The kernel's groups of messages about links and about IPv4 and IPv6 addresses (`RTMGRP_*` in `rtnetlink(7)`).
const GROUPS: u32 = 0x1 | 0x10 | 0x100;
/// Types of messages, and flags of a link that says whether packets pass (`IFF_UP`, `IFF_RUNNING`, `IFF_LOWER_UP`).
const NEW_LINK: u16 = 16;
const DELETED_LINK: u16 = 17;
const NEW_ADDRESS: u16 = 20;
const DELETED_ADDRESS: u16 = 21;
const PASSES: u32 = 0x1 | 0x40 | 0x1_0000;

/// The kernel's messages about addresses and links.
struct Changes {
    /// tokio's pipe type can read a socket without unsafe code.
    socket: Receiver,
    /// Whether packets pass each link, by its number.
    links: BTreeMap<[u8; 4], u32>,
}

impl Changes {
    fn open() -> io::Result<Self> {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, None)?;
        bind(&socket, &SocketAddrNetlink::new(0, GROUPS))?;
        Ok(Self {
            socket: Receiver::from_owned_fd_unchecked(socket)?,
            links: BTreeMap::new(),
        })
    }

    /// Waits for a change.
    async fn wait_for_change(&mut self) -> io::Result<()> {
        let mut buffer = [0; 16_384];
        loop {
            self.socket.readable().await?;
            match self.socket.try_read(&mut buffer) {
                Ok(length) => {
                    let messages = buffer.get(..length).unwrap_or_default();
                    if is_change(messages, &mut self.links) {
                        return Ok(());
                    }
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                // Messages were lost.
                Err(error) if Errno::from_io_error(&error) == Some(Errno::NOBUFS) => return Ok(()),
                Err(error) => return Err(error),
            }
        }
    }
}

/// Whether one of `messages` is about an address, or about a link that packets now pass or no longer pass.
fn is_change(mut messages: &[u8], links: &mut BTreeMap<[u8; 4], u32>) -> bool {
    let mut changed = false;
    // The header: length, type, flags, sequence number, sender. A link's message: family, type, number, flags.
    while let Some((length, _)) = messages.split_first_chunk::<4>() {
        let length = u32::from_ne_bytes(*length) as usize;
        let word = |at: usize| {
            messages
                .get(at..at + 4)
                .and_then(|word| word.try_into().ok())
        };
        let kind = messages.get(4..6).and_then(|kind| kind.try_into().ok());
        match kind.map(u16::from_ne_bytes) {
            Some(NEW_ADDRESS | DELETED_ADDRESS) => changed = true,
            Some(NEW_LINK) => {
                if let (Some(number), Some(flags)) = (word(20), word(24)) {
                    let flags = u32::from_ne_bytes(flags) & PASSES;
                    changed |= links.insert(number, flags) != Some(flags);
                }
            }
            Some(DELETED_LINK) => {
                changed |= word(20).is_some_and(|number| links.remove(&number).is_some());
            }
            _ => {}
        }
        match messages.get(length.next_multiple_of(4).max(16)..) {
            Some(rest) => messages = rest,
            None => break,
        }
    }
    changed
}

/// Watches this computer's addresses as long as it is polled.
pub(crate) async fn watch(nodes: Arc<Nodes>) {
    let mut changes = match Changes::open() {
        Ok(changes) => changes,
        Err(error) => return log_no_events(&error),
    };
    let mut looks = VecDeque::<Instant>::new();
    loop {
        tokio::select! {
            changed = changes.wait_for_change() => {
                if let Err(error) = changed {
                    return log_no_events(&error);
                }
                let now = Instant::now();
                // A look that is due soon stays, even if changes keep coming.
                looks.truncate(1);
                looks.extend(LOOKS.iter().map(|pause| now + *pause));
            }
            () = wait::sleep_until(looks.front().map(|at| (*at).into())) => {
                looks.pop_front();
                check_addresses(&nodes).await;
            }
        }
    }
}

fn log_no_events(error: &io::Error) {
    tracing::info!(%error, "cannot watch this computer's addresses; a lost one is not reported");
}

impl Nodes {
    /// The addresses that this computer has lost, and at which nodes are registered.
    pub(crate) fn lost_addresses(&self) -> Vec<LostAddress> {
        let lost = self.local.lost_addresses().into_iter();
        lost.map(|(address, (since, ports))| LostAddress {
            address,
            since: clock::wall_time_of(since).round(),
            nodes: names_at(self, &ports.into_iter().collect::<Vec<_>>()),
        })
        .collect()
    }
}

/// Finds lost and returned addresses, and asks unreachable nodes again at once.
async fn check_addresses(nodes: &Arc<Nodes>) {
    for port in nodes.local.ports_at_lost_addresses() {
        // The name may have another address by now.
        if let Some(addresses) = origin::addresses(&port, nodes.timeout).await {
            nodes.local.set_addresses(&port, addresses);
        }
    }
    let changes = nodes.local.update_addresses(resolver::is_own);
    if !changes.lost.is_empty() {
        let names = names_at(nodes, &changes.lost);
        rarely!(
            warn,
            ?names,
            at = ?changes.lost,
            "nodes are registered at an address that this computer has lost, so no node can connect to them; give it the address back, or restart these nodes"
        );
    }
    if !changes.returned.is_empty() {
        let names = names_at(nodes, &changes.returned);
        rarely!(
            info,
            ?names,
            "the address of these nodes is back; telling all nodes that use them"
        );
        notify_returned(nodes, &changes.returned);
    }
    nodes.lock().ask_all_at(Instant::now());
    nodes.changed.notify_one();
}

fn names_at(nodes: &Nodes, ports: &[String]) -> Vec<String> {
    nodes.ledger.with_mirror(|mirror| {
        let at = ports.iter().flat_map(|port| mirror.nodes_at(port));
        at.map(|(name, _)| name.to_owned()).collect()
    })
}

/// Tells the nodes at `ports`, and the subscribers of their topics, the present state.
fn notify_returned(nodes: &Arc<Nodes>, ports: &[String]) {
    notifications::notify_ports(nodes, ports);
    let names = names_at(nodes, ports);
    let topics: Vec<String> = nodes.ledger.with_mirror(|mirror| {
        let topics = names.iter().flat_map(|name| mirror.publications(name));
        topics.map(str::to_owned).collect()
    });
    for topic in topics {
        notifications::notify_subscribers(nodes, &topic);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(kind: u16, flags: u32) -> Vec<u8> {
        let mut message = vec![0; 32];
        message[..4].copy_from_slice(&32_u32.to_ne_bytes());
        message[4..6].copy_from_slice(&kind.to_ne_bytes());
        message[24..28].copy_from_slice(&flags.to_ne_bytes());
        message
    }

    #[test]
    fn addresses_and_links_that_packets_pass_or_not_are_changes() {
        let links = &mut BTreeMap::new();
        let mut change = |messages: &[Vec<u8>]| is_change(&messages.concat(), links);
        assert!(change(&[message(NEW_ADDRESS, 0)]));
        assert!(change(&[message(DELETED_ADDRESS, 0)]));
        assert!(change(&[message(NEW_LINK, 0x1_0043)]));
        // Wi-Fi drivers send such messages all the time.
        assert!(!change(&[message(NEW_LINK, 0x1_1043)]));
        assert!(change(&[message(99, 0), message(NEW_LINK, 0x3)]));
        assert!(!change(&[message(99, 0), vec![1, 2, 3]]));
        assert!(!change(&[]));
    }

    #[tokio::test]
    async fn the_kernel_can_be_listened_to() {
        let mut changes = Changes::open().unwrap();
        let waited = tokio::time::timeout(Duration::ZERO, changes.wait_for_change()).await;
        assert!(waited.is_err() || waited.is_ok_and(|changed| changed.is_ok()));
    }
}
