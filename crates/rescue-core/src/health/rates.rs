//! Limits how often the nodes of one host are asked, so that registrations cannot make rosrescue flood a host. A
//! *visit* asks the nodes at one port.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

/// Number of visits, each to the nodes at one port, that a host may get at once. A recovery asks all nodes of a robot
/// at the same time, and asks again soon after they have started. All of them may be on one computer.
const AT_ONCE: u32 = 400;
/// Pause between further visits to the same host.
const PAUSE: Duration = Duration::from_millis(10);
/// Number of hosts to remember. If there are more, those without recent visits are forgotten.
const HOSTS: usize = 1024;

/// The visits to each host, each to the nodes at one port. A leaky bucket for each host limits them (the generic cell
/// rate algorithm).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rates<K: Ord> {
    /// When all visits so far would be over if they had come one by one, with [`PAUSE`] between them.
    over_at: BTreeMap<K, Instant>,
    forget_at: usize,
}

impl<K: Ord> Default for Rates<K> {
    fn default() -> Self {
        Self {
            over_at: BTreeMap::new(),
            forget_at: HOSTS,
        }
    }
}

impl<K: Ord> Rates<K> {
    /// Reserves a visit to `host`, and returns when it may begin.
    pub fn reserve(&mut self, host: K, now: Instant) -> Instant {
        if self.over_at.len() >= self.forget_at {
            self.over_at.retain(|_, over_at| *over_at > now);
            self.forget_at = HOSTS.max(2 * self.over_at.len());
        }
        let over_at = self.over_at.entry(host).or_insert(now);
        let from = (*over_at).max(now);
        *over_at = from + PAUSE;
        let early = from.checked_sub(PAUSE * (AT_ONCE - 1)).unwrap_or(now);
        early.max(now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How long after `now` each of `count` visits begins.
    fn pauses(rates: &mut Rates<u32>, host: u32, count: u32, now: Instant) -> Vec<Duration> {
        let visits = (0..count).map(|_| rates.reserve(host, now) - now);
        visits.collect()
    }

    #[test]
    fn a_host_gets_a_number_of_visits_at_once_and_then_one_per_pause() {
        let start = Instant::now();
        let mut rates = Rates::default();
        let waits = pauses(&mut rates, 1, 2000, start);
        let count = |until| waits.iter().filter(|wait| **wait <= until).count();
        assert_eq!(count(Duration::ZERO), 400);
        assert_eq!(count(Duration::from_secs(2)), 600);
        // Each host has its own limit, and after a while the first one may be visited at once again.
        assert_eq!(pauses(&mut rates, 2, 1, start), [Duration::ZERO]);
        let later = start + Duration::from_secs(20);
        let waits = pauses(&mut rates, 1, 401, later);
        assert_eq!(waits[399], Duration::ZERO);
        assert_eq!(waits[400], PAUSE);
    }

    #[test]
    fn two_recoveries_of_two_hundred_nodes_are_not_delayed() {
        let start = Instant::now();
        let mut rates = Rates::default();
        for second in [0, 0, 2, 4, 6, 8] {
            let now = start + Duration::from_secs(second);
            let waits = pauses(&mut rates, 1, 200, now);
            assert!(waits.iter().all(Duration::is_zero), "{second}");
        }
    }

    #[test]
    fn hosts_without_recent_visits_are_forgotten() {
        let start = Instant::now();
        let mut rates = Rates::default();
        for host in 0..HOSTS {
            rates.reserve(host, start);
        }
        rates.reserve(0, start + PAUSE);
        assert_eq!(rates.over_at.len(), 1);
    }
}
