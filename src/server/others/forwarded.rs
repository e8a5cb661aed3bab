//! Writes that were sent to a leader and are not answered yet. If this computer is cut off before the answers arrive,
//! the writes may still be in the journal. In the journal they must not count as changes by other computers.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use rescue_core::cluster::merge::weight;
use ros1_master::master::Request;

/// Maximum number of calls that are remembered.
const MOST: usize = 1000;
/// Maximum number of bytes of one call, approximately. A call that is too large to remember is later reported as lost,
/// although it is in the journal.
const BYTES_MOST: usize = 1 << 20;

/// The calls that were sent to a leader.
#[derive(Debug, Default)]
pub(crate) struct Forwarded(Mutex<Calls>);

#[derive(Debug, Default)]
struct Calls {
    last: u64,
    calls: BTreeMap<u64, Request>,
}

impl Forwarded {
    fn lock(&self) -> MutexGuard<'_, Calls> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Remembers `call` until the result is dropped, because it was answered or is no longer waited for.
    pub(super) fn begin(self: &Arc<Self>, call: &Request) -> Option<Sent> {
        let bytes: usize = call.calls().into_iter().map(weight).sum();
        let mut calls = self.lock();
        if calls.calls.len() >= MOST || bytes > BYTES_MOST {
            return None;
        }
        calls.last += 1;
        let number = calls.last;
        calls.calls.insert(number, call.clone());
        let of = self.clone();
        Some(Sent { of, number })
    }

    /// The writes that were sent to a leader and are not answered yet.
    pub(crate) fn writes(&self) -> Vec<Request> {
        let calls = self.lock();
        let calls = calls.calls.values().flat_map(Request::calls);
        let writes = calls.filter(|call| call.kind().mutates());
        writes.cloned().collect()
    }
}

/// A call that was sent to a leader.
pub(super) struct Sent {
    of: Arc<Forwarded>,
    number: u64,
}

impl Drop for Sent {
    fn drop(&mut self) {
        self.of.lock().calls.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::master::Method;

    #[test]
    fn a_write_is_remembered_until_it_is_answered() {
        let set = |key: &str| Request::new(Method::SetParam, ["/n", key, "v"]);
        let get = Request::new(Method::GetParam, ["/n", "/a"]);
        let forwarded = Arc::new(Forwarded::default());
        let first = forwarded.begin(&set("/a"));
        let second = forwarded.begin(&Request::multicall([get, set("/b")]));
        assert_eq!(forwarded.writes(), [set("/a"), set("/b")]);
        drop(first);
        assert_eq!(forwarded.writes(), [set("/b")]);
        drop(second);
        assert_eq!(forwarded.writes(), []);
        let large = "x".repeat(BYTES_MOST + 1);
        let large = Request::new(Method::SetParam, ["/n", "/a", large.as_str()]);
        assert!(forwarded.begin(&large).is_none());
        let sent: Vec<_> = (0..=MOST).map(|_| forwarded.begin(&set("/a"))).collect();
        assert_eq!(sent.iter().flatten().count(), MOST);
    }
}
