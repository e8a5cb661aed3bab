//! Tells how long a master has been silent.

use std::time::Instant;

/// Counts the calls to a master that are under way, and remembers since when none has ended.
///
/// A slow call alone does not make a master silent: while other calls end, it is only busy.
#[derive(Clone, Copy, Debug, Default)]
pub struct OpenCalls {
    calls: usize,
    silent_since: Option<Instant>,
}

impl OpenCalls {
    /// Notes that a call begins.
    pub fn begin(&mut self, now: Instant) {
        self.calls += 1;
        self.silent_since.get_or_insert(now);
    }

    /// Notes that a call has ended, with or without an answer.
    pub fn end(&mut self, now: Instant) {
        self.calls = self.calls.saturating_sub(1);
        self.silent_since = (self.calls > 0).then_some(now);
    }

    /// Since when calls are under way and none has ended. `None` if no call is under way.
    pub fn silent_since(&self) -> Option<Instant> {
        self.silent_since
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_master_is_silent_since_the_oldest_call_after_its_last_answer() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut open_calls = OpenCalls::default();
        assert_eq!(open_calls.silent_since(), None);
        open_calls.begin(at(1));
        open_calls.begin(at(2));
        open_calls.begin(at(3));
        assert_eq!(open_calls.silent_since(), Some(at(1)));
        // A slow call does not count against a master that answers others.
        open_calls.end(at(90));
        assert_eq!(open_calls.silent_since(), Some(at(90)));
        open_calls.end(at(91));
        open_calls.begin(at(95));
        assert_eq!(open_calls.silent_since(), Some(at(91)));
        open_calls.end(at(100));
        open_calls.end(at(101));
        assert_eq!(open_calls.silent_since(), None);
        open_calls.begin(at(200));
        assert_eq!(open_calls.silent_since(), Some(at(200)));
    }
}
