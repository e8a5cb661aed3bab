//! Connections to the master, and to other computers ([`peer`]). An *incarnation* is one life of a master process; a call must reach the present one.

mod connection;
pub(crate) mod inspect;
pub(crate) mod next;
pub(crate) mod open_requests;
pub(crate) mod peer;
pub(crate) mod pool;
pub(crate) mod sentinel;
pub(crate) mod sockets;
pub(crate) mod verify;

use std::{
    io,
    net::{IpAddr, SocketAddr},
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use bytes::Bytes;
use hyper::{
    HeaderMap, StatusCode,
    ext::ReasonPhrase,
    header::{HeaderValue, SERVER},
};
use rescue_core::lifecycle::OpenCalls;
use ros1_master::xmlrpc::{self, Python, Reply};
use socket2::{SockRef, TcpKeepalive};
use thiserror::Error;
use tokio::{net::TcpStream, sync::watch, time::timeout};

pub(crate) use self::connection::Connection;
pub(crate) use self::verify::VerifyError;
use self::{sentinel::Sentinel, verify::Verification};
use crate::{resolver, ros_env::MasterUri};

/// Largest accepted reply of the master, in bytes. The XML of a parameter tree of 64 MiB is
/// smaller.
const MAX_REPLY: usize = 512 << 20;
/// Time limit for connecting. A host that drops packets never answers.
const CONNECT_LIMIT: Duration = Duration::from_secs(3);
/// How long before the master closes an idle connection it is no longer used.
const IDLE_RESERVE: Duration = Duration::from_millis(500);

/// Header in the first request of a connection to the master, with the number of an [open request](open_requests). A rosrescue that receives
/// a number of its own is its own master.
pub(crate) const INSTANCE_HEADER: &str = "x-rosrescue-instance";

/// Why a connection could not be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConnectError {
    #[error("nothing listens at {master}")]
    Refused { master: String },
    /// The master's host has no address.
    #[error("{host} has no address: {source}")]
    NoAddress { host: String, source: io::Error },
    /// The master's host gave no answer, or there is no route to it.
    #[error("cannot reach {master}: {source}")]
    Unreachable { master: String, source: io::Error },
}

/// Why a call got no reply. Each kind says whether the master may have run the call.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CallError {
    /// No byte was sent, so the call may be sent again.
    #[error("the call was not sent: {0}")]
    NotSent(hyper::Error),
    /// No byte was sent, because no connection could be made.
    #[error("could not connect for the call: {0}")]
    NotConnected(io::Error),
    /// The master may have run the call.
    #[error("the master sent no reply: {0}")]
    MaybeSent(hyper::Error),
    /// The reply may be from another master process, which does not hold the present state.
    #[error("the reply may come from another master: {0}")]
    Unverified(Box<VerifyError>),
    /// The reply's body ended early or exceeded a limit.
    #[error("the master's reply is incomplete: {0}")]
    BrokenReply(Box<dyn std::error::Error + Send + Sync>),
    /// The reply is complete, but not XML-RPC. Checked only for calls made by rosrescue.
    #[error("the master's reply is not XML-RPC (HTTP status {status}): {reason}")]
    NotXmlRpc { status: StatusCode, reason: String },
}

/// The parts of a client's request, besides the body, that matter to the master.
#[derive(Clone, Debug)]
pub struct Head {
    /// The request's target, such as `/RPC2`.
    pub path: String,
    /// Content encoding of the body, if there is one.
    pub encoding: Option<HeaderValue>,
    /// Address of the caller, if a follower forwards the call. See [`peer::CALLER_HEADER`].
    pub caller: Option<IpAddr>,
    /// How long the call may still wait for a master, if a follower forwards it. See [`peer::HOLD_HEADER`].
    pub hold: Option<Duration>,
}

impl Head {
    /// Whether every rosmaster accepts calls at this path.
    pub(crate) fn is_for_rpc(&self) -> bool {
        matches!(self.path.as_str(), "/" | "/RPC2")
    }

    /// Whether some rosmaster accepts calls at this path: some versions of Python read several slashes as one. The
    /// mirror must not answer at any other path, because rosmaster would refuse the call.
    pub(crate) fn may_be_for_rpc(&self) -> bool {
        matches!(self.path.trim_start_matches('/'), "" | "RPC2")
    }
}

impl Default for Head {
    fn default() -> Self {
        Self {
            path: "/".to_owned(),
            encoding: None,
            caller: None,
            hold: None,
        }
    }
}

