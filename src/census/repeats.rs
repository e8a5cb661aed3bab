//! Topics that are told again, because older news of them may still come from the master.
//!
//! rosmaster makes each list of publishers when something changes, and sends it when one of its
//! threads gets to it: after minutes, where nodes that cannot be reached hold them up. A list that
//! overtakes ours from behind makes roscpp nodes drop links, until they are told anew.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

/// Pause before the first repetition.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Pauses double up to this one.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);
/// How long after its last change a topic is told again: two connects that get no answer.
const LIFE: Duration = Duration::from_secs(300);

/// The topics, and when each is to be told again.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Repeats {
    of: BTreeMap<String, Wait>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Wait {
    pause: Duration,
    next: Instant,
    end: Instant,
    /// Somebody held up the master since the change.
    held_up: bool,
}

impl Repeats {
    /// The publishers of `topic` have changed.
    pub fn changed(&mut self, topic: &str, now: Instant) {
        let held_up = self.of.get(topic).is_some_and(|wait| wait.held_up);
        let wait = Wait {
            pause: FIRST_PAUSE,
            next: now + FIRST_PAUSE,
            end: now + LIFE,
            held_up,
        };
        self.of.insert(topic.to_owned(), wait);
    }

    /// Those to be told now. `holding_up`: there are nodes that do not answer.
    pub fn due(&mut self, now: Instant, holding_up: bool) -> Vec<String> {
        let mut due = Vec::new();
        self.of.retain(|topic, wait| {
            if wait.next > now {
                return true;
            }
            wait.held_up |= holding_up;
            wait.pause = (wait.pause * 2).min(LONGEST_PAUSE);
            wait.next = now + wait.pause;
            if wait.held_up {
                due.push(topic.clone());
            }
            wait.held_up && now < wait.end
        });
        due
    }

    /// When something is to be told next.
    pub fn next(&self) -> Option<Instant> {
        self.of.values().map(|wait| wait.next).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_repeated_while_everybody_answers() {
        let start = Instant::now();
        let mut repeats = Repeats::default();
        repeats.changed("/t", start);
        let next = repeats.next().unwrap();
        assert_eq!(repeats.due(next, false), Vec::<String>::new());
        assert_eq!(repeats.next(), None);
    }

    #[test]
    fn a_topic_is_repeated_for_as_long_as_the_master_may_be_late() {
        let start = Instant::now();
        let mut repeats = Repeats::default();
        repeats.changed("/t", start);
        let mut told = Vec::new();
        while let Some(next) = repeats.next() {
            // Also when they answer again: a thread may still hang.
            told.extend(repeats.due(next, told.is_empty()).iter().map(|_| next));
        }
        let seconds: Vec<_> = told.iter().map(|at| (*at - start).as_secs()).collect();
        assert_eq!(seconds.get(..6).unwrap(), [1, 3, 7, 15, 25, 35]);
        assert_eq!(seconds.last(), Some(&305));
        repeats.changed("/t", start);
        assert_eq!(repeats.due(start, true), Vec::<String>::new());
    }
}
