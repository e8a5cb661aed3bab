//! Decides whether and when to start the next worker.

use std::{
    collections::VecDeque,
    fmt,
    time::{Duration, Instant},
};

/// Number of workers in a row that are replaced at once although they failed before they answered a call. Also the
/// maximum number of deaths within [`SPAN`] that are not reported as repeated.
const AT_ONCE: usize = 5;
const SPAN: Duration = Duration::from_secs(60);
/// The first pause. Each following pause is twice as long.
const PAUSE_LEAST: Duration = Duration::from_millis(500);
/// The longest pause.
pub const PAUSE_MOST: Duration = Duration::from_secs(10);

/// Exit status of a Rust program that panicked.
const PANIC: i32 = 101;

/// The way a worker ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// The worker ended by itself, with this exit status.
    Code(i32),
    Signal(i32),
}

impl End {
    /// The exit status that a shell would report.
    fn status(self) -> i32 {
        match self {
            Self::Code(code) => code,
            Self::Signal(signal) => 128 + signal,
        }
    }
}

impl fmt::Display for End {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Code(code) => write!(f, "exit status {code}"),
            Self::Signal(signal) => write!(f, "signal {signal}"),
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NextStart {
    /// rosrescue ends with this status.
    Exit(i32),
    /// Another worker is started.
    Restart {
        pause: Duration,
        /// Whether more than five workers have died within a minute.
        again_and_again: bool,
    },
}

/// Decides whether and when to restart the worker.
#[derive(Debug, Default)]
pub struct Restarts {
    /// Deaths within the last [`SPAN`], at most one more than [`AT_ONCE`].
    deaths: VecDeque<Instant>,
    /// Number of failed workers in a row.
    failures: usize,
    /// Whether any worker has answered calls.
    served: bool,
    /// The signal that asked rosrescue to stop.
    stop: Option<i32>,
    /// Whether the present worker only has to end the processes that a killed worker left running.
    cleaning: bool,
}

impl Restarts {
    /// Notes a stop signal. From now on a worker is only started to end the processes that a killed worker left
    /// running.
    pub fn stop(&mut self, signal: i32) {
        self.stop = Some(signal);
    }

    /// The signal that asked rosrescue to stop, if there was one.
    pub fn stopped_by(&self) -> Option<i32> {
        self.stop
    }

    /// Whether any worker has answered calls.
    pub fn has_served(&self) -> bool {
        self.served
    }

    /// Whether a worker died while it was stopping. It may have left its master running.
    fn died_stopping(&self, end: End) -> bool {
        match end {
            End::Signal(signal) => self.stop.is_some_and(|stop| stop != signal),
            End::Code(code) => self.stop.is_some() && code == PANIC,
        }
    }

    /// Decides what to do after a worker ended at `now`. `served` says whether it had answered calls.
    ///
    /// Before any worker has answered calls, an exit status is an error of the start, such as a missing rosmaster.
    /// Later the same error may be temporary. A worker that has answered calls is replaced at once, because calls wait.
    /// Workers that fail earlier, or that end with an error again within a minute, could keep the processor busy without
    /// use, so they are delayed.
    pub fn worker_ended(&mut self, end: End, served: bool, now: Instant) -> NextStart {
        self.served |= served;
        let is_error = matches!(end, End::Code(code) if code != PANIC);
        self.failures = match served && !(is_error && self.died_recently(now)) {
            true => usize::from(is_error),
            false => self.failures + 1,
        };
        match end {
            _ if self.died_stopping(end) && !self.cleaning => {
                self.cleaning = true;
                NextStart::Restart {
                    pause: Duration::ZERO,
                    again_and_again: false,
                }
            }
            _ if self.stop.is_some() => NextStart::Exit(end.status()),
            End::Code(0) => NextStart::Exit(0),
            End::Code(code) if code != PANIC && !self.served => NextStart::Exit(code),
            _ => NextStart::Restart {
                pause: self.pause(),
                again_and_again: self.died(now) > AT_ONCE,
            },
        }
    }

    fn pause(&self) -> Duration {
        let further = self.failures.checked_sub(AT_ONCE + 1);
        further.map_or(Duration::ZERO, |further| {
            let doublings = u32::try_from(further).unwrap_or(u32::MAX).min(16);
            (PAUSE_LEAST * 2_u32.pow(doublings)).min(PAUSE_MOST)
        })
    }

    fn died_recently(&self, now: Instant) -> bool {
        let last = self.deaths.back();
        last.is_some_and(|last| now.saturating_duration_since(*last) < SPAN)
    }

