//! Notifications that rosrescue sends because the master's own may be late.
//!
//! rosmaster makes each list of publishers when something changes, but sends it when one of its threads is
//! free: after minutes, if unreachable nodes hold them up. So rosrescue sends the change itself, but not
//! earlier than an unhindered master would: an old list from the master that arrives after our newer one
//! makes roscpp nodes drop links until the next notification. Such a list may still be on its way, so our
//! notification is repeated.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use super::backoff::Backoff;

/// How long a subject must be unchanged before its notification: idle threads of rosmaster look for work
/// every 100 ms.
const QUIET: Duration = Duration::from_millis(300);
/// Longest delay of a notification whose subject keeps changing.
const LATEST: Duration = Duration::from_millis(600);
/// Pause before the first repetition.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Pauses double up to this one.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);
/// How long after the last change it is repeated: two connects of rosmaster without an answer.
const LIFE: Duration = Duration::from_secs(300);

/// Changed subjects, and when each notification is due.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Repeats<K: Ord> {
    of: BTreeMap<K, Wait>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Wait {
    /// The first change without a notification since, if any.
    untold: Option<Instant>,
    backoff: Backoff,
    end: Instant,
    /// Whether an unreachable node has held up the master since the change.
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

    /// The notifications due now. `holding_up`: there are unreachable nodes. Without them the master notifies
    /// nodes itself.
    pub fn due(&mut self, now: Instant, holding_up: bool) -> Vec<K> {
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

    /// When the next notification is due.
    pub fn next(&self) -> Option<Instant> {
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
