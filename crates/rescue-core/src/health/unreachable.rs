//! Keeps track of nodes that do not answer although there is no proof that they are dead.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use super::backoff::Backoff;

/// Pause before an unreachable node is asked again for the first time.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Longest pause before a node is asked again. Pauses double up to this length.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

/// The unreachable ports, and when to ask each one next.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Unreachable {
    of: BTreeMap<String, Wait>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Wait {
    backoff: Backoff,
    /// Whether the question to the port is unanswered.
    asked: bool,
    /// Whether the port has failed a health check.
    failed_check: bool,
}

impl Unreachable {
    /// Notes that a port has not answered a notification or, if `in_check` is true, a health check. Returns whether it
    /// was reachable before.
    pub fn add(&mut self, port: &str, now: Instant, in_check: bool) -> bool {
        if let Some(wait) = self.of.get_mut(port) {
            wait.failed_check |= in_check;
            if std::mem::take(&mut wait.asked) {
                wait.backoff.done(now, LONGEST_PAUSE);
            }
            return false;
        }
        let wait = Wait {
            backoff: Backoff::new(now + FIRST_PAUSE, FIRST_PAUSE * 2),
            asked: false,
            failed_check: in_check,
        };
        self.of.insert(port.to_owned(), wait);
        true
    }

    /// Removes a port that has answered or has no nodes any more. Returns whether it was unreachable.
    pub fn remove(&mut self, port: &str) -> bool {
        self.of.remove(port).is_some()
    }

    /// Lets all ports be asked at `now`, and again soon if they do not answer.
    pub fn ask_all_at(&mut self, now: Instant) {
        for wait in self.of.values_mut() {
            wait.backoff = Backoff::new(now, FIRST_PAUSE);
        }
    }

    /// Removes ports at which no node is registered any more.
    pub fn retain(&mut self, registered: impl Fn(&str) -> bool) {
        self.of.retain(|port, _| registered(port));
    }

    /// Whether the port has failed a health check since it last answered. Only then may its nodes be unregistered when
    /// it refuses connections later.
    pub fn has_failed_check(&self, port: &str) -> bool {
        self.of.get(port).is_some_and(|wait| wait.failed_check)
    }

    pub fn contains(&self, port: &str) -> bool {
        self.of.contains_key(port)
    }

    pub fn is_empty(&self) -> bool {
        self.of.is_empty()
    }

    /// The ports to ask now. Returns a port again only after another call of [`Self::add`], so no port is asked twice
    /// at the same time. The pauses grow.
    pub fn take_due(&mut self, now: Instant) -> Vec<String> {
        let waiting = self.of.iter_mut().filter(|(_, wait)| !wait.asked);
        let due = waiting.filter(|(_, wait)| wait.backoff.next() <= now);
        due.map(|(port, wait)| {
            wait.asked = true;
            port.clone()
        })
        .collect()
    }

    /// When to ask the next port.
    pub fn next(&self) -> Option<Instant> {
        let waiting = self.of.values().filter(|wait| !wait.asked);
        waiting.map(|wait| wait.backoff.next()).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unreachable_nodes_are_asked_again_with_growing_pauses() {
        let start = Instant::now();
        let mut unreachable = Unreachable::default();
        assert!(unreachable.add("a", start, true) && !unreachable.add("a", start, true));
        let mut asked = Vec::new();
        while asked.len() < 9 {
            let next = unreachable.next().unwrap();
            assert_eq!(unreachable.take_due(next), ["a"]);
            assert!(!unreachable.add("a", next, true));
            asked.push((next - start).as_secs());
        }
        assert_eq!(asked, [1, 3, 7, 15, 31, 63, 123, 183, 243]);
        assert_eq!(unreachable.take_due(start), Vec::<String>::new());
        assert!(unreachable.remove("a") && unreachable.is_empty());
        assert_eq!(unreachable.next(), None);
    }

    #[test]
    fn a_node_that_is_being_asked_is_not_asked_again() {
        let start = Instant::now();
        let mut unreachable = Unreachable::default();
        unreachable.add("a", start, true);
        let late = start + Duration::from_secs(100);
        assert_eq!(unreachable.take_due(late), ["a"]);
        assert_eq!(unreachable.next(), None);
        assert_eq!(unreachable.take_due(late), Vec::<String>::new());
        unreachable.add("a", late, true);
        assert_eq!(unreachable.next(), Some(late + FIRST_PAUSE * 2));
    }

    #[test]
    fn all_nodes_are_asked_at_once_when_a_link_is_back() {
        let start = Instant::now();
        let mut unreachable = Unreachable::default();
        unreachable.add("a", start, true);
        unreachable.add("b", start, true);
        let late = start + Duration::from_secs(100);
        assert_eq!(unreachable.take_due(late), ["a", "b"]);
        unreachable.add("a", late, true);
        let back = late + Duration::from_millis(1);
        unreachable.ask_all_at(back);
        assert_eq!(
            unreachable.take_due(back),
            ["a"],
            "the other one is being asked"
        );
        unreachable.add("b", back, true);
        assert_eq!(unreachable.next(), Some(back + FIRST_PAUSE));
    }

    #[test]
    fn a_node_that_is_no_longer_registered_is_not_unreachable() {
        let mut unreachable = Unreachable::default();
        unreachable.add("a", Instant::now(), true);
        unreachable.add("b", Instant::now(), true);
        unreachable.retain(|port| port == "b");
        assert!(!unreachable.contains("a") && unreachable.contains("b"));
    }
    #[test]
    fn a_port_that_refused_a_notification_has_failed_no_check() {
        let now = Instant::now();
        let mut unreachable = Unreachable::default();
        unreachable.add("a", now, false);
        assert!(!unreachable.has_failed_check("a"));
        unreachable.add("a", now, true);
        unreachable.add("a", now, false);
        assert!(unreachable.has_failed_check("a"));
        unreachable.remove("a");
        assert!(!unreachable.has_failed_check("a"));
    }
}
