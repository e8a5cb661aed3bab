//! One connection to the master.

use std::{
    io,
    net::SocketAddr,
    pin::Pin,
    task::{Context, Poll, Waker},
    time::{Duration, Instant},
};

use bytes::Bytes;
use http_body_util::{BodyExt, Collected, Full, Limited};
use hyper::{
    HeaderMap, Request, Version,
    body::Body,
    client::conn::http1::{self, SendRequest},
    header::{
        CONNECTION, CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE, HOST, HeaderValue, SERVER,
        USER_AGENT,
    },
};
use hyper_util::rt::TokioIo;
use ros1_master::{
    master,
    xmlrpc::{self, Python, Reply},
};
use socket2::SockRef;
use tokio::{net::TcpStream, time::timeout};

use super::{
    CONNECT_LIMIT, CallError, Head, INSTANCE_HEADER, RawReply, Silence, Writer,
    open_requests::OpenRequest,
    peer::{CALLER_HEADER, HOLD_HEADER},
    python,
};
use crate::ros_env::MasterUri;

/// Size in bytes from which a reply takes more than a millisecond to decode.
const LONG: usize = 256 << 10;

/// The hyper object that sends and receives on the connection.
type Driver = http1::Connection<TokioIo<TcpStream>, Full<Bytes>>;

/// A connection to the master, for one call at a time.
///
/// The caller's task drives the connection, because another task would have to be woken twice for each call. So an end
/// of the connection between two calls goes unnoticed; [`Self::is_closed`] checks for it.
///
/// If the server closes the connection after one answer, as HTTP/1.0 servers do, the next call gets a new connection.
/// Another process may listen at the address when that call is made.
#[derive(Debug)]
pub struct Connection {
    sender: SendRequest<Full<Bytes>>,
    driver: Drive,
    peer: SocketAddr,
    host: HeaderValue,
    /// Whether requests carry a number by which this process recognises its own ones.
    marked: bool,
    max_reply: usize,
    silence: Option<Silence>,
    /// Whether the server left the connection open after the last answer.
    keeps_alive: Option<bool>,
    server: Option<HeaderValue>,
    last_used: Instant,
}

/// The connection that the caller drives, with the [`Writer`] that counts it if it is for writes. `None` if the
/// connection has ended.
#[derive(Debug)]
struct Drive(Option<(Box<Driver>, Option<Writer>)>);

impl Drive {
    /// Drives the connection while `work` runs.
    async fn run<T>(&mut self, work: impl Future<Output = T>) -> T {
        let mut work = std::pin::pin!(work);
        std::future::poll_fn(|context| {
            if let Poll::Ready(done) = work.as_mut().poll(context) {
                return Poll::Ready(done);
            }
            self.poll(context);
            // `work` is polled again after the connection, so that it sees arrived data at once.
            work.as_mut().poll(context)
        })
        .await
    }

    fn poll(&mut self, context: &mut Context<'_>) {
        if let Some((driver, _)) = &mut self.0
            && Pin::new(driver).poll(context).is_ready()
        {
            // If the connection ended with an error, the running call gets that error.
            self.0 = None;
        }
    }
}

impl Connection {
    /// Starts HTTP with the server at `address` over `stream`. Replies larger than `max_reply` bytes are refused.
    pub async fn over(
        stream: TcpStream,
        address: &MasterUri,
        max_reply: usize,
    ) -> io::Result<Self> {
        Self::open(stream, address, false, max_reply, None, None).await
    }

    pub(super) async fn open(
        stream: TcpStream,
        address: &MasterUri,
        marked: bool,
        max_reply: usize,
        silence: Option<Silence>,
        writer: Option<Writer>,
    ) -> io::Result<Self> {
        let peer = stream.peer_addr()?;
        let (sender, driver) = handshake(stream, silence).await?;
        let host = HeaderValue::from_str(&address.authority()).map_err(io::Error::other)?;
        Ok(Self {
            sender,
            driver: Drive(Some((driver, writer))),
            peer,
            host,
            marked,
            max_reply,
            silence,
            keeps_alive: None,
            server: None,
            last_used: Instant::now(),
        })
    }

    /// Opens the next connection to the same address if the server has closed this one. Returns whether it did. Another
    /// process may listen at the address.
    pub(crate) async fn reopen_if_closed(&mut self) -> Result<bool, CallError> {
        let is_closed = self.keeps_alive == Some(false) || self.is_closed();
        if is_closed {
            self.reopen().await.map_err(CallError::NotConnected)?;
            self.keeps_alive = None;
        }
        Ok(is_closed)
    }

