//! Nodes whose names were taken while another computer led: the next leader tells them to shut down, because the
//! previous one may have died before it did.

use std::{
    collections::{BTreeMap, VecDeque},
    time::{Duration, Instant},
};

use ros1_master::master::{Displaced, Master, Request};

/// How long it may take to tell a node to shut down, including retries.
const TELLING: Duration = Duration::from_secs(60);
/// How many nodes that lost their names are remembered.
const MOST: usize = 1024;

/// The nodes that lost their names to other nodes in the last minute, the oldest first.
#[derive(Debug, Default)]
pub struct DisplacedLately(VecDeque<(Instant, Displaced)>);

impl DisplacedLately {
    /// Notes the nodes that lose their names to other nodes when `call` is applied to `state`.
    pub fn note(&mut self, now: Instant, state: &Master, call: &Request) {
        let calls = call.calls().into_iter();
        self.add(now, calls.filter_map(|call| state.displaced_by(call)));
    }

    /// Adds nodes that lost their names to other nodes.
    pub fn add(&mut self, now: Instant, displaced: impl IntoIterator<Item = Displaced>) {
        self.0.extend(displaced.into_iter().map(|node| (now, node)));
        let is_old = |at: &Instant| now.duration_since(*at) >= TELLING;
        while self.0.len() > MOST || self.0.front().is_some_and(|(at, _)| is_old(at)) {
            self.0.pop_front();
        }
    }

    /// The nodes that lost their names to other nodes in the minute before `now`, one per address.
    pub fn at(&self, now: Instant) -> Vec<Displaced> {
        let lately = self.0.iter();
        let lately = lately.filter(|(at, _)| now.duration_since(*at) < TELLING);
        let by_api: BTreeMap<_, _> = lately.map(|(_, node)| (&node.api, node)).collect();
        by_api.into_values().cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros1_master::master::Method;

    fn publish(api: &str) -> Request {
        Request::new(Method::RegisterPublisher, ["/n", "/t", "x/Y", api])
    }

    #[test]
    fn who_was_displaced_is_remembered_for_a_minute() {
        let (mut state, mut lately) = (Master::default(), DisplacedLately::default());
        let start = Instant::now();
        let apis = |lately: &DisplacedLately, at| -> Vec<String> {
            lately.at(at).into_iter().map(|it| it.api).collect()
        };
        for (seconds, api) in [(0, "http://a:1/"), (1, "http://a:2/"), (30, "http://a:3/")] {
            let call = publish(api);
            let now = start + Duration::from_secs(seconds);
            lately.note(now, &state, &Request::multicall([call.clone()]));
            state.apply(&call);
        }
        let after = |seconds| start + Duration::from_secs(seconds);
        assert_eq!(apis(&lately, after(30)), ["http://a:1/", "http://a:2/"]);
        assert_eq!(apis(&lately, after(61)), ["http://a:2/"]);
        lately.add(after(90), lately.at(after(61)));
        assert_eq!(apis(&lately, after(149)), ["http://a:2/"]);
        assert_eq!(apis(&lately, after(150)), [""; 0]);
    }
}
