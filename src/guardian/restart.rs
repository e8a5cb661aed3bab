//! What to do after the end of a worker. Pure: the time is an argument.

use std::{
    collections::VecDeque,
    fmt,
    time::{Duration, Instant},
};

/// Deaths within [`SPAN`] after which the worker is restarted at once.
const AT_ONCE: usize = 5;
const SPAN: Duration = Duration::from_secs(60);
/// The first pause; each further one is twice as long.
const PAUSE_LEAST: Duration = Duration::from_millis(500);
/// The longest pause. Six of them fit into a minute, so workers that keep dying quickly stay at it.
pub const PAUSE_MOST: Duration = Duration::from_secs(10);

/// The exit status of a Rust program that panicked.
const PANIC: i32 = 101;

/// How a worker ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// By itself, with this exit status.
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
pub enum Next {
    /// End with this status.
    Exit(i32),
    /// Start another worker.
    Restart { pause: Duration },
}

/// Decides whether and when to restart the worker.
#[derive(Debug, Default)]
pub struct Restarts {
    /// Deaths within the last [`SPAN`], at most one more than [`AT_ONCE`].
    deaths: VecDeque<Instant>,
    /// The last pause.
    pause: Duration,
    /// Whether any worker has served.
    served: bool,
    /// The signal that asks for the end.
    stop: Option<i32>,
    /// The present worker was started to end what a killed one left running.
    cleaning: bool,
}

impl Restarts {
    /// After a stop signal no worker is restarted, except one to end what a killed one left running.
    pub fn stop(&mut self, signal: i32) {
        self.stop = Some(signal);
    }

    /// The signal that asked for the end, if one did.
    pub fn stopped_by(&self) -> Option<i32> {
        self.stop
    }

    /// Whether a worker that was to stop ended otherwise, and may have left its master running.
    fn died_stopping(&self, end: End) -> bool {
        match end {
            End::Signal(signal) => self.stop.is_some_and(|stop| stop != signal),
            End::Code(code) => self.stop.is_some() && code == PANIC,
        }
    }

    /// A worker has ended at `now`. `served`: whether it had answered calls.
    ///
    /// Before any worker has served, an exit status is an error of the start, such as a missing rosmaster.
    /// Later the same error may be temporary.
    pub fn ended(&mut self, end: End, served: bool, now: Instant) -> Next {
        self.served |= served;
        match end {
            _ if self.died_stopping(end) && !self.cleaning => {
                self.cleaning = true;
                let pause = Duration::ZERO;
                Next::Restart { pause }
            }
            _ if self.stop.is_some() => Next::Exit(end.status()),
            End::Code(0) => Next::Exit(0),
            End::Code(code) if code != PANIC && !self.served => Next::Exit(code),
            _ => Next::Restart {
                pause: self.pause_after(now),
            },
        }
    }

    fn pause_after(&mut self, now: Instant) -> Duration {
        self.deaths
            .retain(|death| now.saturating_duration_since(*death) < SPAN);
        self.deaths.push_back(now);
        self.pause = if self.deaths.len() > AT_ONCE {
            self.deaths.pop_front();
            (self.pause * 2).clamp(PAUSE_LEAST, PAUSE_MOST)
        } else {
            Duration::ZERO
        };
        self.pause
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KILLED: End = End::Signal(9);

    #[test]
    fn pauses_grow_while_workers_die_and_end_when_one_lives() {
        let mut restarts = Restarts::default();
        let mut now = Instant::now();
        let mut die = |lived: Duration| match restarts.ended(KILLED, true, now + lived) {
            Next::Restart { pause } => {
                now += lived + pause;
                pause.as_millis()
            }
            Next::Exit(status) => panic!("exit {status}"),
        };
        let second = Duration::from_secs(1);
        let pauses: Vec<_> = (0..14).map(|_| die(second / 10)).collect();
        let expected = [
            0, 0, 0, 0, 0, 500, 1000, 2000, 4000, 8000, 10_000, 10_000, 10_000, 10_000,
        ];
        assert_eq!(pauses, expected);
        assert_eq!(die(61 * second), 0);
        assert_eq!(die(second), 0);
    }

    #[test]
    fn errors_of_the_start_end_it_and_later_ones_do_not() {
        let now = Instant::now();
        let mut restarts = Restarts::default();
        assert_eq!(restarts.ended(End::Code(1), false, now), Next::Exit(1));
        let at_once = Next::Restart {
            pause: Duration::ZERO,
        };
        assert_eq!(restarts.ended(KILLED, false, now), at_once);
        assert_eq!(restarts.ended(End::Code(PANIC), false, now), at_once);
        // Still none has served.
        assert_eq!(restarts.ended(End::Code(2), false, now), Next::Exit(2));
        assert_eq!(restarts.ended(KILLED, true, now), at_once);
        assert_eq!(restarts.ended(End::Code(1), false, now), at_once);
    }

    #[test]
    fn a_stop_ends_it_with_the_status_of_the_worker() {
        let now = Instant::now();
        let mut restarts = Restarts::default();
        assert_eq!(restarts.ended(End::Code(0), true, now), Next::Exit(0));
        restarts.stop(15);
        for (end, status) in [
            (End::Code(0), 0),
            (End::Code(130), 130),
            (End::Signal(15), 143),
        ] {
            assert_eq!(restarts.ended(end, true, now), Next::Exit(status));
        }
        // The one that was to stop has left its master; so may the one after it, but only once.
        let pause = Duration::ZERO;
        assert_eq!(restarts.ended(KILLED, true, now), Next::Restart { pause });
        assert_eq!(restarts.ended(KILLED, true, now), Next::Exit(137));
        let mut restarts = Restarts::default();
        restarts.stop(15);
        let panicked = End::Code(PANIC);
        assert_eq!(restarts.ended(panicked, true, now), Next::Restart { pause });
        assert_eq!(restarts.ended(panicked, true, now), Next::Exit(PANIC));
    }
}
