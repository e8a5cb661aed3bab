//! Dead nodes that were unregistered, for the status page.

use std::{
    collections::VecDeque,
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

/// Number of nodes that are remembered.
const MOST: usize = 100;

/// How long an unregistered node counts as trouble, unless it comes back. An operator must have time to see it, and some
/// programs never come back.
const LATELY: Duration = Duration::from_secs(600);

/// The most recently unregistered dead nodes, oldest first.
#[derive(Debug, Default)]
pub(crate) struct Removed(Mutex<VecDeque<(String, Instant)>>);

impl Removed {
    pub(crate) fn add(&self, node: &str, at: Instant) {
        let mut removed = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        removed.retain(|(name, _)| name != node);
        if removed.len() == MOST {
            removed.pop_front();
        }
        removed.push_back((node.to_owned(), at));
    }

    /// The nodes that were unregistered in the last ten minutes, with the time. Some may have come back.
    pub(crate) fn lately(&self, now: Instant) -> Vec<(String, Instant)> {
        let mut list = self.list();
        list.retain(|(_, at)| now.duration_since(*at) < LATELY);
        list
    }

    /// The names of the nodes, and when they were unregistered. Some may have come back.
    pub(crate) fn list(&self) -> Vec<(String, Instant)> {
        let removed = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        removed.iter().cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_is_listed_once_and_the_oldest_are_forgotten() {
        let removed = Removed::default();
        for index in (0..=MOST).chain([7]) {
            removed.add(&format!("/{index}"), Instant::now());
        }
        let names: Vec<_> = removed.list().into_iter().map(|(name, _)| name).collect();
        assert_eq!(names.len(), MOST);
        assert_eq!([&names[0], &names[MOST - 1]], ["/1", "/7"]);
    }
}
