//! Registering names must not make rosrescue flood the host to which they point.

use std::net::{Ipv4Addr, TcpListener};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::Call;

use crate::support::{Client, Mode, Robot, eventually, names, params};

/// A host that counts connections and closes them without an answer.
struct Host {
    ports: Vec<u16>,
    connections: Arc<Mutex<Vec<Instant>>>,
    done: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Host {
    fn with_ports(count: usize) -> Self {
        let listen = |_| {
            let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
            listener.set_nonblocking(true).unwrap();
            listener
        };
        let listeners: Vec<_> = (0..count).map(listen).collect();
        let port = |listener: &TcpListener| listener.local_addr().unwrap().port();
        let ports = listeners.iter().map(port).collect();
        let connections = Arc::<Mutex<Vec<_>>>::default();
        let done = Arc::<AtomicBool>::default();
        let (seen, stop) = (connections.clone(), done.clone());
        let accept = move || {
            while !stop.load(Ordering::Relaxed) {
                for listener in &listeners {
                    while listener.accept().is_ok() {
                        seen.lock().unwrap().push(Instant::now());
                    }
                }
                thread::sleep(Duration::from_millis(20));
            }
        };
        Self {
            ports,
            connections,
            done,
            thread: Some(thread::spawn(accept)),
        }
    }

    /// Number of connections since `start`.
    fn since(&self, start: Instant) -> usize {
        let connections = self.connections.lock().unwrap();
        connections.iter().filter(|at| **at >= start).count()
    }

    /// Registers `count` names, each with a different address. The ports are used in turn.
    fn register(&self, client: &Client, count: usize) {
        let call = |(name, port): (usize, &u16)| {
            let api = format!("http://127.0.0.1:{port}/{name}/");
            let name = format!("/name{name}");
            let call = params![name, "/topic", "std_msgs/String", api];
            Call::new("registerPublisher", call)
        };
        let calls: Vec<_> = (0..count)
            .zip(self.ports.iter().cycle())
            .map(call)
            .collect();
        client.call_all(&calls);
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        self.done.store(true, Ordering::Relaxed);
        let _ = self.thread.take().unwrap().join();
    }
}

/// A number of connections, and the time in which they were made.
type Connections = (usize, Duration);

/// Registers `count` names at the ports of `host`, and kills the master after 5 s. Returns the connections before that,
/// and for each of `windows` those from then on until that many seconds after the recovery, or more on a busy computer.
fn connections<const N: usize>(
    robot: &mut Robot,
    host: &Host,
    count: usize,
    windows: [u64; N],
) -> (Connections, [Connections; N]) {
    let since = |start: Instant, span: Duration| {
        thread::sleep(span.saturating_sub(start.elapsed()));
        let count = host.since(start);
        (count, start.elapsed())
    };
    let start = Instant::now();
    host.register(&robot.client(), count);
    let before = since(start, Duration::from_secs(5));
    let start = Instant::now();
    robot.crash_master();
    let outage = start.elapsed();
    let after = windows.map(|seconds| since(start, outage + Duration::from_secs(seconds)));
    let ports = host.ports.len();
    println!(
        "{count} names at {ports} ports: {before:?} connections, {after:?} after {windows:?} s"
    );
    (before, after)
}

#[test]
fn names_at_one_port_share_a_visit() {
    let mut robot = Robot::start(Mode::Core);
    let host = Host::with_ports(1);
    const NAMES: usize = 100;
    let ((before, _), [(soon, _), (later, _)]) = connections(&mut robot, &host, NAMES, [2, 12]);
    // One question for names that register together, one visit after the recovery, and further ones after 1,
    // 3 and 7 s.
    assert!(before <= 20, "{before}");
    assert!(soon <= 4 && later <= 10, "{soon}, {later}");
    let unreachable = names(&robot.status().unwrap()["unreachable"]).len();
    assert_eq!(unreachable, NAMES);
    // One refused connection counts for all names.
    drop(host);
    eventually("the dead nodes are unregistered", || {
        let nodes = robot.status().unwrap()["state"]["nodes"].as_u64();
        nodes < Some(10)
    });
}

/// Each host gets 400 visits at once and then 100 per second.
#[test]
fn all_ports_of_a_host_share_one_rate_limit() {
    let mut robot = Robot::start(Mode::Core);
    let host = Host::with_ports(1200);
    let (before, [after]) = connections(&mut robot, &host, 1200, [2]);
    let most = |time: Duration| 400.0 + 100.0 * time.as_secs_f64();
    assert!(before.0 as f64 <= most(before.1), "{before:?}");
    assert!(after.0 as f64 <= most(after.1) + 100.0, "{after:?}");
}