impl RawReply {
    /// Whether the connection may be used again. rosmaster does not read the body of a request whose head it refuses,
    /// and then takes that body for the next request.
    pub fn leaves_connection_usable(&self) -> bool {
        self.status.is_success() && self.keeps_alive
    }
}

#[derive(Clone, Debug)]
pub struct RawReply {
    /// Whether the other end accepts another request on the connection.
    pub keeps_alive: bool,
    pub status: StatusCode,
    /// The reason phrase, unless it is the standard one.
    pub reason: Option<ReasonPhrase>,
    pub headers: HeaderMap,
    pub body: Bytes,
}

impl RawReply {
    /// Whether the other end keeps dictionaries in order, as every Python since 3.6 does.
    pub fn keeps_order(&self) -> bool {
        python(self.headers.get(SERVER).and_then(|it| it.to_str().ok())).keeps_order()
    }

    pub fn decode(&self) -> Result<Reply, CallError> {
        xmlrpc::decode_reply(&self.body).map_err(|error| CallError::NotXmlRpc {
            status: self.status,
            reason: error.to_string(),
        })
    }
}

/// The version of Python with which a master that sends this `Server` header is treated.
fn python(server: Option<&str>) -> Python {
    server.and_then(Python::of_server).unwrap_or_default()
}

/// Connects to the master, on this or another computer.
#[derive(Debug)]
pub struct Upstream {
    address: watch::Sender<MasterUri>,
    probe_timeout: Duration,
    probe_count: u32,
    /// Longest time for which a connection may have been idle. `None` without limit.
    idle_most: Option<Duration>,
    /// The master's addresses from the last successful lookup.
    found: watch::Sender<Option<(MasterUri, Vec<SocketAddr>)>>,
    /// Number of connections for writes.
    writers: watch::Sender<usize>,
    /// How rosrescue verifies that a call reaches the master process that holds the present state. `None` while no
    /// calls pass to a master.
    verification: Mutex<Option<Verification>>,
    open_calls: Mutex<OpenCalls>,
}

/// Counts a connection for writes until it is dropped.
#[derive(Debug)]
struct Writer(watch::Sender<usize>);

impl Drop for Writer {
    fn drop(&mut self) {
        self.0.send_modify(|count| *count = count.saturating_sub(1));
    }
}

/// A call to the master. It counts as under way until this value is dropped; see [`Upstream::silent_since`].
#[derive(Debug)]
pub(crate) struct OpenCall<'a>(&'a Upstream);

impl Drop for OpenCall<'_> {
    fn drop(&mut self) {
        self.0.lock_open_calls().end(Instant::now());
    }
}

impl Upstream {
    /// Prepares connections to `address`. A connection also ends after the kernel's probes were unanswered, with the count
    /// and timeout of rosrescue's own probes.
    pub fn new(address: MasterUri, probe_timeout: Duration, probe_count: u32) -> Self {
        Self {
            address: watch::Sender::new(address),
            probe_timeout,
            probe_count,
            idle_most: None,
            found: watch::Sender::new(None),
            writers: watch::Sender::new(0),
            verification: Mutex::default(),
            open_calls: Mutex::default(),
        }
    }

    /// For a master that closes each connection that has been idle for `timeout`, as rosmaster does with `-t`. A call that
    /// meets the close looks like the death of the master, so connections are given up a little earlier.
    pub(crate) fn with_socket_timeout(mut self, timeout: Option<Duration>) -> Self {
        self.idle_most = timeout.map(|timeout| timeout - IDLE_RESERVE.min(timeout / 2));
        self
    }

    /// Whether the master may be about to close a connection that was used last at `last_used`.
    fn may_close(&self, last_used: Instant) -> bool {
        self.idle_most
            .is_some_and(|most| last_used.elapsed() > most)
    }

    pub fn address(&self) -> MasterUri {
        self.address.borrow().clone()
    }

    /// Changes the master's address. Open connections stay.
    pub fn relocate(&self, address: MasterUri) {
        self.address.send_replace(address);
    }

    pub async fn connect(&self) -> Result<Connection, ConnectError> {
        self.connect_with(None).await
    }

    /// Opens a connection for writes; see [`Self::no_writers`].
    pub async fn connect_for_writes(&self) -> Result<Connection, ConnectError> {
        self.writers.send_modify(|count| *count += 1);
        self.connect_with(Some(Writer(self.writers.clone()))).await
    }

    /// Waits until all connections for writes have ended.
    pub async fn no_writers(&self) {
        // This cannot fail: this value holds a sender.
        let _ = self.writers.subscribe().wait_for(|count| *count == 0).await;
    }

