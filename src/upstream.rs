//! Connections to the master.

mod connection;
pub(crate) mod inspect;
pub(crate) mod peer;
pub(crate) mod pool;
pub(crate) mod sockets;

use std::{io, net::SocketAddr, time::Duration};

use bytes::Bytes;
use hyper::{HeaderMap, StatusCode, ext::ReasonPhrase, header::HeaderValue};
use socket2::{SockRef, TcpKeepalive};
use thiserror::Error;
use tokio::{net::TcpStream, sync::watch, time::timeout};

pub(crate) use self::connection::Connection;
use crate::{
    resolver,
    ros_env::MasterUri,
    xmlrpc::{self, Reply},
};

/// Largest accepted reply of the master, in bytes. A parameter tree of 64 MiB, encoded again as XML, is
/// smaller.
const MAX_REPLY: usize = 512 << 20;
/// Limit on a connect: a host that drops packets never answers.
const CONNECT_LIMIT: Duration = Duration::from_secs(3);

/// In each request to the master, so that a proxy that points at itself notices.
pub(crate) const INSTANCE_HEADER: &str = "x-rosrescue-instance";

/// Why a connection could not be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConnectError {
    #[error("nothing listens at {master}")]
    Refused { master: String },
    /// There is no route, or no answer.
    #[error("cannot reach {master}: {source}")]
    Unreachable { master: String, source: io::Error },
}

/// A call without a reply. Whether the master may have run it decides what may follow.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CallError {
    /// No byte was sent: it may be sent again.
    #[error("the call was not sent: {0}")]
    NotSent(hyper::Error),
    /// The master may have run it.
    #[error("the master gave no reply: {0}")]
    MaybeSent(hyper::Error),
    /// The reply's body broke off, or exceeded all limits.
    #[error("the master's reply is not whole: {0}")]
    BrokenReply(Box<dyn std::error::Error + Send + Sync>),
    /// The reply is whole, but not XML-RPC; only for calls of our own.
    #[error("the master's reply is no XML-RPC (HTTP status {status}): {reason}")]
    NotXmlRpc { status: StatusCode, reason: String },
}

/// The parts of a client's request, besides the body, that matter to the master.
#[derive(Clone, Debug)]
pub struct Head {
    /// The request's target, such as `/RPC2`.
    pub path: String,
    /// The body's content encoding, if any.
    pub encoding: Option<HeaderValue>,
}

impl Default for Head {
    fn default() -> Self {
        Self {
            path: "/".to_owned(),
            encoding: None,
        }
    }
}

impl RawReply {
    /// Whether the connection may be used again. rosmaster does not read the body of a request whose head it
    /// refuses, and would take it for the next request.
    pub fn leaves_connection_usable(&self) -> bool {
        self.status.is_success()
    }
}

#[derive(Clone, Debug)]
pub struct RawReply {
    pub status: StatusCode,
    /// The reason phrase, unless it is the usual one.
    pub reason: Option<ReasonPhrase>,
    pub headers: HeaderMap,
    pub body: Bytes,
}

impl RawReply {
    pub fn decode(&self) -> Result<Reply, CallError> {
        xmlrpc::decode_reply(&self.body).map_err(|error| CallError::NotXmlRpc {
            status: self.status,
            reason: error.to_string(),
        })
    }
}

/// Connects to the master, wherever it is.
#[derive(Debug)]
pub struct Upstream {
    address: watch::Sender<MasterUri>,
    instance: HeaderValue,
    probe_timeout: Duration,
    probe_count: u32,
    /// The master's addresses as resolved last.
    found: watch::Sender<Option<(MasterUri, Vec<SocketAddr>)>>,
    /// Number of connections for writes.
    writers: watch::Sender<usize>,
}

/// Counts a connection for writes until it ends.
#[derive(Debug)]
struct Writer(watch::Sender<usize>);

impl Drop for Writer {
    fn drop(&mut self) {
        self.0.send_modify(|count| *count = count.saturating_sub(1));
    }
}

impl Upstream {
    /// Connections to `address`. `instance` identifies this process. A connection ends when the kernel's
    /// probes, the same number with the same timeout, are not answered either.
    pub fn new(
        address: MasterUri,
        instance: HeaderValue,
        probe_timeout: Duration,
        probe_count: u32,
    ) -> Self {
        Self {
            address: watch::Sender::new(address),
            instance,
            probe_timeout,
            probe_count,
            found: watch::Sender::new(None),
            writers: watch::Sender::new(0),
        }
    }

    pub fn address(&self) -> MasterUri {
        self.address.borrow().clone()
    }

