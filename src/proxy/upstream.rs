//! Connections to the master.

use std::{io, net::SocketAddr, time::Duration};

use bytes::Bytes;
use http_body_util::{BodyExt, Collected, Full, Limited};
use hyper::{
    HeaderMap, Request, StatusCode,
    body::Body,
    client::conn::http1::SendRequest,
    ext::ReasonPhrase,
    header::{CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE, HOST, HeaderValue, USER_AGENT},
};
use hyper_util::rt::TokioIo;
use socket2::{SockRef, TcpKeepalive};
use thiserror::Error;
use tokio::{net::TcpStream, sync::watch, time::timeout};

use crate::{
    resolver,
    ros_env::MasterUri,
    xmlrpc::{self, Call, Reply},
};

/// Largest reply that is taken from the master, in bytes. A parameter tree of 64 MiB written out
/// again as XML stays below it.
const MAX_REPLY: usize = 512 << 20;
/// How long a connect may take. A host that drops packets never answers.
const CONNECT_LIMIT: Duration = Duration::from_secs(3);

/// Each request to the master bears it, so that a proxy that is pointed at itself notices.
pub const INSTANCE_HEADER: &str = "x-rosrescue-instance";

/// A connection that could not be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConnectError {
    /// Nothing listens there.
    #[error("nothing listens at {master}")]
    Refused {
        /// Where.
        master: String,
    },
    /// There is no way there, or no answer.
    #[error("cannot reach {master}: {source}")]
    Unreachable {
        /// Where.
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
    NotXmlRpc {
        /// The HTTP status.
        status: StatusCode,
        /// What is wrong with it.
        reason: String,
    },
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
    /// The HTTP status.
    pub status: StatusCode,
    /// The words behind the status, if they are not the usual ones.
    pub reason: Option<ReasonPhrase>,
    /// The master's headers.
    pub headers: HeaderMap,
    /// The body, unchanged.
    pub body: Bytes,
}

impl RawReply {
    /// The reply to a call of our own.
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

    /// Where the master is.
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
        let pace = self.probe_timeout.max(Duration::from_secs(1));
        let probes = TcpKeepalive::new().with_time(pace).with_interval(pace);
        let socket = SockRef::from(stream);
        socket.set_tcp_keepalive(&probes)?;
        // This limit, and no count, also ends the probes.
        socket.set_tcp_user_timeout(Some(pace * (self.probe_count + 1)))
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

/// One keep-alive connection to the master, for one call at a time.
#[derive(Debug)]
pub struct Connection {
    sender: SendRequest<Full<Bytes>>,
    ended: watch::Receiver<()>,
    local: bool,
    peer: SocketAddr,
    host: HeaderValue,
    instance: HeaderValue,
    max_reply: usize,
}

impl Connection {
    /// A connection to the server at `address` over `stream`. Replies of more than `max_reply` bytes
    /// are not taken.
    pub async fn over(
        stream: TcpStream,
        address: &MasterUri,
        instance: HeaderValue,
        max_reply: usize,
    ) -> io::Result<Self> {
        Self::open(stream, address, instance, max_reply, None).await
    }

    async fn open(
        stream: TcpStream,
        address: &MasterUri,
        instance: HeaderValue,
        max_reply: usize,
        writer: Option<Writer>,
    ) -> io::Result<Self> {
        stream.set_nodelay(true)?;
        let (local, peer) = (is_local(&stream)?, stream.peer_addr()?);
        let (sender, driver) = hyper::client::conn::http1::Builder::new()
            .title_case_headers(true)
            .handshake(TokioIo::new(stream))
            .await
            .map_err(io::Error::other)?;
        let (end, ended) = watch::channel(());
        tokio::spawn(async move {
            // Its error, if any, is also that of the call under way.
            let _ = driver.await;
            drop((end, writer));
        });
        let host = HeaderValue::from_str(&address.authority()).map_err(io::Error::other)?;
        Ok(Self {
            sender,
            ended,
            local,
            peer,
            host,
            instance,
            max_reply,
        })
    }

    /// Whether the connection is known to have ended.
    pub fn is_closed(&self) -> bool {
        self.sender.is_closed()
    }

    /// Whether the other end is on this computer, or seems to be: a tunnel's is here too.
    pub fn is_local(&self) -> bool {
        self.local
    }

    /// The other end.
    pub fn peer(&self) -> SocketAddr {
        self.peer
    }

    /// Returns when the connection has ended.
    pub fn ended(&self) -> impl Future<Output = ()> + Send + 'static {
        let mut ended = self.ended.clone();
        async move {
            // Nothing is ever sent: it ends in the error that the sender is gone.
            while ended.changed().await.is_ok() {}
        }
    }