    /// Opens a connection on which nothing will be sent.
    pub(crate) async fn connect_sentinel(&self) -> Result<Sentinel, ConnectError> {
        let (address, stream) = self.bounded_stream().await?;
        Sentinel::new(stream).map_err(|source| ConnectError::Unreachable {
            master: address.to_string(),
            source,
        })
    }

    async fn bounded_stream(&self) -> Result<(MasterUri, TcpStream), ConnectError> {
        let (address, stream) = self.stream().await?;
        // If this fails, the connection still works.
        let _ = self.silence().bound(&stream);
        Ok((address, stream))
    }

    /// How rosrescue verifies that a call reaches the master process that holds the present state. `None` while no
    /// calls pass to a master.
    pub(crate) fn verification(&self) -> Option<Verification> {
        self.lock_verification().clone()
    }

    /// Sets how calls are verified. The previous [`Sentinel`] closes once no call needs it any more.
    pub(crate) fn set_verification(&self, verification: Option<Verification>) {
        *self.lock_verification() = verification;
    }

    fn lock_verification(&self) -> MutexGuard<'_, Option<Verification>> {
        self.verification
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that a call begins.
    pub(crate) fn begin_call(&self) -> OpenCall<'_> {
        self.lock_open_calls().begin(Instant::now());
        OpenCall(self)
    }

    /// Since when calls to the master have been under way without any of them ending. `None` if none is under way.
    pub(crate) fn silent_since(&self) -> Option<Instant> {
        self.lock_open_calls().silent_since()
    }

    fn lock_open_calls(&self) -> MutexGuard<'_, OpenCalls> {
        self.open_calls
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    async fn connect_with(&self, writer: Option<Writer>) -> Result<Connection, ConnectError> {
        let (address, stream) = self.stream().await?;
        let silence = Some(self.silence());
        Connection::open(stream, &address, true, MAX_REPLY, silence, writer)
            .await
            .map_err(|source| ConnectError::Unreachable {
                master: address.to_string(),
                source,
            })
    }

    async fn stream(&self) -> Result<(MasterUri, TcpStream), ConnectError> {
        let address = self.address();
        let unreachable = |source| ConnectError::Unreachable {
            master: address.to_string(),
            source,
        };
        let connecting = async {
            let found = self.find(&address).await;
            let (addresses, confirmed) = found.map_err(|source| ConnectError::NoAddress {
                host: address.host.clone(),
                source,
            })?;
            // At an old address there may be nobody any more, as after the restart of a container. Trying it must not
            // delay the next lookup for long.
            let limit = if confirmed {
                CONNECT_LIMIT
            } else {
                self.probe_timeout
            };
            match timeout(limit, open(addresses)).await {
                Ok(Ok(stream)) => Ok(stream),
                Ok(Err(error)) if error.kind() == io::ErrorKind::ConnectionRefused => {
                    Err(ConnectError::Refused {
                        master: address.to_string(),
                    })
                }
                Ok(Err(error)) => Err(unreachable(error)),
                Err(_) => Err(unreachable(io::ErrorKind::TimedOut.into())),
            }
        };
        let stream = timeout(CONNECT_LIMIT, connecting).await;
        let stream = stream.unwrap_or_else(|_| Err(unreachable(io::ErrorKind::TimedOut.into())));
        Ok((address.clone(), stream?))
    }

    /// Looks up the master's addresses. If that fails, returns the last known ones and false: a failing name server must
    /// not cut off a living master.
    async fn find(&self, address: &MasterUri) -> io::Result<(Vec<SocketAddr>, bool)> {
        if let Ok(ip) = address.host.parse() {
            return Ok((vec![SocketAddr::new(ip, address.port)], true));
        }
        let (found, asked) = (self.found.clone(), address.clone());
        // The lookup runs in a task of its own, so that a late answer can serve the next connection. A moved master is
        // found even with a slow name server.
        let lookup = crate::task::spawn(async move {
            let addresses = resolver::addresses(&asked.host, asked.port).await?;
            found.send_replace(Some((asked, addresses)));
            io::Result::Ok(())
        });
        let known = || {
            let found = self.found.borrow();
            let found = found.as_ref().filter(|(of, _)| of == address);
            found.map(|(_, addresses)| addresses.clone())
        };
        let confirmed = if known().is_some() {
            // The rest of a probe's time is left for the master itself.
            let found = timeout(self.probe_timeout / 4, lookup).await;
            matches!(found, Ok(Ok(Ok(()))))
        } else {
            lookup.await.map_err(io::Error::other)??;
            true
        };
        let known = known().map(|addresses| (addresses, confirmed));
        known.ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    fn silence(&self) -> Silence {
        // The kernel accepts only whole seconds here.
        let interval = self.probe_timeout.max(Duration::from_secs(1));
        Silence {
            interval,
            limit: interval * (self.probe_count + 1),
        }
    }
}

