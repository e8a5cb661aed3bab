//! Decides whether a master that does not answer hangs, by what the kernel shows of its process.
//!
//! Silence alone proves nothing. On a busy computer a healthy master may get no processor time, or rosrescue gets none
//! and its probes are late. A hung process does not need the processor: it is stopped, or its threads get processor
//! time when they ask for it, use little of it, and wait for something else.

use std::time::{Duration, Instant};

/// Shortest time that a silent master must have been watched before it can be judged to hang.
pub const WATCHED_LEAST: Duration = Duration::from_millis(300);
/// Shortest time that a silent master must have been watched if it was not stopped.
const IDLE_LEAST: Duration = Duration::from_millis(900);
/// A master that has used this much processor time since its last answer is in an endless loop.
pub const BUSY_LIMIT: Duration = Duration::from_secs(30);
/// A process that has used more than this part (1/n) of the time is busy. The threads of an idle rosmaster wake a
/// hundred times a second and use 1/200 of the time, or 1/30 on a small computer.
const BUSY_PART: u32 = 10;
/// A process is starved if its threads wait longer than this each time they need the processor. An answer takes some
/// ten such turns.
const STARVED_WAIT: Duration = Duration::from_millis(10);
/// A process that needs the processor and got fewer turns than this is starved as well.
const TURNS_LEAST: u64 = 5;
/// If rosrescue itself has waited for the processor for more than this part (1/n) of the time, its probes prove
/// nothing.
const UNFAIR_PART: u32 = 2;

/// What the threads of a process and of its children do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Effort {
    /// Whether a thread runs or waits for the processor.
    pub runnable: bool,
    /// Whether a thread waits for a disk and cannot be interrupted (state `D`).
    pub on_disk: bool,
    /// Whether every thread was stopped, by SIGSTOP or a debugger.
    pub stopped: bool,
    /// Processor time that the threads have used since they were started.
    pub ran: Duration,
    /// Time that the threads have waited for the processor. The kernel adds a wait when it ends.
    pub waited: Duration,
    /// Number of times that the threads were given the processor.
    pub turns: u64,
}

/// The state of a process at one moment.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    pub at: Instant,
    /// What the master's threads do. `None` if the system does not show it.
    pub master: Option<Effort>,
    /// How long rosrescue's own threads have waited for the processor, plus the delay of its timers.
    pub own_wait: Duration,
}

/// What the samples of a silent master show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SilenceVerdict {
    /// The master hangs, or the system does not show what it does.
    Hung,
    /// There is no proof that the master hangs. The text says why.
    Unproved(&'static str),
    /// The master has not been watched for long enough.
    Unknown,
}

/// The samples of a master since its last answer.
#[derive(Debug, Default)]
pub struct Evidence {
    /// The first sample since the last answer.
    silent: Option<Sample>,
    /// The first sample that the next judgement uses.
    first: Option<Sample>,
    last: Option<Sample>,
    /// The first of the latest consecutive samples in which the master was stopped and used no processor time.
    stopped: Option<Sample>,
    /// Whether in any judged sample a thread needs the processor.
    runnable: bool,
    /// Whether in any judged sample no thread needs the processor.
    rested: bool,
    /// Whether any judged sample shows a thread that waits for a disk.
    on_disk: bool,
    /// Whether in any judged sample all threads were stopped.
    was_stopped: bool,
}

impl Evidence {
    /// Adds a sample.
    pub fn add(&mut self, sample: Sample) {
        let before = self.last.replace(sample);
        self.silent.get_or_insert(sample);
        self.first.get_or_insert(sample);
        let Some(effort) = sample.master else { return };
        self.runnable |= effort.runnable;
        self.rested |= !effort.runnable;
        self.on_disk |= effort.on_disk;
        self.was_stopped |= effort.stopped;
        let same = |before: Effort| before.stopped && before.ran == effort.ran;
        let went_on = before.and_then(|before| before.master).is_some_and(same);
        self.stopped = match (effort.stopped, self.stopped) {
            (true, Some(since)) if went_on => Some(since),
            (true, _) => Some(sample),
            (false, _) => None,
        };
    }

    /// When the last sample was taken.
    pub fn last_at(&self) -> Option<Instant> {
        self.last.map(|sample| sample.at)
    }

