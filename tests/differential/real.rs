//! A real rosmaster, and talking to it.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rosrescue::xmlrpc::{Call, Reply, Value, decode_reply, encode_call};

/// Longest wait for a rosmaster to answer.
const START: Duration = Duration::from_secs(30);

/// A rosmaster of its own, ended when this is dropped.
pub(crate) struct Rosmaster {
    process: Child,
    port: u16,
    connection: Option<BufReader<TcpStream>>,
    pub(crate) pid: i32,
    pub(crate) uri: String,
    _scratch: tempfile::TempDir,
}

impl Rosmaster {
    /// Starts one without waiting for it.
    pub(crate) fn start() -> Self {
        let scratch = tempfile::tempdir().unwrap();
        // The default configuration's stream handler imports rospy, which doubles the start.
        let logging = scratch.path().join("logging.conf");
        std::fs::write(&logging, LOGGING).unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        drop(listener);
        let process = Command::new("/usr/bin/python3")
            .args(["/usr/bin/rosmaster", "--core", "-p", &port.to_string()])
            .env_clear()
            .env("PATH", "/usr/bin:/bin")
            .env("LANG", "C.UTF-8")
            .env("ROS_IP", "127.0.0.1")
            .env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"))
            .env("ROS_HOME", scratch.path())
            .env("ROS_LOG_DIR", scratch.path())
            .env("ROS_PYTHON_LOG_CONFIG_FILE", &logging)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("ROS Noetic's rosmaster must be installed for this test");
        Self {
            process,
            port,
            connection: None,
            pid: 0,
            uri: String::new(),
            _scratch: scratch,
        }
    }

    /// Waits until it answers.
    pub(crate) fn ready(mut self) -> Self {
        let deadline = Instant::now() + START;
        let connection = loop {
            match TcpStream::connect(("127.0.0.1", self.port)) {
                Ok(connection) => break connection,
                Err(error) => {
                    let ended = self.process.try_wait().unwrap();
                    assert!(ended.is_none(), "rosmaster ended at its start: {ended:?}");
                    assert!(
                        Instant::now() < deadline,
                        "rosmaster does not listen: {error}"
                    );
                    std::thread::sleep(Duration::from_millis(10));
                }
            }
        };
        connection.set_nodelay(true).unwrap();
        connection.set_read_timeout(Some(START)).unwrap();
        self.connection = Some(BufReader::new(connection));
        let mut ask = |method: &str| {
            let reply = self.call(&Call::new(method, vec!["/test".into()]));
            match reply {
                Reply::Value(Value::Array(mut answer)) => answer.pop().unwrap(),
                other => panic!("{method}: {other:?}"),
            }
        };
        let (pid, uri) = (ask("getPid"), ask("getUri"));
        self.pid = pid.as_int().unwrap();
        self.uri = uri.as_str().unwrap().to_owned();
        self
    }

    /// Sends a call and reads the reply.
    pub(crate) fn call(&mut self, call: &Call) -> Reply {
        let body = encode_call(call);
        let connection = self.connection.as_mut().expect("not ready");
        let head = format!(
            "POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: text/xml\r\nContent-Length: {}\r\n\r\n",
            body.len()
        );
        let request = [head.as_bytes(), &body].concat();
        connection.get_mut().write_all(&request).unwrap();
        let body = read_message(connection).expect("rosmaster closed the connection");
        decode_reply(&body).expect("a reply that cannot be decoded")
    }
}

impl Drop for Rosmaster {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// The body of an HTTP message; none if the connection was closed before it.
pub(crate) fn read_message(connection: &mut BufReader<TcpStream>) -> Option<Vec<u8>> {
    let mut length = 0;
    loop {
        let mut line = String::new();
        if connection.read_line(&mut line).ok()? == 0 {
            return None;
        }
        let line = line.trim_end().to_ascii_lowercase();
        if let Some(value) = line.strip_prefix("content-length:") {
            length = value.trim().parse().ok()?;
        } else if line.is_empty() {
            break;
        }
    }
    let mut body = vec![0; length];
    connection.read_exact(&mut body).ok()?;
    Some(body)
}

const LOGGING: &str = "[loggers]
keys=root
[handlers]
keys=none
[formatters]
keys=
[logger_root]
level=CRITICAL
handlers=none
[handler_none]
class=NullHandler
args=()
";