    /// Sends `body` as it is; the reply comes back as it is.
    pub async fn forward(&mut self, head: &Head, body: Bytes) -> Result<RawReply, CallError> {
        self.exchange(head, body, None).await
    }

    /// Sends a body of our own. As far as the reply is what was `predicted` it is only compared, and
    /// takes no memory.
    pub async fn predicted(
        &mut self,
        body: Bytes,
        predicted: &Bytes,
    ) -> Result<RawReply, CallError> {
        let head = Head::default();
        self.exchange(&head, body, Some(predicted)).await
    }

    async fn exchange(
        &mut self,
        head: &Head,
        body: Bytes,
        predicted: Option<&Bytes>,
    ) -> Result<RawReply, CallError> {
        // rosmaster gzips replies when it may, in Python: it may not.
        let mut request = Request::post(head.path.as_str())
            .header(HOST, &self.host)
            .header(USER_AGENT, concat!("rosrescue/", env!("CARGO_PKG_VERSION")))
            .header(CONTENT_TYPE, "text/xml")
            // Of an empty body too: without it rosmaster answers with a status 500 and no body.
            .header(CONTENT_LENGTH, body.len())
            .header(INSTANCE_HEADER, &self.instance);
        if let Some(encoding) = &head.encoding {
            request = request.header(CONTENT_ENCODING, encoding);
        }
        let request = request
            .body(Full::new(body))
            .map_err(|error| CallError::BrokenReply(error.into()))?;
        if let Err(error) = self.sender.ready().await {
            return Err(CallError::NotSent(error));
        }
        let reply = match self.sender.send_request(request).await {
            Ok(reply) => reply,
            Err(error) if error.is_canceled() => return Err(CallError::NotSent(error)),
            Err(error) => return Err(CallError::MaybeSent(error)),
        };
        let (parts, body) = reply.into_parts();
        let body = Limited::new(body, self.max_reply);
        let body = match predicted {
            Some(predicted) => collect(body, predicted).await,
            None => body.collect().await.map(Collected::to_bytes),
        };
        Ok(RawReply {
            status: parts.status,
            reason: parts.extensions.get().cloned(),
            headers: parts.headers,
            body: body.map_err(CallError::BrokenReply)?,
        })
    }

    /// Makes a call of our own.
    pub async fn call(&mut self, call: &Call) -> Result<Reply, CallError> {
        let body = Bytes::from(xmlrpc::encode_call(call));
        self.forward(&Head::default(), body).await?.decode()
    }
}

/// The whole of `body`. As far as it is what was `predicted`, that stands for it.
async fn collect<B: Body<Data = Bytes> + Unpin>(
    mut body: B,
    predicted: &Bytes,
) -> Result<Bytes, B::Error> {
    let mut same = 0;
    while let Some(frame) = body.frame().await {
        let Ok(data) = frame?.into_data() else {
            continue;
        };
        let (before, ahead) = predicted.split_at(same);
        if !ahead.starts_with(&data) {
            let rest = body.collect().await?.to_bytes();
            return Ok([before, &data, &rest].concat().into());
        }
        same += data.len();
    }
    Ok(predicted.slice(..same))
}

#[cfg(test)]
mod tests {
    use std::{
        convert::Infallible,
        pin::Pin,
        task::{Context, Poll},
    };

    use hyper::body::Frame;

    use super::*;

    /// A body that comes in these pieces.
    struct Pieces(std::vec::IntoIter<&'static str>);

    impl Body for Pieces {
        type Data = Bytes;
        type Error = Infallible;

        fn poll_frame(
            mut self: Pin<&mut Self>,
            _: &mut Context<'_>,
        ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
            let piece = self.0.next();
            Poll::Ready(piece.map(|piece| Ok(Frame::data(Bytes::from(piece)))))
        }
    }

    #[tokio::test]
    async fn a_predicted_reply_is_kept_once_and_any_other_as_it_is() {
        let predicted = Bytes::from("what is predicted");
        for pieces in [
            vec!["what is ", "predicted"],
            vec!["what is ", "", "predicted", " and more"],
            vec!["what is ", "fore", "seen", "?"],
            vec!["what", " is"],
            vec!["nothing of it"],
            vec![],
        ] {
            let whole = pieces.concat();
            let got = collect(Pieces(pieces.into_iter()), &predicted).await;
            let got = got.unwrap_or_default();
            assert_eq!(got, whole);
            let is_kept = got.as_ptr() == predicted.as_ptr();
            assert_eq!(is_kept, predicted.starts_with(whole.as_bytes()), "{whole}");
        }
    }
}
