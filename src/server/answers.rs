//! Limits the memory of large answers that are being sent, and closes slow readers when the memory is used up.

use std::{
    collections::HashMap,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use bytes::Bytes;
use http_body_util::BodyExt;
use hyper::body::Body;
use tokio::sync::{Mutex as Turn, Notify, OwnedSemaphorePermit, Semaphore};

use super::{body::SMALL, replies::HttpReply};

/// Minimum rate at which a client must read a large answer, in bytes per second. A slower client is closed when other
/// answers need its memory.
const RATE: u32 = 256 << 10;
/// Maximum credit that a client gains by reading faster than [`RATE`]. A client that pauses for this long counts as
/// slow.
const AHEAD: Duration = Duration::from_millis(250);
/// Maximum number of answers that may wait for memory although they are already encoded. They get memory before answers
/// that are not encoded yet. Therefore only a few answers must be dropped and encoded again.
const WAITING: usize = 4;

/// Tracks how fast one connection reads its large answers.
#[derive(Debug)]
pub(crate) struct Reader {
    /// Until when the reader counts as fast enough.
    fast_until: Mutex<Instant>,
    /// Whether the client has been sent a large answer.
    counts: AtomicBool,
    close: Notify,
    /// Whether the connection was told to close and is still open.
    close_requested: AtomicBool,
}

impl Default for Reader {
    fn default() -> Self {
        Self {
            fast_until: Mutex::new(Instant::now()),
            counts: AtomicBool::new(false),
            close: Notify::new(),
            close_requested: AtomicBool::new(false),
        }
    }
}

impl Reader {
    fn fast_until(&self) -> MutexGuard<'_, Instant> {
        self.fast_until
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that the client has read this many bytes.
    pub(crate) fn note_read(&self, bytes: usize) {
        if self.counts.load(Ordering::Relaxed) {
            let mut until = self.fast_until();
            *until = fast_until(*until, Instant::now(), bytes);
        }
    }

    /// Completes when the connection should close, unless it [is no longer slow](Self::is_slow).
    pub(crate) async fn wait_until_closing(&self) {
        self.close.notified().await;
        self.close_requested.store(false, Ordering::Relaxed);
    }

    /// Whether the client is too slow. The caller should first try to write once more, because rosrescue itself may
    /// have been busy.
    pub(crate) fn is_slow(&self) -> bool {
        *self.fast_until() <= Instant::now()
    }
}

/// Until when a reader counts as fast enough, if it has read `bytes` at `now` and counted as fast enough until
/// `before`.
fn fast_until(before: Instant, now: Instant, bytes: usize) -> Instant {
    let bytes = u32::try_from(bytes).unwrap_or(u32::MAX);
    let earned = Duration::from_secs(1) * bytes / RATE;
    // The result may still be in the past, so a client that reads a single byte from time to time stays slow.
    (before + earned).min(now + AHEAD)
}

/// Memory for large answers.
#[derive(Debug)]
pub struct AnswerMemory {
    /// Size in KiB.
    size: u32,
    room: Arc<Semaphore>,
    /// Requests that wait for memory before their answer is encoded, in order.
    turn: Turn<()>,
    waiting: Semaphore,
    under_way: Mutex<HashMap<u64, Arc<Reader>>>,
    next: AtomicU64,
}

/// Memory for one answer, released on drop.
#[derive(Debug)]
pub(crate) struct AnswerRoom(OwnedSemaphorePermit);

/// An answer's bytes, which count against the memory limit until they have been written.
struct ReservedBytes {
    bytes: Bytes,
    number: u64,
    answers: Arc<AnswerMemory>,
    _room: AnswerRoom,
}

impl AsRef<[u8]> for ReservedBytes {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Drop for ReservedBytes {
    fn drop(&mut self) {
        lock(&self.answers.under_way).remove(&self.number);
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The size of an answer in bytes, if it is a large one.
pub(crate) fn size(reply: &HttpReply) -> Option<usize> {
    let size = reply.body().size_hint().exact()?;
    let size = usize::try_from(size).unwrap_or(usize::MAX);
    (size > SMALL).then_some(size)
}

impl AnswerMemory {
    /// Creates memory for large answers of `bytes` in total. A larger answer takes all of it.
    pub(crate) fn within(bytes: usize) -> Arc<Self> {
        let size = u32::try_from(bytes >> 10).unwrap_or(u32::MAX);
        Arc::new(Self {
            size,
            room: Arc::new(Semaphore::new(size as usize)),
            turn: Turn::default(),
            waiting: Semaphore::new(WAITING),
            under_way: Mutex::default(),
            next: AtomicU64::new(0),
        })
    }

    fn kib(&self, bytes: usize) -> u32 {
        let kib = u32::try_from(bytes.div_ceil(1 << 10)).unwrap_or(u32::MAX);
        kib.min(self.size)
    }

    /// Returns `room` if it is enough for `bytes`, or a new reservation if memory becomes free soon.
    pub(crate) async fn room_for(
        &self,
        room: Option<AnswerRoom>,
        bytes: usize,
    ) -> Option<AnswerRoom> {
        let kib = self.kib(bytes);
        if let Some(room) = room
            && room.0.num_permits() >= kib as usize
        {
            return Some(room);
        }
        let room = self.room.clone().try_acquire_many_owned(kib);
        match room {
            Ok(room) => Some(AnswerRoom(room)),
            Err(_) => self.reserve_now(bytes).await,
        }
    }

    /// Reserves memory for an answer that has not been encoded yet.
    pub(crate) async fn reserve(&self, bytes: usize) -> AnswerRoom {
        let _turn = self.turn.lock().await;
        self.acquire(bytes).await
    }

    /// Reserves memory for an encoded answer. `None` if too many encoded answers already wait.
    async fn reserve_now(&self, bytes: usize) -> Option<AnswerRoom> {
        let _waiting = self.waiting.try_acquire().ok()?;
        Some(self.acquire(bytes).await)
    }

    /// Reserves memory, and closes clients that read too slowly.
    async fn acquire(&self, bytes: usize) -> AnswerRoom {
        let mut room = std::pin::pin!(self.room.clone().acquire_many_owned(self.kib(bytes)));
        loop {
            let next = self.close_slowest(Instant::now());
            tokio::select! {
                biased;
                room = &mut room => match room {
                    Ok(room) => return AnswerRoom(room),
                    // The semaphore is never closed.
                    Err(_) => std::future::pending().await,
                },
                () = tokio::time::sleep_until(next.into()) => {}
            }
        }
    }

    /// Closes the connection that has been too slow for longest, if there is one. Returns when to check again.
    fn close_slowest(&self, now: Instant) -> Instant {
        let under_way = lock(&self.under_way);
        let readers = under_way
            .iter()
            .filter(|(_, reader)| !reader.close_requested.load(Ordering::Relaxed))
            .map(|(number, reader)| (*reader.fast_until(), *number));
        let Some((until, number)) = readers.min() else {
            return now + AHEAD;
        };
        if until > now {
            return until;
        }
        if let Some(reader) = under_way.get(&number) {
            reader.close_requested.store(true, Ordering::Relaxed);
            reader.close.notify_one();
        }
        // If this connection does not free enough memory, the next one is closed.
        now + Duration::from_millis(1)
    }

    /// Returns `reply` in a form that keeps `room`, its share of the memory for large answers, until `reader` has read
    /// all of the reply.
    pub(crate) async fn hold_room(
        self: &Arc<Self>,
        reply: HttpReply,
        room: AnswerRoom,
        reader: &Arc<Reader>,
    ) -> HttpReply {
        let (head, body) = reply.into_parts();
        let Ok(whole) = body.collect().await;
        let bytes = whole.to_bytes();
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        *reader.fast_until() = Instant::now() + AHEAD;
        reader.counts.store(true, Ordering::Relaxed);
        lock(&self.under_way).insert(number, reader.clone());
        let reserved = ReservedBytes {
            bytes,
            number,
            answers: self.clone(),
            _room: room,
        };
        HttpReply::from_parts(head, Bytes::from_owner(reserved).into())
    }
}

#[cfg(test)]
mod tests {
    use hyper::StatusCode;

    use super::*;
    use crate::server::replies::text;

    const LARGE: usize = 100 << 10;

    async fn sent(answers: &Arc<AnswerMemory>, reader: &Arc<Reader>) -> HttpReply {
        let reply = text(StatusCode::OK, "x".repeat(LARGE));
        assert_eq!(size(&reply), Some(LARGE));
        let room = answers.reserve(LARGE).await;
        answers.hold_room(reply, room, reader).await
    }

    #[test]
    fn who_reads_steadily_is_fast_enough_and_who_dribbles_is_not() {
        let start = Instant::now();
        let step = Duration::from_millis(125);
        let slack = |bytes, steps: u32| {
            let until = (1..=steps).fold(start + AHEAD, |until, number| {
                fast_until(until, start + step * number, bytes)
            });
            until.checked_duration_since(start + step * steps)
        };
        let enough = RATE as usize / 8;
        assert_eq!(slack(enough, 100), Some(AHEAD));
        assert_eq!(slack(10 * enough, 100), Some(AHEAD), "no more than that");
        assert_eq!(slack(enough / 10, 3), None);
        assert_eq!(slack(0, 2), Some(AHEAD - 2 * step));
    }

    #[tokio::test]
    async fn room_is_held_until_the_bytes_are_gone() {
        let answers = AnswerMemory::within(2 * LARGE);
        let reader = Arc::default();
        let first = sent(&answers, &reader).await;
        let Ok(bytes) = first.into_body().collect().await;
        let _second = sent(&answers, &reader).await;
        assert_eq!(answers.room.available_permits(), 0);
        drop(bytes);
        let room = answers.room_for(None, LARGE).await.unwrap();
        // An existing reservation is used if it is large enough.
        assert!(answers.room_for(Some(room), LARGE).await.is_some());
        assert_eq!(lock(&answers.under_way).len(), 1);
    }

    #[tokio::test]
    async fn the_slowest_is_closed_when_there_is_no_room() {
        let answers = AnswerMemory::within(2 * LARGE);
        let readers = [(); 2].map(|()| Arc::<Reader>::default());
        let mut held = Vec::new();
        for reader in &readers {
            held.push(sent(&answers, reader).await);
        }
        // The first reader has just read something.
        let slow = async {
            readers[1].wait_until_closing().await;
            held.pop();
        };
        let reading = async {
            loop {
                readers[0].note_read(LARGE);
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        };
        let waiting = async { tokio::join!(answers.reserve(LARGE), slow) };
        tokio::select! {
            _ = waiting => {}
            () = reading => {}
            () = readers[0].wait_until_closing() => panic!("it is fast enough"),
        }
    }

    #[tokio::test]
    async fn there_is_room_for_an_answer_however_large_it_is() {
        let answers = AnswerMemory::within(2 * LARGE);
        assert!(answers.room_for(None, 100 * LARGE).await.is_some());
    }
}
