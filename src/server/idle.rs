//! Connections without a request in progress, ordered by the start of their idle time.
//!
//! Nodes keep such connections for hours, so there is no idle timeout. If there are too many, the one that has been
//! idle for longest is closed. Its client reconnects when needed, as with a rosmaster that closes idle connections.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use tokio::sync::Notify;

/// Maximum number of idle connections, even if many more connections are allowed. Each connection takes some 16 KB, or
/// 40 KB after a large body.
const MOST: usize = 2000;

#[derive(Debug)]
pub struct Idle {
    most: usize,
    queue: Mutex<Queue>,
}

#[derive(Debug, Default)]
struct Queue {
    next: u64,
    /// Signals that close the idle connections. The first connection has been idle for longest.
    waiting: BTreeMap<u64, Arc<Notify>>,
}

impl Idle {
    /// Allows half of `connections` (two or more) to be idle, so that idle ones never block a new one.
    pub fn among(connections: usize) -> Self {
        Self {
            most: (connections / 2).min(MOST),
            queue: Mutex::default(),
        }
    }

    /// Counts a connection as idle until the result is dropped. `close` signals that it must close. If a request has
    /// arrived by then, the request is answered first, and the connection counts as idle again.
    pub fn enter(&self, close: &Arc<Notify>) -> Idling<'_> {
        let mut queue = self.queue();
        let number = queue.next;
        queue.next += 1;
        queue.waiting.insert(number, close.clone());
        let too_many = queue.waiting.len() > self.most;
        let longest = too_many.then(|| queue.waiting.pop_first()).flatten();
        drop(queue);
        if let Some((_, longest)) = longest {
            longest.notify_one();
        }
        Idling { idle: self, number }
    }

    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Counts a connection as idle until it is dropped.
#[derive(Debug)]
pub struct Idling<'a> {
    idle: &'a Idle,
    number: u64,
}

impl Drop for Idling<'_> {
    fn drop(&mut self) {
        self.idle.queue().waiting.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use std::{
        future::Future,
        pin::pin,
        task::{Context, Waker},
    };

    use super::*;

    fn is_notified(close: &Notify) -> bool {
        let told = pin!(close.notified());
        told.poll(&mut Context::from_waker(Waker::noop()))
            .is_ready()
    }

    #[test]
    fn the_one_that_has_been_idle_for_longest_is_closed() {
        let idle = Idle::among(4);
        let [first, second, third, fourth] = [(); 4].map(|()| Arc::new(Notify::new()));
        let was_idle = idle.enter(&first);
        let _second = idle.enter(&second);
        // The connection serves a request meanwhile.
        drop(was_idle);
        let _first = idle.enter(&first);
        assert!(
            ![&first, &second]
                .map(|close| is_notified(close))
                .contains(&true)
        );
        let left = idle.enter(&third);
        assert_eq!(
            [&second, &first, &third].map(|close| is_notified(close)),
            [true, false, false]
        );
        // Ended connections make room for others.
        drop(left);
        let _fourth = idle.enter(&fourth);
        assert!(!is_notified(&first));
        assert_eq!(idle.queue().waiting.len(), 2);
    }

    #[test]
    fn half_of_the_connections_may_be_idle() {
        for (connections, most) in [(2, 1), (16, 8), (832, 416), (10_000, 2000)] {
            assert_eq!(Idle::among(connections).most, most);
        }
    }
}
