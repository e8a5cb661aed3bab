//! A client of a master, for calls and for raw bytes.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::Duration;

use ros1_master::xmlrpc::{self, Call, Reply, Value};

use super::patience::{PATIENCE, eventually};

/// How long a client waits for an answer: longer than rosrescue may hold any call, and than 20,000 changes take on a busy
/// computer.
const ANSWER: Duration = PATIENCE;

/// Encodes the body of a call.
pub(crate) fn encode_call(method: &str, params: Vec<Value>) -> Vec<u8> {
    xmlrpc::encode_call(&Call::new(method, params))
}

/// An HTTP request as XML-RPC clients send it: HTTP/1.1 to `/RPC2`, keep-alive, with a length.
pub(crate) fn http_request(body: &[u8]) -> Vec<u8> {
    request("POST /RPC2 HTTP/1.1", &[], body)
}

/// An HTTP request with this `first` line, `headers` in addition to the usual ones, and `body`.
pub(crate) fn request(first: &str, headers: &[&str], body: &[u8]) -> Vec<u8> {
    let mut head = format!("{first}\r\nHost: localhost\r\nContent-Type: text/xml\r\n");
    for header in headers {
        head += header;
        head += "\r\n";
    }
    head += &format!("Content-Length: {}\r\n\r\n", body.len());
    [head.as_bytes(), body].concat()
}

/// A request in UTF-16 without a byte order mark that sets `key` to `value`. rosmaster understands it and rosrescue
/// does not.
pub(crate) fn unreadable(key: &str, value: i32) -> Vec<u8> {
    let params = vec!["/test".into(), key.into(), value.into()];
    let call = String::from_utf8(encode_call("setParam", params)).unwrap();
    let (_, call) = call.split_once("?>").unwrap();
    let call = format!("<?xml version='1.0' encoding='utf-16'?>{call}");
    let body: Vec<_> = call.encode_utf16().flat_map(u16::to_le_bytes).collect();
    http_request(&body)
}

/// A client of one master. Each call uses a new connection and is sent exactly once.
#[derive(Clone, Debug)]
pub(crate) struct Client {
    host: String,
    port: u16,
}

impl Client {
    /// A client of a master on 127.0.0.1.
    pub(crate) fn new(port: u16) -> Self {
        Self::at("127.0.0.1", port)
    }

    /// A client of a master on `host`: a name, an IPv4 address, or an IPv6 address in brackets.
    pub(crate) fn at(host: &str, port: u16) -> Self {
        Self {
            host: host.to_owned(),
            port,
        }
    }

    pub(crate) fn port(&self) -> u16 {
        self.port
    }

    pub(crate) fn uri(&self) -> String {
        format!("http://{}:{}/", self.host, self.port)
    }

    pub(crate) fn connect(&self) -> io::Result<Wire> {
        Wire::connect(&self.host, self.port)
    }

    /// Sends a raw request and returns the raw answer.
    pub(crate) fn exchange(&self, request: &[u8]) -> io::Result<Response> {
        let mut wire = self.connect()?;
        wire.send(request)?;
        wire.response()
    }

    /// Makes all of `calls`, in multicalls so large that rosrescue does not split them.
    #[track_caller]
    pub(crate) fn call_all(&self, calls: &[Call]) {
        for some in calls.chunks(200) {
            let Call { method, params } = Call::multicall(some.iter().cloned());
            let reply = self.call(&method, params).unwrap();
            let Reply::Value(Value::Array(results)) = reply else {
                panic!("{reply:?}");
            };
            assert_eq!(results.len(), some.len());
        }
    }

    /// Makes a call and decodes the answer.
    pub(crate) fn call(&self, method: &str, params: Vec<Value>) -> io::Result<Reply> {
        self.connect()?.call(method, params)
    }

    /// Code, message and value of the answer to a method of the Master API.
    pub(crate) fn status(
        &self,
        method: &str,
        params: Vec<Value>,
    ) -> io::Result<(i32, String, Value)> {
        self.connect()?.status(method, params)
    }

    /// The value of a call that must succeed.
    #[track_caller]
    pub(crate) fn ok(&self, method: &str, params: Vec<Value>) -> Value {
        let shown = format!("{method}{}", super::short(&params));
        match self.status(method, params) {
            Ok((1, _, value)) => value,
            other => panic!("{shown} at {}: {other:?}", self.uri()),
        }
    }

    /// The value of a call, if it succeeds.
    pub(crate) fn ask(&self, method: &str, params: Vec<Value>) -> Option<Value> {
        match self.status(method, params) {
            Ok((1, _, value)) => Some(value),
            _ => None,
        }
    }

    /// The process id of the master.
    pub(crate) fn master_pid(&self) -> Option<u32> {
        let pid = self.ask("getPid", vec!["/test".into()])?.as_int()?;
        u32::try_from(pid).ok()
    }

    #[track_caller]
    pub(crate) fn set_param(&self, key: &str, value: impl Into<Value>) {
        self.ok("setParam", vec!["/test".into(), key.into(), value.into()]);
    }

    /// The value of a parameter, if it is set.
    pub(crate) fn param(&self, key: &str) -> Option<Value> {
        self.ask("getParam", vec!["/test".into(), key.into()])
    }

    /// Waits until `core` has set the parameters that a roscore sets. `rosversion` takes a while on a busy computer.
    #[track_caller]
    pub(crate) fn await_roscore_params(&self) {
        eventually("roscore's parameters are set", || {
            let keys = ["/rosversion", "/rosdistro", "/run_id"];
            keys.iter().all(|key| self.param(key).is_some())
        });
    }
}

