//! Fakes of both sides: a node that records its calls, and a master that can give any answer.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Shutdown, TcpListener, TcpStream};
use std::os::fd::AsRawFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread;

use ros1_master::xmlrpc::{self, Reply, Value};
use socket2::SockRef;

use super::params;
use super::patience::eventually_some;
use super::rpc::Client;
use super::scratch::free_port;

/// A call that a fake node received.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ReceivedCall {
    pub(crate) method: String,
    pub(crate) params: Vec<Value>,
    /// Whether rosrescue itself made the call, under the name of the master, as nodes expect.
    pub(crate) from_rosrescue: bool,
    pub(crate) from: Option<IpAddr>,
    /// Milliseconds since 1970.
    pub(crate) at: u64,
}

#[derive(Debug, Default)]
struct Inner {
    received: Mutex<Vec<ReceivedCall>>,
    holding: Mutex<bool>,
    /// A method, and the number of its call with which holding begins.
    hold_at: Mutex<Option<(String, usize)>>,
    released: Condvar,
    publications: Mutex<BTreeMap<String, String>>,
    subscriptions: Mutex<BTreeMap<String, String>>,
    /// The process id that the node reports. `None` means the test's process id.
    pid: Mutex<Option<i32>>,
    /// Whether the node reports a different process id each time.
    restless: AtomicBool,
    /// The address of the master that the node reports.
    master: Mutex<Option<String>>,
    /// A method that the node never answers.
    ignored: Mutex<Option<String>>,
}

/// A node without TCPROS: an XML-RPC server that gives the answers of a real node and records every call.
#[derive(Debug)]
pub(crate) struct FakeNode {
    pub(crate) name: String,
    pub(crate) api: String,
    inner: Arc<Inner>,
    server: Server,
}

impl FakeNode {
    pub(crate) fn start(name: &str) -> Self {
        Self::start_at(name, 0)
    }

    /// Starts a node at `port`, for example the port of a node that has ended. 0 means any port.
    pub(crate) fn start_at(name: &str, port: u16) -> Self {
        Self::start_on(name, Ipv4Addr::LOCALHOST, port)
    }

    /// Like [`Self::start_at`], at another address of this computer.
    pub(crate) fn start_on(name: &str, address: Ipv4Addr, port: u16) -> Self {
        let inner = Arc::new(Inner::default());
        let state = Arc::clone(&inner);
        let server = Server::start_at(address, port, move |stream| serve_node(&state, stream));
        Self {
            name: name.to_owned(),
            api: format!("http://{address}:{}/", server.port),
            inner,
            server,
        }
    }

    /// Registers under this host name from now on. It must lead to the address at which the node was started.
    pub(crate) fn at_host(mut self, host: &str) -> Self {
        self.api = format!("http://{host}:{}/", self.server.port);
        self
    }

    pub(crate) fn port(&self) -> u16 {
        self.server.port
    }

    /// Reports this process id from now on.
    pub(crate) fn claim_pid(&self, pid: i32) {
        *lock(&self.inner.pid) = Some(pid);
    }

    /// Reports a different process id each time from now on.
    pub(crate) fn claim_restless_pid(&self) {
        self.claim_pid(5000);
        self.inner.restless.store(true, Ordering::SeqCst);
    }

    /// Reports this address as that of its master.
    pub(crate) fn claim_master(&self, uri: &str) {
        *lock(&self.inner.master) = Some(uri.to_owned());
    }

    /// Never answers `method` from now on, but still answers everything else.
    pub(crate) fn ignore(&self, method: &str) {
        *lock(&self.inner.ignored) = Some(method.to_owned());
    }

    /// Answers everything from now on.
    pub(crate) fn answer_all(&self) {
        *lock(&self.inner.ignored) = None;
    }

    /// The parameters of each call of `method` that the node received, in order.
    pub(crate) fn received(&self, method: &str) -> Vec<Vec<Value>> {
        let received = lock(&self.inner.received);
        received
            .iter()
            .filter(|call| call.method == method)
            .map(|call| call.params.clone())
            .collect()
    }

