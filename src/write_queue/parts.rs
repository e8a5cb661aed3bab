//! Sends long multicalls to the master in parts, so that other writes pass in between. No client can rely on a
//! multicall running in one step: in rosmaster, entries of concurrent multicalls take turns.

use std::{iter::Peekable, vec};

use ros1_master::{
    master::{Entry, Kind, Method, Request},
    xmlrpc::Value,
};

use super::batch::{BYTES_MAX, CALLS_MAX};

/// Maximum number of entries of a multicall that is sent whole, as the client's own bytes.
const ENTRIES_WHOLE: usize = 2 * CALLS_MAX;

/// The parts of a long multicall, in order. Each is a multicall of a batch's size.
pub(crate) struct Parts(Peekable<vec::IntoIter<Entry>>);

impl Parts {
    /// Splits `call`. `None` if it must be sent whole. `bytes` is the length of its body.
    pub(crate) fn split(call: &mut Option<Request>, bytes: usize) -> Option<Self> {
        let call = call.take_if(|call| {
            let entries = call.entries();
            (entries.len() > ENTRIES_WHOLE || entries.len() > 1 && bytes > BYTES_MAX)
                && entries.iter().all(is_independent)
        })?;
        Some(Self(call.into_entries().into_iter().peekable()))
    }
}

impl Iterator for Parts {
    type Item = Request;

    fn next(&mut self) -> Option<Request> {
        let (mut entries, mut bytes) = (Vec::new(), 0);
        while entries.len() < CALLS_MAX
            && let Some(entry) = self.0.next_if(|next| {
                bytes += weight(next);
                entries.is_empty() || bytes <= BYTES_MAX
            })
        {
            entries.push(entry);
        }
        (!entries.is_empty()).then(|| Request::of_entries(entries))
    }
}

/// Whether the entry's result is independent of other entries. A malformed entry, or a parameter's value that the
/// master cannot return, turns the whole multicall into a fault. A dict among the results also shows the writes of
/// later entries.
fn is_independent(entry: &Entry) -> bool {
    let Entry::Request(call) = entry else {
        return false;
    };
    let depends = [Method::GetParam, Method::SubscribeParam, Method::Multicall];
    !depends.contains(call.method()) && !matches!(call.kind(), Kind::Unknown | Kind::Shutdown)
}

fn weight(entry: &Entry) -> usize {
    match entry {
        Entry::Request(call) => call.params().iter().map(Value::size).sum(),
        Entry::Refused(_) | Entry::Malformed(_) => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::master::Malformed;

    /// The multicall with a malformed entry added at its end.
    fn malformed(call: Request) -> Request {
        let mut entries = call.into_entries();
        entries.push(Entry::Malformed(Malformed::Arity));
        Request::of_entries(entries)
    }

    fn set(value: &str) -> Request {
        Request::new(Method::SetParam, ["/n", "/a", value])
    }

    fn many(count: usize) -> Vec<Request> {
        (0..count).map(|index| set(&index.to_string())).collect()
    }

    fn sizes(call: Request, bytes: usize) -> Option<Vec<usize>> {
        let parts = Parts::split(&mut Some(call), bytes)?;
        Some(parts.map(|part| part.entries().len()).collect())
    }

    #[test]
    fn only_a_long_multicall_is_taken_apart() {
        assert_eq!(sizes(set("1"), 2 * BYTES_MAX), None);
        assert_eq!(sizes(Request::multicall(many(ENTRIES_WHOLE)), 0), None);
        let long = Request::multicall(many(ENTRIES_WHOLE + 50));
        assert_eq!(sizes(long, 0), Some(vec![CALLS_MAX, CALLS_MAX, 50]));
    }

    #[test]
    fn parts_are_bounded_in_bytes_and_keep_the_order() {
        let half = "x".repeat(BYTES_MAX / 2);
        let values = ["1", &half, &half, "2", "3"];
        let call = Request::multicall(values.map(set));
        assert_eq!(sizes(call.clone(), 0), None);
        assert_eq!(sizes(call.clone(), 2 * BYTES_MAX), Some(vec![2, 3]));
        let mut whole = Some(call.clone());
        let parts = Parts::split(&mut whole, 2 * BYTES_MAX).unwrap();
        assert_eq!(whole, None);
        let entries = parts.flat_map(Request::into_entries).collect();
        assert_eq!(Request::of_entries(entries), call);
        let large = "x".repeat(2 * BYTES_MAX);
        let call = Request::multicall([set(&large), set(&large)]);
        assert_eq!(sizes(call, 4 * BYTES_MAX), Some(vec![1, 1]));
    }

    #[test]
    fn entries_that_affect_each_other_keep_the_multicall_whole() {
        let with = |last: Request| Request::multicall(many(1000).into_iter().chain([last]));
        let of = |method| Request::new(method, ["/n", "/a", "/a"]);
        assert!(sizes(with(of(Method::HasParam)), 0).is_some());
        for call in [
            with(of(Method::GetParam)),
            with(of(Method::SubscribeParam)),
            with(of(Method::Shutdown)),
            with(of(Method::named("system.listMethods"))),
            with(Request::multicall([])),
            malformed(Request::multicall(many(1000))),
        ] {
            let mut whole = Some(call.clone());
            assert!(Parts::split(&mut whole, 0).is_none());
            assert_eq!(whole, Some(call));
        }
    }
}