/// One connection. After an HTTP/1.0 answer, or one with `Connection: close`, it connects again.
#[derive(Debug)]
pub(crate) struct Wire {
    stream: BufReader<TcpStream>,
    address: SocketAddr,
    spent: bool,
}

impl Wire {
    pub(crate) fn connect(host: &str, port: u16) -> io::Result<Self> {
        let address = format!("{host}:{port}")
            .to_socket_addrs()?
            .next()
            .ok_or_else(|| io::Error::other(format!("{host} has no address")))?;
        Self::to(address)
    }

    fn to(address: SocketAddr) -> io::Result<Self> {
        let stream = TcpStream::connect_timeout(&address, ANSWER)?;
        stream.set_read_timeout(Some(ANSWER))?;
        stream.set_write_timeout(Some(ANSWER))?;
        stream.set_nodelay(true)?;
        Ok(Self {
            stream: BufReader::new(stream),
            address,
            spent: false,
        })
    }

    /// A second handle of the connection.
    pub(crate) fn stream(&self) -> TcpStream {
        self.stream.get_ref().try_clone().expect("a connection")
    }

    pub(crate) fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        if self.spent {
            *self = Self::to(self.address)?;
        }
        self.stream.get_mut().write_all(bytes)
    }

    /// Makes a call and decodes the answer.
    pub(crate) fn call(&mut self, method: &str, params: Vec<Value>) -> io::Result<Reply> {
        self.send(&http_request(&encode_call(method, params)))?;
        let response = self.response()?;
        if response.code != 200 {
            let text = format!("{method}: the HTTP status is `{}`", response.status);
            return Err(io::Error::other(text));
        }
        xmlrpc::decode_reply(&response.body).map_err(io::Error::other)
    }

    /// Code, message and value of the answer to a method of the Master API.
    pub(crate) fn status(
        &mut self,
        method: &str,
        params: Vec<Value>,
    ) -> io::Result<(i32, String, Value)> {
        match self.call(method, params)? {
            Reply::Value(Value::Array(fields)) => match fields.as_slice() {
                [Value::Int(code), Value::String(text), value] => {
                    Ok((*code, text.clone(), value.clone()))
                }
                other => Err(io::Error::other(format!("{method}: {other:?}"))),
            },
            other => Err(io::Error::other(format!("{method}: {other:?}"))),
        }
    }

    /// Closes this half of the connection, after the last request.
    pub(crate) fn finish(&mut self) -> io::Result<()> {
        self.stream.get_mut().shutdown(std::net::Shutdown::Write)
    }

    pub(crate) fn set_patience(&mut self, patience: Duration) {
        self.stream
            .get_mut()
            .set_read_timeout(Some(patience))
            .unwrap();
    }

    /// Reads the head of an answer: status line and headers.
    pub(crate) fn head(&mut self) -> io::Result<Response> {
        let mut lines = Vec::new();
        loop {
            let mut line = String::new();
            if self.stream.read_line(&mut line)? == 0 {
                let text = format!("the connection was closed after {lines:?}");
                return Err(io::Error::new(io::ErrorKind::UnexpectedEof, text));
            }
            let line = line.trim_end_matches(['\r', '\n']);
            if line.is_empty() {
                break;
            }
            lines.push(line.to_owned());
        }
        if lines.is_empty() {
            return Err(io::Error::other("an answer without a status line"));
        }
        let status = lines.remove(0);
        let code = status.split(' ').nth(1).and_then(|code| code.parse().ok());
        Ok(Response {
            code: code.ok_or_else(|| io::Error::other(format!("no status: `{status}`")))?,
            status,
            headers: lines,
            body: Vec::new(),
        })
    }

    /// Returns bytes that have been received, or waits for some.
    pub(crate) fn some(&mut self) -> io::Result<Vec<u8>> {
        let part = self.stream.fill_buf()?.to_vec();
        self.stream.consume(part.len());
        Ok(part)
    }

    /// Reads one whole answer, as long as its Content-Length says, or up to the end without one.
    pub(crate) fn response(&mut self) -> io::Result<Response> {
        let mut response = self.head()?;
        match response.header("content-length") {
            _ if response.code < 200 => {}
            Some(length) => {
                let length = length.parse().map_err(io::Error::other)?;
                response.body = vec![0; length];
                self.stream.read_exact(&mut response.body)?;
            }
            None => {
                self.stream.read_to_end(&mut response.body)?;
            }
        }
        self.spent = response.status.starts_with("HTTP/1.0")
            || response.header("connection") == Some("close");
        Ok(response)
    }

    /// Whether the other side closes the connection within `patience` and sends nothing more.
    pub(crate) fn closes(&mut self, patience: Duration) -> bool {
        self.set_patience(patience);
        match self.stream.read(&mut [0; 1]) {
            Ok(count) => count == 0,
            Err(error) => error.kind() == io::ErrorKind::ConnectionReset,
        }
    }
}

/// An HTTP answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Response {
    /// The status line.
    pub(crate) status: String,
    pub(crate) code: u16,
    /// The header lines, unchanged.
    pub(crate) headers: Vec<String>,
    pub(crate) body: Vec<u8>,
}

impl Response {
    /// The value of a header. `name` must be in lower case.
    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find_map(|line| {
            let (found, value) = line.split_once(':')?;
            (found.to_ascii_lowercase() == name).then(|| value.trim())
        })
    }

    pub(crate) fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    pub(crate) fn reply(&self) -> Reply {
        xmlrpc::decode_reply(&self.body)
            .unwrap_or_else(|error| panic!("{error}: {:.500}", self.text()))
    }
}