    /// All calls that the node received, in order.
    pub(crate) fn calls(&self) -> Vec<ReceivedCall> {
        lock(&self.inner.received).clone()
    }

    /// The list of publishers in each publisherUpdate for `topic`, in order.
    pub(crate) fn updates(&self, topic: &str) -> Vec<Vec<String>> {
        self.received("publisherUpdate")
            .into_iter()
            .filter(|params| params[1] == Value::from(topic))
            .map(|params| {
                let uris = params[2].as_array().expect("a list of addresses");
                uris.iter()
                    .map(|uri| uri.as_str().expect("an address").to_owned())
                    .collect()
            })
            .collect()
    }

    /// Records calls that arrive from now on, but does not answer them.
    pub(crate) fn hold(&self) {
        *lock(&self.inner.holding) = true;
    }

    /// Like [`Self::hold`], from the `number`th call of `method` on.
    pub(crate) fn hold_at(&self, method: &str, number: usize) {
        *lock(&self.inner.hold_at) = Some((method.to_owned(), number));
    }

    /// Answers calls again, including those that are waiting.
    pub(crate) fn release(&self) {
        *lock(&self.inner.holding) = false;
        self.inner.released.notify_all();
    }

    #[track_caller]
    pub(crate) fn publish(&self, master: &Client, topic: &str, topic_type: &str) {
        self.claim_publication(topic, Some(topic_type));
        let params = params![self.name.as_str(), topic, topic_type, self.api.as_str()];
        master.ok("registerPublisher", params);
    }

    #[track_caller]
    pub(crate) fn unpublish(&self, master: &Client, topic: &str) {
        self.claim_publication(topic, None);
        let params = params![self.name.as_str(), topic, self.api.as_str()];
        assert_eq!(master.ok("unregisterPublisher", params), Value::Int(1));
    }

    #[track_caller]
    pub(crate) fn subscribe(&self, master: &Client, topic: &str, topic_type: &str) {
        self.claim_subscription(topic, Some(topic_type));
        let params = params![self.name.as_str(), topic, topic_type, self.api.as_str()];
        master.ok("registerSubscriber", params);
    }

    #[track_caller]
    pub(crate) fn unsubscribe(&self, master: &Client, topic: &str) {
        self.claim_subscription(topic, None);
        let params = params![self.name.as_str(), topic, self.api.as_str()];
        assert_eq!(master.ok("unregisterSubscriber", params), Value::Int(1));
    }

    /// Changes what the node reports to publish, without a call to the master. `None` removes the topic.
    pub(crate) fn claim_publication(&self, topic: &str, topic_type: Option<&str>) {
        claim(&self.inner.publications, topic, topic_type);
    }

    /// Like [`Self::claim_publication`], for a topic that the node subscribes to.
    pub(crate) fn claim_subscription(&self, topic: &str, topic_type: Option<&str>) {
        claim(&self.inner.subscriptions, topic, topic_type);
    }

    /// The node's address for services. No TCPROS server listens there.
    pub(crate) fn service_api(&self) -> String {
        format!("rosrpc://127.0.0.1:{}", self.server.port)
    }

    #[track_caller]
    pub(crate) fn offer(&self, master: &Client, service: &str) {
        let params = params![
            self.name.as_str(),
            service,
            self.service_api(),
            self.api.as_str()
        ];
        master.ok("registerService", params);
    }

    #[track_caller]
    pub(crate) fn withdraw(&self, master: &Client, service: &str) {
        let params = params![self.name.as_str(), service, self.service_api()];
        assert_eq!(master.ok("unregisterService", params), Value::Int(1));
    }

    #[track_caller]
    pub(crate) fn watch_param(&self, master: &Client, key: &str) -> Value {
        master.ok(
            "subscribeParam",
            params![self.name.as_str(), self.api.as_str(), key],
        )
    }
}

impl Drop for FakeNode {
    fn drop(&mut self) {
        self.release();
    }
}

fn claim(table: &Mutex<BTreeMap<String, String>>, topic: &str, topic_type: Option<&str>) {
    match topic_type {
        Some(topic_type) => lock(table).insert(topic.to_owned(), topic_type.to_owned()),
        None => lock(table).remove(topic),
    };
}