    /// Counts a death, and returns the number of recent deaths.
    fn died(&mut self, now: Instant) -> usize {
        self.deaths
            .retain(|death| now.saturating_duration_since(*death) < SPAN);
        self.deaths.push_back(now);
        if self.deaths.len() > AT_ONCE + 1 {
            self.deaths.pop_front();
        }
        self.deaths.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KILLED: End = End::Signal(9);

    const AT_ONCE: NextStart = NextStart::Restart {
        pause: Duration::ZERO,
        again_and_again: false,
    };

    #[test]
    fn pauses_grow_while_workers_fail_and_end_when_one_serves() {
        let mut restarts = Restarts::default();
        let now = Instant::now();
        let mut die = |served| match restarts.worker_ended(KILLED, served, now) {
            NextStart::Restart { pause, .. } => pause.as_millis(),
            NextStart::Exit(status) => panic!("exit {status}"),
        };
        let pauses: Vec<_> = (0..12).map(|_| die(false)).collect();
        let expected = [0, 0, 0, 0, 0, 500, 1000, 2000, 4000, 8000, 10_000, 10_000];
        assert_eq!(pauses, expected);
        assert_eq!(die(true), 0);
        assert_eq!(die(false), 0);
    }

    #[test]
    fn workers_that_have_served_are_followed_at_once_and_many_deaths_are_told() {
        let mut restarts = Restarts::default();
        let start = Instant::now();
        let mut die =
            |at| match restarts.worker_ended(KILLED, true, start + Duration::from_secs(at)) {
                NextStart::Restart {
                    pause,
                    again_and_again,
                } => (pause.is_zero(), again_and_again),
                NextStart::Exit(status) => panic!("exit {status}"),
            };
        // This takes longer than a minute.
        for number in 0..40 {
            assert_eq!(die(2 * number), (true, number >= 5), "{number}");
        }
        assert_eq!(die(200), (true, false), "much later");
    }

    /// For example `proxy` in front of itself: the mirror answers before the error is found.
    #[test]
    fn an_error_that_comes_back_is_delayed_although_each_worker_has_served() {
        let mut restarts = Restarts::default();
        let start = Instant::now();
        let mut fail = |at| {
            let now = start + Duration::from_secs(at);
            match restarts.worker_ended(End::Code(1), true, now) {
                NextStart::Restart { pause, .. } => pause.as_millis(),
                NextStart::Exit(status) => panic!("exit {status}"),
            }
        };
        let pauses: Vec<_> = (0..8).map(&mut fail).collect();
        assert_eq!(pauses, [0, 0, 0, 0, 0, 500, 1000, 2000]);
        assert_eq!(fail(200), 0, "much later");
    }

    #[test]
    fn errors_of_the_start_end_it_and_later_ones_do_not() {
        let now = Instant::now();
        let mut restarts = Restarts::default();
        assert_eq!(
            restarts.worker_ended(End::Code(1), false, now),
            NextStart::Exit(1)
        );
        assert_eq!(restarts.worker_ended(KILLED, false, now), AT_ONCE);
        assert_eq!(restarts.worker_ended(End::Code(PANIC), false, now), AT_ONCE);
        // No worker has answered calls yet.
        assert_eq!(
            restarts.worker_ended(End::Code(2), false, now),
            NextStart::Exit(2)
        );
        assert_eq!(restarts.worker_ended(KILLED, true, now), AT_ONCE);
        assert_eq!(restarts.worker_ended(End::Code(1), false, now), AT_ONCE);
    }

    #[test]
    fn a_stop_ends_it_with_the_status_of_the_worker() {
        let now = Instant::now();
        let mut restarts = Restarts::default();
        assert_eq!(
            restarts.worker_ended(End::Code(0), true, now),
            NextStart::Exit(0)
        );
        restarts.stop(15);
        for (end, status) in [
            (End::Code(0), 0),
            (End::Code(130), 130),
            (End::Signal(15), 143),
        ] {
            assert_eq!(
                restarts.worker_ended(end, true, now),
                NextStart::Exit(status)
            );
        }
        // The worker died while it stopped, so its master still runs. One more worker is started to
        // end that master, but only one.
        assert_eq!(restarts.worker_ended(KILLED, true, now), AT_ONCE);
        assert_eq!(
            restarts.worker_ended(KILLED, true, now),
            NextStart::Exit(137)
        );
        let mut restarts = Restarts::default();
        restarts.stop(15);
        let panicked = End::Code(PANIC);
        assert_eq!(restarts.worker_ended(panicked, true, now), AT_ONCE);
        assert_eq!(
            restarts.worker_ended(panicked, true, now),
            NextStart::Exit(PANIC)
        );
    }
}
