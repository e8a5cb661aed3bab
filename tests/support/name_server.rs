//! A name server that a test runs for single processes.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, UdpSocket};
use std::path::PathBuf;
use std::process::Command;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use super::process::behind;
use super::scratch::Scratch;

/// A name server at a separate loopback address. Needs root. It ends with the test's process.
#[derive(Debug)]
pub(crate) struct NameServer {
    resolv: PathBuf,
    says: Arc<Mutex<Says>>,
}

/// How the name server answers.
#[derive(Debug)]
enum Says {
    Nothing,
    /// Every name has this address; the answer comes after this time.
    Always(Ipv4Addr, Duration),
    /// Only these hosts exist.
    Hosts(BTreeMap<String, Ipv4Addr>),
}

impl NameServer {
    /// Starts a name server that never answers.
    #[track_caller]
    pub(crate) fn silent(scratch: &Scratch) -> Self {
        Self::start(scratch, Says::Nothing)
    }

    /// Starts a name server that knows no hosts yet.
    #[track_caller]
    pub(crate) fn of_hosts(scratch: &Scratch) -> Self {
        Self::start(scratch, Says::Hosts(BTreeMap::new()))
    }

    #[track_caller]
    fn start(scratch: &Scratch, says: Says) -> Self {
        static COUNT: AtomicU8 = AtomicU8::new(0);
        let id = std::process::id();
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let host = format!("127.{}.{}.{}", 64 + (id >> 8) % 128, id & 255, 53 + number);
        let socket = UdpSocket::bind((host.as_str(), 53));
        let socket = socket.expect("the port of name servers cannot be bound: it needs root");
        let resolv = scratch.path("resolv.conf");
        let text = format!("nameserver {host}\noptions timeout:5\n");
        std::fs::write(&resolv, text).unwrap();
        let says = Arc::new(Mutex::new(says));
        let this = Self {
            resolv,
            says: says.clone(),
        };
        thread::spawn(move || serve(&socket, &says));
        this
    }

    /// Gives every name this address from now on, and answers after `delay`.
    pub(crate) fn say(&self, address: Ipv4Addr, delay: Duration) {
        *self.says.lock().unwrap() = Says::Always(address, delay);
    }

    /// Stops answering.
    pub(crate) fn fall_silent(&self) {
        *self.says.lock().unwrap() = Says::Nothing;
    }

    /// Adds a host, or moves it to another address.
    pub(crate) fn set(&self, host: &str, address: Ipv4Addr) {
        let mut says = self.says.lock().unwrap();
        let Says::Hosts(hosts) = &mut *says else {
            panic!("this name server has no list of hosts");
        };
        hosts.insert(host.to_owned(), address);
    }

    /// Wraps `command` so that it uses this name server: `unshare` gives it a separate resolv.conf.
    pub(crate) fn serving(&self, command: &Command) -> Command {
        let mut unshare = Command::new("unshare");
        unshare
            .args(["--mount", "sh", "-c"])
            .arg(r#"mount --bind "$0" /etc/resolv.conf && exec "$@""#)
            .arg(&self.resolv);
        behind(unshare, command)
    }
}

fn serve(socket: &UdpSocket, says: &Mutex<Says>) {
    let mut query = [0; 512];
    while let Ok((length, client)) = socket.recv_from(&mut query) {
        let query = &query[..length];
        let (address, delay) = match &*says.lock().unwrap() {
            Says::Nothing => continue,
            Says::Always(address, delay) => (Some(*address), *delay),
            Says::Hosts(hosts) => (hosts.get(&host(query)).copied(), Duration::ZERO),
        };
        let reply = reply(query, address);
        let socket = socket.try_clone().unwrap();
        thread::spawn(move || {
            thread::sleep(delay);
            let _ = socket.send_to(&reply, client);
        });
    }
}

/// The host name in a query with one question.
fn host(query: &[u8]) -> String {
    let (mut labels, mut at) = (Vec::new(), 12);
    while query[at] != 0 {
        let end = at + 1 + usize::from(query[at]);
        labels.push(String::from_utf8_lossy(&query[at + 1..end]));
        at = end;
    }
    labels.join(".")
}

/// The reply to a query with one question: the address if the question is for IPv4, or NXDOMAIN if there is
/// no such host.
fn reply(query: &[u8], address: Option<Ipv4Addr>) -> Vec<u8> {
    let name = query[12..].iter().position(|&byte| byte == 0).unwrap();
    let question = &query[12..12 + name + 5];
    let code = if address.is_some() { 0 } else { 3 };
    let address = address.filter(|_| question[name + 1..] == [0, 1, 0, 1]);
    // Id, flags "reply, recursion available" with the code, counts, and the question unchanged.
    let mut reply = query[..2].to_vec();
    let count = u8::from(address.is_some());
    reply.extend([0x81, 0x80 | code, 0, 1, 0, count, 0, 0, 0, 0]);
    reply.extend(question);
    if let Some(address) = address {
        // The name in the question, type A, class IN, time to live 0, length 4.
        reply.extend([0xc0, 12, 0, 1, 0, 1, 0, 0, 0, 0, 0, 4]);
        reply.extend(address.octets());
    }
    reply
}
