//! Decides how long a write waits for the master before the mirror answers it.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

/// How long a false alarm counts. In a false alarm the mirror has stood in for a master that was only late.
const MEMORY: Duration = Duration::from_secs(60);
/// Number of false alarms within [`MEMORY`] that do not make writes wait longer. Each further one doubles the wait.
const FREE: usize = 5;
/// Longest time that a write waits, unless the configured time is longer.
const LONGEST: Duration = Duration::from_secs(10);
/// Shortest time that a write waits, however long the master has been silent. The master may be about to answer a slow
/// read. A rosmaster answers within a millisecond, or within about ten milliseconds if another call keeps its
/// interpreter busy.
const CHANCE: Duration = Duration::from_millis(20);

/// How long writes wait for a slow master. The time grows when the mirror often stands in for a master that was only
/// late. It shrinks again a minute later.
#[derive(Clone, Debug)]
pub struct Patience {
    base: Duration,
    /// Times when a late master answered, oldest first.
    alarms: VecDeque<Instant>,
}

impl Patience {
    /// `base` is the time that a write waits while the master is rarely late.
    pub fn new(base: Duration) -> Self {
        Self {
            base,
            alarms: VecDeque::new(),
        }
    }

    /// Notes that the mirror stood in for a master that has answered now.
    pub fn was_late(&mut self, now: Instant) {
        self.forget(now);
        self.alarms.push_back(now);
    }

    /// How long a write waits now.
    pub fn limit_at(&mut self, now: Instant) -> Duration {
        self.forget(now);
        let further = self.alarms.len().saturating_sub(FREE);
        let doublings = u32::try_from(further).unwrap_or(u32::MAX).min(16);
        (self.base * 2_u32.pow(doublings)).min(LONGEST.max(self.base))
    }

    /// When the mirror answers a write that was sent at `sent` to a master that has been silent
    /// since `silent_since`.
    ///
    /// The master's silence counts, so that a client that first reads and then writes does not wait
    /// twice. While the master answers other calls, only the write's own wait counts.
    pub fn late_at(
        &mut self,
        now: Instant,
        sent: Instant,
        silent_since: Option<Instant>,
    ) -> Instant {
        let since = silent_since.map_or(sent, |since| since.min(sent));
        (since + self.limit_at(now)).max(sent + CHANCE)
    }

    fn forget(&mut self, now: Instant) {
        while let Some(at) = self.alarms.front()
            && now.duration_since(*at) > MEMORY
        {
            self.alarms.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BASE: Duration = Duration::from_millis(100);

    #[test]
    fn it_grows_with_false_alarms_and_shrinks_again() {
        let mut patience = Patience::new(BASE);
        let mut now = Instant::now();
        for _ in 0..FREE {
            assert_eq!(patience.limit_at(now), BASE);
            patience.was_late(now);
        }
        assert_eq!(patience.limit_at(now), BASE);
        for doublings in 1..=6 {
            patience.was_late(now);
            assert_eq!(patience.limit_at(now), BASE * 2_u32.pow(doublings));
        }
        (0..100).for_each(|_| patience.was_late(now));
        assert_eq!(patience.limit_at(now), LONGEST);
        now += MEMORY + Duration::from_secs(1);
        assert_eq!(patience.limit_at(now), BASE);
    }

    #[test]
    fn a_client_that_reads_and_then_writes_does_not_wait_twice() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut patience = Patience::new(BASE);
        let mut late_at = |sent, silent| patience.late_at(at(sent), at(sent), silent);
        // The write is alone.
        assert_eq!(late_at(0, None), at(100));
        assert_eq!(late_at(0, Some(at(0))), at(100));
        // A read has had no answer for a while.
        assert_eq!(late_at(40, Some(at(0))), at(100));
        assert_eq!(late_at(101, Some(at(0))), at(121));
        assert_eq!(late_at(900, Some(at(0))), at(920));
        // The master has answered others meanwhile.
        assert_eq!(late_at(0, Some(at(70))), at(100));
        // After false alarms, silence counts less.
        (0..=FREE).for_each(|_| patience.was_late(start));
        assert_eq!(patience.late_at(at(101), at(101), Some(start)), at(200));
    }

    /// The mirror stands in only so many times within any minute, however late the master answers.
    #[test]
    fn the_gate_does_not_flap_without_bounds() {
        const MOST: usize = 18;
        for late in [101, 110, 150, 199, 250, 401, 900, 1700, 3300, 7000, 10_001] {
            let late = Duration::from_millis(late);
            let mut patience = Patience::new(BASE);
            let mut now = Instant::now();
            let end = now + 10 * MEMORY;
            let mut flaps = Vec::new();
            while now < end {
                if patience.limit_at(now) < late {
                    flaps.push(now);
                    now += late;
                    patience.was_late(now);
                } else {
                    now += late;
                }
            }
            for from in &flaps {
                let minute = *from..*from + MEMORY;
                let count = flaps.iter().filter(|at| minute.contains(at)).count();
                assert!(count <= MOST, "{count} within a minute: {late:?}");
            }
        }
    }
}