    /// Sets the master's address; open connections stay as they are.
    pub fn relocate(&self, address: MasterUri) {
        self.address.send_replace(address);
    }

    pub async fn connect(&self) -> Result<Connection, ConnectError> {
        self.connect_with(None).await
    }

    /// A new connection for writes; see [`Self::no_writers`].
    pub async fn connect_for_writes(&self) -> Result<Connection, ConnectError> {
        self.writers.send_modify(|count| *count += 1);
        self.connect_with(Some(Writer(self.writers.clone()))).await
    }

    /// Returns when every connection for writes has ended.
    pub async fn no_writers(&self) {
        // We own a sender.
        let _ = self.writers.subscribe().wait_for(|count| *count == 0).await;
    }

    async fn connect_with(&self, writer: Option<Writer>) -> Result<Connection, ConnectError> {
        let address = self.address();
        let unreachable = |source| ConnectError::Unreachable {
            master: address.to_string(),
            source,
        };
        let connecting = async { open(self.find(&address).await?).await };
        let stream = match timeout(CONNECT_LIMIT, connecting).await {
            Err(_) => return Err(unreachable(io::ErrorKind::TimedOut.into())),
            Ok(Err(error)) if error.kind() == io::ErrorKind::ConnectionRefused => {
                return Err(ConnectError::Refused {
                    master: address.to_string(),
                });
            }
            Ok(Err(error)) => return Err(unreachable(error)),
            Ok(Ok(stream)) => stream,
        };
        // Best effort: the connection works without it.
        let _ = self.bound_silence(&stream);
        Connection::open(stream, &address, self.instance.clone(), MAX_REPLY, writer)
            .await
            .map_err(unreachable)
    }

    /// The addresses of the master. When its name cannot be resolved, those resolved last: a failing name
    /// server must not cut off a master that lives.
    async fn find(&self, address: &MasterUri) -> io::Result<Vec<SocketAddr>> {
        if let Ok(ip) = address.host.parse() {
            return Ok(vec![SocketAddr::new(ip, address.port)]);
        }
        let (found, asked) = (self.found.clone(), address.clone());
        // In a task: a late answer serves the next connection, so that a moved master is found however slow
        // the name server is.
        let lookup = tokio::spawn(async move {
            let addresses = resolver::addresses(&asked.host, asked.port).await?;
            found.send_replace(Some((asked, addresses)));
            io::Result::Ok(())
        });
        let known = || {
            let found = self.found.borrow();
            let found = found.as_ref().filter(|(of, _)| of == address);
            found.map(|(_, addresses)| addresses.clone())
        };
        if known().is_some() {
            // The rest of a probe's time is for the master itself.
            let _ = timeout(self.probe_timeout / 4, lookup).await;
        } else {
            lookup.await.map_err(io::Error::other)??;
        }
        known().ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    /// Ends a connection whose other side has acknowledged nothing for a little longer than the probes take
    /// to find a dead master. The kernel of a hung master still acknowledges. If a cable is cut, or a router
    /// has forgotten the connection, nothing is acknowledged, and TCP itself would take a quarter of an hour.
    /// Not needed on this computer.
    fn bound_silence(&self, stream: &TcpStream) -> io::Result<()> {
        if is_local(stream)? {
            return Ok(());
        }
        // The kernel counts whole seconds here.
        let interval = self.probe_timeout.max(Duration::from_secs(1));
        let probes = TcpKeepalive::new()
            .with_time(interval)
            .with_interval(interval);
        let socket = SockRef::from(stream);
        socket.set_tcp_keepalive(&probes)?;
        // This limit, not a count, also ends the probes.
        socket.set_tcp_user_timeout(Some(interval * (self.probe_count + 1)))
    }
}

/// Connects to the first of `addresses` that accepts. A refusal is reported before an unreachable address: it
/// shows more about the master.
async fn open(addresses: Vec<SocketAddr>) -> io::Result<TcpStream> {
    let mut failure = io::Error::from(io::ErrorKind::NotFound);
    for address in addresses {
        match TcpStream::connect(address).await {
            Ok(stream) => return Ok(stream),
            Err(_) if failure.kind() == io::ErrorKind::ConnectionRefused => {}
            Err(error) => failure = error,
        }
    }
    Err(failure)
}

/// Whether the other end is on this computer, or seems to be: a tunnel's end is here too.
fn is_local(stream: &TcpStream) -> io::Result<bool> {
    let peer = stream.peer_addr()?.ip();
    Ok(peer.is_loopback() || peer == stream.local_addr()?.ip())
}