/// Ends a connection to another computer if that computer's kernel has acknowledged nothing for a little longer than
/// probes take to find a dead master.
///
/// The kernel of a hung master still acknowledges. After a cut cable, or if a router has forgotten the connection,
/// nothing is acknowledged, and TCP itself would take a quarter of an hour to notice. Connections within this computer
/// do not need this.
#[derive(Clone, Copy, Debug)]
struct Silence {
    interval: Duration,
    limit: Duration,
}

impl Silence {
    fn bound(self, stream: &TcpStream) -> io::Result<()> {
        if is_local(stream.peer_addr()?, stream.local_addr()?) {
            return Ok(());
        }
        let probes = TcpKeepalive::new()
            .with_time(self.interval)
            .with_interval(self.interval);
        let socket = SockRef::from(stream);
        socket.set_tcp_keepalive(&probes)?;
        // This limit also ends the probes, instead of a count.
        socket.set_tcp_user_timeout(Some(self.limit))
    }
}

/// Connects to the first of `addresses` that accepts. If all fail, prefers to report a refusal, because it tells more
/// about the master than an unreachable address.
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

/// Whether the other end seems to be on this computer. A tunnel's near end also counts.
pub(crate) fn is_local(peer: SocketAddr, own: SocketAddr) -> bool {
    peer.ip().to_canonical().is_loopback() || peer.ip() == own.ip()
}

/// Listens like a master, and connects to that listener. Returns the listener, the accepted end of the sentinel, the
/// connections, and the sentinel.
#[cfg(test)]
pub(crate) async fn test_master() -> (
    tokio::net::TcpListener,
    TcpStream,
    std::sync::Arc<Upstream>,
    std::sync::Arc<Sentinel>,
) {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let uri = format!("http://{}", listener.local_addr().unwrap());
    let uri = MasterUri::parse(&uri).unwrap();
    let upstream = Upstream::new(uri, Duration::from_secs(1), 3);
    let sentinel = upstream.connect_sentinel().await.unwrap();
    let (accepted, _) = listener.accept().await.unwrap();
    (listener, accepted, upstream.into(), sentinel.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_connection_is_given_up_before_the_master_closes_it() {
        let uri = MasterUri::parse("http://127.0.0.1:11312").unwrap();
        for (timeout, most) in [
            (None, None),
            (Some(5_000), Some(4_500)),
            (Some(400), Some(200)),
        ] {
            let upstream = Upstream::new(uri.clone(), Duration::from_secs(1), 3);
            let upstream = upstream.with_socket_timeout(timeout.map(Duration::from_millis));
            assert_eq!(upstream.idle_most, most.map(Duration::from_millis));
            let (now, hour) = (Instant::now(), Duration::from_secs(3600));
            assert_eq!(upstream.may_close(now - hour), most.is_some());
            assert!(!upstream.may_close(now + hour));
        }
    }

    /// A container that is started again has another address, and no kernel answers at the old one.
    #[tokio::test(start_paused = true)]
    async fn an_old_address_that_does_not_answer_delays_the_next_lookup_only_for_a_moment() {
        let full =
            socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::STREAM, None).unwrap();
        full.bind(&SocketAddr::from(([127, 0, 0, 1], 0)).into())
            .unwrap();
        full.listen(0).unwrap();
        let old = full.local_addr().unwrap().as_socket().unwrap();
        // The kernel ignores further connections.
        let _waiting = std::net::TcpStream::connect(old).unwrap();
        let uri = MasterUri::parse("http://nobody.invalid:11312").unwrap();
        let upstream = Upstream::new(uri.clone(), Duration::from_millis(200), 3);
        upstream.found.send_replace(Some((uri, vec![old])));
        // The clock stands still except for waiting.
        let began = tokio::time::Instant::now();
        let outcome = upstream.connect().await;
        assert!(
            matches!(outcome, Err(ConnectError::Unreachable { .. })),
            "{outcome:?}"
        );
        let waited = began.elapsed();
        assert!(waited <= Duration::from_millis(260), "{waited:?}");
    }
}
