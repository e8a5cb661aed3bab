//! The load generator: one thread with any number of keep-alive connections, each of which makes its next
//! call as soon as it has its answer.

use std::{
    io::{self, ErrorKind},
    net::Ipv4Addr,
    sync::Arc,
    time::{Duration, Instant},
};

use ros1_master::xmlrpc::{self, Reply, Value};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    runtime::{Builder, Runtime},
    sync::Barrier,
    task::JoinSet,
};

use super::support::http_request;

/// A placeholder in a request for a number that differs in each call.
pub(crate) const NUMBER: i32 = 17_171_717;
/// The smallest such number. All of them have as many digits as [`NUMBER`].
const FIRST: usize = 20_000_000;
const NUMBERS: usize = 70_000_000;
/// Maximum number of calls in one turn, over all connections.
const CALLS_MAX: usize = 1_000_000;
/// The errors by which a closed connection shows.
const CLOSED: [ErrorKind; 3] = [
    ErrorKind::UnexpectedEof,
    ErrorKind::ConnectionReset,
    ErrorKind::BrokenPipe,
];
/// Initial capacity for an answer. It grows with the first large one.
const ROOM: usize = 64 << 10;

/// The calls that one client repeats.
#[derive(Debug)]
pub(crate) struct Script {
    /// The requests, and the places of the number in each.
    requests: Vec<(Vec<u8>, Vec<usize>)>,
    sent: usize,
}

impl Script {
    /// Makes a script of the bodies of calls.
    pub(crate) fn new(bodies: impl IntoIterator<Item = Vec<u8>>) -> Self {
        let number = NUMBER.to_string();
        let request = |body: Vec<u8>| {
            let request = http_request(&body);
            let windows = request.windows(number.len()).enumerate();
            let places = windows.filter(|(_, found)| *found == number.as_bytes());
            let places = places.map(|(place, _)| place).collect();
            (request, places)
        };
        Self {
            requests: bodies.into_iter().map(request).collect(),
            sent: 0,
        }
    }

    fn next(&mut self) -> &[u8] {
        let place = self.sent % self.requests.len();
        let (request, places) = &mut self.requests[place];
        let number = (FIRST + self.sent % NUMBERS).to_string();
        for place in places {
            request[*place..*place + number.len()].copy_from_slice(number.as_bytes());
        }
        self.sent += 1;
        request
    }
}

/// Connected clients that have each been answered once.
#[derive(Debug)]
pub(crate) struct Load {
    runtime: Runtime,
    callers: Vec<Caller>,
}

/// The time of each call, and of all of them together.
#[derive(Debug)]
pub(crate) struct Turn {
    pub(crate) calls: Vec<Duration>,
    pub(crate) time: Duration,
    pub(crate) reconnections: usize,
}

impl Load {
    /// Connects one client per script, one after another, because a rosmaster accepts only few at once. Each
    /// call of a script must succeed.
    pub(crate) fn connect(port: u16, scripts: Vec<Script>) -> io::Result<Self> {
        let runtime = runtime()?;
        let mut callers = Vec::new();
        for script in scripts {
            callers.push(runtime.block_on(async {
                let mut caller = Caller::connect(port, script).await?;
                for _ in 0..caller.script.requests.len() {
                    caller.call().await?;
                    caller.assert_success();
                }
                io::Result::Ok(caller)
            })?);
        }
        Ok(Self { runtime, callers })
    }

    /// Makes all clients call for `time`, at least once each. Calls that were sent by then are counted. The
    /// clients stay connected.
    pub(crate) fn run(&mut self, time: Duration) -> io::Result<Turn> {
        let mut callers = std::mem::take(&mut self.callers);
        callers
            .iter_mut()
            .for_each(|caller| caller.reconnections = 0);
        let most = CALLS_MAX / callers.len().max(1);
        let barrier = Arc::new(Barrier::new(callers.len()));
        let call = |mut caller: Caller| {
            let barrier = Arc::clone(&barrier);
            async move {
                barrier.wait().await;
                let (begin, mut calls) = (Instant::now(), Vec::new());
                loop {
                    let before = Instant::now();
                    caller.call().await?;
                    let end = Instant::now();
                    calls.push(end - before);
                    if end - begin > time || calls.len() >= most {
                        return io::Result::Ok((caller, calls, begin, end));
                    }
                }
            }
        };
        self.runtime.block_on(async {
            let mut running: JoinSet<_> = callers.into_iter().map(call).collect();
            let mut calls = Vec::new();
            let (mut first, mut last) = (None, None);
            while let Some(done) = running.join_next().await {
                let (caller, times, begin, end) = done??;
                self.callers.push(caller);
                calls.extend(times);
                first = Some(first.map_or(begin, |first: Instant| first.min(begin)));
                last = last.max(Some(end));
            }
            let time = first.zip(last).map(|(first, last)| last - first);
            let time = time.unwrap_or_default();
            let reconnections = self.callers.iter().map(|caller| caller.reconnections);
            Ok(Turn {
                calls,
                time,
                reconnections: reconnections.sum(),
            })
        })
    }
}

