//! A table of connected clients, for the status page.

use std::{
    collections::HashMap,
    net::SocketAddr,
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use dashmap::DashMap;

use crate::{
    clock,
    status::{
        report::ms,
        summary::{Caller, ClientStatus},
    },
};

/// Maximum number of clients listed on the status page. There may be thousands.
const LISTED: usize = 1000;
/// Maximum number of characters of a caller id that are kept. A client may send a caller id of any length, and stay
/// connected for hours.
const CALLER_ID: usize = 200;

/// Maximum number of callers of ended connections whose times are kept. Tools use a new name each time.
const CALLERS: usize = 256;

/// The connections of clients, and how long their calls took.
#[derive(Debug, Default)]
pub struct Clients {
    present: DashMap<SocketAddr, Seen>,
    /// How long the calls took of callers whose connections have ended or are now used by another caller.
    past: Mutex<HashMap<String, Times>>,
}

#[derive(Debug, Default)]
struct Seen {
    caller_id: String,
    calls: u64,
    /// How long the calls of the present caller took.
    times: Times,
}

impl Seen {
    /// The caller id, or the client's address if it sends none.
    fn caller(&self, peer: &SocketAddr) -> String {
        match self.caller_id.as_str() {
            "" => peer.ip().to_string(),
            id => id.to_owned(),
        }
    }
}

/// How long a caller's calls took.
#[derive(Clone, Copy, Debug, Default)]
struct Times {
    calls: u64,
    all: Duration,
    longest: Duration,
    longest_at: Option<Instant>,
}

impl Times {
    fn add(&mut self, other: Self) {
        self.calls += other.calls;
        self.all += other.all;
        if other.longest > self.longest {
            (self.longest, self.longest_at) = (other.longest, other.longest_at);
        }
    }
}

impl Clients {
    /// Lists a connection from `peer` until the result is dropped.
    pub fn enter(&self, peer: SocketAddr) -> ListedClient<'_> {
        self.present.insert(peer, Seen::default());
        ListedClient {
            clients: self,
            peer,
        }
    }

    pub fn called(&self, peer: SocketAddr, caller_id: &str) {
        let end = caller_id.char_indices().nth(CALLER_ID);
        let caller_id = end.map_or(caller_id, |(end, _)| caller_id.split_at(end).0);
        if let Some(mut seen) = self.present.get_mut(&peer) {
            seen.calls += 1;
            if seen.caller_id != caller_id {
                self.add_past(seen.caller(&peer), std::mem::take(&mut seen.times));
                caller_id.clone_into(&mut seen.caller_id);
            }
        }
    }

    /// Notes that the call of `peer` that began at `start` has ended, with or without an answer. Returns its duration.
    pub fn end_call(&self, peer: SocketAddr, start: Instant) -> Duration {
        let now = Instant::now();
        let longest = now.duration_since(start);
        if let Some(mut seen) = self.present.get_mut(&peer) {
            seen.times.add(Times {
                calls: 1,
                all: longest,
                longest,
                longest_at: Some(now),
            });
        }
        longest
    }

    fn past(&self) -> MutexGuard<'_, HashMap<String, Times>> {
        self.past.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps how long the calls of a caller took. If there are too many, callers without a long call are dropped first.
    fn add_past(&self, caller: String, times: Times) {
        if times.calls == 0 {
            return;
        }
        let mut past = self.past();
        past.entry(caller).or_default().add(times);
        if past.len() > CALLERS {
            let quickest = past.iter().min_by_key(|(_, times)| times.longest);
            if let Some(caller) = quickest.map(|(caller, _)| caller.clone()) {
                past.remove(&caller);
            }
        }
    }

    /// The callers with the longest calls, at most `most`.
    pub(crate) fn slowest(&self, most: usize) -> Vec<Caller> {
        let mut all = self.past().clone();
        for entry in &self.present {
            if entry.times.calls > 0 {
                all.entry(entry.caller(entry.key()))
                    .or_default()
                    .add(entry.times);
            }
        }
        let mut all: Vec<_> = all.into_iter().collect();
        all.sort_by(|(a, one), (b, other)| (other.longest, a).cmp(&(one.longest, b)));
        let callers = all.into_iter().take(most).map(|(caller, times)| Caller {
            caller,
            calls: times.calls,
            mean_ms: ms(times.all / u32::try_from(times.calls).unwrap_or(u32::MAX)),
            longest_ms: ms(times.longest),
            longest_at: times.longest_at.map_or(0.0, clock::wall_time_of),
        });
        callers.collect()
    }

    /// The connections sorted by caller id, at most [`LISTED`].
    pub(crate) fn list(&self) -> Vec<ClientStatus> {
        let clients = self.present.iter().take(LISTED).map(|entry| ClientStatus {
            peer: entry.key().to_string(),
            caller_id: entry.caller_id.clone(),
            calls: entry.calls,
        });
        let mut clients: Vec<_> = clients.collect();
        clients.sort_by(|a, b| (&a.caller_id, &a.peer).cmp(&(&b.caller_id, &b.peer)));
        clients
    }
}

/// Removes a connection from the list when it ends.
#[derive(Debug)]
pub struct ListedClient<'a> {
    clients: &'a Clients,
    peer: SocketAddr,
}

impl Drop for ListedClient<'_> {
    fn drop(&mut self) {
        if let Some((peer, seen)) = self.clients.present.remove(&self.peer) {
            self.clients.add_past(seen.caller(&peer), seen.times);
        }
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
        let expected = ClientStatus {
            peer: peer.to_string(),
            caller_id: "/talker".to_owned(),
            calls: 2,
        };
        assert_eq!(clients.list(), [expected]);
        clients.called(peer, &"ü".repeat(1000));
        assert_eq!(clients.list()[0].caller_id, "ü".repeat(CALLER_ID));
        drop(present);
        assert_eq!(clients.present.len(), 0);
    }

    #[test]
    fn the_slowest_callers_are_known_after_they_have_gone() {
        let clients = Clients::default();
        let now = Instant::now();
        let ago = |ms| now.checked_sub(Duration::from_millis(ms)).unwrap();
        let call = |peer: &str, caller_id: &str, ms| {
            let peer = peer.parse().unwrap();
            let present = clients.enter(peer);
            clients.called(peer, caller_id);
            clients.end_call(peer, ago(ms));
            present
        };
        let stays = call("127.0.0.1:1", "/slow", 1_000);
        drop(call("127.0.0.1:2", "/slow", 3_000));
        drop(call("127.0.0.1:3", "", 2_000));
        for number in 0..2 * CALLERS {
            drop(call("127.0.0.1:4", &format!("/tool_{number}"), 1));
        }
        assert_eq!(clients.past().len(), CALLERS);
        let slowest = clients.slowest(2);
        let names: Vec<_> = slowest.iter().map(|caller| &*caller.caller).collect();
        assert_eq!(names, ["/slow", "127.0.0.1"]);
        assert_eq!(slowest[0].calls, 2);
        assert!((2_999.0..4_000.0).contains(&slowest[0].longest_ms));
        assert!((1_999.0..3_000.0).contains(&slowest[0].mean_ms));
        drop(stays);
    }

    #[test]
    fn a_connection_that_another_caller_uses_counts_for_both() {
        let clients = Clients::default();
        let peer = "127.0.0.1:4000".parse().unwrap();
        let _present = clients.enter(peer);
        for caller_id in ["/a", "/b"] {
            clients.called(peer, caller_id);
            clients.end_call(peer, Instant::now());
        }
        assert_eq!(clients.slowest(5).len(), 2);
        assert_eq!(clients.list()[0].calls, 2);
    }
}
