//! Measures what the threads of a process do, and how much processor time they get (`proc_pid_task(5)`). This never
//! needs the lock on the process's memory, so it does not wait for a busy process.

use std::{fs, time::Duration};

use rescue_core::lifecycle::evidence::Effort;

use super::Stat;

/// Maximum number of processes that are counted as one: the master and its descendants.
const FAMILY_MOST: usize = 64;

/// What the threads of the process `pid` and its descendants do: a wrapper may have started the master. `None` if there
/// is no such process.
pub(crate) fn measure(pid: u32) -> Option<Effort> {
    let mut threads = Threads::default();
    let mut family = vec![pid.to_string()];
    let mut next = 0;
    while let Some(process) = family.get(next).cloned() {
        next += 1;
        let tasks = fs::read_dir(format!("/proc/{process}/task"));
        for task in tasks.into_iter().flatten().flatten() {
            let read = |name| fs::read_to_string(task.path().join(name)).ok();
            let Some(stat) = read("stat") else { continue };
            threads.add(&stat, read("schedstat").as_deref());
            let children = read("children").unwrap_or_default();
            let children = children.split_whitespace().map(str::to_owned);
            family.extend(children.take(FAMILY_MOST.saturating_sub(family.len())));
        }
    }
    threads.effort()
}

/// How long this process has waited for the processor since it was started.
pub(crate) fn own_wait() -> Duration {
    let tasks = fs::read_dir("/proc/self/task").into_iter().flatten();
    let waits = tasks.flatten().filter_map(|task| {
        let text = fs::read_to_string(task.path().join("schedstat")).ok()?;
        Some(schedstat(&text)?.1)
    });
    waits.sum()
}

#[derive(Debug, Default)]
struct Threads {
    count: usize,
    stopped: usize,
    effort: Effort,
}

impl Threads {
    /// Adds a thread, given its `stat` and `schedstat`.
    fn add(&mut self, stat: &str, sched: Option<&str>) {
        let Some(stat) = Stat::parse(stat).filter(|stat| !matches!(stat.state, 'Z' | 'X')) else {
            return;
        };
        self.count += 1;
        self.stopped += usize::from(stat.is_stopped());
        self.effort.runnable |= stat.state == 'R';
        self.effort.on_disk |= stat.state == 'D';
        let (ran, waited, turns) = sched.and_then(schedstat).unwrap_or_else(|| {
            // A kernel without scheduler statistics only counts ticks.
            let ran = Duration::from_secs_f64(stat.cpu_seconds());
            (ran, Duration::ZERO, 0)
        });
        self.effort.ran += ran;
        self.effort.waited += waited;
        self.effort.turns += turns;
    }

    fn effort(self) -> Option<Effort> {
        let effort = Effort {
            stopped: self.stopped == self.count,
            ..self.effort
        };
        (self.count > 0).then_some(effort)
    }
}

/// Parses how long a thread has run, how long it has waited for the processor, and how often it got it.
fn schedstat(text: &str) -> Option<(Duration, Duration, u64)> {
    let mut fields = text.split_whitespace().map(str::parse);
    let mut next = || fields.next()?.ok();
    let (ran, waited) = (next()?, next()?);
    Some((
        Duration::from_nanos(ran),
        Duration::from_nanos(waited),
        next()?,
    ))
}

#[cfg(test)]
mod tests {
    use std::{
        process::{Child, Command},
        time::Instant,
    };

    use rustix::process::Signal;

    use super::*;
    use crate::process::signal_process;

    struct Ended(Child);

    impl Drop for Ended {
        fn drop(&mut self) {
            let _ = self.0.kill();
            let _ = self.0.wait();
        }
    }

    fn sh(script: &str) -> Ended {
        let child = Command::new("sh").args(["-c", script]).spawn();
        Ended(child.unwrap())
    }

    fn eventually(what: &str, is_it: impl Fn() -> bool) {
        let deadline = Instant::now() + Duration::from_secs(60);
        while !is_it() {
            assert!(Instant::now() < deadline, "never: {what}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn what_a_process_and_its_children_do_is_seen() {
        // The shell waits for its child, which is busy.
        let busy = sh("(while :; do :; done) & wait");
        let pid = busy.0.id();
        eventually("it is busy", || {
            measure(pid).is_some_and(|it| it.runnable && it.ran > Duration::from_millis(100))
        });
        assert!(!measure(pid).unwrap().stopped);
        let children = fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap();
        let child: u32 = children.trim().parse().unwrap();
        for pid in [pid, child] {
            signal_process(pid, Signal::STOP);
        }
        eventually("it is stopped", || measure(pid).unwrap().stopped);
        let before = measure(pid).unwrap();
        std::thread::sleep(Duration::from_millis(20));
        assert_eq!(measure(pid).unwrap(), before, "no progress");
        assert!(!before.runnable);
        signal_process(child, Signal::KILL);
    }

    #[test]
    fn threads_count_together() {
        let line = |state: &str| {
            format!("7 (a) b) {state} 3 7 7 0 -1 0 1 2 3 4 50 25 7 8 20 0 9 0 4711 8192 5")
        };
        let mut threads = Threads::default();
        threads.add(&line("T"), Some("2000000 1000000 5"));
        assert!(threads.effort().unwrap().stopped);
        let mut threads = Threads::default();
        for state in ["T", "S", "Z"] {
            threads.add(&line(state), Some("2000000 1000000 5"));
        }
        let effort = threads.effort().unwrap();
        assert!(!effort.stopped && !effort.runnable && !effort.on_disk);
        assert_eq!(effort.ran, Duration::from_millis(4));
        assert_eq!(effort.waited, Duration::from_millis(2));
        assert_eq!(effort.turns, 10);
        let mut threads = Threads::default();
        threads.add(&line("D"), None);
        let effort = threads.effort().unwrap();
        assert!(effort.on_disk);
        assert_eq!(effort.ran, Duration::from_millis(750));
        assert_eq!(Threads::default().effort(), None);
        assert_eq!(measure(u32::MAX), None);
    }
}
