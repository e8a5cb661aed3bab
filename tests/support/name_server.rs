//! A name server that gives every name the same address, late or never, for single processes.

use std::net::{Ipv4Addr, UdpSocket};
use std::path::PathBuf;
use std::process::Command;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use super::scratch::Scratch;

/// A name server on a loopback address of its own. Needs root. Ends with the test's process.
#[derive(Debug)]
pub(crate) struct NameServer {
    resolv: PathBuf,
    folder: PathBuf,
    answer: Arc<Mutex<Option<(Ipv4Addr, Duration)>>>,
}

impl NameServer {
    /// One that never answers.
    #[track_caller]
    pub(crate) fn silent(scratch: &Scratch) -> Self {
        static COUNT: AtomicU8 = AtomicU8::new(0);
        let id = std::process::id();
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let host = format!("127.{}.{}.{}", 64 + (id >> 8) % 128, id & 255, 153 + number);
        let socket = UdpSocket::bind((host.as_str(), 53));
        let socket = socket.expect("root, and the port of name servers");
        let resolv = scratch.path("resolv.conf");
        let text = format!("nameserver {host}\noptions timeout:5\n");
        std::fs::write(&resolv, text).unwrap();
        let answer = Arc::default();
        let says = Arc::clone(&answer);
        thread::spawn(move || serve(&socket, &says));
        Self {
            resolv,
            folder: scratch.path(""),
            answer,
        }
    }

    /// Every name is that of `address` from now on; it says so after `delay`.
    pub(crate) fn say(&self, address: Ipv4Addr, delay: Duration) {
        *self.answer.lock().unwrap() = Some((address, delay));
    }

    /// It answers no more.
    pub(crate) fn fall_silent(&self) {
        *self.answer.lock().unwrap() = None;
    }

    /// `command`, to be run with this as its name server: `unshare` gives it a resolv.conf of its own.
    pub(crate) fn serving(&self, command: &Command) -> Command {
        let mut serving = Command::new("unshare");
        serving
            .args(["--mount", "sh", "-c"])
            .arg(r#"mount --bind "$0" /etc/resolv.conf && exec "$@""#)
            .arg(&self.resolv)
            .arg(command.get_program())
            .args(command.get_args())
            .current_dir(&self.folder);
        for (key, value) in command.get_envs() {
            match value {
                Some(value) => serving.env(key, value),
                None => serving.env_remove(key),
            };
        }
        serving
    }
}

fn serve(socket: &UdpSocket, says: &Mutex<Option<(Ipv4Addr, Duration)>>) {
    let mut query = [0; 512];
    while let Ok((length, client)) = socket.recv_from(&mut query) {
        let Some((address, delay)) = *says.lock().unwrap() else {
            continue;
        };
        let reply = reply(&query[..length], address);
        let socket = socket.try_clone().unwrap();
        thread::spawn(move || {
            thread::sleep(delay);
            let _ = socket.send_to(&reply, client);
        });
    }
}

/// The reply to a query of one question: the address if it asks for one of IPv4, else none.
fn reply(query: &[u8], address: Ipv4Addr) -> Vec<u8> {
    let name = query[12..].iter().position(|&byte| byte == 0).unwrap();
    let question = &query[12..12 + name + 5];
    let wanted = question[name + 1..] == [0, 1, 0, 1];
    // Id, "a reply, recursion available, no error", counts, the question as it came.
    let mut reply = query[..2].to_vec();
    reply.extend([0x81, 0x80, 0, 1, 0, u8::from(wanted), 0, 0, 0, 0]);
    reply.extend(question);
    if wanted {
        // The name of the question, type A, class IN, for no time at all, four bytes.
        reply.extend([0xc0, 12, 0, 1, 0, 1, 0, 0, 0, 0, 0, 4]);
        reply.extend(address.octets());
    }
    reply
}
