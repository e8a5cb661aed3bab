//! Connections without a request, in the order in which they fell idle.
//!
//! Nodes keep such connections for hours, so there is no time after which one is closed. But when
//! there are too many of them, the one that has been idle for longest gives way: its client connects
//! again when it has something to say, as it must with a rosmaster that closes idle connections.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use tokio::sync::Notify;

/// So many connections may be idle, however many there may be in all. Each takes some 16 KB, after a large body 40.
const MOST: usize = 2000;

/// The idle connections.
#[derive(Debug)]
pub struct Idle {
    most: usize,
    queue: Mutex<Queue>,
}

#[derive(Debug, Default)]
struct Queue {
    next: u64,
    /// How to tell them to close; the first has been idle for longest.
    waiting: BTreeMap<u64, Arc<Notify>>,
}

impl Idle {
    /// Room for idle ones among `connections`, two or more: half of them, so that they never keep a new
    /// one out.
    pub fn among(connections: usize) -> Self {
        Self {
            most: (connections / 2).min(MOST),
            queue: Mutex::default(),
        }
    }

    /// A connection is idle until the result is dropped. If it is to be closed, `close` is notified; should
    /// it have a request by then, that goes first, and it counts as idle again afterwards.
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

/// A connection is idle while this is there.
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

    fn is_told(close: &Notify) -> bool {
        let told = pin!(close.notified());
        told.poll(&mut Context::from_waker(Waker::noop()))
            .is_ready()
    }

    #[test]
    fn the_one_that_has_been_idle_for_longest_gives_way() {
        let idle = Idle::among(4);
        let [first, second, third, fourth] = [(); 4].map(|()| Arc::new(Notify::new()));
        let was_idle = idle.enter(&first);
        let _second = idle.enter(&second);
        // A request and its answer between.
        drop(was_idle);
        let _first = idle.enter(&first);
        assert!(
            ![&first, &second]
                .map(|close| is_told(close))
                .contains(&true)
        );
        let left = idle.enter(&third);
        assert_eq!(
            [&second, &first, &third].map(|close| is_told(close)),
            [true, false, false]
        );
        // Who has gone makes place.
        drop(left);
        let _fourth = idle.enter(&fourth);
        assert!(!is_told(&first));
        assert_eq!(idle.queue().waiting.len(), 2);
    }

    #[test]
    fn half_of_the_connections_may_be_idle() {
        for (connections, most) in [(2, 1), (16, 8), (832, 416), (10_000, 2000)] {
            assert_eq!(Idle::among(connections).most, most);
        }
    }
}
