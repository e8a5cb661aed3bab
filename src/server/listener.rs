//! Listening sockets and their connections.

use std::{
    io,
    net::{self, IpAddr, Ipv6Addr, SocketAddr},
    sync::Arc,
    time::{Duration, Instant},
};

use hyper::service::service_fn;
use hyper_util::rt::TokioIo;
use socket2::{Domain, Protocol, SockRef, Socket, TcpKeepalive, Type};
use thiserror::Error;
use tokio::{
    net::{TcpListener, TcpStream},
    sync::{Notify, Semaphore},
};
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tracing::Instrument;

use super::{
    Server,
    deadlines::{Deadlines, Timed},
    service,
};
use crate::{limit::rarely, process::listeners, task::boxed};

/// Number of connections that the kernel holds while rosrescue is busy or restarting.
const BACKLOG: i32 = 1024;
/// Read buffer of a connection, in bytes. hyper keeps it while the connection is idle. A head must
/// fit into it.
const BUFFER: usize = 16 << 10;
/// Pause after a failed accept, for example for lack of a file descriptor.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);
/// Idle time after which the kernel probes the peer, so that connections of vanished computers do
/// not pile up.
const KEEPALIVE: Duration = Duration::from_secs(60);

/// How long a port may stay in use at the start. The kernel closes the sockets of a killed process a moment after its
/// end.
const LINGER: Duration = Duration::from_secs(2);
const LINGER_PAUSE: Duration = Duration::from_millis(20);

/// Why an address cannot be served.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ListenError {
    /// Another process has the port.
    #[error(
        "port {} is in use at {} by {by}: stop it, or choose another port with {option}",
        address.port(), address.ip()
    )]
    InUse {
        address: SocketAddr,
        /// The processes that listen at the port.
        by: String,
        /// The option that chooses the port.
        option: &'static str,
    },
    /// The address cannot be served for another reason.
    #[error("cannot listen at {address}: {source}; choose another one with {option}")]
    Other {
        address: SocketAddr,
        /// The option that chooses the faulty part of the address.
        option: &'static str,
        source: io::Error,
    },
}

/// Listens at all of `addresses`, without blocking. Waits up to two seconds for a port that is in
/// use. Addresses after the first are left out if the computer lacks their address family. With
/// port 0 they share one free port. Errors name `option`, which chooses the port.
pub fn bind(
    addresses: &[SocketAddr],
    option: &'static str,
) -> Result<Vec<net::TcpListener>, ListenError> {
    let mut listeners: Vec<net::TcpListener> = Vec::new();
    let mut port = None;
    let begin = Instant::now();
    for address in addresses {
        let address = SocketAddr::new(address.ip(), port.unwrap_or_else(|| address.port()));
        match bind_lingering(address, begin + LINGER) {
            Ok(listener) => {
                port = listener.local_addr().ok().map(|bound| bound.port());
                listeners.push(listener);
            }
            Err(source) if source.kind() == io::ErrorKind::AddrInUse => {
                let by = listeners::named(address.port());
                return Err(ListenError::InUse {
                    address,
                    by,
                    option,
                });
            }
            Err(error) if !listeners.is_empty() => {
                tracing::debug!(%address, %error, "not served");
            }
            Err(source) => {
                // Some ports are for root only; other errors concern the address.
                let option = match source.kind() {
                    io::ErrorKind::PermissionDenied => option,
                    _ => "--listen",
                };
                return Err(ListenError::Other {
                    address,
                    option,
                    source,
                });
            }
        }
    }
    Ok(listeners)
}

/// Retries [`bind_one`] until `deadline` while the port is in use.
fn bind_lingering(address: SocketAddr, deadline: Instant) -> io::Result<net::TcpListener> {
    loop {
        match bind_one(address) {
            Err(error) if error.kind() == io::ErrorKind::AddrInUse && Instant::now() < deadline => {
                std::thread::sleep(LINGER_PAUSE);
            }
            bound => return bound,
        }
    }
}

fn bind_one(address: SocketAddr) -> io::Result<net::TcpListener> {
    let socket = Socket::new(
        Domain::for_address(address),
        Type::STREAM,
        Some(Protocol::TCP),
    )?;
    socket.set_reuse_address(true)?;
    if address.is_ipv6() {
        socket.set_only_v6(true)?;
    }
    socket.set_nonblocking(true)?;
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    Ok(socket.into())
}