/// Whether rosrescue itself has sent the request with this head.
pub(crate) fn is_from_rosrescue(head: &str) -> bool {
    head.to_ascii_lowercase()
        .contains("\nuser-agent: rosrescue/")
}

fn serve_node(inner: &Inner, stream: TcpStream) {
    let from = stream.peer_addr().ok().map(|peer| peer.ip());
    let mut stream = BufReader::new(stream);
    while let Some((head, body)) = read_request(&mut stream) {
        let Ok(call) = xmlrpc::decode_call(&body) else {
            break;
        };
        // The flag is read before the call is recorded: a test that sees the call and then sets the flag means later
        // calls.
        let mut is_held = *lock(&inner.holding);
        let mut received = lock(&inner.received);
        received.push(ReceivedCall {
            method: call.method.clone(),
            params: call.params,
            from_rosrescue: is_from_rosrescue(&head),
            from,
            at: rosrescue::clock::wall_millis(),
        });
        if let Some((method, number)) = &*lock(&inner.hold_at)
            && call.method == *method
            && received.iter().filter(|it| it.method == *method).count() == *number
        {
            *lock(&inner.holding) = true;
            is_held = true;
        }
        drop(received);
        if lock(&inner.ignored).as_ref() == Some(&call.method) {
            continue;
        }
        let mut holding = lock(&inner.holding);
        while is_held && *holding {
            holding = inner
                .released
                .wait(holding)
                .unwrap_or_else(PoisonError::into_inner);
        }
        drop(holding);
        let pairs = |table: &Mutex<BTreeMap<String, String>>| {
            let table = lock(table);
            Value::from(
                table
                    .iter()
                    .map(|(a, b)| params![a.as_str(), b.as_str()])
                    .collect::<Vec<_>>(),
            )
        };
        let value = match call.method.as_str() {
            "getPid" => {
                let own = i32::try_from(std::process::id()).unwrap();
                let mut claimed = lock(&inner.pid);
                let pid = claimed.unwrap_or(own);
                if inner.restless.load(Ordering::SeqCst) {
                    *claimed = Some(pid + 1);
                }
                Value::Int(pid)
            }
            "getMasterUri" => lock(&inner.master)
                .clone()
                .map_or(Value::Int(0), Value::from),
            "getPublications" => pairs(&inner.publications),
            "getSubscriptions" => pairs(&inner.subscriptions),
            "requestTopic" => Value::Array(Vec::new()),
            _ => Value::Int(0),
        };
        let code = i32::from(call.method != "requestTopic");
        let reply = Reply::Value(Value::Array(vec![code.into(), "".into(), value]));
        if stream
            .get_mut()
            .write_all(&http_reply(&xmlrpc::encode_reply(&reply)))
            .is_err()
        {
            break;
        }
    }
}

/// A server that answers each request with the bytes that the test gives it, then closes the connection.
#[derive(Debug)]
pub(crate) struct FakeMaster {
    server: Server,
}

impl FakeMaster {
    /// Starts a server. `answer` gets the body of a request and returns all bytes to send back.
    pub(crate) fn start(answer: impl Fn(&[u8]) -> Vec<u8> + Send + Sync + 'static) -> Self {
        Self::start_with_heads(move |_, body| answer(body))
    }

    /// Like [`Self::start`]. `answer` also gets the head of the request.
    pub(crate) fn start_with_heads(
        answer: impl Fn(&str, &[u8]) -> Vec<u8> + Send + Sync + 'static,
    ) -> Self {
        let server = Server::start(move |stream| {
            let mut stream = BufReader::new(stream);
            while let Some((head, body)) = read_request(&mut stream) {
                let bytes = answer(&head, &body);
                let whole = bytes.starts_with(b"HTTP/1.1 200 OK\r\nServer: fake-keep-alive");
                if stream.get_mut().write_all(&bytes).is_err() || !whole {
                    break;
                }
            }
            let _ = stream.get_mut().shutdown(Shutdown::Both);
        });
        Self { server }
    }

