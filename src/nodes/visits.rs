//! Limits the questions to nodes, because any client can register any address. Each port gets one question at a time,
//! each host gets questions at a bounded rate, and the total number at a time is bounded.

use std::{
    collections::HashMap,
    net::IpAddr,
    sync::{Arc, Mutex, PoisonError, Weak},
    time::{Duration, Instant},
};

use rescue_core::health::Rates;
use tokio::sync::{Mutex as Turn, OwnedMutexGuard, Semaphore, SemaphorePermit};

use super::origin;

/// Number of nodes that are asked at the same time. Each takes two file descriptors, at most until its deadline.
const AT_ONCE: usize = 64;

/// The questions to nodes that wait or are in progress.
#[derive(Debug)]
pub(super) struct Visits {
    turns: Mutex<HashMap<String, Weak<Turn<()>>>>,
    rates: Mutex<Rates<IpAddr>>,
    permits: Semaphore,
}

/// Permission to ask the node at one port, over up to three connections.
#[derive(Debug)]
pub(super) struct Admitted<'a> {
    _turn: OwnedMutexGuard<()>,
    _permit: Option<SemaphorePermit<'a>>,
}

impl Default for Visits {
    fn default() -> Self {
        Self {
            turns: Mutex::default(),
            rates: Mutex::default(),
            permits: Semaphore::new(AT_ONCE),
        }
    }
}

impl Visits {
    /// Waits until the node at `port` may be asked. `None` if its host has no address within `limit`.
    pub(super) async fn admit(&self, port: &str, limit: Duration) -> Option<Admitted<'_>> {
        let turn = self.turn(port).lock_owned().await;
        let host = origin::addresses(port, limit).await?.first()?.ip();
        let from = {
            let mut rates = self.rates.lock().unwrap_or_else(PoisonError::into_inner);
            rates.reserve(host, Instant::now())
        };
        tokio::time::sleep_until(from.into()).await;
        Some(Admitted {
            _turn: turn,
            // This comes last, so that a host that has to wait does not block others. The semaphore is never closed.
            _permit: self.permits.acquire().await.ok(),
        })
    }

    fn turn(&self, port: &str) -> Arc<Turn<()>> {
        let mut turns = self.turns.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(turn) = turns.get(port).and_then(Weak::upgrade) {
            return turn;
        }
        if turns.len() == turns.capacity() {
            turns.retain(|_, turn| turn.strong_count() > 0);
        }
        let turn = Arc::default();
        turns.insert(port.to_owned(), Arc::downgrade(&turn));
        turn
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_port_is_visited_once_at_a_time_and_others_meanwhile() {
        let visits = Visits::default();
        let limit = Duration::from_secs(1);
        let first = visits.admit("http://127.0.0.1:1", limit).await;
        assert!(first.is_some());
        let again = visits.admit("http://127.0.0.1:1", limit);
        assert!(tokio::time::timeout(limit, again).await.is_err());
        assert!(visits.admit("http://127.0.0.1:2", limit).await.is_some());
        drop(first);
        assert!(visits.admit("http://127.0.0.1:1", limit).await.is_some());
        assert!(visits.admit("nowhere", limit).await.is_none());
    }
}
