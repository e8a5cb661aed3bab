//! Reads request bodies, within limits of size, time and memory.

use std::{io, time::Duration};

use bytes::Bytes;
use http_body_util::BodyExt;
use hyper::body::{Body, Incoming};
use ros1_master::xmlrpc::Value;
use tokio::{
    sync::{Semaphore, SemaphorePermit},
    time::{Instant, timeout, timeout_at},
};

/// Larger bodies, in bytes, reserve memory and are decoded outside of the runtime. Decoding this much takes some 0.3
/// ms.
pub(crate) const SMALL: usize = 64 << 10;
/// Time allowed for every body, plus one second for each [`RATE`] bytes that have arrived. Also the longest pause
/// within a body.
const TIME: Duration = Duration::from_secs(10);
/// The slowest accepted link, in bytes per second.
const RATE: u64 = 64 << 10;
/// Permit that breaks deadlocks: its holder may use more memory than [`budget`] allows. Without it, several bodies that
/// each hold a part of that memory could wait for each other forever.
static LAST: Semaphore = Semaphore::const_new(1);

/// Number of bodies of the largest size that fit into memory at the same time.
const LARGE_BODIES: usize = 4;

/// The memory for large bodies, in KiB, if none is larger than `max_body` bytes.
pub(crate) fn budget(max_body: usize) -> Semaphore {
    Semaphore::new(LARGE_BODIES * (max_body >> 10))
}

/// Why a body could not be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BodyError {
    /// The body is larger than this limit, in bytes.
    TooLarge { limit: usize },
    /// The body ended early, or is not valid HTTP.
    Broken,
    /// The bytes of the body came too slowly.
    TooSlow,
    /// Other bodies held the memory for too long.
    NoRoom,
}

/// Memory reserved for one body, released on drop. A body reserves twice the size that has arrived. The announced
/// length reserves nothing.
#[derive(Debug)]
pub(crate) struct Room<'a> {
    /// The memory for all large bodies, in KiB; see [`budget`].
    pool: &'a Semaphore,
    held: Option<SemaphorePermit<'a>>,
    last: Option<SemaphorePermit<'static>>,
}

impl<'a> Room<'a> {
    /// An empty reservation from `pool`, which counts KiB.
    pub(crate) fn new(pool: &'a Semaphore) -> Self {
        Self {
            pool,
            held: None,
            last: None,
        }
    }

    /// Waits until `bytes` in total are reserved.
    async fn grow(&mut self, bytes: usize) {
        let held = self.held.as_ref().map_or(0, SemaphorePermit::num_permits);
        let missing = bytes.div_ceil(1 << 10).saturating_sub(held);
        if self.last.is_some() || missing == 0 {
            return;
        }
        let missing = u32::try_from(missing).unwrap_or(u32::MAX);
        // The semaphore is never closed.
        tokio::select! {
            biased;
            more = self.pool.acquire_many(missing) => match (&mut self.held, more) {
                (Some(held), Ok(more)) => held.merge(more),
                (held, more) => *held = more.ok(),
            },
            last = LAST.acquire() => self.last = last.ok(),
        }
    }

    /// Waits until `bytes` in total are reserved. Fails after the time that a body of `longest` bytes may take.
    async fn grow_in_time(&mut self, bytes: usize, longest: usize) -> Result<(), BodyError> {
        let grown = timeout(time_for(longest), self.grow(bytes)).await;
        grown.map_err(|_| BodyError::NoRoom)
    }
}

/// The time in which a body of this size must arrive.
fn time_for(bytes: usize) -> Duration {
    TIME + Duration::from_secs(bytes as u64 / RATE)
}

/// Reads a body of at most `limit` bytes, and reserves memory in `room` as it arrives.
pub(crate) async fn read(
    mut body: Incoming,
    limit: usize,
    room: &mut Room<'_>,
) -> Result<Bytes, BodyError> {
    let hint = body.size_hint();
    if hint.lower() > limit as u64 {
        return Err(BodyError::TooLarge { limit });
    }
    let most = hint
        .upper()
        .map_or(limit, |upper| usize::try_from(upper).unwrap_or(limit));
    let mut whole = Vec::new();
    let mut start = Instant::now();
    loop {
        let deadline = (start + time_for(whole.len())).min(Instant::now() + TIME);
        let data = match timeout_at(deadline, body.frame()).await {
            Err(_) => return Err(BodyError::TooSlow),
            Ok(None) => return Ok(whole.into()),
            Ok(Some(Err(_))) => return Err(BodyError::Broken),
            Ok(Some(Ok(frame))) => frame.into_data().unwrap_or_default(),
        };
        if whole.is_empty() && body.is_end_stream() && data.len() <= SMALL.min(limit) {
            return Ok(data);
        }
        let length = whole.len() + data.len();
        if length > limit {
            return Err(BodyError::TooLarge { limit });
        }
        if length > whole.capacity().max(SMALL) {
            let size = (2 * length).min(most);
            let waits = Instant::now();
            room.grow_in_time(size, most).await?;
            // The client is not charged for this wait.
            start += waits.elapsed();
            whole.reserve_exact(size.saturating_sub(whole.len()));
        }
        whole.extend_from_slice(&data);
    }
}

/// Reserves memory for the decoded values of a large body. Short values take many times the size of their text.
pub(crate) async fn room_for_values(text: &Bytes, room: &mut Room<'_>) -> Result<(), BodyError> {
    let searched = text.clone();
    // Each value has a start tag of its own, whatever its name.
    let count = move || {
        let tags = memchr::memchr_iter(b'<', &searched).count();
        Ok(tags - memchr::memmem::find_iter(&searched, b"</").count())
    };
    let values = in_a_thread(count).await.unwrap_or_default();
    // A growing list reserves up to twice its content.
    let size = 2 * (text.len() + values * size_of::<Value>());
    room.grow_in_time(size, text.len()).await
}

/// Runs `work` outside of the runtime.
async fn in_a_thread<T: Send + 'static>(
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> Option<T> {
    crate::task::spawn_blocking(work).await.ok()?.ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn short_values_take_more_room_than_their_text() {
        for element in ["<value/>", "<a:value/>", "<nil/>", "<i4>1</i4>"] {
            let pool = Semaphore::new(80 << 10);
            let mut room = Room::new(&pool);
            let text = Bytes::from(element.repeat(100_000));
            room_for_values(&text, &mut room).await.unwrap();
            let left = (80 << 10) - 100 * 2 * size_of::<Value>();
            assert!(pool.available_permits() < left, "{element}");
        }
    }

    /// Each body holds a part of the memory and needs more than is left.
    #[tokio::test]
    async fn bodies_with_a_part_of_the_room_do_not_wait_for_each_other() {
        let pool = Semaphore::new(256);
        let body = || async {
            let mut room = Room::new(&pool);
            for kib in [32, 64, 128, 256] {
                room.grow(kib << 10).await;
                tokio::task::yield_now().await;
            }
        };
        let all = at_once((0..20).map(|_| body()));
        timeout(Duration::from_secs(20), all).await.unwrap();
        assert_eq!(pool.available_permits(), 256);
        assert_eq!(LAST.available_permits(), 1);
    }

    /// Runs all of them at the same time.
    async fn at_once(bodies: impl Iterator<Item = impl Future<Output = ()>>) {
        let mut bodies: Vec<_> = bodies.map(Box::pin).collect();
        std::future::poll_fn(|cx| {
            bodies.retain_mut(|body| body.as_mut().poll(cx).is_pending());
            if bodies.is_empty() {
                std::task::Poll::Ready(())
            } else {
                std::task::Poll::Pending
            }
        })
        .await;
    }
}
