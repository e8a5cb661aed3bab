//! Kills processes, and waits for the recovery.

use std::time::{Duration, Instant};

use rustix::process::Signal;
use tokio::time::{sleep, timeout};

use super::{
    Drill,
    target::Stopped,
    verdict::{Kill, names},
};
use crate::{
    cli::Victim,
    commands::{CommandFailure, eprint_line},
    process,
};

/// How long the drill watches after each recovery. Late notifications arrive in that time.
const AFTER: Duration = Duration::from_millis(1500);
/// Pause between two checks for the recovery.
const LOOK: Duration = Duration::from_millis(20);
/// How long a master is stopped with `--hang`. It counts as hung after some 1.6 s.
const HANG: Duration = Duration::from_secs(4);
/// Maximum number of deaths within a minute that are not a crash loop.
const DEATHS: usize = 5;
const DEATHS_WITHIN: Duration = Duration::from_secs(61);

impl Drill<'_> {
    /// Kills as often as `--times` asks, and waits for each recovery.
    pub(super) async fn kill(&self) -> Result<Vec<Kill>, CommandFailure> {
        let kill = if self.args.hang {
            Victim::Master
        } else {
            self.args.kill
        };
        let status = self.target.running.status().await?;
        let rescues = status.last_rescues.iter();
        let mut times = times_of_deaths(
            rescues.map(|report| report.detected_at),
            status.started + status.uptime,
        );
        let mut kills = Vec::new();
        for number in 1..=self.args.times {
            let pause = pause_after(&times);
            if !pause.is_zero() {
                eprint_line(&format!(
                    "waiting {} s, because more deaths now would be a crash loop",
                    pause.as_secs()
                ));
                sleep(pause).await;
            }
            // Each kill replaces the processes, so they are looked up again.
            let victims = self.target.victims(kill).await?;
            let signal = if self.args.hang { "SIGSTOP" } else { "SIGKILL" };
            eprint_line(&format!(
                "{number} of {}: {signal} to {}",
                self.args.times,
                names(&victims)
            ));
            let start = Instant::now();
            times.push(start);
            let mut stopped = None;
            for (_, pid) in &victims {
                if self.args.hang {
                    stopped = Some(Stopped::new(*pid));
                } else {
                    process::signal_process(*pid, Signal::KILL);
                }
            }
            let limit = Duration::from_secs(self.args.limit.into());
            let recovered = timeout(limit, self.recovered(&victims, stopped)).await;
            let recovered_ms = recovered
                .is_ok()
                .then(|| start.elapsed().as_secs_f64() * 1e3);
            let failed = recovered.is_err();
            kills.push(Kill {
                killed: victims,
                signal,
                recovered_ms,
            });
            if failed {
                eprint_line("calls do not pass again: the drill stops");
                break;
            }
            sleep(AFTER).await;
        }
        Ok(kills)
    }

    /// Waits until calls pass to a living master again, and each killed process has a successor. A master that was only
    /// stopped may continue instead.
    async fn recovered(&self, victims: &[(&'static str, u32)], mut stopped: Option<Stopped>) {
        let start = Instant::now();
        loop {
            if let Ok(status) = self.target.running.status().await
                && status.open
            {
                let mut replaced = true;
                for (name, pid) in victims {
                    replaced &= match *name {
                        "worker" => status.pid != *pid,
                        _ => self.target.master_pid().await.is_ok_and(|now| now != *pid),
                    };
                }
                let goes_on = self.args.hang && stopped.is_none();
                if replaced || goes_on {
                    return;
                }
            }
            if start.elapsed() > HANG {
                stopped = None;
            }
            sleep(LOOK).await;
        }
    }
}

/// The times of deaths that rosrescue has seen, such as those of an earlier drill. `deaths` and `now` are seconds since
/// 1970.
fn times_of_deaths(deaths: impl Iterator<Item = f64>, now: f64) -> Vec<Instant> {
    let ago = deaths.filter_map(|death| Duration::try_from_secs_f64(now - death).ok());
    ago.filter_map(|ago| Instant::now().checked_sub(ago))
        .collect()
}

/// How long to wait after `deaths`, oldest first, so that one more is not a crash loop.
fn pause_after(deaths: &[Instant]) -> Duration {
    let fifth = deaths.iter().rev().nth(DEATHS - 1);
    fifth.map_or(Duration::ZERO, |then| {
        DEATHS_WITHIN.saturating_sub(then.elapsed())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deaths_before_the_drill_count_towards_a_crash_loop() {
        let pause = |deaths: &[f64]| pause_after(&times_of_deaths(deaths.iter().copied(), 100.0));
        assert_eq!(pause(&[90.0, 92.0, 94.0, 96.0]), Duration::ZERO);
        let fifth = pause(&[10.0, 90.0, 92.0, 94.0, 96.0, 98.0]).as_secs_f64();
        assert!((50.0..=51.0).contains(&fifth), "{fifth}");
        // The clock was set back.
        assert_eq!(pause(&[200.0; 6]), Duration::ZERO);
    }
}
