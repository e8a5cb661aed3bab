//! rosrescue under systemd: it gets sockets by `sd_listen_fds(3)` and reports its state by `sd_notify(3)`.
//! The test plays the part of systemd.

use std::fs;
use std::net::TcpListener;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixDatagram;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::support::{
    Client, PATIENCE, Rosmaster, Scratch, Setup, behind, eventually, free_port, status,
};
use command_fds::{CommandFdExt, FdMapping};
use rustix::process::Signal;

/// Runs `command` like a unit's process that gets `socket` as file descriptor 3.
fn activated(command: &Command, socket: OwnedFd) -> Command {
    let mut shell = Command::new("sh");
    // `LISTEN_PID` is the process id of the shell, which then becomes the program.
    shell.args(["-c", r#"LISTEN_PID=$$ exec "$0" "$@""#]);
    let mut command = behind(shell, command);
    let mapping = FdMapping {
        parent_fd: socket,
        child_fd: 3,
    };
    command.env("LISTEN_FDS", "1");
    command.fd_mappings(vec![mapping]).unwrap();
    command
}

/// systemd's side of a notification socket.
struct Manager {
    socket: UnixDatagram,
    heard: Vec<String>,
}

impl Manager {
    fn new(scratch: &Scratch) -> Self {
        let socket = UnixDatagram::bind(scratch.path("notify")).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        let heard = Vec::new();
        Self { socket, heard }
    }

    /// Waits for a line that starts with `assignment`.
    #[track_caller]
    fn wait(&mut self, assignment: &str) {
        let mut buffer = [0; 4096];
        loop {
            let length = self.socket.recv(&mut buffer);
            let length = length.unwrap_or_else(|_| panic!("no {assignment}: {:?}", self.heard));
            let message = String::from_utf8(buffer[..length].to_vec()).unwrap();
            let lines: Vec<_> = message.lines().map(str::to_owned).collect();
            let found = lines.iter().any(|line| line.starts_with(assignment));
            self.heard.extend(lines);
            if found {
                return;
            }
        }
    }

    fn has_heard(&self, assignment: &str) -> bool {
        self.heard.iter().any(|line| line == assignment)
    }
}

#[test]
fn with_a_socket_unit_systemd_replaces_the_guardian() {
    let scratch = Scratch::new();
    let mut manager = Manager::new(&scratch);
    let master_port = free_port();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let master = format!("http://127.0.0.1:{master_port}");
    let setup = Setup::bare(&scratch, ["proxy", "--master", &master])
        .guarded()
        .env("NOTIFY_SOCKET", scratch.path("notify"))
        .env("WATCHDOG_USEC", "300000");
    let socket = listener.try_clone().unwrap();
    let mut rescue = setup
        .wrapped(|own| activated(own, socket.into()))
        .at_port(port)
        .spawn();
    manager.wait("STATUS=waiting for the first master: Calls wait");
    manager.wait("WATCHDOG=1");
    assert!(!manager.has_heard("READY=1"));
    let mut master = Rosmaster::start_at(&scratch, master_port);
    manager.wait("READY=1");
    rescue.wait_serving();
    let uri = format!("ROS_MASTER_URI=http://127.0.0.1:{port}/");
    assert!(rescue.stdout().contains(&uri), "{:?}", rescue.stdout());
    manager.wait("STATUS=protected");
    manager.wait("WATCHDOG=1");
    let page = status(&rescue.client());
    assert_eq!(page["guarded"], true);
    assert_eq!(page["guarded_by"], "systemd");
    master.kill();
    manager.wait("STATUS=standing in for the master: Nodes keep working");

    // After a crash, systemd starts the program again with the same socket.
    rescue.kill();
    let waiting = Client::new(port).connect();
    assert!(waiting.is_ok(), "a connection is refused");
    rescue.start_again();
    let _master = Rosmaster::start_at(&scratch, master_port);
    manager.wait("READY=1");
    rescue.signal(Signal::TERM);
    manager.wait("STOPPING=1");
    assert_eq!(rescue.wait().code(), Some(0));
}

/// A service without a socket unit: the guardian is the main process, and the worker notifies systemd.
#[test]
fn the_worker_of_a_guardian_notifies_systemd() {
    let scratch = Scratch::new();
    let mut manager = Manager::new(&scratch);
    let rescue = Setup::core(&scratch, free_port())
        .args(["--no-rosout"])
        .guarded()
        .env("NOTIFY_SOCKET", scratch.path("notify"));
    let mut rescue = rescue
        .wrapped(|own| {
            let mut shell = Command::new("sh");
            shell.args(["-c", r#"WATCHDOG_PID=$$ exec "$0" "$@""#]);
            let mut command = behind(shell, own);
            command.env("WATCHDOG_USEC", "300000");
            command
        })
        .spawn();
    manager.wait("READY=1");
    manager.wait("WATCHDOG=1");
    rescue.signal(Signal::TERM);
    manager.wait("STOPPING=1");
    assert_eq!(rescue.wait().code(), Some(0));
}

/// The test fills the notification socket. On one core rosrescue has only one thread for all calls.
#[test]
fn a_systemd_that_reads_no_notifications_delays_no_call() {
    let scratch = Scratch::new();
    let manager = Manager::new(&scratch);
    let mut rescue = Setup::core(&scratch, free_port())
        .args(["--no-rosout"])
        .env("NOTIFY_SOCKET", scratch.path("notify"))
        .env("WATCHDOG_USEC", "2000")
        .wrapped(|own| {
            let status = fs::read_to_string("/proc/self/status").unwrap();
            let list = status.split_once("Cpus_allowed_list:").unwrap().1;
            let core = list.trim().split(|c: char| !c.is_ascii_digit()).next();
            let mut pinned = Command::new("taskset");
            pinned.args(["-c", core.unwrap()]);
            behind(pinned, own)
        })
        .start();
    let full = UnixDatagram::unbound().unwrap();
    full.set_nonblocking(true).unwrap();
    full.connect(scratch.path("notify")).unwrap();
    eventually("the socket is full", || full.send(b"X=1").is_err());
    let client = rescue.client();
    for round in 0..100 {
        client.set_param("/round", round);
    }
    assert_eq!(rescue.terminate().code(), Some(0));
    drop(manager);
}

#[test]
fn a_descriptor_that_is_not_a_listening_socket_is_refused() {
    let scratch = Scratch::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let connected = std::net::TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let datagram = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    for socket in [OwnedFd::from(connected), datagram.into()] {
        let setup = Setup::bare(&scratch, ["proxy", "--master", "http://127.0.0.1:1"]);
        let mut rescue = setup.wrapped(|own| activated(own, socket)).spawn();
        assert_eq!(rescue.wait_output().code(), Some(1));
        let said = rescue.stderr().join("\n");
        assert!(said.contains("ListenStream="), "{said}");
    }
}

/// systemd starts it again 50 ms later, and never gives up.
#[test]
fn a_start_that_fails_under_systemd_takes_two_seconds() {
    let scratch = Scratch::new();
    let wrong_option = ["proxy", "--master", "http://127.0.0.1:1", "--hold", "10s"];
    let no_program = ["core", "--rosmaster", "/nowhere"];
    for (arguments, status) in [(&wrong_option[..], 2), (&no_program, 1)] {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let setup = Setup::bare(&scratch, arguments);
        let start = Instant::now();
        let mut rescue = setup.wrapped(|own| activated(own, listener.into())).spawn();
        assert_eq!(rescue.wait_output().code(), Some(status));
        let took = start.elapsed();
        assert!(took >= Duration::from_secs(2), "{arguments:?}: {took:?}");
    }
}

/// Sockets meant for another process are left alone.
#[test]
fn sockets_for_another_process_are_not_used() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let setup = Setup::proxy(&scratch, master.client().port())
        .env("LISTEN_FDS", "1")
        .env("LISTEN_PID", "1");
    let rescue = setup.start();
    rescue.client().set_param("/x", 1);
    assert_eq!(status(&rescue.client())["guarded"], false);
}
