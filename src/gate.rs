//! The gate: whether calls pass to the master. Any task may read the gate and wait for a change. Only the
//! [ledger](crate::ledger::Ledger) sets it, under its lock, so that the mirror and the gate always fit together.
//!
//! `recovery::course` decides when it is [`State::StandingIn`] or [`State::Unknown`], the lifecycle when it is
//! [`State::Late`] or [`State::Open`], and an examination when it is [`State::Injecting`] or [`State::Frozen`]. A start with a
//! checkpoint sets [`State::StandingIn`] (`app::Runs::choose`). While this computer does not lead, `app::cluster` sets
//! [`State::Elsewhere`] or, if this computer is alone, [`State::StandingIn`].

use tokio::{sync::watch, time::Instant};

/// The state of the gate: it says which side answers calls.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Calls pass to the master.
    Open {
        /// Number of the incarnation, which is one life of a master process; see [`Token`](rescue_core::replay::Token).
        incarnation: u64,
    },
    /// The mirror answers reads and writes, because the master is away.
    StandingIn,
    /// The mirror answers reads and writes, because the master has not answered a call for too long. When the master
    /// answers, it gets the writes that it has missed.
    Late,
    /// rosrescue is giving the master the state of a moment (an injection). The mirror answers reads and writes; the
    /// master gets these writes next.
    Injecting,
    /// The mirror must not change for a moment: an injection begins, or calls are about to pass to the master. The mirror
    /// answers reads, and writes that change nothing. Other writes wait.
    Frozen,
    /// Another computer has the master or will have it soon. Calls are forwarded to that computer.
    Elsewhere,
    /// No master has been seen yet, so the state is unknown and calls wait.
    Unknown,
}

impl State {
    /// Whether calls pass to the master.
    pub fn is_open(self) -> bool {
        matches!(self, Self::Open { .. })
    }

    /// Whether the master is getting its state.
    pub(crate) fn is_injecting(self) -> bool {
        matches!(self, Self::Injecting | Self::Frozen)
    }
}

#[derive(Clone, Copy, Debug)]
struct Gate {
    state: State,
    /// When calls last began or stopped passing to the master.
    since: Instant,
}

/// Creates a [gate](self) that lets no calls pass.
pub(crate) fn gate() -> Tx {
    let (tx, _) = watch::channel(Gate {
        state: State::Unknown,
        since: Instant::now(),
    });
    Tx(tx)
}

/// The writing half of the [gate](self), which sets whether calls pass to the master.
#[derive(Debug)]
pub(crate) struct Tx(watch::Sender<Gate>);

impl Tx {
    /// Changes the state and wakes all waiters at once. Setting the present state again has no effect.
    pub(crate) fn set(&self, state: State) {
        self.0.send_if_modified(|gate| {
            if gate.state == state {
                return false;
            }
            tracing::debug!("gate: {:?} => {state:?}", gate.state);
            if gate.state.is_open() != state.is_open() {
                gate.since = Instant::now();
            }
            gate.state = state;
            true
        });
    }

    pub(crate) fn state(&self) -> State {
        self.0.borrow().state
    }

    pub(crate) fn subscribe(&self) -> Rx {
        Rx(self.0.subscribe())
    }
}

/// The reading half of the gate, which tells whether calls pass to the master and waits for a change.
#[derive(Clone, Debug)]
pub struct Rx(watch::Receiver<Gate>);

impl Rx {
    pub fn state(&self) -> State {
        self.0.borrow().state
    }

    /// Whether calls pass to the master.
    pub fn is_open(&self) -> bool {
        self.state().is_open()
    }

    /// When calls last began or stopped passing to the master.
    pub fn opened_or_shut_at(&self) -> Instant {
        self.0.borrow().since
    }

    /// Waits until the state has changed since the last [`Self::observe`] or the last return of this method. Cancel safe.
    /// Never returns once the sender is dropped.
    pub async fn changed(&mut self) {
        if self.0.changed().await.is_err() {
            std::future::pending::<()>().await;
        }
    }

    /// The present state, and whether it has changed since the last observation or since [`Self::changed`] returned.
    pub fn observe_change(&mut self) -> (State, bool) {
        let gate = self.0.borrow_and_update();
        (gate.state, gate.has_changed())
    }

    /// The present state. [`Self::changed`] waits for changes after it.
    pub fn observe(&mut self) -> State {
        self.0.borrow_and_update().state
    }

    /// Waits until `is_it` accepts the state. Cancel safe.
    pub async fn wait_for(&mut self, is_it: impl Fn(State) -> bool) -> State {
        loop {
            let state = self.observe();
            if is_it(state) {
                return state;
            }
            self.changed().await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn an_observation_reports_a_change_that_was_not_waited_for() {
        let tx = gate();
        let mut rx = tx.subscribe();
        tx.set(State::StandingIn);
        assert_eq!(rx.observe_change(), (State::StandingIn, true));
        assert_eq!(rx.observe_change(), (State::StandingIn, false));
        tx.set(State::Open { incarnation: 1 });
        tx.set(State::StandingIn);
        assert_eq!(rx.observe_change(), (State::StandingIn, true));
        tx.set(State::Frozen);
        rx.changed().await;
        assert_eq!(rx.observe_change(), (State::Frozen, false));
    }
}
