//! Schedules *inspections*, which read the master's whole state to compare it with the mirror. Pure: the time is an
//! argument.

use std::time::{Duration, Instant};

/// Pause after an inspection that failed.
const RETRY_PAUSE: Duration = Duration::from_secs(1);
/// The pause after an inspection is this many times its duration. Writes pass only in the pauses, because they wait
/// during an inspection. All requests during a pause share the next inspection.
const SPACING: u32 = 10;
/// Longest pause between two inspections, because answers may be waiting for the next one.
const SPACING_MOST: Duration = Duration::from_secs(30);

/// The schedule of inspections.
#[derive(Debug, Default)]
pub(super) struct ResyncSchedule {
    due: bool,
    /// When to repeat an inspection that failed or was requested during a pause.
    retry_at: Option<Instant>,
    not_before: Option<Instant>,
}

impl ResyncSchedule {
    /// Requests an inspection as soon as possible.
    pub(super) fn request(&mut self) {
        self.due = true;
    }

    /// Requests an inspection because the mirror is in doubt, unless a retry is scheduled.
    pub(super) fn doubted(&mut self) {
        self.due |= self.retry_at.is_none();
    }

    /// When to call [`Self::wake`].
    pub(super) fn wake_at(&self) -> Option<Instant> {
        self.retry_at
    }

    pub(super) fn wake(&mut self) {
        (self.due, self.retry_at) = (true, None);
    }

    /// Drops all requests, because they concerned the previous master.
    pub(super) fn reset(&mut self) {
        (self.due, self.retry_at) = (false, None);
    }

    /// Whether an inspection begins now.
    pub(super) fn begin(&mut self, now: Instant) -> bool {
        if !self.due {
            return false;
        }
        self.retry_at = self.not_before.filter(|end| now < *end);
        self.due = self.retry_at.is_some();
        !self.due
    }

    /// Notes the end of an inspection that took `time`.
    pub(super) fn ended(&mut self, now: Instant, time: Duration) {
        self.not_before = Some(now + (time * SPACING).min(SPACING_MOST));
    }

    /// Notes that an inspection has failed.
    pub(super) fn failed(&mut self, now: Instant) {
        self.retry_at = Some(now + RETRY_PAUSE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn inspections_are_spaced_by_what_they_take() {
        let start = Instant::now();
        let mut schedule = ResyncSchedule::default();
        assert!(!schedule.begin(start));
        schedule.request();
        assert!(schedule.begin(start) && !schedule.begin(start));
        schedule.ended(start, 20 * MS);
        schedule.doubted();
        assert!(!schedule.begin(start + 199 * MS));
        assert_eq!(schedule.wake_at(), Some(start + 200 * MS));
        schedule.wake();
        assert!(schedule.begin(start + 200 * MS));
        schedule.ended(start, Duration::from_secs(60));
        schedule.request();
        assert!(!schedule.begin(start + SPACING_MOST - MS));
        assert!(schedule.begin(start + SPACING_MOST));
    }

    #[test]
    fn a_failed_inspection_is_retried_although_calls_pass_in_between() {
        let start = Instant::now();
        let mut schedule = ResyncSchedule::default();
        schedule.request();
        assert!(schedule.begin(start));
        schedule.failed(start);
        // This happens before each call that is sent.
        schedule.doubted();
        assert!(!schedule.begin(start));
        assert_eq!(schedule.wake_at(), Some(start + RETRY_PAUSE));
        schedule.wake();
        assert!(schedule.begin(start + RETRY_PAUSE));
        schedule.failed(start);
        schedule.reset();
        assert_eq!(schedule.wake_at(), None);
    }
}
