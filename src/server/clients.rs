//! Connected clients: a table for the status page.

use std::net::SocketAddr;

use dashmap::DashMap;

use crate::status::summary::Client;

/// Clients listed on the status page; there may be thousands.
const LISTED: usize = 1000;
/// Kept length of a caller id, in characters: a client may send any, and be idle for hours.
const CALLER_ID: usize = 200;

/// The connections of clients.
#[derive(Debug, Default)]
pub struct Clients(DashMap<SocketAddr, Seen>);

#[derive(Debug, Default)]
struct Seen {
    caller_id: String,
    calls: u64,
}

impl Clients {
    /// Lists a connection from `peer` until the result is dropped.
    pub fn enter(&self, peer: SocketAddr) -> Present<'_> {
        self.0.insert(peer, Seen::default());
        Present {
            clients: self,
            peer,
        }
    }

    pub fn called(&self, peer: SocketAddr, caller_id: &str) {
        let end = caller_id.char_indices().nth(CALLER_ID);
        let caller_id = end.map_or(caller_id, |(end, _)| caller_id.split_at(end).0);
        if let Some(mut seen) = self.0.get_mut(&peer) {
            seen.calls += 1;
            if seen.caller_id != caller_id {
                caller_id.clone_into(&mut seen.caller_id);
            }
        }
    }

    pub fn count(&self) -> usize {
        self.0.len()
    }

    /// The connections, by caller id, at most a thousand.
    pub(crate) fn list(&self) -> Vec<Client> {
        let clients = self.0.iter().take(LISTED).map(|entry| Client {
            peer: entry.key().to_string(),
            caller_id: entry.caller_id.clone(),
            calls: entry.calls,
        });
        let mut clients: Vec<_> = clients.collect();
        clients.sort_by(|a, b| (&a.caller_id, &a.peer).cmp(&(&b.caller_id, &b.peer)));
        clients
    }
}

/// Takes a connection off the list when it ends.
#[derive(Debug)]
pub struct Present<'a> {
    clients: &'a Clients,
    peer: SocketAddr,
}

impl Drop for Present<'_> {
    fn drop(&mut self) {
        self.clients.0.remove(&self.peer);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_client_is_listed_while_it_is_present() {
        let clients = Clients::default();
        let peer = "127.0.0.1:4000".parse().unwrap();
        let present = clients.enter(peer);
        clients.called(peer, "/talker");
        clients.called(peer, "/talker");
        let expected = Client {
            peer: peer.to_string(),
            caller_id: "/talker".to_owned(),
            calls: 2,
        };
        assert_eq!(clients.list(), [expected]);
        clients.called(peer, &"ü".repeat(1000));
        assert_eq!(clients.list()[0].caller_id, "ü".repeat(CALLER_ID));
        drop(present);
        assert_eq!(clients.count(), 0);
    }
}
