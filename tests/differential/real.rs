//! Starts real rosmasters and calls them.

use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use ros1_master::{
    master::{Master, Request},
    xmlrpc::{Call, Reply, Value, decode_reply, encode_call},
};

use crate::support::{self, Client, PATIENCE, Scratch, find_program, free_port, http_request};

/// A rosmaster that is killed when this is dropped.
pub(crate) struct Rosmaster {
    process: Child,
    pub(crate) port: u16,
    pub(crate) scratch: Scratch,
}

impl Rosmaster {
    /// Starts a rosmaster without waiting for it.
    pub(crate) fn start() -> Self {
        Self::start_at(free_port())
    }

    /// Starts a rosmaster at `port` without waiting for it.
    pub(crate) fn start_at(port: u16) -> Self {
        let scratch = Scratch::new();
        // The default configuration has a screen handler that imports rospy, which doubles the time to start.
        let logging = scratch.path("logging.conf");
        std::fs::write(&logging, LOGGING).unwrap();
        let mut command = Command::new(find_program("rosmaster"));
        scratch.prepare(&mut command);
        let process = command
            .args(["--core", "-p", &port.to_string()])
            .env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"))
            .env("ROS_PYTHON_LOG_CONFIG_FILE", &logging)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("a rosmaster that can be run");
        Self {
            process,
            port,
            scratch,
        }
    }

    /// A connection, once the rosmaster answers.
    pub(crate) fn ready(&mut self) -> Wire {
        let deadline = Instant::now() + PATIENCE;
        loop {
            match Wire::connect(self.port) {
                Ok(wire) => return wire,
                Err(error) => {
                    let ended = self.process.try_wait().unwrap();
                    assert!(ended.is_none(), "rosmaster ended at its start: {ended:?}");
                    assert!(
                        Instant::now() < deadline,
                        "rosmaster does not listen: {error}"
                    );
                    std::thread::sleep(Duration::from_millis(5));
                }
            }
        }
    }

    /// Kills the rosmaster with SIGKILL and waits for its end.
    pub(crate) fn kill(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Drop for Rosmaster {
    fn drop(&mut self) {
        self.kill();
    }
}

/// The line in the log of a rosmaster, which writes to `scratch`, that says that it has lost a callback. A struct in a
/// callback is the dict of the parameter tree, and cannot be encoded if a later call changes its keys meanwhile.
pub(crate) fn lost_callback(scratch: &Scratch) -> Option<String> {
    let log = std::fs::read(scratch.log_dir().join("master.log")).ok()?;
    let log = String::from_utf8_lossy(&log);
    let line = log.lines().find(|line| line.contains("during iteration"))?;
    Some(format!("rosmaster has lost a callback: {line}"))
}

/// A client's connection to a master.
pub(crate) struct Wire(support::Wire);

impl Wire {
    pub(crate) fn connect(port: u16) -> std::io::Result<Self> {
        Client::new(port).connect().map(Self)
    }

    /// Sends a call without waiting for the reply.
    pub(crate) fn send(&mut self, call: &Call) -> Result<(), String> {
        let sent = self.0.send(&http_request(&encode_call(call)));
        sent.map_err(|error| format!("the call cannot be sent: {error}"))
    }

    /// Waits for the reply to the call that was sent.
    pub(crate) fn receive(&mut self) -> Result<Reply, String> {
        let answer = self.0.response();
        let answer = answer.map_err(|error| format!("no answer: {error}"))?;
        decode_reply(&answer.body).map_err(|error| error.to_string())
    }

    /// Sends a call and reads the reply.
    pub(crate) fn call(&mut self, call: &Call) -> Result<Reply, String> {
        self.send(call)?;
        self.receive()
    }

    /// Like [`Self::call`], for a call that rosrescue makes.
    pub(crate) fn ask(&mut self, call: &Request) -> Result<Reply, String> {
        let sent = self.0.send(&http_request(&call.encode()));
        sent.map_err(|error| format!("the call cannot be sent: {error}"))?;
        self.receive()
    }

    /// Process id and address of the master.
    pub(crate) fn identity(&mut self) -> (i32, String) {
        let mut ask = |method: &str| match self.call(&Call::new(method, vec!["/test".into()])) {
            Ok(Reply::Value(Value::Array(mut answer))) => answer.pop().unwrap(),
            other => panic!("{method}: {other:?}"),
        };
        let (pid, uri) = (ask("getPid"), ask("getUri"));
        (pid.as_int().unwrap(), uri.as_str().unwrap().to_owned())
    }

    /// Makes the model answer and notify like this master.
    pub(crate) fn identify(&mut self, model: &mut Master) {
        let (pid, uri) = self.identity();
        model.set_identity(pid, uri);
        let answer = self.ask(&Master::ask_if_old()).unwrap();
        model.set_old(Master::shows_old(&answer));
    }
}

/// The log has only what [`lost_callback`] reads.
const LOGGING: &str = "[loggers]
keys=root,notifiers
[handlers]
keys=none,file
[formatters]
keys=
[logger_root]
level=CRITICAL
handlers=none
[logger_notifiers]
qualname=rosmaster.threadpool
level=ERROR
handlers=file
[handler_none]
class=NullHandler
args=()
[handler_file]
class=FileHandler
args=(os.environ['ROS_LOG_FILENAME'],)
";
