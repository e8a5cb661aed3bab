//! Writes that were sent to a leader, until this computer has read them in the journal. If it is cut off before, they
//! must not count as changes by other computers when it reads them.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use rescue_core::cluster::{member::ForwardedWrites, merge::weight, standing::JournalPosition};
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
    unanswered: BTreeMap<u64, Request>,
    /// The calls that the leader has answered, in this order, with the position that the journal as read here must reach.
    answered: VecDeque<(JournalPosition, Request)>,
}

impl Forwarded {
    fn lock(&self) -> MutexGuard<'_, Calls> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Remembers `call` until the result is dropped, because it is no longer waited for.
    pub(super) fn begin(self: &Arc<Self>, call: &Request) -> Option<Sent> {
        let bytes: usize = call.calls().into_iter().map(weight).sum();
        let mut calls = self.lock();
        if calls.unanswered.len() >= MOST || bytes > BYTES_MOST {
            return None;
        }
        calls.last += 1;
        let number = calls.last;
        calls.unanswered.insert(number, call.clone());
        let of = self.clone();
        Some(Sent { of, number })
    }

    /// The writes that may be missing in the journal as it was read up to `followed`.
    pub(crate) fn writes(&self, followed: JournalPosition) -> ForwardedWrites {
        let mut calls = self.lock();
        calls.forget_followed(followed);
        let unanswered = calls.unanswered.values();
        let answered = calls.answered.iter().map(|(_, call)| call);
        ForwardedWrites {
            unanswered: unanswered.flat_map(writes_in).collect(),
            answered: answered.flat_map(writes_in).collect(),
        }
    }
}

impl Calls {
    fn forget_followed(&mut self, followed: JournalPosition) {
        while let Some((shown, _)) = self.answered.front()
            && followed.shows(*shown)
        {
            self.answered.pop_front();
        }
    }
}

fn writes_in(call: &Request) -> impl Iterator<Item = Request> + use<> {
    let calls = call.calls().into_iter();
    let writes = calls.filter(|call| call.kind().mutates()).cloned();
    writes.collect::<Vec<_>>().into_iter()
}

/// A call that was sent to a leader.
pub(super) struct Sent {
    of: Arc<Forwarded>,
    number: u64,
}

impl Sent {
    /// Notes that the leader has answered, and the journal includes the call at position `shown` at the latest. It has
    /// been read up to `followed`.
    pub(super) fn answered(self, shown: JournalPosition, followed: JournalPosition) {
        let mut calls = self.of.lock();
        calls.forget_followed(followed);
        if let Some(call) = calls.unanswered.remove(&self.number)
            && !followed.shows(shown)
        {
            calls.answered.push_back((shown, call));
            if calls.answered.len() > MOST {
                calls.answered.pop_front();
            }
        }
    }
}

impl Drop for Sent {
    fn drop(&mut self) {
        self.of.lock().unanswered.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::master::Method;

    fn set(key: &str) -> Request {
        Request::new(Method::SetParam, ["/n", key, "v"])
    }

    fn at(seq: u64) -> JournalPosition {
        let term = 1;
        JournalPosition {
            term,
            seq,
            ..JournalPosition::default()
        }
    }

    #[test]
    fn a_write_is_remembered_until_it_has_been_read_in_the_journal() {
        let get = Request::new(Method::GetParam, ["/n", "/a"]);
        let forwarded = Arc::new(Forwarded::default());
        let first = forwarded.begin(&set("/a")).unwrap();
        let second = forwarded.begin(&Request::multicall([get, set("/b")]));
        let third = forwarded.begin(&set("/c")).unwrap();
        let writes = forwarded.writes(at(1));
        assert_eq!(writes.unanswered, [set("/a"), set("/b"), set("/c")]);
        drop(second);
        first.answered(at(2), at(1));
        third.answered(at(3), at(1));
        let writes = forwarded.writes(at(1));
        assert_eq!(
            (writes.unanswered, writes.answered),
            (vec![], vec![set("/a"), set("/c")])
        );
        assert_eq!(forwarded.writes(at(2)).answered, [set("/c")]);
        // The watch on etcd was faster than the leader's answer.
        let fourth = forwarded.begin(&set("/d")).unwrap();
        fourth.answered(at(4), at(4));
        assert_eq!(forwarded.writes(at(4)).answered, []);
    }

    #[test]
    fn only_so_much_is_remembered() {
        let forwarded = Arc::new(Forwarded::default());
        let large = "x".repeat(BYTES_MOST + 1);
        let large = Request::new(Method::SetParam, ["/n", "/a", large.as_str()]);
        assert!(forwarded.begin(&large).is_none());
        for _ in 0..=MOST {
            let sent = forwarded.begin(&set("/a")).unwrap();
            sent.answered(at(2), at(1));
        }
        let sent: Vec<_> = (0..=MOST).map(|_| forwarded.begin(&set("/a"))).collect();
        assert_eq!(sent.iter().flatten().count(), MOST);
        assert_eq!(forwarded.writes(at(1)).answered.len(), MOST);
    }
}
