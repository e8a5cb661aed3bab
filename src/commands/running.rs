//! Finds and asks the running rosrescue.

use std::{net::SocketAddr, time::Duration};

use http_body_util::{BodyExt, Full, Limited};
use hyper::{
    Request, StatusCode,
    body::Bytes,
    client::conn::http1,
    header::{ACCEPT, CONTENT_TYPE, HOST},
};
use hyper_util::rt::TokioIo;
use ros1_master::xmlrpc::{self, Call, Reply, Value};
use serde::Deserialize;
use tokio::{
    net::TcpStream,
    time::{Instant, timeout_at},
};

use super::CommandFailure;
use crate::{
    cli::TargetArgs,
    resolver,
    ros_env::{DEFAULT_MASTER_PORT, MasterUri},
    status::summary::{SCHEMA, Status},
};

/// Longest time for rosrescue to answer. It needs only milliseconds, because it waits for no other process.
pub(super) const ANSWER_LIMIT: Duration = Duration::from_secs(5);
/// Largest page that is read, in bytes.
const MAX_PAGE: usize = 64 << 20;

/// A rosrescue at a known address. It may not answer.
#[derive(Clone, Debug)]
pub(super) struct Running {
    pub(super) address: MasterUri,
}

impl Running {
    /// The rosrescue that `target` stands for.
    pub(super) fn find(target: &TargetArgs) -> Result<Self, CommandFailure> {
        let of = |variable: &str, uri: &str| {
            MasterUri::parse(uri)
                .map_err(|error| CommandFailure::Usage(format!("{variable}: {error}")))
        };
        let address = match (&target.uri, std::env::var("ROS_MASTER_URI")) {
            (Some(uri), _) => of("--uri", uri)?,
            (None, Ok(uri)) if !uri.is_empty() => of("ROS_MASTER_URI", &uri)?,
            _ => MasterUri {
                host: "localhost".to_owned(),
                port: DEFAULT_MASTER_PORT,
            },
        };
        Ok(Self { address })
    }

    /// Gets the page at `path`.
    pub(super) async fn get(&self, path: &str) -> Result<(StatusCode, Bytes), CommandFailure> {
        let request = Request::get(path).header(ACCEPT, "text/plain, application/json");
        self.exchange(request, Bytes::new(), ANSWER_LIMIT).await
    }

    /// Gets the status.
    pub(super) async fn status(&self) -> Result<Status, CommandFailure> {
        /// The field that all versions have.
        #[derive(Deserialize)]
        struct Versioned {
            schema: u32,
            version: String,
        }
        let (code, json) = self.get("/status.json").await?;
        let at = &self.address;
        if code == StatusCode::FORBIDDEN {
            let why = String::from_utf8_lossy(&json);
            return Err(CommandFailure::Failed(format!(
                "{at} refuses: {}",
                why.trim()
            )));
        }
        let versioned = serde_json::from_slice(&json).map_err(|_| {
            self.silent("another program answers there, perhaps a bare rosmaster".to_owned())
        })?;
        let Versioned { schema, version } = versioned;
        if schema > SCHEMA {
            return Err(CommandFailure::Failed(format!(
                "the rosrescue at {at} is version {version}, newer than this one ({}): use its own \
                 command",
                env!("CARGO_PKG_VERSION")
            )));
        }
        // Either program may have a field or a name that the other one does not know.
        serde_json::from_slice(&json).map_err(|error| {
            CommandFailure::Failed(format!(
                "cannot read the status of the rosrescue at {at}: {error}. It is version {version}, this program is {}: \
                 use its own command, or restart it",
                env!("CARGO_PKG_VERSION")
            ))
        })
    }

    /// Makes a call within `limit`, and returns the answer.
    pub(super) async fn call(
        &self,
        method: &str,
        params: Vec<Value>,
        limit: Duration,
    ) -> Result<Reply, CommandFailure> {
        let body = xmlrpc::encode_call(&Call::new(method, params));
        let request = Request::post("/RPC2").header(CONTENT_TYPE, "text/xml");
        let answer = self.exchange(request, body.into(), limit).await?;
        xmlrpc::decode_reply(&answer.1)
            .map_err(|error| self.nobody(format!("it gives no answer to calls: {error}")))
    }

    pub(super) fn nobody(&self, why: String) -> CommandFailure {
        CommandFailure::Nobody {
            uri: self.address.to_string(),
            why,
        }
    }