/// Serves `listener` until `stop`. Running requests may finish.
pub async fn run(
    listener: TcpListener,
    server: Arc<Server>,
    permits: Arc<Semaphore>,
    connections: TaskTracker,
    stop: CancellationToken,
) {
    let mut failed = false;
    loop {
        // The permit comes second, so that an idle listener takes none.
        let accepted = async {
            let accepted = listener.accept().await?;
            // The semaphore is never closed.
            let permit = permits.clone().acquire_owned().await;
            io::Result::Ok((accepted, permit))
        };
        let accepted = tokio::select! {
            accepted = accepted => accepted,
            () = stop.cancelled() => return,
        };
        match accepted {
            Ok(((stream, peer), permit)) => {
                failed = false;
                let connection = serve(stream, peer, server.clone(), stop.clone());
                let served = async move {
                    connection.await;
                    drop(permit);
                };
                let span = tracing::debug_span!("connection", %peer);
                connections.spawn(boxed(served.instrument(span)));
            }
            Err(error) => {
                if !std::mem::replace(&mut failed, true) {
                    rarely!(warn, %error, "cannot accept connections; retrying; raise the limit on open files if that is the reason");
                }
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

async fn serve(stream: TcpStream, peer: SocketAddr, server: Arc<Server>, stop: CancellationToken) {
    let keepalive = TcpKeepalive::new()
        .with_time(KEEPALIVE)
        .with_interval(KEEPALIVE / 4);
    let _ = SockRef::from(&stream).set_tcp_keepalive(&keepalive);
    let _ = stream.set_nodelay(true);
    let own = stream.local_addr().ok().map(|own| own.ip());
    let grant = server.access.grant_for(peer.ip(), own);
    let peer = SocketAddr::new(peer.ip().to_canonical(), peer.port());
    let here = server.clone();
    let _present = here.clients.enter(peer);
    let deadlines = Deadlines::default();
    let close = Arc::new(Notify::new());
    let timed = Timed::new(stream, deadlines.clone(), &here.idle, close.clone());
    let service = |request| {
        // The future is boxed, so that idle connections hold no memory for it.
        Box::pin(service::serve(
            server.clone(),
            peer,
            grant,
            deadlines.clone(),
            request,
        ))
    };
    let mut connection = hyper::server::conn::http1::Builder::new()
        .title_case_headers(true)
        .half_close(true)
        .max_buf_size(BUFFER)
        .serve_connection(TokioIo::new(timed), service_fn(service));
    let ended = loop {
        tokio::select! {
            // A request that has arrived is served first.
            biased;
            ended = &mut connection => break ended,
            () = close.notified() => {
                if deadlines.is_idle() {
                    tracing::debug!(%peer, "closed the connection that was idle for longest");
                    return;
                }
            }
            () = deadlines.reader.wait_until_closing() => {
                if deadlines.is_replying() && deadlines.reader.is_slow() {
                    tracing::debug!(%peer, "closed a connection that reads too slowly: other answers need its memory");
                    // A reset: the kernel drops the answer, and the client calls again.
                    let stream = connection.into_parts().io.into_inner();
                    let _ = SockRef::from(stream.stream()).set_linger(Some(Duration::ZERO));
                    return;
                }
            }
            () = stop.cancelled() => {
                std::pin::Pin::new(&mut connection).graceful_shutdown();
                break connection.await;
            }
        }
    };
    if let Err(error) = ended {
        tracing::debug!(%peer, %error, "connection");
    }
}

/// This computer's address in the network, if it has one: the source address of its default route. No packet is sent.
pub fn local_address() -> Option<IpAddr> {
    let routed = |from: SocketAddr, to: SocketAddr| {
        let socket = net::UdpSocket::bind(from).ok()?;
        socket.connect(to).ok()?;
        Some(socket.local_addr().ok()?.ip())
    };
    // These addresses are reserved for documentation, but routed like any other.
    let v4 = routed(([0, 0, 0, 0], 0).into(), ([192, 0, 2, 1], 9).into());
    let documentation = Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 1);
    v4.or_else(|| routed((Ipv6Addr::UNSPECIFIED, 0).into(), (documentation, 9).into()))
}
