//! A connection that ends when a peer sends a request's head too slowly.
//!
//! hyper's own limit on the time for a head also counts the idle time before it, and would close
//! the keep-alive connections that nodes hold for hours. Here the time begins with the head's first
//! byte.

use std::{
    io,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicU8, Ordering},
    },
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    time::{Instant, Sleep},
};

/// Where a connection stands between requests.
#[derive(Clone, Debug, Default)]
pub struct Pace(Arc<AtomicU8>);

const IDLE: u8 = 0;
const HEAD: u8 = 1;
const SERVING: u8 = 2;

impl Pace {
    /// The head has been read; the body and the answer have limits of their own.
    pub fn serving(&self) {
        self.0.store(SERVING, Ordering::Relaxed);
    }

    /// The request has been answered: the next byte begins a head.
    pub fn idle(&self) {
        self.0.store(IDLE, Ordering::Relaxed);
    }
}

/// A stream that keeps `pace`.
#[derive(Debug)]
pub struct Paced<S> {
    stream: S,
    pace: Pace,
    limit: Duration,
    deadline: Pin<Box<Sleep>>,
}

impl<S> Paced<S> {
    /// Ends `stream` when a head takes longer than `limit`.
    pub fn new(stream: S, pace: Pace, limit: Duration) -> Self {
        Self {
            stream,
            pace,
            limit,
            deadline: Box::pin(tokio::time::sleep(limit)),
        }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Paced<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = &mut *self;
        let before = buf.filled().len();
        let polled = Pin::new(&mut this.stream).poll_read(cx, buf);
        if buf.filled().len() > before && this.pace.0.load(Ordering::Relaxed) == IDLE {
            this.pace.0.store(HEAD, Ordering::Relaxed);
            this.deadline.as_mut().reset(Instant::now() + this.limit);
        }
        if polled.is_pending()
            && this.pace.0.load(Ordering::Relaxed) == HEAD
            && this.deadline.as_mut().poll(cx).is_ready()
        {
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        polled
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Paced<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, buf)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(cx, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;

    const LIMIT: Duration = Duration::from_secs(10);

    #[tokio::test(start_paused = true)]
    async fn idle_time_does_not_count_and_a_dribbled_head_does() {
        let (mut peer, ours) = tokio::io::duplex(64);
        let pace = Pace::default();
        let mut paced = Paced::new(ours, pace.clone(), LIMIT);
        let mut byte = [0];
        for _ in 0..3 {
            let late = async {
                tokio::time::sleep(LIMIT * 100).await;
                peer.write_all(b"P").await.unwrap();
            };
            let (read, ()) = tokio::join!(paced.read(&mut byte), late);
            assert_eq!(read.unwrap(), 1);
            pace.serving();
            pace.idle();
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
                if let Err(error) = paced.read(&mut byte).await {
                    return (error.kind(), start.elapsed());
                }
            }
        };
        let (ended, ()) = tokio::join!(reader, dribble);
        assert_eq!(ended, (io::ErrorKind::TimedOut, LIMIT));
    }
}