    pub(crate) fn port(&self) -> u16 {
        self.server.port
    }

    /// The bytes of a well-formed answer with `reply`, after which the connection stays open.
    pub(crate) fn proper(reply: &Reply) -> Vec<u8> {
        let body = xmlrpc::encode_reply(reply);
        let head = format!(
            "HTTP/1.1 200 OK\r\nServer: fake-keep-alive\r\nContent-Type: text/xml\r\n\
             Content-Length: {}\r\n\r\n",
            body.len()
        );
        [head.as_bytes(), &body].concat()
    }
}

fn http_reply(body: &[u8]) -> Vec<u8> {
    let length = body.len();
    let head =
        format!("HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: {length}\r\n\r\n");
    [head.as_bytes(), body].concat()
}

/// Reads the head and body of the next request. `None` at the end of the connection.
pub(crate) fn read_request(stream: &mut BufReader<TcpStream>) -> Option<(String, Vec<u8>)> {
    let mut head = String::new();
    loop {
        let mut line = String::new();
        if stream.read_line(&mut line).ok()? == 0 {
            return None;
        }
        if line.trim().is_empty() {
            break;
        }
        head += &line;
    }
    let length = head.lines().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        name.eq_ignore_ascii_case("content-length")
            .then(|| value.trim().parse().ok())?
    });
    let mut body = vec![0; length.unwrap_or(0)];
    stream.read_exact(&mut body).ok()?;
    Some((head, body))
}

/// A listener with one thread per connection. All connections are closed when it is dropped.
#[derive(Debug)]
struct Server {
    port: u16,
    listener: TcpListener,
    done: Arc<AtomicBool>,
    open: Arc<Mutex<Vec<TcpStream>>>,
    thread: Option<thread::JoinHandle<()>>,
}

impl Server {
    fn start(serve: impl Fn(TcpStream) + Send + Sync + 'static) -> Self {
        Self::start_at(Ipv4Addr::LOCALHOST, 0, serve)
    }

    fn start_at(
        address: Ipv4Addr,
        port: u16,
        serve: impl Fn(TcpStream) + Send + Sync + 'static,
    ) -> Self {
        // Not port 0: the kernel could give the same port to an outgoing connection before we listen. A process that is
        // being started may hold a closed socket of this program for a moment.
        let listener = eventually_some("a free port", || {
            let port = if port == 0 { free_port() } else { port };
            TcpListener::bind((address, port)).ok()
        });
        let port = listener.local_addr().unwrap().port();
        let kept = listener.try_clone().unwrap();
        let done = Arc::new(AtomicBool::new(false));
        let open = Arc::new(Mutex::new(Vec::new()));
        let serve = Arc::new(serve);
        let (stop, connections) = (Arc::clone(&done), Arc::clone(&open));
        let thread = thread::spawn(move || {
            for stream in listener.incoming() {
                if stop.load(Ordering::SeqCst) {
                    break;
                }
                let Ok((stream, other)) = stream.and_then(|it| Ok((it.try_clone()?, it))) else {
                    continue;
                };
                let _ = stream.set_nodelay(true);
                let handle = other.as_raw_fd();
                lock(&connections).push(other);
                let (serve, connections) = (Arc::clone(&serve), Arc::clone(&connections));
                thread::spawn(move || {
                    let closing = stream.try_clone();
                    serve(stream);
                    // The list above holds a second handle, so dropping this one would not close the
                    // connection.
                    if let Ok(stream) = closing {
                        let _ = stream.shutdown(Shutdown::Both);
                    }
                    lock(&connections).retain(|other| other.as_raw_fd() != handle);
                });
            }
        });
        Self {
            port,
            listener: kept,
            done,
            open,
            thread: Some(thread),
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.done.store(true, Ordering::SeqCst);
        // This ends the wait for connections even if the computer has lost the address.
        let _ = SockRef::from(&self.listener).shutdown(Shutdown::Both);
        // From here on the port refuses connections.
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        for stream in lock(&self.open).drain(..) {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }
}

/// Takes the lock even if another thread has panicked: the panic is reported where it happened.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
