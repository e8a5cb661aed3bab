//! What calls pass on their way to the master; shut while the master is away.

use std::time::Duration;

use tokio::{sync::watch, time::Instant};

/// What may answer while the gate is shut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StandIn {
    /// Nobody: the mirror is not known to be a master's state yet.
    Nobody,
    /// The mirror answers reads; it must not change, because an injection was made from it.
    Reads,
    /// The mirror answers reads and takes unregistrations.
    Unregistrations,
}

/// The state of the gate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Calls pass to the master of this incarnation number.
    Open {
        /// Counts the incarnations that this rosrescue has served, from 1.
        incarnation: u64,
    },
    /// Calls wait, or are answered by the mirror.
    Shut(StandIn),
}

/// Makes a gate that is shut.
pub fn gate() -> (Keeper, Gate) {
    let (tx, rx) = watch::channel(State::Shut(StandIn::Nobody));
    (Keeper { state: tx }, Gate { state: rx })
}

/// Opens and shuts the gate.
#[derive(Debug, Clone)]
pub struct Keeper {
    state: watch::Sender<State>,
}

impl Keeper {
    /// Changes the state; waiters see it at once. The same state again wakes nobody.
    pub fn set(&self, state: State) {
        self.state.send_if_modified(|now| {
            if *now == state {
                return false;
            }
            tracing::debug!(before = ?now, ?state, "gate");
            *now = state;
            true
        });
    }

    /// The state now.
    pub fn state(&self) -> State {
        *self.state.borrow()
    }
}

/// Looks at the gate and waits for it.
#[derive(Clone, Debug)]
pub struct Gate {
    state: watch::Receiver<State>,
}

impl Gate {
    /// The state now.
    pub fn state(&self) -> State {
        *self.state.borrow()
    }

    /// Returns when the state has changed since the last look by this method or by
    /// [`Self::look`]. Cancel safe. Pends for ever once the keeper is gone.
    pub async fn changed(&mut self) {
        if self.state.changed().await.is_err() {
            std::future::pending::<()>().await;
        }
    }

    /// The state now, and the point from which [`Self::changed`] looks for changes.
    pub fn look(&mut self) -> State {
        *self.state.borrow_and_update()
    }

    /// Returns when the gate has been shut for `hold` in one piece, counted from now at the
    /// earliest. Never returns while it is open. Cancel safe, but the count starts anew.
    pub async fn shut_for(&mut self, hold: Duration) {
        loop {
            while matches!(self.look(), State::Open { .. }) {
                self.changed().await;
            }
            let deadline = Instant::now() + hold;
            loop {
                tokio::select! {
                    () = tokio::time::sleep_until(deadline) => return,
                    () = self.changed() => {}
                }
                if matches!(self.look(), State::Open { .. }) {
                    break;
                }
            }
        }
    }

    /// Returns when another incarnation than `incarnation` is served.
    pub async fn succeeded(&mut self, incarnation: u64) {
        loop {
            match self.look() {
                State::Open { incarnation: now } if now != incarnation => return,
                _ => self.changed().await,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn the_hold_starts_anew_after_an_opening() {
        let (keeper, mut gate) = gate();
        let start = Instant::now();
        let opener = async {
            tokio::time::sleep(Duration::from_secs(7)).await;
            keeper.set(State::Open { incarnation: 1 });
            tokio::time::sleep(Duration::from_secs(60)).await;
            keeper.set(State::Shut(StandIn::Unregistrations));
            tokio::time::sleep(Duration::from_secs(1)).await;
            keeper.set(State::Shut(StandIn::Reads));
        };
        tokio::join!(opener, gate.shut_for(Duration::from_secs(8)));
        assert_eq!(start.elapsed(), Duration::from_secs(7 + 60 + 8));
    }

    #[tokio::test(start_paused = true)]
    async fn a_successor_is_another_incarnation_not_a_reopening() {
        let (keeper, mut gate) = gate();
        keeper.set(State::Open { incarnation: 1 });
        let start = Instant::now();
        let changes = async {
            for (seconds, state) in [
                (1, State::Shut(StandIn::Reads)),
                (1, State::Open { incarnation: 1 }),
                (1, State::Shut(StandIn::Reads)),
                (1, State::Open { incarnation: 2 }),
            ] {
                tokio::time::sleep(Duration::from_secs(seconds)).await;
                keeper.set(state);
            }
        };
        tokio::join!(changes, gate.succeeded(1));
        assert_eq!(start.elapsed(), Duration::from_secs(4));
    }
}
