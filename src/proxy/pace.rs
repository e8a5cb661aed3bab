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

use socket2::SockRef;
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::TcpStream,
    time::{Instant, Sleep},
};

/// Where a connection stands between requests.
#[derive(Clone, Debug, Default)]
pub struct Pace {
    place: Arc<AtomicU8>,
    stream: Option<Arc<TcpStream>>,
}

const IDLE: u8 = 0;
const HEAD: u8 = 1;
const SERVING: u8 = 2;

impl Pace {
    /// The pace of `stream`.
    pub fn of(stream: Arc<TcpStream>) -> Self {
        Self {
            place: Arc::default(),
            stream: Some(stream),
        }
    }

    /// Returns when the peer has closed its side behind the request, as it does when it ends.
    /// Never if it has sent more.
    pub async fn hung_up(&self) {
        if let Some(stream) = &self.stream
            && !matches!(stream.peek(&mut [0]).await, Ok(1..))
        {
            return;
        }
        std::future::pending().await
    }

    /// The head has been read; the body and the answer have limits of their own.
    pub fn serving(&self) {
        self.place.store(SERVING, Ordering::Relaxed);
    }

    /// The request has been answered: the next byte begins a head.
    pub fn idle(&self) {
        self.place.store(IDLE, Ordering::Relaxed);
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
        if buf.filled().len() > before && this.pace.place.load(Ordering::Relaxed) == IDLE {
            this.pace.place.store(HEAD, Ordering::Relaxed);
            this.deadline.as_mut().reset(Instant::now() + this.limit);
        }
        if polled.is_pending()
            && this.pace.place.load(Ordering::Relaxed) == HEAD
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

/// A stream that [`Pace::hung_up`] may look at beside its reader.
#[derive(Debug)]
pub struct Shared(pub Arc<TcpStream>);

impl Shared {
    /// Tries until it is done, fails, or has to wait for readiness.
    fn attempt<T>(
        ready: impl Fn() -> Poll<io::Result<()>>,
        mut attempt: impl FnMut() -> io::Result<T>,
    ) -> Poll<io::Result<T>> {
        loop {
            std::task::ready!(ready())?;
            match attempt() {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                done => return Poll::Ready(done),
            }
        }
    }
}

impl AsyncRead for Shared {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let cx = std::cell::RefCell::new(cx);
        let ready = || self.0.poll_read_ready(&mut cx.borrow_mut());
        let read = std::task::ready!(Self::attempt(ready, || {
            self.0.try_read(buf.initialize_unfilled())
        }))?;
        buf.advance(read);
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Shared {
    fn poll_write(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.poll_write_vectored(cx, &[io::IoSlice::new(buf)])
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(SockRef::from(&*self.0).shutdown(std::net::Shutdown::Write))
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let cx = std::cell::RefCell::new(cx);
        let ready = || self.0.poll_write_ready(&mut cx.borrow_mut());
        Self::attempt(ready, || self.0.try_write_vectored(bufs))
    }

    fn is_write_vectored(&self) -> bool {
        true
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
