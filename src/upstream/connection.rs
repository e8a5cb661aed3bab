//! One connection to the master.

use std::{
    io,
    net::SocketAddr,
    pin::Pin,
    task::{Context, Poll, Waker},
};

use bytes::Bytes;
use http_body_util::{BodyExt, Collected, Full, Limited};
use hyper::{
    Request,
    body::Body,
    client::conn::http1::{self, SendRequest},
    header::{CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE, HOST, HeaderValue, USER_AGENT},
};
use hyper_util::rt::TokioIo;
use tokio::{net::TcpStream, sync::watch};

use super::{CallError, Head, INSTANCE_HEADER, RawReply, Writer, is_local};
use crate::{
    ros_env::MasterUri,
    xmlrpc::{self, Call, Reply},
};

/// Replies that take a millisecond to decode, in bytes.
const LONG: usize = 256 << 10;

/// Sends and receives what hyper's handle is given.
type Driver = http1::Connection<TokioIo<TcpStream>, Full<Bytes>>;

/// A keep-alive connection to the master, for one call at a time.
///
/// The caller drives it, in its own task: another task would have to be woken twice for
/// each call. So nobody notices its end between two calls; [`Self::is_closed`] looks.
#[derive(Debug)]
pub struct Connection {
    sender: SendRequest<Full<Bytes>>,
    driver: Drive,
    local: bool,
    peer: SocketAddr,
    host: HeaderValue,
    instance: HeaderValue,
    max_reply: usize,
}

/// Who drives a connection.
#[derive(Debug)]
enum Drive {
    /// The caller; none if it has ended. With it ends the count of connections for writes.
    Caller(Option<(Box<Driver>, Option<Writer>)>),
    /// A task, whose end is the connection's.
    Task(watch::Receiver<()>),
}

impl Drive {
    /// Runs `work`, which waits for the connection.
    async fn run<T>(&mut self, work: impl Future<Output = T>) -> T {
        let mut work = std::pin::pin!(work);
        std::future::poll_fn(|context| {
            if let Poll::Ready(done) = work.as_mut().poll(context) {
                return Poll::Ready(done);
            }
            self.poll(context);
            // What has arrived is seen at once.
            work.as_mut().poll(context)
        })
        .await
    }

    fn poll(&mut self, context: &mut Context<'_>) {
        if let Self::Caller(driven) = self
            && let Some((driver, _)) = driven
            && Pin::new(driver).poll(context).is_ready()
        {
            // The call under way gets its error, if any.
            *driven = None;
        }
    }
}

impl Connection {
    /// A connection to the server at `address` over `stream`. Larger replies than `max_reply` bytes are
    /// refused.
    pub async fn over(
        stream: TcpStream,
        address: &MasterUri,
        instance: HeaderValue,
        max_reply: usize,
    ) -> io::Result<Self> {
        Self::open(stream, address, instance, max_reply, None).await
    }

    pub(super) async fn open(
        stream: TcpStream,
        address: &MasterUri,
        instance: HeaderValue,
        max_reply: usize,
        writer: Option<Writer>,
    ) -> io::Result<Self> {
        stream.set_nodelay(true)?;
        let (local, peer) = (is_local(&stream)?, stream.peer_addr()?);
        let (sender, driver) = http1::Builder::new()
            .title_case_headers(true)
            .handshake(TokioIo::new(stream))
            .await
            .map_err(io::Error::other)?;
        let host = HeaderValue::from_str(&address.authority()).map_err(io::Error::other)?;
        Ok(Self {
            sender,
            driver: Drive::Caller(Some((Box::new(driver), writer))),
            local,
            peer,
            host,
            instance,
            max_reply,
        })
    }

    /// Whether the connection has ended.
    pub fn is_closed(&mut self) -> bool {
        self.driver.poll(&mut Context::from_waker(Waker::noop()));
        self.sender.is_closed()
    }

    /// Whether the other end is on this computer, or seems to be: a tunnel's end is here too.
    pub fn is_local(&self) -> bool {
        self.local
    }

    /// The other end's address.
    pub fn peer(&self) -> SocketAddr {
        self.peer
    }

    /// Has the connection driven by a task from now on. Returns when it has ended.
    pub fn ended(&mut self) -> impl Future<Output = ()> + Send + 'static {
        let mut ended = match &mut self.driver {
            Drive::Task(ended) => ended.clone(),
            Drive::Caller(driven) => {
                let (end, ended) = watch::channel(());
                let driven = driven.take();
                tokio::spawn(async move {
                    if let Some((driver, _writer)) = driven {
                        let _ = driver.await;
                    }
                    drop(end);
                });
                self.driver = Drive::Task(ended.clone());
                ended
            }
        };
        async move {
            // Nothing is ever sent: it ends when the sender is dropped.
            while ended.changed().await.is_ok() {}
        }
    }

    /// Sends `body` unchanged and returns the reply unchanged.
    pub async fn forward(&mut self, head: &Head, body: Bytes) -> Result<RawReply, CallError> {
        self.exchange(head, body, None).await
    }

    /// Sends a body of our own. The part of the reply that equals `predicted` is only compared and takes no
    /// memory.
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
        // No Accept-Encoding: rosmaster would gzip replies, in Python.
        let mut request = Request::post(head.path.as_str())
            .header(HOST, &self.host)
            .header(USER_AGENT, concat!("rosrescue/", env!("CARGO_PKG_VERSION")))
            .header(CONTENT_TYPE, "text/xml")
            // Also for an empty body: without it rosmaster answers with a status 500 and no body.
            .header(CONTENT_LENGTH, body.len())
            .header(INSTANCE_HEADER, &self.instance);
        if let Some(encoding) = &head.encoding {
            request = request.header(CONTENT_ENCODING, encoding);
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
                status: parts.status,
                reason: parts.extensions.get().cloned(),
                headers: parts.headers,
                body: body.map_err(CallError::BrokenReply)?,
            })
        };
        self.driver.run(exchange).await
    }

    pub async fn call(&mut self, call: &Call) -> Result<Reply, CallError> {
        let body = Bytes::from(xmlrpc::encode_call(call));
        let reply = self.forward(&Head::default(), body).await?;
        match reply.body.len() > LONG {
            true => tokio::task::block_in_place(|| reply.decode()),
            false => reply.decode(),
        }
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