    /// Connects to it.
    pub(super) async fn connect(&self, deadline: Instant) -> Result<TcpStream, CommandFailure> {
        let connect = async {
            let addresses = resolver::addresses(&self.address.host, self.address.port).await?;
            TcpStream::connect(&*addresses).await
        };
        match timeout_at(deadline, connect).await {
            Ok(connected) => connected.map_err(|error| self.nobody(error.to_string())),
            // The backlog of a stopped rosrescue may be full.
            Err(_) => Err(self.silent("no connection in time".to_owned())),
        }
    }

    /// Sends a request. Its `Host` is the address and not the name that was given, because rosrescue refuses to show pages
    /// under a name that is not its computer's own, and the reader of a status may have another name for it.
    async fn exchange(
        &self,
        request: http::request::Builder,
        body: Bytes,
        limit: Duration,
    ) -> Result<(StatusCode, Bytes), CommandFailure> {
        let deadline = Instant::now() + limit;
        let stream = self.connect(deadline).await?;
        let there = stream.peer_addr();
        let there = there.map_err(|error| self.nobody(error.to_string()))?;
        // Without the zone of an IPv6 address.
        let there = SocketAddr::new(there.ip(), there.port()).to_string();
        let request = request.header(HOST, there).body(Full::new(body));
        match timeout_at(deadline, try_exchange(stream, request)).await {
            Ok(answer) => answer.map_err(|error| self.silent(error.to_string())),
            Err(_) => Err(self.silent(format!("no answer in {} s", limit.as_secs()))),
        }
    }

    fn silent(&self, why: String) -> CommandFailure {
        CommandFailure::Silent {
            uri: self.address.to_string(),
            why,
        }
    }
}

async fn try_exchange(
    stream: TcpStream,
    request: http::Result<Request<Full<Bytes>>>,
) -> Result<(StatusCode, Bytes), Box<dyn std::error::Error + Send + Sync>> {
    let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await?;
    crate::task::spawn(connection);
    let (head, body) = sender.send_request(request?).await?.into_parts();
    let body = Limited::new(body, MAX_PAGE).collect().await?.to_bytes();
    Ok((head.status, body))
}

/// Whether `address` leads to this computer.
pub(super) async fn is_here(address: &MasterUri) -> bool {
    let running = Running {
        address: address.clone(),
    };
    let Ok(stream) = running.connect(Instant::now() + ANSWER_LIMIT).await else {
        return false;
    };
    match (stream.local_addr(), stream.peer_addr()) {
        (Ok(here), Ok(there)) => there.ip().is_loopback() || here.ip() == there.ip(),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use std::{
        io::{BufRead, BufReader, Write},
        net::TcpListener,
    };

    use socket2::{Domain, Socket, Type};

    use super::*;

    #[tokio::test]
    async fn a_port_that_accepts_no_connection_is_taken() {
        let listener = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
        let any: SocketAddr = ([127, 0, 0, 1], 0).into();
        listener.bind(&any.into()).unwrap();
        listener.listen(0).unwrap();
        let address = listener.local_addr().unwrap().as_socket().unwrap();
        // Connects until the backlog is full.
        let limit = Duration::from_millis(500);
        let connect = || std::net::TcpStream::connect_timeout(&address, limit).ok();
        let _waiting: Vec<_> = std::iter::from_fn(connect).collect();
        let address = MasterUri {
            host: "127.0.0.1".to_owned(),
            port: address.port(),
        };
        let connected = Running { address }.connect(Instant::now() + limit).await;
        assert!(matches!(connected, Err(CommandFailure::Silent { .. })));
    }

    #[tokio::test]
    async fn a_status_of_another_version_names_both_versions() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = MasterUri {
            host: "127.0.0.1".to_owned(),
            port: listener.local_addr().unwrap().port(),
        };
        let older = std::thread::spawn(move || {
            let mut stream = BufReader::new(listener.accept().unwrap().0);
            let lines = BufRead::lines(&mut stream).map(Result::unwrap);
            lines.take_while(|line| !line.is_empty()).for_each(drop);
            let page = r#"{"schema":1,"version":"0.1.9"}"#;
            let length = page.len();
            write!(
                stream.get_mut(),
                "HTTP/1.1 200 OK\r\nContent-Length: {length}\r\n\r\n{page}"
            )
            .unwrap();
        });
        let failed = Running { address }.status().await.unwrap_err();
        older.join().unwrap();
        let words = format!(
            "It is version 0.1.9, this program is {}",
            env!("CARGO_PKG_VERSION")
        );
        assert!(failed.to_string().contains(&words), "{failed}");
    }
}
