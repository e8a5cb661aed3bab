//! Closes a connection if its peer sends a request's head too slowly, or does not read its answer.
//!
//! hyper's time limit for a head includes the idle time before it, and would close the keep-alive connections that
//! nodes hold for hours. Here the time starts with the first byte of the head. hyper has no time limit for writing.

use std::{
    io,
    pin::Pin,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU8, Ordering},
    },
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::Notify,
    time::{Instant, Sleep},
};

use super::{
    answers::Reader,
    idle::{Idle, Idling},
    replies::UntilWritten,
};

/// Time in which a request's head must arrive, counted from its first byte.
const HEAD_TIME: Duration = Duration::from_secs(10);
/// Time in which a peer must read a part of an answer.
const WRITE_TIME: Duration = Duration::from_secs(60);

/// The state of a connection within a request.
#[derive(Clone, Default)]
pub(crate) struct Deadlines {
    phase: Arc<AtomicU8>,
    /// Values that are dropped once the answer has been written.
    held: Arc<Mutex<Option<UntilWritten>>>,
    pub(super) reader: Arc<Reader>,
}

const IDLE: u8 = 0;
const HEAD: u8 = 1;
const SERVING: u8 = 2;
const REPLYING: u8 = 3;

impl Deadlines {
    /// Notes that the head has been read. The body and the answer have their own limits.
    pub(crate) fn serving(&self) {
        self.phase.store(SERVING, Ordering::Relaxed);
    }

    /// Notes that the answer is ready. After it has been sent, `held` is dropped, and the next byte starts a new head.
    pub(crate) fn replying(&self, held: Option<UntilWritten>) {
        *self.lock_held() = held;
        self.phase.store(REPLYING, Ordering::Relaxed);
    }

    fn lock_held(&self) -> MutexGuard<'_, Option<UntilWritten>> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether no request has begun since the last answer was sent.
    pub(crate) fn is_idle(&self) -> bool {
        self.is_in(IDLE)
    }

    /// Whether an answer is ready and has not been sent in full.
    pub(crate) fn is_replying(&self) -> bool {
        self.is_in(REPLYING)
    }

    fn is_in(&self, place: u8) -> bool {
        self.phase.load(Ordering::Relaxed) == place
    }
}

/// A stream that enforces `deadlines` and counts as idle between requests.
pub(crate) struct Timed<'a, S> {
    stream: S,
    deadlines: Deadlines,
    deadline: Pin<Box<Sleep>>,
    /// Whether the peer did not read in time.
    stuck: bool,
    idle: &'a Idle,
    /// Signals that the connection must close because too many are idle.
    close: Arc<Notify>,
    idling: Option<Idling<'a>>,
}

impl<'a, S> Timed<'a, S> {
    /// Wraps `stream` before its first request. `close` signals that `idle` has too many connections.
    pub(crate) fn new(stream: S, deadlines: Deadlines, idle: &'a Idle, close: Arc<Notify>) -> Self {
        Self {
            stream,
            deadlines,
            deadline: Box::pin(tokio::time::sleep(HEAD_TIME)),
            stuck: false,
            idling: Some(idle.enter(&close)),
            idle,
            close,
        }
    }

    /// Fails if a write has made no progress for too long.
    fn written(
        &mut self,
        cx: &mut Context<'_>,
        polled: Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        let was_stuck = std::mem::replace(&mut self.stuck, polled.is_pending());
        if let Poll::Ready(Ok(bytes)) = polled {
            self.deadlines.reader.note_read(bytes);
        }
        if !self.stuck {
            return polled;
        }
        if !was_stuck {
            self.deadline.as_mut().reset(Instant::now() + WRITE_TIME);
        }
        let overdue = self.deadline.as_mut().poll(cx);
        overdue.map(|()| Err(io::ErrorKind::TimedOut.into()))
    }
}

