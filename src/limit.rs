//! Rate limits for events that could come by the thousand, such as log lines and files in a crash loop. The first ten
//! events pass at once, later events one from time to time.

use std::{
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

/// How many events may pass at once.
const BURST: u32 = 10;
/// Time after which one more event may pass: some 300 a day.
const REFILL: Duration = Duration::from_secs(300);

/// Permission to let one event pass, for example to write one log line.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Permit {
    /// Number of events left out before this one. `None` if there were none.
    pub(crate) left_out: Option<u64>,
}

/// A rate limit for one kind of event.
#[derive(Debug)]
pub(crate) struct Limit(Mutex<Bucket>);

#[derive(Debug)]
struct Bucket {
    tokens: u32,
    /// When the bucket was last refilled.
    filled: Option<Instant>,
    left_out: u64,
}

impl Limit {
    pub(crate) const fn new() -> Self {
        Self(Mutex::new(Bucket::FULL))
    }

    /// Permission for an event at `now`. `None` if it must be left out.
    pub(crate) fn pass(&self, now: Instant) -> Option<Permit> {
        let mut bucket = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        bucket.pass(now)
    }
}

impl Bucket {
    const FULL: Self = Self {
        tokens: BURST,
        filled: None,
        left_out: 0,
    };

    fn pass(&mut self, now: Instant) -> Option<Permit> {
        let mut filled = *self.filled.get_or_insert(now);
        while self.tokens < BURST && now.duration_since(filled) >= REFILL {
            filled += REFILL;
            self.tokens += 1;
        }
        if self.tokens == BURST {
            filled = now;
        }
        self.filled = Some(filled);
        let Some(left) = self.tokens.checked_sub(1) else {
            self.left_out += 1;
            return None;
        };
        self.tokens = left;
        let left_out = std::mem::take(&mut self.left_out);
        Some(Permit {
            left_out: (left_out > 0).then_some(left_out),
        })
    }
}

/// A rate limit for an alarm and its all-clear. Both are logged, or neither is.
#[derive(Debug)]
pub(crate) struct AlarmLimit(Mutex<Episode>);

#[derive(Debug)]
struct Episode {
    bucket: Bucket,
    /// Whether an alarm was logged since the last all-clear. `None` if there was no alarm.
    alarm_logged: Option<bool>,
}

impl AlarmLimit {
    pub(crate) const fn new() -> Self {
        Self(Mutex::new(Episode {
            bucket: Bucket::FULL,
            alarm_logged: None,
        }))
    }

    fn lock(&self) -> MutexGuard<'_, Episode> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Permission to log an alarm at `now`. `None` if the alarm must be left out.
    pub(crate) fn alarm(&self, now: Instant) -> Option<Permit> {
        let mut episode = self.lock();
        let passed = episode.bucket.pass(now);
        episode.alarm_logged = Some(episode.alarm_logged == Some(true) || passed.is_some());
        passed
    }

    /// Permission to log the all-clear at `now`. The all-clear is logged if an alarm was logged since the last
    /// all-clear, and left out if all alarms since then were left out. Without an alarm the all-clear is limited like
    /// any other line.
    pub(crate) fn all_clear(&self, now: Instant) -> Option<Permit> {
        let mut episode = self.lock();
        match episode.alarm_logged.take() {
            Some(told) => told.then_some(Permit { left_out: None }),
            None => episode.bucket.pass(now),
        }
    }

    /// Notes that another log line has reported the same trouble, so that the all-clear is logged as well.
    pub(crate) fn note_reported(&self) {
        self.lock().alarm_logged = Some(true);
    }
}

/// Logs like the `tracing` macro of that level, but [rate-limited](self). Lines above the limit are logged at level
/// debug.
macro_rules! rarely {
    ($level:ident, $($line:tt)+) => {{
        static LIMIT: $crate::limit::Limit = $crate::limit::Limit::new();
        match LIMIT.pass(std::time::Instant::now()) {
            Some(pass) => tracing::$level!(left_out = pass.left_out, $($line)+),
            None => tracing::debug!($($line)+),
        }
    }};
}
pub(crate) use rarely;

/// Logs the alarm of an [`AlarmLimit`] like [`rarely!`], if [`AlarmLimit::alarm`] permits.
macro_rules! alarm {
    ($level:ident, $limit:path, $($line:tt)+) => {
        match $limit.alarm(std::time::Instant::now()) {
            Some(pass) => tracing::$level!(left_out = pass.left_out, $($line)+),
            None => tracing::debug!($($line)+),
        }
    };
}
pub(crate) use alarm;

/// Logs the all-clear of an [`AlarmLimit`] like [`rarely!`], if [`AlarmLimit::all_clear`] permits.
macro_rules! all_clear {
    ($level:ident, $limit:path, $($line:tt)+) => {
        match $limit.all_clear(std::time::Instant::now()) {
            Some(pass) => tracing::$level!(left_out = pass.left_out, $($line)+),
            None => tracing::debug!($($line)+),
        }
    };
}
pub(crate) use all_clear;

#[cfg(test)]
mod tests {
    use super::*;

    /// A permission after `left_out` refusals.
    fn passed(left_out: Option<u64>) -> Option<Permit> {
        Some(Permit { left_out })
    }

    #[test]
    fn a_line_that_comes_every_second_is_logged_some_300_times_a_day() {
        let limit = Limit::new();
        let start = Instant::now();
        let mut logged = 0;
        let mut left_out = 0;
        for second in 0..86_400 {
            if let Some(pass) = limit.pass(start + Duration::from_secs(second)) {
                logged += 1;
                left_out += pass.left_out.unwrap_or(0);
            }
        }
        assert_eq!(logged, 10 + 86_400 / 300 - 1);
        assert!(left_out > 85_000);
    }

    #[test]
    fn after_a_long_rest_the_limit_is_as_at_the_start() {
        let limit = Limit::new();
        let start = Instant::now();
        let burst = |at: Instant| (0..20).filter(|_| limit.pass(at).is_some()).count();
        assert_eq!(burst(start), 10);
        assert_eq!(burst(start + Duration::from_secs(3_600)), 10);
        assert_eq!(burst(start + Duration::from_secs(3_900)), 1);
    }

    #[test]
    fn an_all_clear_is_logged_with_its_alarm_or_left_out_with_it() {
        let limit = AlarmLimit::new();
        let now = Instant::now();
        for _ in 0..BURST {
            assert_eq!(limit.alarm(now), passed(None));
            assert_eq!(limit.all_clear(now), passed(None));
        }
        for _ in 0..5 {
            assert_eq!((limit.alarm(now), limit.all_clear(now)), (None, None));
        }
        let later = now + REFILL;
        assert_eq!(limit.alarm(later), passed(Some(5)), "so many were left out");
        // The same trouble continues and is not logged again.
        assert_eq!(limit.alarm(later), None);
        assert_eq!(limit.all_clear(later), passed(None));
    }

    #[test]
    fn an_all_clear_follows_any_line_that_reported_the_trouble() {
        let limit = AlarmLimit::new();
        let now = Instant::now();
        // Without an alarm, as at the start, the all-clear is an ordinary line.
        let alone = (0..20).filter(|_| limit.all_clear(now).is_some()).count();
        assert_eq!(alone, 10);
        assert_eq!(limit.alarm(now), None);
        limit.note_reported();
        assert_eq!(limit.alarm(now), None);
        assert_eq!(limit.all_clear(now), passed(None));
    }
}