    /// Drops all samples, because the master has answered.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Judges a master that was silent during all samples. A master that has used the processor for `busy_limit`
    /// without an answer hangs. After any verdict but [`SilenceVerdict::Unknown`], the next judgement uses only the
    /// last sample and later ones.
    pub fn judge_silence(&mut self, busy_limit: Duration) -> SilenceVerdict {
        let verdict = self.verdict(busy_limit);
        if verdict != SilenceVerdict::Unknown
            && let Some(last) = self.last
        {
            self.first = Some(last);
            let effort = last.master.unwrap_or_default();
            (self.runnable, self.rested) = (effort.runnable, !effort.runnable);
            self.on_disk = effort.on_disk;
            self.was_stopped = effort.stopped;
        }
        verdict
    }

    fn verdict(&self, busy_limit: Duration) -> SilenceVerdict {
        let (Some(first), Some(last)) = (self.first, self.last) else {
            return SilenceVerdict::Hung;
        };
        let (Some(before), Some(now)) = (first.master, last.master) else {
            return SilenceVerdict::Hung;
        };
        let watched = last.at.duration_since(first.at);
        if watched < WATCHED_LEAST {
            return SilenceVerdict::Unknown;
        }
        let stopped = self
            .stopped
            .map_or(Duration::ZERO, |since| last.at.duration_since(since.at));
        if stopped >= watched / 5 * 3 {
            return SilenceVerdict::Hung;
        }
        if watched < IDLE_LEAST {
            return SilenceVerdict::Unknown;
        }
        let silent = self.silent.and_then(|sample| sample.master);
        let spent = now.ran.saturating_sub(silent.unwrap_or(before).ran);
        if spent >= busy_limit {
            return SilenceVerdict::Hung;
        }
        let ran = now.ran.saturating_sub(before.ran);
        if ran > watched / BUSY_PART {
            return SilenceVerdict::Unproved("it is busy");
        }
        let waited = now.waited.saturating_sub(before.waited);
        let turns = now.turns.saturating_sub(before.turns);
        let each = waited / u32::try_from(turns).unwrap_or(u32::MAX).max(1);
        let too_few = self.runnable && turns < TURNS_LEAST;
        // The kernel does not show a wait that has not ended, and many short waits are a long one together.
        if too_few || !self.rested || each > STARVED_WAIT {
            return SilenceVerdict::Unproved("it gets too little CPU time");
        }
        if self.on_disk {
            return SilenceVerdict::Unproved("it waits for a disk");
        }
        if self.was_stopped {
            return SilenceVerdict::Unproved("it was stopped only part of the time");
        }
        if last.own_wait.saturating_sub(first.own_wait) > watched / UNFAIR_PART {
            return SilenceVerdict::Unproved("rosrescue gets too little CPU time to probe it");
        }
        SilenceVerdict::Hung
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    /// An idle rosmaster after `at` milliseconds: the totals of its threads and of rosrescue's.
    fn idle(at: u64) -> (Effort, Duration) {
        let effort = Effort {
            ran: Duration::from_secs(1) + ms(at) / 200,
            // An idle rosmaster wakes a hundred times a second.
            turns: at / 10,
            waited: Duration::from_secs(1) + ms(at) / 20,
            ..Effort::default()
        };
        (effort, ms(at) / 500)
    }

    /// The verdict after samples at 0, 500 and 1,000 ms. `seen` changes the samples of an idle master.
    fn verdict(seen: impl Fn(u64, &mut Effort, &mut Duration)) -> SilenceVerdict {
        let start = Instant::now();
        let mut evidence = Evidence::default();
        for at in [0, 500, 1000] {
            let (mut effort, mut own_wait) = idle(at);
            seen(at, &mut effort, &mut own_wait);
            evidence.add(Sample {
                at: start + ms(at),
                master: Some(effort),
                own_wait,
            });
        }
        evidence.judge_silence(BUSY_LIMIT)
    }

    fn is_unproved(verdict: SilenceVerdict, word: &str) {
        let SilenceVerdict::Unproved(why) = verdict else {
            panic!("{verdict:?} instead of {word}")
        };
        assert!(why.contains(word), "{why}");
    }

    #[test]
    fn a_stopped_or_idle_master_that_does_not_answer_hangs() {
        assert_eq!(verdict(|_, _, _| {}), SilenceVerdict::Hung);
        let stop = |effort: &mut Effort| {
            effort.stopped = true;
            effort.ran = ms(7);
        };
        assert_eq!(verdict(|_, effort, _| stop(effort)), SilenceVerdict::Hung);
        // A stopped master hangs, however little processor time rosrescue gets.
        let starved = |at: u64, effort: &mut Effort, own: &mut Duration| {
            stop(effort);
            *own = ms(at);
        };
        assert_eq!(verdict(starved), SilenceVerdict::Hung);
    }

    #[test]
    fn a_master_that_is_starved_or_busy_does_not_hang() {
        for moment in [0, 500, 1000] {
            let waits = |at: u64, effort: &mut Effort, _: &mut Duration| {
                effort.runnable = at == moment;
                effort.turns = 0;
            };
            is_unproved(verdict(waits), "too little CPU time");
            // Threads of an idle master are runnable from time to time.
            let found = verdict(|at, effort, _| effort.runnable = at == moment);
            assert_eq!(found, SilenceVerdict::Hung);
        }
        // A master that needs the processor all the time is not idle, however short each wait is.
        let found = verdict(|_, effort, _| effort.runnable = true);
        is_unproved(found, "too little CPU time");
        let found = verdict(|at, effort, _| {
            effort.turns /= 10;
            effort.waited += ms(at) / 5;
        });
        is_unproved(found, "too little CPU time");
        let found = verdict(|at, effort, _| effort.ran += ms(at) / 5);
        is_unproved(found, "busy");
        is_unproved(verdict(|_, effort, _| effort.on_disk = true), "disk");
        let found = verdict(|at, _, own| *own += ms(at) / 3 * 2);
        is_unproved(found, "rosrescue gets too little");
        // The master is stopped in each sample, and runs in between.
        for going_on in [500, 1000, 2000] {
            let found = verdict(|at, effort, _| effort.stopped = at != going_on);
            is_unproved(found, "part of the time");
        }
    }

    #[test]
    fn an_endless_loop_does_not_count_as_progress_forever() {
        let start = Instant::now();
        let mut evidence = Evidence::default();
        let mut verdicts = Vec::new();
        for second in 0..40 {
            let at = Duration::from_secs(second);
            let master = Some(Effort {
                runnable: true,
                ran: at,
                ..Effort::default()
            });
            let (at, own_wait) = (start + at, Duration::ZERO);
            evidence.add(Sample {
                at,
                master,
                own_wait,
            });
            verdicts.push(evidence.judge_silence(BUSY_LIMIT));
        }
        let hung = verdicts.iter().position(|it| *it == SilenceVerdict::Hung);
        assert_eq!(hung, Some(30));
    }

    #[test]
    fn there_is_no_verdict_at_first_and_an_invisible_process_counts_as_hung() {
        let mut evidence = Evidence::default();
        assert_eq!(evidence.judge_silence(BUSY_LIMIT), SilenceVerdict::Hung);
        let mut sample = Sample {
            at: Instant::now(),
            master: None,
            own_wait: Duration::ZERO,
        };
        evidence.add(sample);
        assert_eq!(evidence.judge_silence(BUSY_LIMIT), SilenceVerdict::Hung);
        evidence.clear();
        sample.master = Some(Effort::default());
        evidence.add(sample);
        assert_eq!(evidence.judge_silence(BUSY_LIMIT), SilenceVerdict::Unknown);
        sample.at += IDLE_LEAST;
        evidence.add(sample);
        assert_eq!(evidence.judge_silence(BUSY_LIMIT), SilenceVerdict::Hung);
    }

    /// A start that is busy for five seconds and then waits forever.
    #[test]
    fn progress_of_long_ago_does_not_count() {
        let start = Instant::now();
        let mut evidence = Evidence::default();
        let sample = |evidence: &mut Evidence, seconds: u64| {
            let ran = Duration::from_secs(seconds.min(5));
            let master = Some(Effort {
                ran,
                ..Effort::default()
            });
            evidence.add(Sample {
                at: start + Duration::from_secs(seconds),
                master,
                own_wait: Duration::ZERO,
            });
            evidence.judge_silence(BUSY_LIMIT)
        };
        assert_eq!(sample(&mut evidence, 0), SilenceVerdict::Unknown);
        is_unproved(sample(&mut evidence, 30), "busy");
        assert_eq!(sample(&mut evidence, 31), SilenceVerdict::Hung);
    }
}