/// The time until clients that all connect at once have been answered every call of their scripts.
pub(crate) fn once(port: u16, scripts: Vec<Script>) -> io::Result<Duration> {
    let client = |script: Script| async move {
        let count = script.requests.len();
        let mut caller = Caller::connect(port, script).await?;
        for _ in 0..count {
            caller.call().await?;
        }
        io::Result::Ok(())
    };
    runtime()?.block_on(async {
        let begin = Instant::now();
        let mut running: JoinSet<_> = scripts.into_iter().map(client).collect();
        while let Some(done) = running.join_next().await {
            done??;
        }
        Ok(begin.elapsed())
    })
}

fn runtime() -> io::Result<Runtime> {
    Builder::new_current_thread().enable_io().build()
}

#[derive(Debug)]
struct Caller {
    port: u16,
    stream: TcpStream,
    /// How often the connection was found closed.
    reconnections: usize,
    /// Whether the last answer was HTTP/1.0, so that the next call needs a new connection, which counts as
    /// part of its time.
    spent: bool,
    script: Script,
    /// The last answer, head and body.
    answer: Vec<u8>,
    body: std::ops::Range<usize>,
}

impl Caller {
    async fn connect(port: u16, script: Script) -> io::Result<Self> {
        Ok(Self {
            port,
            stream: connect(port).await?,
            reconnections: 0,
            spent: false,
            script,
            answer: vec![0; ROOM],
            body: 0..0,
        })
    }

    /// Makes a call and waits for the whole answer. If the connection was closed, it repeats the call once on
    /// a new one, as Python's client does: a rosmaster closes connections that are idle for 5 s.
    async fn call(&mut self) -> io::Result<()> {
        let request = self.script.next().to_vec();
        if self.spent {
            self.stream = connect(self.port).await?;
        }
        match self.exchange(&request).await {
            Err(error) if CLOSED.contains(&error.kind()) => {
                self.reconnections += 1;
                self.stream = connect(self.port).await?;
                self.exchange(&request).await
            }
            done => done,
        }
    }

    async fn exchange(&mut self, request: &[u8]) -> io::Result<()> {
        self.stream.write_all(request).await?;
        let (mut filled, mut body) = (0, None);
        loop {
            let count = self.stream.read(&mut self.answer[filled..]).await?;
            if count == 0 {
                return Err(ErrorKind::UnexpectedEof.into());
            }
            filled += count;
            if body.is_none() {
                body = body_of(&self.answer[..filled])?;
            }
            if let Some(body) = &body {
                if filled >= body.end {
                    self.spent = self.answer.starts_with(b"HTTP/1.0");
                    self.body = body.clone();
                    return Ok(());
                }
                if self.answer.len() < body.end {
                    self.answer.resize(body.end, 0);
                }
            }
        }
    }

    /// Panics unless the last answer reports success, or is a list of such answers.
    fn assert_success(&self) {
        let reply = xmlrpc::decode_reply(&self.answer[self.body.clone()]).expect("an answer");
        let is_success = |value: &Value| matches!(value, Value::Array(fields) if fields.first() == Some(&Value::Int(1)));
        let entry =
            |value: &Value| matches!(value, Value::Array(fields) if fields.iter().all(is_success));
        let Reply::Value(value) = &reply else {
            panic!("{reply:?}");
        };
        let entries = value.as_array().unwrap_or_default();
        let all = !entries.is_empty() && entries.iter().all(entry);
        assert!(is_success(value) || all, "{reply:?}");
    }
}

async fn connect(port: u16) -> io::Result<TcpStream> {
    let stream = TcpStream::connect((Ipv4Addr::LOCALHOST, port)).await?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// The position of the body in an answer, of which this much has been read. `None` before the end of the
/// head.
fn body_of(answer: &[u8]) -> io::Result<Option<std::ops::Range<usize>>> {
    const END: &[u8] = b"\r\n\r\n";
    let Some(end) = answer.windows(END.len()).position(|found| found == END) else {
        return Ok(None);
    };
    let head = String::from_utf8_lossy(&answer[..end]);
    let length = head.lines().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        let is_length = name.eq_ignore_ascii_case("content-length");
        is_length.then(|| value.trim().parse::<usize>().ok())?
    });
    match length {
        Some(length) if head.starts_with("HTTP/1.1 200 ") || head.starts_with("HTTP/1.0 200 ") => {
            let start = end + END.len();
            Ok(Some(start..start + length))
        }
        _ => Err(io::Error::other(format!("the answer is {head:?}"))),
    }
}
