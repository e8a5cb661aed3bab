//! A relay between rosrescue and a master that can swallow replies.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::thread;

use super::rescue::{Rescue, Setup};
use super::ros::Rosmaster;
use super::scratch::Scratch;

/// A text in requests, and how many replies to such requests are still to be swallowed.
type Swallow = Arc<Mutex<(Vec<u8>, u32)>>;

/// Relays connections to a port on this computer. It ends with the test's process.
#[derive(Debug)]
pub(crate) struct Relay {
    port: u16,
    to_swallow: Swallow,
    target: Arc<Mutex<u16>>,
    /// The open connections to the present target.
    open: Arc<Mutex<Vec<TcpStream>>>,
}

impl Relay {
    /// A rosmaster, a relay in front of it, and rosrescue in front of the relay.
    pub(crate) fn between(scratch: &Scratch) -> (Rosmaster, Self, Rescue) {
        let master = Rosmaster::start(scratch);
        let relay = Self::to(master.port);
        let rescue = Setup::proxy(scratch, relay.port()).start();
        (master, relay, rescue)
    }

    /// Starts a relay to `port`.
    pub(crate) fn to(port: u16) -> Self {
        let listener = TcpListener::bind(("127.0.0.1", 0)).unwrap();
        let to_swallow = Swallow::default();
        let (target, open) = (Arc::new(Mutex::new(port)), Arc::default());
        let relay = Self {
            port: listener.local_addr().unwrap().port(),
            to_swallow: to_swallow.clone(),
            target: Arc::clone(&target),
            open: Arc::clone(&open),
        };
        thread::spawn(move || {
            for near in listener.incoming().map_while(Result::ok) {
                let port = *target.lock().unwrap();
                // If there is no master, the connection is closed.
                if let Ok(far) = TcpStream::connect(("127.0.0.1", port)) {
                    let to_swallow = to_swallow.clone();
                    open.lock().unwrap().push(near.try_clone().unwrap());
                    thread::spawn(move || carry(&near, &far, &to_swallow));
                }
            }
        });
        relay
    }

    /// The port at which the relay listens.
    pub(crate) fn port(&self) -> u16 {
        self.port
    }

    /// Relays to `port` from now on, and ends the present connections: as when a virtual address moves, or,
    /// if no process listens there, when a cable is cut.
    pub(crate) fn turn_to(&self, port: u16) {
        *self.target.lock().unwrap() = port;
        for connection in self.open.lock().unwrap().drain(..) {
            let _ = connection.shutdown(Shutdown::Both);
        }
    }

    /// Lets the next `count` requests that contain `marker` reach the master, but closes their connections
    /// instead of passing on the replies.
    pub(crate) fn swallow(&self, marker: &str, count: u32) {
        *self.to_swallow.lock().unwrap() = (marker.into(), count);
    }

    /// How many replies are still to be swallowed.
    pub(crate) fn to_swallow(&self) -> u32 {
        self.to_swallow.lock().unwrap().1
    }
}

fn carry(near: &TcpStream, far: &TcpStream, to_swallow: &Swallow) {
    let request = Arc::new(Mutex::new(Vec::new()));
    let (mut from, mut to) = (near.try_clone().unwrap(), far.try_clone().unwrap());
    let seen = request.clone();
    thread::spawn(move || {
        let mut buffer = [0; 65536];
        while let Ok(count @ 1..) = from.read(&mut buffer) {
            seen.lock().unwrap().extend_from_slice(&buffer[..count]);
            if to.write_all(&buffer[..count]).is_err() {
                break;
            }
        }
        let _ = to.shutdown(Shutdown::Both);
    });
    let (mut far, mut near) = (far, near);
    let mut buffer = [0; 65536];
    while let Ok(count @ 1..) = far.read(&mut buffer) {
        // The master has run the request, because it answers.
        let request = std::mem::take(&mut *request.lock().unwrap());
        let mut to_swallow = to_swallow.lock().unwrap();
        let (marker, left) = &mut *to_swallow;
        if *left > 0 && request.windows(marker.len()).any(|part| part == marker) {
            *left -= 1;
            break;
        }
        drop(to_swallow);
        if near.write_all(&buffer[..count]).is_err() {
            break;
        }
    }
    let _ = near.shutdown(Shutdown::Both);
    let _ = far.shutdown(Shutdown::Both);
}
