//! Nodes that do not answer and are not known to be dead.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use super::backoff::Backoff;

/// Pause before a suspect is asked for the first time again.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Pauses double up to this one.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

/// The addresses that are suspect, and when each is to be asked again.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Unreachable {
    of: BTreeMap<String, Backoff>,
}

impl Unreachable {
    /// The node at `api` did not answer just now. Answers whether it was no suspect before.
    pub fn add(&mut self, api: &str, now: Instant) -> bool {
        if self.of.contains_key(api) {
            return false;
        }
        let backoff = Backoff::new(now + FIRST_PAUSE, FIRST_PAUSE * 2);
        self.of.insert(api.to_owned(), backoff);
        true
    }

    /// The node at `api` has answered, or is no more. Answers whether it was a suspect.
    pub fn remove(&mut self, api: &str) -> bool {
        self.of.remove(api).is_some()
    }

    /// Drops those that are not registered any more.
    pub fn retain(&mut self, registered: impl Fn(&str) -> bool) {
        self.of.retain(|api, _| registered(api));
    }

    /// Whether the node at `api` is a suspect.
    pub fn contains(&self, api: &str) -> bool {
        self.of.contains_key(api)
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.of.is_empty()
    }

    /// Those to be asked now; the next time comes after a longer pause.
    pub fn due(&mut self, now: Instant) -> Vec<String> {
        let mut due = Vec::new();
        for (api, backoff) in &mut self.of {
            if backoff.next() <= now {
                backoff.done(now, LONGEST_PAUSE);
                due.push(api.clone());
            }
        }
        due
    }

    /// When somebody is to be asked next.
    pub fn next(&self) -> Option<Instant> {
        self.of.values().map(Backoff::next).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn suspects_are_asked_with_growing_pauses() {
        let start = Instant::now();
        let mut suspects = Unreachable::default();
        assert!(suspects.add("a", start) && !suspects.add("a", start));
        let mut asked = Vec::new();
        while asked.len() < 9 {
            let next = suspects.next().unwrap();
            assert_eq!(suspects.due(next), ["a"]);
            asked.push((next - start).as_secs());
        }
        assert_eq!(asked, [1, 3, 7, 15, 31, 63, 123, 183, 243]);
        assert_eq!(suspects.due(start), Vec::<String>::new());
        assert!(suspects.remove("a") && suspects.is_empty());
        assert_eq!(suspects.next(), None);
    }

    #[test]
    fn who_is_not_registered_any_more_is_no_suspect() {
        let mut suspects = Unreachable::default();
        suspects.add("a", Instant::now());
        suspects.add("b", Instant::now());
        suspects.retain(|api| api == "b");
        assert!(!suspects.contains("a") && suspects.contains("b"));
    }
}
