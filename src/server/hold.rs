//! How long a call waits for a master (`--hold`).

use std::time::Duration;

use tokio::time::Instant;

use crate::gate;

/// The clock of one call. It starts when the call arrives, and stands still while a living master works on the call.
/// With several computers, the computer that has the master goes on with the clock of the one that forwards the call.
#[derive(Debug)]
pub(crate) struct Hold {
    time_left: Duration,
}

impl Hold {
    pub(crate) fn new(limit: Duration) -> Self {
        Self { time_left: limit }
    }

    /// How long the call may still wait.
    pub(crate) fn time_left(&self) -> Duration {
        self.time_left
    }

    /// Takes off `time`, in which no living master worked on the call.
    pub(crate) fn spend(&mut self, time: Duration) {
        self.time_left = self.time_left.saturating_sub(time);
    }

    /// Waits until the time is over. Counts only while it is awaited, so it may be cancelled and called again.
    pub(crate) async fn wait_until_spent(&mut self) {
        let left = self.time_left;
        let _counted = Counted {
            since: Instant::now(),
            hold: self,
        };
        tokio::time::sleep(left).await;
    }

    /// Like [`Self::wait_until_spent`], but counts only while no calls pass to a master.
    pub(crate) async fn wait_until_spent_while_shut(&mut self, gate: &mut gate::Rx) {
        loop {
            gate.wait_for(|state| !state.is_open()).await;
            tokio::select! {
                // On a busy computer both branches may be ready.
                biased;
                _ = gate.wait_for(gate::State::is_open) => {}
                () = self.wait_until_spent() => return,
            }
        }
    }
}

/// Counts the time until it is dropped.
struct Counted<'a> {
    since: Instant,
    hold: &'a mut Hold,
}

impl Drop for Counted<'_> {
    fn drop(&mut self) {
        self.hold.spend(self.since.elapsed());
    }
}

#[cfg(test)]
mod tests {
    use std::task::{Context, Waker};

    use super::*;
    use crate::gate::{State, gate};

    const SECOND: Duration = Duration::from_secs(1);

    #[tokio::test(start_paused = true)]
    async fn the_clock_stands_still_while_calls_pass_to_a_master() {
        let tx = gate();
        let mut rx = tx.subscribe();
        let start = Instant::now();
        let opener = async {
            tokio::time::sleep(7 * SECOND).await;
            tx.set(State::Open { incarnation: 1 });
            tokio::time::sleep(60 * SECOND).await;
            tx.set(State::StandingIn);
            tokio::time::sleep(SECOND).await;
            tx.set(State::Frozen);
        };
        let mut hold = Hold::new(8 * SECOND);
        tokio::join!(opener, hold.wait_until_spent_while_shut(&mut rx));
        assert_eq!(start.elapsed(), 68 * SECOND);
    }

    #[tokio::test(start_paused = true)]
    async fn all_waits_of_a_call_count_together() {
        let mut hold = Hold::new(10 * SECOND);
        tokio::time::timeout(4 * SECOND, hold.wait_until_spent())
            .await
            .unwrap_err();
        tokio::time::sleep(60 * SECOND).await;
        hold.spend(SECOND);
        assert_eq!(hold.time_left(), 5 * SECOND);
        let start = Instant::now();
        hold.wait_until_spent().await;
        assert_eq!(
            (start.elapsed(), hold.time_left()),
            (5 * SECOND, Duration::ZERO)
        );
    }

    #[tokio::test(start_paused = true)]
    async fn a_gate_that_opens_in_time_is_not_taken_for_one_that_stays_shut() {
        for _ in 0..50 {
            let tx = gate();
            let mut rx = tx.subscribe();
            let mut hold = Hold::new(SECOND);
            let mut spent = std::pin::pin!(hold.wait_until_spent_while_shut(&mut rx));
            let mut context = Context::from_waker(Waker::noop());
            assert!(spent.as_mut().poll(&mut context).is_pending());
            tokio::time::advance(2 * SECOND).await;
            tx.set(State::Open { incarnation: 1 });
            assert!(spent.as_mut().poll(&mut context).is_pending());
        }
    }
}