    /// Opens the next connection to the same address.
    async fn reopen(&mut self) -> io::Result<()> {
        let connecting = timeout(CONNECT_LIMIT, TcpStream::connect(self.peer));
        let (sender, driver) = handshake(connecting.await??, self.silence).await?;
        (self.sender, self.driver) = (sender, Drive(Some((driver, None))));
        Ok(())
    }

    /// Ends the connection. What the other end has not received yet is not sent any more.
    pub(crate) fn reset(mut self) {
        if let Some((driver, _)) = self.driver.0.take() {
            let stream = driver.into_parts().io.into_inner();
            // If this fails, the connection has ended.
            let _ = SockRef::from(&stream).set_linger(Some(Duration::ZERO));
        }
    }

    /// Whether the connection has ended.
    pub fn is_closed(&mut self) -> bool {
        self.driver.poll(&mut Context::from_waker(Waker::noop()));
        self.sender.is_closed()
    }

    /// When the last answer came, or the connection was opened.
    pub(super) fn last_used(&self) -> Instant {
        self.last_used
    }

    /// Whether the server answers more than one call on a connection. `None` before its first answer.
    pub fn keeps_alive(&self) -> Option<bool> {
        self.keeps_alive
    }

    /// Whether the server keeps dictionaries in order, according to its last answer.
    pub fn keeps_order(&self) -> bool {
        self.python().keeps_order()
    }

    /// The version of Python on which the master runs, according to its last answer.
    pub fn python(&self) -> Python {
        python(self.server())
    }

    /// The `Server` header of the last answer.
    pub fn server(&self) -> Option<&str> {
        self.server.as_ref()?.to_str().ok()
    }

    /// Sends `body` unchanged and returns the reply unchanged.
    pub async fn forward(&mut self, head: &Head, body: Bytes) -> Result<RawReply, CallError> {
        self.exchange(head, body, None).await
    }

    /// Sends a body made by rosrescue. The part of the reply that equals `predicted` is compared without being stored.
    pub async fn call_expecting(
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
        if self.keeps_alive == Some(false) {
            self.reopen().await.map_err(CallError::NotConnected)?;
        }
        // The server that has answered on this connection is known. rosmaster parses each header in Python, for 4 µs.
        let is_known = self.keeps_alive == Some(true);
        // No Accept-Encoding is sent, because rosmaster would compress replies in Python.
        let mut request = Request::post(head.path.as_str())
            // An HTTP proxy on the way refuses a request without it.
            .header(HOST, &self.host)
            // An empty body needs this header too. Without it rosmaster answers with status 500 and no body.
            .header(CONTENT_LENGTH, body.len());
        if !is_known || !self.server().is_some_and(ignores_types) {
            request = request.header(CONTENT_TYPE, "text/xml");
        }
        if !is_known {
            request = request.header(USER_AGENT, concat!("rosrescue/", env!("CARGO_PKG_VERSION")));
        }
        let open = (self.marked && !is_known).then(OpenRequest::begin);
        if let Some(open) = &open {
            request = request.header(INSTANCE_HEADER, open.value());
        }
        if let Some(encoding) = &head.encoding {
            request = request.header(CONTENT_ENCODING, encoding);
        }
        if let Some(caller) = head.caller {
            request = request.header(CALLER_HEADER, caller.to_string());
        }
        if let Some(hold) = head.hold {
            request = request.header(HOLD_HEADER, hold.as_millis().to_string());
        }
        let request = request
            .body(Full::new(body))
            .map_err(|error| CallError::BrokenReply(error.into()))?;
        let (sender, max_reply) = (&mut self.sender, self.max_reply);
        let exchange = async {
            if let Err(error) = sender.ready().await {
                return Err(CallError::NotSent(error));
            }
            let reply = match sender.send_request(request).await {
                Ok(reply) => reply,
                Err(error) if error.is_canceled() => return Err(CallError::NotSent(error)),
                Err(error) => return Err(CallError::MaybeSent(error)),
            };
            let (parts, body) = reply.into_parts();
            let body = Limited::new(body, max_reply);
            let body = match predicted {
                Some(predicted) => collect(body, predicted).await,
                None => body.collect().await.map(Collected::to_bytes),
            };
            Ok(RawReply {
                keeps_alive: keeps_alive(parts.version, &parts.headers),
                status: parts.status,
                reason: parts.extensions.get().cloned(),
                headers: parts.headers,
                body: body.map_err(CallError::BrokenReply)?,
            })
        };
        let reply = self.driver.run(exchange).await?;
        self.keeps_alive = Some(reply.keeps_alive);
        self.server = reply.headers.get(SERVER).cloned();
        self.last_used = Instant::now();
        Ok(reply)
    }

    /// Makes a call to a master.
    pub async fn call(&mut self, call: &master::Request) -> Result<Reply, CallError> {
        self.decoded(call.encode()).await
    }

