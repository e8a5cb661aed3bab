//! Notifications that we send beside the master, whose own may be late.
//!
//! rosmaster makes each list of publishers when something changes, and sends it when one of its
//! threads gets to it: after minutes, where nodes that cannot be reached hold them up. So we tell the change
//! ourselves, but not before the master would have done so if nothing held it up: a list of its
//! that comes after a newer one of ours makes roscpp nodes drop links, until they are told anew. And
//! we tell them again and again, because such a list may still be on its way.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use super::backoff::Backoff;

/// How long nothing must have changed before we tell it: idle threads of rosmaster look for work
/// every 100 ms.
const QUIET: Duration = Duration::from_millis(300);
/// Longest delay of a notification whose subject keeps changing.
const LATEST: Duration = Duration::from_millis(600);
/// Pause before it is told again.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Pauses double up to this one.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);
/// How long after the last change it is told again: two connects of rosmaster that get no answer.
const LIFE: Duration = Duration::from_secs(300);

/// What has changed, and when it is to be told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Repeats<K: Ord> {
    of: BTreeMap<K, Wait>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Wait {
    /// The first change that has not been told, if there is one.
    untold: Option<Instant>,
    backoff: Backoff,
    end: Instant,
    /// Somebody held up the master since the change.
    held_up: bool,
}

impl<K: Ord> Default for Repeats<K> {
    fn default() -> Self {
        Self {
            of: BTreeMap::new(),
        }
    }
}

impl<K: Ord + Clone> Repeats<K> {
    /// `key` has changed.
    pub(crate) fn changed(&mut self, key: K, now: Instant) {
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

    /// What is to be told now. `holding_up`: there are nodes that do not answer. While all do, the
    /// master notifies nodes itself.
    pub(crate) fn due(&mut self, now: Instant, holding_up: bool) -> Vec<K> {
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

    /// When something is to be told next.
    pub(crate) fn next(&self) -> Option<Instant> {
        self.of.values().map(|wait| wait.backoff.next()).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_told_while_everybody_answers() {
        let start = Instant::now();
        let mut repeats = Repeats::default();
        repeats.changed("/t", start);
        let next = repeats.next().unwrap();
        assert_eq!(repeats.due(next, false), Vec::<&str>::new());
        assert_eq!(repeats.next(), None);
    }

    #[test]
    fn it_is_told_again_for_as_long_as_the_master_may_be_late() {
        let start = Instant::now();
        let mut repeats = Repeats::default();
        repeats.changed("/t", start);
        let mut told = Vec::new();
        while let Some(next) = repeats.next() {
            // Also when they answer again: a thread may still hang.
            told.extend(repeats.due(next, told.is_empty()).iter().map(|_| next));
        }
        let times: Vec<_> = told.iter().map(|at| (*at - start).as_millis()).collect();
        let first = [300, 1300, 3300, 7300, 15_300, 25_300, 35_300];
        assert_eq!(times.get(..7).unwrap(), first);
        assert_eq!(times.last(), Some(&305_300));
    }

    #[test]
    fn what_changes_all_the_time_is_told_nevertheless() {
        let start = Instant::now();
        let step = Duration::from_millis(100);
        let mut repeats = Repeats::default();
        let mut told = Vec::new();
        for i in 0..20 {
            let now = start + step * i;
            told.extend(repeats.due(now, true).iter().map(|_| i));
            repeats.changed("/t", now);
        }
        assert_eq!(told, [6, 12, 18]);
    }
}