impl<S> Timed<'_, S> {
    pub(crate) fn stream(&self) -> &S {
        &self.stream
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Timed<'_, S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = &mut *self;
        let before = buf.filled().len();
        let polled = Pin::new(&mut this.stream).poll_read(cx, buf);
        if buf.filled().len() > before {
            this.idling = None;
            if this.deadlines.is_in(IDLE) {
                this.deadlines.phase.store(HEAD, Ordering::Relaxed);
                this.deadline.as_mut().reset(Instant::now() + HEAD_TIME);
            }
        }
        if polled.is_pending()
            && this.deadlines.is_in(HEAD)
            && this.deadline.as_mut().poll(cx).is_ready()
        {
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        polled
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Timed<'_, S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &[u8],
    ) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write(cx, buf);
        self.written(cx, polled)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = &mut *self;
        let polled = Pin::new(&mut this.stream).poll_flush(cx);
        // hyper flushes once the whole answer is written.
        if polled.is_ready() && this.deadlines.is_in(REPLYING) {
            this.deadlines.phase.store(IDLE, Ordering::Relaxed);
            let written = this.deadlines.lock_held().take();
            drop(written);
            this.idling = Some(this.idle.enter(&this.close));
        }
        polled
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write_vectored(cx, bufs);
        self.written(cx, polled)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn idle_time_does_not_count_and_a_dribbled_head_does() {
        let (mut peer, ours) = tokio::io::duplex(64);
        let idle = Idle::among(16);
        let deadlines = Deadlines::default();
        let mut stream = Timed::new(ours, deadlines.clone(), &idle, Arc::default());
        let mut byte = [0];
        for _ in 0..3 {
            let late = async {
                tokio::time::sleep(HEAD_TIME * 100).await;
                peer.write_all(b"P").await.unwrap();
            };
            let (read, ()) = tokio::join!(stream.read(&mut byte), late);
            assert_eq!(read.unwrap(), 1);
            deadlines.serving();
            deadlines.replying(None);
            stream.flush().await.unwrap();
        }
        let start = Instant::now();
        let dribble = async {
            for _ in 0..20 {
                peer.write_all(b"P").await.unwrap();
                tokio::time::sleep(Duration::from_secs(1)).await;
            }
        };
        let reader = async {
            loop {
                if let Err(error) = stream.read(&mut byte).await {
                    return (error.kind(), start.elapsed());
                }
            }
        };
        let (ended, ()) = tokio::join!(reader, dribble);
        assert_eq!(ended, (io::ErrorKind::TimedOut, HEAD_TIME));
    }

    #[tokio::test(start_paused = true)]
    async fn an_answer_may_be_read_slowly_but_must_be_read() {
        let (mut peer, ours) = tokio::io::duplex(64);
        let idle = Idle::among(16);
        let mut stream = Timed::new(ours, Deadlines::default(), &idle, Arc::default());
        let start = Instant::now();
        let slow = async {
            for _ in 0..5 {
                tokio::time::sleep(WRITE_TIME * 9 / 10).await;
                peer.read_exact(&mut [0; 64]).await.unwrap();
            }
            start.elapsed()
        };
        let (written, last) = tokio::join!(stream.write_all(&[0; 1000]), slow);
        assert_eq!(written.unwrap_err().kind(), io::ErrorKind::TimedOut);
        assert_eq!(start.elapsed(), last + WRITE_TIME);
    }

    #[tokio::test]
    async fn a_connection_is_idle_from_the_end_of_its_answer_to_the_next_request() {
        let (mut peer, ours) = tokio::io::duplex(64);
        let idle = Idle::among(2);
        let close = Arc::new(Notify::new());
        let deadlines = Deadlines::default();
        let mut stream = Timed::new(ours, deadlines.clone(), &idle, close.clone());
        let mut bytes = [0; 2];
        peer.write_all(b"PO").await.unwrap();
        stream.read_exact(&mut bytes).await.unwrap();
        deadlines.serving();
        deadlines.replying(None);
        stream.write_all(b"HTTP").await.unwrap();
        assert!(!deadlines.is_idle());
        // Another connection is idle at the same time.
        drop(idle.enter(&Arc::default()));
        stream.flush().await.unwrap();
        assert!(deadlines.is_idle());
        let _other = idle.enter(&Arc::default());
        close.notified().await;
    }
}
