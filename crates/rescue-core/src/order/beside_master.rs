//! Decides when rosrescue itself notifies nodes of a changed topic or parameter, because the master's notifications may
//! be late.
//!
//! rosmaster makes a list of publishers when something changes, but sends it only when one of its threads is free. If
//! unreachable nodes hold up these threads, that takes minutes. So rosrescue sends the change as well, but no earlier
//! than an undisturbed master would. If the master's older list arrived after rosrescue's newer one, roscpp nodes would
//! drop connections until the next notification. The master's older list may come even later, so rosrescue repeats its
//! notification.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use crate::health::backoff::Backoff;

/// How long a topic or parameter must be unchanged before its notification. Idle threads of rosmaster look for work
/// every 100 ms.
const QUIET: Duration = Duration::from_millis(300);
/// Longest delay of a notification while its topic or parameter keeps changing.
const LATEST: Duration = Duration::from_millis(600);
/// Pause before the first repeat.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Longest pause between two repeats. Pauses double up to this length.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);
/// How long after the last change of a topic or parameter its notification is repeated. Two connection attempts of
/// rosmaster that get no answer take about this time.
const LIFE: Duration = Duration::from_secs(300);

/// The changed topics and parameters, each with the time of its next notification.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BesideMaster<K: Ord> {
    of: BTreeMap<K, Wait>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Wait {
    /// When the topic or parameter first changed since its last notification. `None` if it has not.
    untold: Option<Instant>,
    backoff: Backoff,
    end: Instant,
    /// Whether an unreachable node has held up the master since the change.
    held_up: bool,
}

impl<K: Ord> Default for BesideMaster<K> {
    fn default() -> Self {
        Self {
            of: BTreeMap::new(),
        }
    }
}

impl<K: Ord + Clone> BesideMaster<K> {
    /// Notes that `key` has changed.
    pub fn changed(&mut self, key: K, now: Instant) {
        let before = self.of.get(&key);
        let untold = before.and_then(|wait| wait.untold).unwrap_or(now);
        let wait = Wait {
            untold: Some(untold),
            backoff: Backoff::new((now + QUIET).min(untold + LATEST), FIRST_PAUSE),
            end: now + LIFE,
            held_up: before.is_some_and(|wait| wait.held_up),
        };
        self.of.insert(key, wait);
    }

    /// The notifications to send now. `holding_up` says whether there are unreachable nodes. A topic or parameter is
    /// dropped if all nodes have been reachable since its change, because the master then notifies nodes in time.
    pub fn take_due(&mut self, now: Instant, holding_up: bool) -> Vec<K> {
        let mut due = Vec::new();
        self.of.retain(|key, wait| {
            if wait.backoff.next() > now {
                return true;
            }
            wait.held_up |= holding_up;
            wait.untold = None;
            wait.backoff.done(now, LONGEST_PAUSE);
            if wait.held_up {
                due.push(key.clone());
            }
            wait.held_up && now < wait.end
        });
        due
    }

    /// When to send the next notification.
    pub fn next(&self) -> Option<Instant> {
        self.of.values().map(|wait| wait.backoff.next()).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_notification_is_due_while_all_nodes_answer() {
        let start = Instant::now();
        let mut repeats = BesideMaster::default();
        repeats.changed("/t", start);
        let next = repeats.next().unwrap();
        assert_eq!(repeats.take_due(next, false), Vec::<&str>::new());
        assert_eq!(repeats.next(), None);
    }

    #[test]
    fn a_notification_is_repeated_as_long_as_the_master_may_be_late() {
        let start = Instant::now();
        let mut repeats = BesideMaster::default();
        repeats.changed("/t", start);
        let mut told = Vec::new();
        while let Some(next) = repeats.next() {
            // The repeats continue when all nodes answer again, because a thread of the master may still hang.
            told.extend(repeats.take_due(next, told.is_empty()).iter().map(|_| next));
        }
        let times: Vec<_> = told.iter().map(|at| (*at - start).as_millis()).collect();
        let first = [300, 1300, 3300, 7300, 15_300, 25_300, 35_300];
        assert_eq!(times.get(..7).unwrap(), first);
        assert_eq!(times.last(), Some(&305_300));
    }

    #[test]
    fn a_subject_that_keeps_changing_is_notified_nevertheless() {
        let start = Instant::now();
        let step = Duration::from_millis(100);
        let mut repeats = BesideMaster::default();
        let mut told = Vec::new();
        for i in 0..20 {
            let now = start + step * i;
            told.extend(repeats.take_due(now, true).iter().map(|_| i));
            repeats.changed("/t", now);
        }
        assert_eq!(told, [6, 12, 18]);
    }
}
