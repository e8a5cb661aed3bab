//! Connections to the master.

mod connection;
pub(crate) mod inspect;
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

/// Largest reply that is taken from the master, in bytes. A parameter tree of 64 MiB written out
/// again as XML stays below it.
const MAX_REPLY: usize = 512 << 20;
/// How long a connect may take. A host that drops packets never answers.
const CONNECT_LIMIT: Duration = Duration::from_secs(3);

/// Each request to the master bears it, so that a proxy that is pointed at itself notices.
pub(crate) const INSTANCE_HEADER: &str = "x-rosrescue-instance";

/// A connection that could not be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConnectError {
    /// Nothing listens there.
    #[error("nothing listens at {master}")]
    Refused { master: String },
    /// There is no way there, or no answer.
    #[error("cannot reach {master}: {source}")]
    Unreachable {
        master: String,
        /// What the system said.
        source: io::Error,
    },
}

/// A call that got no reply. Whether the master may have run it decides what may be done next.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CallError {
    /// No byte has left: it may be sent again.
    #[error("the call was not sent: {0}")]
    NotSent(hyper::Error),
    /// The master may have run it.
    #[error("the master gave no reply: {0}")]
    MaybeSent(hyper::Error),
    /// The reply's body broke off, or was beyond all limits.
    #[error("the master's reply is not whole: {0}")]
    BrokenReply(Box<dyn std::error::Error + Send + Sync>),
    /// The reply is whole, but no XML-RPC; only for calls of our own.
    #[error("the master's reply is no XML-RPC (HTTP status {status}): {reason}")]
    NotXmlRpc { status: StatusCode, reason: String },
}

/// The parts of a client's request that matter to the master, besides the body.
#[derive(Clone, Debug)]
pub struct Head {
    /// The request's target, such as `/RPC2`.
    pub path: String,
    /// How the body is packed, if it is.
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
    /// Whether the connection may be used again: rosmaster does not read the body behind a head
    /// that it refuses, and would take the rest of it for the next request.
    pub fn leaves_connection_usable(&self) -> bool {
        self.status.is_success()
    }
}

/// A whole reply of the master.
#[derive(Clone, Debug)]
pub struct RawReply {
    pub status: StatusCode,
    /// The words behind the status, if they are not the usual ones.
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

/// Knows where the master is and how requests to it look.
#[derive(Debug)]
pub struct Upstream {
    address: watch::Sender<MasterUri>,
    instance: HeaderValue,
    probe_timeout: Duration,
    probe_count: u32,
    /// What the master's name was found to mean the last time.
    found: watch::Sender<Option<(MasterUri, Vec<SocketAddr>)>>,
    /// How many connections for writes there are.
    writers: watch::Sender<usize>,
}

/// Counts a connection for writes until it has ended.
#[derive(Debug)]
struct Writer(watch::Sender<usize>);

impl Drop for Writer {
    fn drop(&mut self) {
        self.0.send_modify(|count| *count = count.saturating_sub(1));
    }
}

impl Upstream {
    /// Connections to `address`; `instance` tells this process from every other. A connection ends
    /// when the kernel's own probes, as many with the same timeout, are not answered either.
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

    /// The master is elsewhere from now on; open connections stay as they are.
    pub fn relocate(&self, address: MasterUri) {
        self.address.send_replace(address);
    }

    /// A new connection to the master.
    pub async fn connect(&self) -> Result<Connection, ConnectError> {
        self.connect_with(None).await
    }

    /// A new connection to the master that carries writes; see [`Self::no_writers`].
    pub async fn connect_for_writes(&self) -> Result<Connection, ConnectError> {
        self.writers.send_modify(|count| *count += 1);
        self.connect_with(Some(Writer(self.writers.clone()))).await
    }

    /// Returns when every connection for writes has ended.
    pub async fn no_writers(&self) {
        // We hold a sender.
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
        // Where the kernel cannot do that, the connection is as good as it was.
        let _ = self.bound_silence(&stream);
        Connection::open(stream, &address, self.instance.clone(), MAX_REPLY, writer)
            .await
            .map_err(unreachable)
    }

    /// The addresses of the master: what its name means now, and while nobody can tell, what it meant
    /// before. A name server that fails must not take away a master that lives.
    async fn find(&self, address: &MasterUri) -> io::Result<Vec<SocketAddr>> {
        if let Ok(ip) = address.host.parse() {
            return Ok(vec![SocketAddr::new(ip, address.port)]);
        }
        let (found, asked) = (self.found.clone(), address.clone());
        // In a task: an answer that comes too late for this connection serves the next one, so that a
        // master that has moved is found however slow the name server is.
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
            // The rest of a probe's time is for the master.
            let _ = timeout(self.probe_timeout / 4, lookup).await;
        } else {
            lookup.await.map_err(io::Error::other)??;
        }
        known().ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    /// Ends a connection that has become a dead end: the other side's kernel has acknowledged nothing
    /// for a little longer than the probes take to find that the master is gone. That of a master that
    /// hangs does acknowledge. Where a cable is cut, or a router has forgotten the connection, nobody
    /// does, and TCP itself would go on for a quarter of an hour. On this computer there are no dead
    /// ends.
    fn bound_silence(&self, stream: &TcpStream) -> io::Result<()> {
        if is_local(stream)? {
            return Ok(());
        }
        // The kernel counts in whole seconds here.
        let interval = self.probe_timeout.max(Duration::from_secs(1));
        let probes = TcpKeepalive::new()
            .with_time(interval)
            .with_interval(interval);
        let socket = SockRef::from(stream);
        socket.set_tcp_keepalive(&probes)?;
        // This limit, and no count, also ends the probes.
        socket.set_tcp_user_timeout(Some(interval * (self.probe_count + 1)))
    }
}

/// A connection to the first of `addresses` that takes it. One that refuses says more of the master
/// than one to which there is no way.
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

/// Whether the other end is on this computer, or seems to be: a tunnel's is here too.
fn is_local(stream: &TcpStream) -> io::Result<bool> {
    let peer = stream.peer_addr()?.ip();
    Ok(peer.is_loopback() || peer == stream.local_addr()?.ip())
}
