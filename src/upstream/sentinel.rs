//! The sentinel: a connection to the master on which nothing is ever sent. It ends when the master
//! ends.

use std::{io, mem::MaybeUninit, net::SocketAddr, sync::Arc, time::Duration};

use socket2::SockRef;
use tokio::{net::TcpStream, sync::watch};
use tokio_util::task::AbortOnDropHandle;

use super::{ConnectError, Upstream, is_local};

/// A connection on which nothing is ever sent. Even a master that closes each connection after one
/// answer leaves it open. It is renewed from time to time, because a master may close idle
/// connections.
#[derive(Debug)]
pub(crate) struct Sentinel {
    stream: watch::Sender<Arc<TcpStream>>,
    local: bool,
    peer: SocketAddr,
}

impl Sentinel {
    pub(super) fn new(stream: TcpStream) -> io::Result<Self> {
        let peer = stream.peer_addr()?;
        Ok(Self {
            local: is_local(peer, stream.local_addr()?),
            peer,
            stream: watch::Sender::new(Arc::new(stream)),
        })
    }

    /// Whether the other end seems to be on this computer. A tunnel's near end also counts.
    pub(crate) fn is_local(&self) -> bool {
        self.local
    }

    /// Address of the other end.
    pub(crate) fn peer(&self) -> SocketAddr {
        self.peer
    }

    /// Whether the connection is open. Asks the kernel, because the runtime may not have noticed its end yet.
    pub(crate) fn is_open(&self) -> bool {
        let mut byte = [MaybeUninit::uninit()];
        let peeked = SockRef::from(&**self.stream.borrow()).peek(&mut byte);
        peeked.is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock)
    }

    /// Replaces the connection by a new one to the same process. The kernel closes the descriptors
    /// of a dying process one by one, mostly the newest first.
    async fn renew(&self, upstream: &Upstream) -> Result<(), ConnectError> {
        let (_, stream) = upstream.bounded_stream().await?;
        // The old connection is still open, so the new one must lead to the same process.
        if self.is_open() {
            self.stream.send_replace(Arc::new(stream));
        }
        Ok(())
    }

    /// Renews the connection every `pause` until it has ended. A task of its own renews, because the caller may occupy
    /// its thread for seconds.
    pub(crate) async fn watch(self: Arc<Self>, upstream: Arc<Upstream>, pause: Duration) {
        let sentinel = self.clone();
        let _renewing = AbortOnDropHandle::new(crate::task::spawn(async move {
            loop {
                tokio::time::sleep(pause).await;
                // If this fails, the end of the connection shows why.
                let _ = sentinel.renew(&upstream).await;
            }
        }));
        self.wait_until_ended().await;
    }

    /// Waits until the connection has ended, or until the other end sends data without a request, which no master does.
    async fn wait_until_ended(&self) {
        let mut renewed = self.stream.subscribe();
        loop {
            let stream = renewed.borrow_and_update().clone();
            let mut byte = [0];
            tokio::select! {
                biased;
                _ = renewed.changed() => {}
                _ = stream.peek(&mut byte) => return,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use tokio::net::TcpListener;

    use super::*;

    /// Waits until `sentinel` has ended, without a turn of the runtime. Until a process that another test starts has
    /// called exec, it has copies of the sockets.
    fn await_end(sentinel: &Sentinel, why: &str) {
        let start = Instant::now();
        while sentinel.is_open() {
            assert!(start.elapsed() < Duration::from_secs(60), "open: {why}");
            std::thread::yield_now();
        }
    }

    #[tokio::test]
    async fn the_end_of_the_other_side_is_seen_at_once() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let connect =
            || async { Sentinel::new(TcpStream::connect(address).await.unwrap()).unwrap() };
        let sentinel = connect().await;
        let waiting = connect().await;
        assert!(sentinel.is_local() && sentinel.peer() == address);
        assert!(sentinel.is_open() && waiting.is_open(), "not accepted yet");
        let (accepted, _) = listener.accept().await.unwrap();
        let early =
            tokio::time::timeout(Duration::from_millis(20), sentinel.wait_until_ended()).await;
        assert!(early.is_err() && sentinel.is_open());
        drop(accepted);
        await_end(&sentinel, "the other end is closed");
        sentinel.wait_until_ended().await;
        assert!(waiting.is_open());
        let silent = tokio::time::timeout(Duration::from_millis(20), waiting.wait_until_ended());
        assert!(silent.await.is_err());
        drop(listener);
        await_end(&waiting, "nobody can accept it any more");
    }

    #[tokio::test]
    async fn a_renewed_one_leads_to_the_same_process() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let uri = crate::ros_env::MasterUri::parse(&format!("http://{address}")).unwrap();
        let upstream = Upstream::new(uri, Duration::from_secs(1), 3);
        let sentinel = Arc::new(upstream.connect_sentinel().await.unwrap());
        let ended = crate::task::spawn({
            let sentinel = sentinel.clone();
            async move { sentinel.wait_until_ended().await }
        });
        let (first, _) = listener.accept().await.unwrap();
        sentinel.renew(&upstream).await.unwrap();
        let (second, _) = listener.accept().await.unwrap();
        assert_eq!(first.peek(&mut [0]).await.unwrap(), 0, "it is closed");
        drop(first);
        assert!(sentinel.is_open() && !ended.is_finished());
        drop(second);
        ended.await.unwrap();
        // The process is gone, so a connection to its successor is not trusted.
        sentinel.renew(&upstream).await.unwrap();
        assert!(!sentinel.is_open());
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 1)]
    async fn it_is_renewed_while_its_watcher_occupies_its_thread() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let uri = crate::ros_env::MasterUri::parse(&format!("http://{address}")).unwrap();
        let upstream = Arc::new(Upstream::new(uri, Duration::from_secs(1), 3));
        let sentinel = Arc::new(upstream.connect_sentinel().await.unwrap());
        let (accepted, connections) = std::sync::mpsc::sync_channel(2);
        std::thread::spawn(move || {
            for connection in listener.incoming() {
                let _ = accepted.send(connection);
            }
        });
        let busy = async {
            tokio::task::block_in_place(|| {
                ["the first", "the renewed"].map(|connection| {
                    let next = connections.recv_timeout(Duration::from_secs(20));
                    next.expect(connection).unwrap()
                })
            })
        };
        tokio::select! {
            biased;
            () = sentinel.watch(upstream, Duration::from_millis(1)) => panic!("it ended"),
            _open = busy => {}
        }
    }
}