    /// Like [`Self::call`], for a call of a node's slave API.
    pub async fn call_node(&mut self, call: &xmlrpc::Call) -> Result<Reply, CallError> {
        self.decoded(xmlrpc::encode_node_call(call)).await
    }

    /// Sends `body` and decodes the reply.
    async fn decoded(&mut self, body: Vec<u8>) -> Result<Reply, CallError> {
        let reply = self.forward(&Head::default(), Bytes::from(body)).await?;
        match reply.body.len() > LONG {
            true => tokio::task::block_in_place(|| reply.decode()),
            false => reply.decode(),
        }
    }
}

async fn handshake(
    stream: TcpStream,
    silence: Option<Silence>,
) -> io::Result<(SendRequest<Full<Bytes>>, Box<Driver>)> {
    stream.set_nodelay(true)?;
    if let Some(silence) = silence {
        // If this fails, the connection still works.
        let _ = silence.bound(&stream);
    }
    let (sender, driver) = http1::Builder::new()
        .title_case_headers(true)
        .handshake(TokioIo::new(stream))
        .await
        .map_err(io::Error::other)?;
    Ok((sender, Box::new(driver)))
}

/// Whether the server with this `Server` header is that of Python's library, as in rosmaster. It does not read
/// `Content-Type`.
fn ignores_types(server: &str) -> bool {
    server.starts_with("BaseHTTP/")
}

/// Whether a server accepts another request on the connection after an answer with this version and these headers.
fn keeps_alive(version: Version, headers: &HeaderMap) -> bool {
    let values = headers.get_all(CONNECTION).into_iter();
    let mut words = values.flat_map(|value| value.to_str().unwrap_or_default().split(','));
    let mut says = |word: &str| words.any(|said| said.trim().eq_ignore_ascii_case(word));
    match version {
        Version::HTTP_11 => !says("close"),
        _ => says("keep-alive"),
    }
}

/// Reads all of `body`. The part that equals `predicted` is not stored twice.
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
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;
    use crate::upstream::Upstream;

    /// A body in these pieces.
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

    #[test]
    fn the_first_answer_shows_whether_a_connection_is_kept() {
        let of = |version, connection: Option<&'static str>| {
            let value = connection.map(|value| (CONNECTION, HeaderValue::from_static(value)));
            keeps_alive(version, &value.into_iter().collect())
        };
        assert!(of(Version::HTTP_11, None));
        assert!(of(Version::HTTP_11, Some("keep-alive")));
        assert!(!of(Version::HTTP_11, Some("Close")));
        assert!(!of(Version::HTTP_11, Some("x-other, close")));
        assert!(!of(Version::HTTP_10, None));
        assert!(!of(Version::HTTP_10, Some("close")));
        assert!(of(Version::HTTP_10, Some("Keep-Alive")));
    }

    /// The names of the headers of three requests to a server that answers with this `Server` header.
    async fn headers_sent_to(server: &'static str) -> Vec<Vec<String>> {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let uri = format!("http://{}/", listener.local_addr().unwrap());
        let upstream = Upstream::new(MasterUri::parse(&uri).unwrap(), Duration::from_secs(1), 3);
        let serve = async {
            let (mut stream, _) = listener.accept().await.unwrap();
            let mut heads = Vec::new();
            for _ in 0..3 {
                let mut request = Vec::new();
                while !request.ends_with(b"body") {
                    assert_ne!(stream.read_buf(&mut request).await.unwrap(), 0);
                }
                let head = String::from_utf8(request).unwrap();
                let names = head
                    .lines()
                    .skip(1)
                    .filter_map(|line| line.split_once(": "));
                heads.push(names.map(|(name, _)| name.to_lowercase()).collect());
                let answer =
                    format!("HTTP/1.1 200 OK\r\nServer: {server}\r\nContent-Length: 0\r\n\r\n");
                stream.write_all(answer.as_bytes()).await.unwrap();
            }
            heads
        };
        let ask = async {
            let mut connection = upstream.connect().await.unwrap();
            for _ in 0..3 {
                let body = Bytes::from_static(b"body");
                connection.forward(&Head::default(), body).await.unwrap();
            }
        };
        tokio::join!(serve, ask).0
    }

    #[tokio::test]
    async fn only_the_first_request_of_a_connection_has_headers_that_a_known_server_does_not_need()
    {
        let first = [
            "host",
            "content-length",
            "content-type",
            "user-agent",
            "x-rosrescue-instance",
        ];
        let later = ["host", "content-length", "content-type"];
        for (server, later) in [
            ("BaseHTTP/0.6 Python/3.11.2", &later[..2]),
            ("nginx", &later),
        ] {
            let sent = headers_sent_to(server).await;
            assert_eq!(sent, [&first[..], later, later], "{server}");
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
