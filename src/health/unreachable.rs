//! Nodes that do not answer and are not known to be dead.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use super::backoff::Backoff;

/// Pause before an unreachable node is asked again for the first time.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Pauses double up to this one.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

/// The unreachable addresses, and when each is asked next.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Unreachable {
    of: BTreeMap<String, Backoff>,
}

impl Unreachable {
    /// Adds a node that has not answered. Returns whether that is new.
    pub(crate) fn add(&mut self, api: &str, now: Instant) -> bool {
        if self.of.contains_key(api) {
            return false;
        }
        let backoff = Backoff::new(now + FIRST_PAUSE, FIRST_PAUSE * 2);
        self.of.insert(api.to_owned(), backoff);
        true
    }

    /// Removes a node that has answered or is gone. Returns whether it was unreachable.
    pub(crate) fn remove(&mut self, api: &str) -> bool {
        self.of.remove(api).is_some()
    }

    /// Drops those that are not registered any more.
    pub(crate) fn retain(&mut self, registered: impl Fn(&str) -> bool) {
        self.of.retain(|api, _| registered(api));
    }

    pub(crate) fn contains(&self, api: &str) -> bool {
        self.of.contains_key(api)
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.of.is_empty()
    }

    /// Addresses to ask now. Each following pause is longer.
    pub(crate) fn due(&mut self, now: Instant) -> Vec<String> {
        let mut due = Vec::new();
        for (api, backoff) in &mut self.of {
            if backoff.next() <= now {
                backoff.done(now, LONGEST_PAUSE);
                due.push(api.clone());
            }
        }
        due
    }

    /// When the next node is due.
    pub(crate) fn next(&self) -> Option<Instant> {
        self.of.values().map(Backoff::next).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unreachable_nodes_are_asked_with_growing_pauses() {
        let start = Instant::now();
        let mut unreachable = Unreachable::default();
        assert!(unreachable.add("a", start) && !unreachable.add("a", start));
        let mut asked = Vec::new();
        while asked.len() < 9 {
            let next = unreachable.next().unwrap();
            assert_eq!(unreachable.due(next), ["a"]);
            asked.push((next - start).as_secs());
        }
        assert_eq!(asked, [1, 3, 7, 15, 31, 63, 123, 183, 243]);
        assert_eq!(unreachable.due(start), Vec::<String>::new());
        assert!(unreachable.remove("a") && unreachable.is_empty());
        assert_eq!(unreachable.next(), None);
    }

    #[test]
    fn who_is_not_registered_any_more_is_not_unreachable() {
        let mut unreachable = Unreachable::default();
        unreachable.add("a", Instant::now());
        unreachable.add("b", Instant::now());
        unreachable.retain(|api| api == "b");
        assert!(!unreachable.contains("a") && unreachable.contains("b"));
    }
}
