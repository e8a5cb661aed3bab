//! The real rosmaster, for what only it can tell.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rosrescue::xmlrpc::{Call, Value, encode_call};
use tempfile::TempDir;

pub(crate) struct Master {
    child: Child,
    port: u16,
    _scratch: TempDir,
}

impl Master {
    pub(crate) fn start() -> Self {
        let scratch = tempfile::tempdir().unwrap();
        let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let port = free.local_addr().unwrap().port();
        drop(free);
        let child = Command::new("/usr/bin/python3")
            .args(["/usr/bin/rosmaster", "--core", "-p", &port.to_string()])
            .env("ROS_IP", "127.0.0.1")
            .env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"))
            .env("ROS_HOME", scratch.path())
            .env("ROS_LOG_DIR", scratch.path())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let master = Self {
            child,
            port,
            _scratch: scratch,
        };
        let deadline = Instant::now() + Duration::from_secs(30);
        while TcpStream::connect((Ipv4Addr::LOCALHOST, port)).is_err() {
            assert!(Instant::now() < deadline, "rosmaster does not listen");
            sleep(Duration::from_millis(10));
        }
        master
    }

    /// The body of its answer.
    pub(crate) fn call(&self, method: &str, params: Vec<Value>) -> Vec<u8> {
        let body = encode_call(&Call::new(method, params));
        let head = format!(
            "POST /RPC2 HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/xml\r\n\
             Content-Length: {}\r\nConnection: close\r\n\r\n",
            body.len()
        );
        let mut stream = TcpStream::connect((Ipv4Addr::LOCALHOST, self.port)).unwrap();
        stream
            .set_read_timeout(Some(Duration::from_secs(30)))
            .unwrap();
        stream
            .write_all(&[head.as_bytes(), &body].concat())
            .unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer
            .windows(4)
            .position(|window| window == b"\r\n\r\n")
            .unwrap();
        answer.split_off(end + 4)
    }
}

impl Drop for Master {
    fn drop(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}
